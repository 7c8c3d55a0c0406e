"""The writers that turn the paths of one program into its text: one of G-code, one of RML-1."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np
from numba import njit

from cam.moves import Array, Motion, Path
from cam.posts.dialects import Dialect
from cam.posts.lines import MOST_BYTES_PER_LINE, UNKNOWN, write_lines, write_number
from cam.posts.post import HIGH_PRECISION_WORDS, Post, ProgramSetup, RmlPost, number

POINTS_AT_ONCE = 40_000

# of RML-1
FASTEST_MM_PER_S = 50.0
DWELL_S = 4.0
_LONGEST_WAIT_MS = 30_000  # of a range that ends at 32,767
_TOP_UNITS = 10_500  # a height that no mill of this kind reaches: it stops at its top
_TOP = f"^PR;Z0,0,{_TOP_UNITS};^PA;"  # from any position of the tool


class Writer(Protocol):
    """The modal state of one program while it is written: start, then paths, then end."""

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
        """Write everything before the first cut: modes, safe height, the trace in the air, spindle up to speed, and all
        that `setup` switches on. program: number, from 1; trace: paths run before the spindle turns, where the control
        allows that.
        """

    def write(self, path: Path) -> Iterator[bytes]:
        """Yield blocks of one path, in pieces."""

    def end(self, *, safe_z_mm: float, setup: ProgramSetup | None = None) -> bytes:
        """Write everything after the last move: up, all off, end."""


def create_writer(dialect: Dialect) -> Writer:
    """Return the writer of one program in a dialect."""
    match dialect:
        case Post():
            return ProgramWriter(dialect)
        case RmlPost():
            return RmlWriter(dialect)


class ProgramWriter:
    """Turns paths into blocks without repeating unchanged words. Its only state is the modal state."""

    def __init__(self, post: Post) -> None:
        self.post = post
        self._raised = False  # the head is at its top: the tool must move over its place before it comes down
        self._tool = 0  # tool whose length has not been taken into account yet, with the head at its top
        self._safe_z = ""
        self._motion: str | None = None
        self._feed: float | None = None
        self._state = np.array([UNKNOWN, UNKNOWN, UNKNOWN, 0], dtype=np.int64)
        self._letters, self._gap, self._line_end = map(_bytes, (post.axes, post.between_words, post.line_end))
        self._decimals = np.array([post.xy_decimals, post.xy_decimals, post.z_decimals], dtype=np.int64)
        self._buffer = np.empty(POINTS_AT_ONCE * MOST_BYTES_PER_LINE, dtype=np.uint8)

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
        """Write tape mark, name and remarks, then the first blocks: modes, way up, trace, spindle, coolant."""
        post, setup = self.post, setup or ProgramSetup()
        self._tool = setup.tool
        first, *further = setup.spindle_steps(rpm, dwell_s=post.spindle_dwell_s)
        values: dict[str, object] = {"number": program, "blend": self._blend(setup), **self._heights(setup, safe_z_mm)}
        values["tool"] = setup.tool
        values |= {"offset": f"G{53 + setup.work_offset}", "offset_number": setup.work_offset}
        begin, zero = {**values, **self._spin(*first)}, post.zero.format(**values)
        if setup.tool:
            offset = post.name_offset(setup.work_offset)
            zero = f"zero: {offset}, T{setup.tool} with its length H{setup.tool} in the control's table"
        self._raised = setup.top_z_mm is not None
        return b"".join(
            [
                self._write_templates(post.tape, values),
                *(
                    post.remark(remark)
                    for remark in (*remarks, zero, *_describe_beginning(post, setup, safe_z_mm))
                    if remark
                ),
                self._write_templates((*post.start, *self._change(setup), self._first_way_up(setup)), begin),
                *(piece for path in trace for piece in self.write(path)),
                self._write_templates((post.stop,) if setup.optional_stop else (), begin),
                self._write_templates(post.spin, begin),
                *(self._write_templates(post.faster or post.spin, self._spin(*step)) for step in further),
                self._write_templates(_on(post, setup), {}),
            ]
        )

    def end(self, *, safe_z_mm: float, setup: ProgramSetup | None = None) -> bytes:
        """Write the way up, if the tool is not there; switch off what the start switched on, spindle off, end."""
        setup = setup or ProgramSetup()
        is_up = setup.top_z_mm is None and self._state[2] == math.floor(safe_z_mm * 10**self.post.z_decimals + 0.5)
        way_up = () if is_up and self._motion == self.post.rapid else (self._way_up(setup),)
        return self._write_templates((*way_up, *_off(setup), *self.post.end), self._heights(setup, safe_z_mm))

    def _way_up(self, setup: ProgramSetup) -> str:
        return self.post.lift if setup.top_z_mm is None else self.post.top

    def _change(self, setup: ProgramSetup) -> tuple[str, ...]:
        return self.post.change if setup.tool else ()

    def _first_way_up(self, setup: ProgramSetup) -> str:
        """Return the first block with Z; the tool's length belongs to the first in the work frame."""
        if setup.tool and setup.top_z_mm is None:
            return self.post.lift.replace("Z", f"{self.post.length}Z")
        return self._way_up(setup)

    def _heights(self, setup: ProgramSetup, safe_z_mm: float) -> dict[str, object]:
        top_mm = setup.top_z_mm
        self._safe_z = self._length(safe_z_mm)
        return {"safe_z": self._safe_z, "top": "" if top_mm is None else self._length(top_mm)}

    def _blend(self, setup: ProgramSetup) -> str:
        tolerance_mm = self.post.usual_blend_mm if setup.blend_tolerance_mm is None else setup.blend_tolerance_mm
        rounded, stopped = self.post.blend
        tolerance = number(tolerance_mm / self.post.unit_mm, decimals=4 if self.post.unit_mm == 1.0 else 6)
        return rounded.format(tolerance=tolerance) if tolerance_mm > 0 else stopped

    def _spin(self, rpm: float, dwell_s: float) -> dict[str, object]:
        return {"rpm": number(rpm), "dwell_s": self._number(dwell_s), "whole_dwell_s": f"{math.ceil(dwell_s)}"}

    def _number(self, value: float) -> str:
        return number(value, self.post.least_decimals)

    def _length(self, value_mm: float) -> str:
        return self._number(value_mm / self.post.unit_mm)

    def _write_templates(self, templates: tuple[str, ...], values: dict[str, object]) -> bytes:
        self._motion, self._feed = None, None  # the modes after the templates are not tracked
        self._state[:3] = UNKNOWN
        return b"".join(self.post.block(t.format(**values)) for t in templates)

    def write(self, path: Path) -> Iterator[bytes]:
        """Yield blocks of one path in pieces; a point that rounds to the tool's position makes no block."""
        if self._raised:
            yield self._go_over(path)
        motion = self.post.rapid if path.motion is Motion.RAPID else self.post.cut
        for first in range(0, len(path.points_mm), POINTS_AT_ONCE):
            opening = motion if motion != self._motion else ""
            new_feed = path.feed_mm_per_min is not None and path.feed_mm_per_min != self._feed
            closing = self._feed_word(path.feed_mm_per_min) if new_feed else ""  # type: ignore[arg-type]
            if text := self._lines(path.points_mm[first : first + POINTS_AT_ONCE], opening, closing):
                self._motion = motion
                if new_feed:
                    self._feed = path.feed_mm_per_min
                yield text

    def _go_over(self, path: Path) -> bytes:
        """Write the move across to the start of a path, at the height of the raised head."""
        self._raised, self._motion = False, self.post.rapid
        over_mm = path.points_mm[:1]
        # Treat the height as reached: no Z is written.
        self._state[2] = math.floor(over_mm[0, 2] / self.post.unit_mm * 10**self.post.z_decimals + 0.5)
        text = self._lines(over_mm, self.post.rapid, "")
        self._state[2] = UNKNOWN
        if not self._tool:
            return text
        down = f"{self.post.rapid}{self.post.length}Z{self._safe_z}".format(tool=self._tool)
        self._state[2] = math.floor(float(self._safe_z) * 10**self.post.z_decimals + 0.5)
        return text + self.post.block(down)

    def _lines(self, points_mm: Array, opening: str, closing: str) -> bytes:
        size, _ = write_lines(
            np.ascontiguousarray(points_mm / self.post.unit_mm),
            self._state,
            self._decimals,
            self._letters,
            self._gap,
            self._line_end,
            _bytes(opening),
            _bytes(closing),
            self.post.least_decimals,
            self.post.number_every,
            self._buffer,
        )
        return self._buffer[:size].tobytes()

    def _feed_word(self, feed_mm_per_min: float) -> str:
        scale = 10**self.post.feed_decimals
        units = max(1, math.floor(feed_mm_per_min / self.post.unit_mm * scale + 1e-6))
        return self.post.feed + number(units / scale, self.post.least_decimals if self.post.feed_decimals else 0)


def _describe_beginning(post: Post, setup: ProgramSetup, safe_z_mm: float) -> Iterator[str]:
    """Describe the unit, and where the tool may be when the program begins."""
    if post.unit_mm != 1.0:
        yield "all words of this program in inches"
    yield _describe_place(setup, safe_z_mm)


def _describe_place(setup: ProgramSetup, safe_z_mm: float) -> str:
    if setup.top_z_mm is None:
        return f"start: with the tool over the block, or not above Z{safe_z_mm:g}, where it goes first"
    return f"start: homed, from anywhere: up to machine Z{setup.top_z_mm:g}, across, down; ends up there"


def _on(post: Post, setup: ProgramSetup) -> tuple[str, ...]:
    coolant = () if setup.coolant == "none" else (post.coolant[setup.coolant],)
    precise = () if setup.high_precision == "none" else HIGH_PRECISION_WORDS[setup.high_precision][:1]
    return (*coolant, *precise)


def _off(setup: ProgramSetup) -> tuple[str, ...]:
    precise = () if setup.high_precision == "none" else HIGH_PRECISION_WORDS[setup.high_precision][1:]
    return (*precise, *(() if setup.coolant == "none" else ("M9",)))


def _bytes(text: str) -> np.ndarray:
    return np.frombuffer(text.encode("ascii"), dtype=np.uint8)


class RmlWriter:
    """Turns paths into commands; writes the speed only when it changes."""

    def __init__(self, post: RmlPost) -> None:
        self._post = post
        self._raised = False  # the head is at its top: the tool must move over its place before it comes down
        self._speed: str | None = None
        self._place = np.full(3, UNKNOWN, dtype=np.int64)
        self._line_end = np.frombuffer(f";{post.line_end}".encode("ascii"), dtype=np.uint8)
        self._buffer = np.empty(POINTS_AT_ONCE * MOST_BYTES_PER_LINE, dtype=np.uint8)

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
        """Yield commands of one path in pieces; a point that rounds to the tool's position makes none."""
        if self._raised:
            yield self._go_over(path)
        if path.motion is Motion.RAPID:
            speed = _speed_word(FASTEST_MM_PER_S)
        else:
            assert path.feed_mm_per_min is not None
            tenths = min(max(1, math.floor(path.feed_mm_per_min / 6 + 1e-9)), round(10 * FASTEST_MM_PER_S) - 1)
            speed = _speed_word(tenths / 10)
        for first in range(0, len(path.points_mm), POINTS_AT_ONCE):
            size = _write_triples(
                path.points_mm[first : first + POINTS_AT_ONCE],
                *(self._place, 1 / self._post.unit_mm, self._line_end, self._buffer),
            )
            if size:
                head = b"" if speed == self._speed else self._lines(speed + ";")
                self._speed = speed
                yield head + self._buffer[:size].tobytes()

    def _go_over(self, path: Path) -> bytes:
        """Write the move across to the start of a path, along the top. Every move states X, Y and Z."""
        self._raised = False
        x, y = (math.floor(value / self._post.unit_mm + 0.5) for value in path.points_mm[0, :2])
        return self._lines(f"Z{x},{y},{_TOP_UNITS};")


def _waits(dwell_s: float) -> list[str]:
    """Return commands that wait for a time, none of them longer than the language allows."""
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
