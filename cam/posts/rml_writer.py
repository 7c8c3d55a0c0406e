"""The writer of RML-1."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from numba import njit

from cam.moves import Motion, Path
from cam.posts.lines import UNKNOWN, write_number
from cam.posts.post import RmlPost
from cam.posts.setup import ProgramSetup

FASTEST_MM_PER_S = 50.0
DWELL_S = 4.0
_LONGEST_WAIT_MS = 30_000  # of a range that ends at 32,767
_TOP_UNITS = 10_500  # a height that no mill of the kind reaches: it stops at its top
_TOP = f"^PR;Z0,0,{_TOP_UNITS};^PA;"  # from wherever the tool stands
_POINTS_AT_ONCE = 40_000
_MOST_BYTES_PER_LINE = 64


class RmlWriter:
    """Paths to commands; the speed only where it changes."""

    def __init__(self, post: RmlPost) -> None:
        self._post = post
        self._raised = False  # the head stands at its top: the tool must get over its place before it comes down
        self._speed: str | None = None
        self._place = np.full(3, UNKNOWN, dtype=np.int64)
        self._line_end = np.frombuffer(f";{post.line_end}".encode("ascii"), dtype=np.uint8)
        self._buffer = np.empty(_POINTS_AT_ONCE * _MOST_BYTES_PER_LINE, dtype=np.uint8)

    def start(
        self,
        remarks: tuple[str, ...],
        *,
        rpm: float,
        safe_z_mm: float,
        program: int = 1,
        setup: ProgramSetup | None = None,
        trace: Iterable[Path] = (),
    ) -> bytes:
        """Write defaults, up, trace, spindle up to speed. The language has no remarks, program names or coolant."""
        self._speed, self._place[:] = _speed_word(FASTEST_MM_PER_S), UNKNOWN
        self._raised = True
        begin = self._lines(";;^DF;", "!MC0;", f"{self._speed};", _TOP)
        traced = b"".join(piece for path in trace for piece in self.write(path))
        steps = (setup or ProgramSetup()).spindle_steps(rpm, dwell_s=DWELL_S)
        spin = [
            self._lines(f"!RC{speed:.0f};", *["!MC1;"] * (number == 0), *_waits(dwell_s))
            for number, (speed, dwell_s) in enumerate(steps)
        ]
        return b"".join([begin, traced, *spin])

    def end(self, *, safe_z_mm: float, setup: ProgramSetup | None = None) -> bytes:
        self._place[:] = UNKNOWN
        return self._lines(f"{_speed_word(FASTEST_MM_PER_S)};", _TOP, "!MC0;", "^DF;")

    def _lines(self, *commands: str) -> bytes:
        return "".join(command + self._post.line_end for command in commands).encode("ascii")

    def write(self, path: Path) -> Iterator[bytes]:
        """Yield commands of one path in pieces; a point that rounds to where the tool stands makes none."""
        if self._raised:
            yield self._go_over(path)
        if path.motion is Motion.RAPID:
            speed = _speed_word(FASTEST_MM_PER_S)
        else:
            assert path.feed_mm_per_min is not None
            tenths = min(max(1, math.floor(path.feed_mm_per_min / 6 + 1e-9)), round(10 * FASTEST_MM_PER_S) - 1)
            speed = _speed_word(tenths / 10)
        for first in range(0, len(path.points_mm), _POINTS_AT_ONCE):
            size = _write_triples(
                path.points_mm[first : first + _POINTS_AT_ONCE],
                *(self._place, 1 / self._post.unit_mm, self._line_end, self._buffer),
            )
            if size:
                head = b"" if speed == self._speed else self._lines(speed + ";")
                self._speed = speed
                yield head + self._buffer[:size].tobytes()

    def _go_over(self, path: Path) -> bytes:
        """Write the way across to where a path begins, along the top. Every move states X, Y and Z."""
        self._raised = False
        x, y = (math.floor(value / self._post.unit_mm + 0.5) for value in path.points_mm[0, :2])
        return self._lines(f"Z{x},{y},{_TOP_UNITS};")


def _waits(dwell_s: float) -> list[str]:
    """Return commands that stand still for a time, none of them longer than the language can say."""
    whole, rest = divmod(round(1000 * dwell_s), _LONGEST_WAIT_MS)
    return [f"W{milliseconds};" for milliseconds in [_LONGEST_WAIT_MS] * whole + [rest] * (rest > 0)]


def _speed_word(mm_per_s: float) -> str:
    return f"V{mm_per_s:.1f}"


@njit(cache=True, nogil=True)
def _write_triples(points, place, per_mm, line_end, out):  # type: ignore[no-untyped-def]
    """Write points (n, 3) as Z commands into out; place (3,) int64 is updated. Returns the bytes written."""
    at = 0
    for k in range(points.shape[0]):
        moved = False
        for a in range(3):
            value = np.int64(math.floor(points[k, a] * per_mm + 0.5))
            if value != place[a]:
                place[a] = value
                moved = True
        if not moved:
            continue
        for a in range(3):
            out[at] = 90 if a == 0 else 44  # Z, then commas
            at = write_number(place[a], 0, 0, out, at + 1)
        for c in line_end:
            out[at] = c
            at += 1
    return at
