"""The writer that turns paths into the blocks of a dialect of G-code."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from cam.moves import Motion, Path
from cam.posts.lines import MOST_BYTES_PER_LINE, UNKNOWN, write_lines
from cam.posts.post import Post, number
from cam.posts.setup import HIGH_PRECISION_WORDS, ProgramSetup
from cam.posts.writer import Writer

POINTS_AT_ONCE = 40_000


class ProgramWriter(Writer):
    """Paths to blocks; words that have not changed are not repeated. Holds the modal state, nothing else."""

    def __init__(self, post: Post) -> None:
        self.post = post
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
        """Write tape mark, name and remarks, then the first blocks: modes, safe height, trace, spindle, coolant."""
        post, setup = self.post, setup or ProgramSetup()
        first, *further = setup.spindle_steps(rpm, dwell_s=post.spindle_dwell_s)
        values: dict[str, object] = {"number": program, "safe_z": self._number(safe_z_mm), "blend": self._blend(setup)}
        values |= {"offset": f"G{53 + setup.work_offset}", "offset_number": setup.work_offset}
        begin = {**values, **self._spin(*first)}
        return b"".join(
            [
                self._blocks(post.tape, values),
                *(post.remark(remark) for remark in remarks),
                self._blocks(post.start, begin),
                *(piece for path in trace for piece in self.write(path)),
                self._blocks(post.spin, begin),
                *(self._blocks(post.faster or post.spin, self._spin(*step)) for step in further),
                self._blocks(_on(post, setup), {}),
            ]
        )

    def end(self, *, safe_z_mm: float, setup: ProgramSetup | None = None) -> bytes:
        """Write the way up, what the start switched on off again, spindle off, end."""
        values: dict[str, object] = {"safe_z": self._number(safe_z_mm)}
        lift, rest = self.post.end[:1], self.post.end[1:]
        return self._blocks((*lift, *_off(setup or ProgramSetup()), *rest), values)

    def _blend(self, setup: ProgramSetup) -> str:
        tolerance_mm = self.post.usual_blend_mm if setup.blend_tolerance_mm is None else setup.blend_tolerance_mm
        rounded, stopped = self.post.blend
        return rounded.format(tolerance=number(tolerance_mm)) if tolerance_mm > 0 else stopped

    def _spin(self, rpm: float, dwell_s: float) -> dict[str, object]:
        return {"rpm": number(rpm), "dwell_s": self._number(dwell_s), "whole_dwell_s": f"{math.ceil(dwell_s)}"}

    def _number(self, value: float) -> str:
        return number(value, self.post.least_decimals)

    def _blocks(self, templates: tuple[str, ...], values: dict[str, object]) -> bytes:
        self._motion, self._feed = None, None  # what the templates leave is not tracked
        self._state[:3] = UNKNOWN
        return b"".join(self.post.block(t.format(**values)) for t in templates)

    def write(self, path: Path) -> Iterator[bytes]:
        """Yield blocks of one path in pieces; a point that rounds to where the tool stands makes no block."""
        motion = self.post.rapid if path.motion is Motion.RAPID else self.post.cut
        for first in range(0, len(path.points_mm), POINTS_AT_ONCE):
            opening = motion if motion != self._motion else ""
            new_feed = path.feed_mm_per_min is not None and path.feed_mm_per_min != self._feed
            closing = self._feed_word(path.feed_mm_per_min) if new_feed else ""  # type: ignore[arg-type]
            size, lines = write_lines(
                path.points_mm[first : first + POINTS_AT_ONCE],
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
            if lines:
                self._motion = motion
                if new_feed:
                    self._feed = path.feed_mm_per_min
                yield self._buffer[:size].tobytes()

    def _feed_word(self, feed_mm_per_min: float) -> str:
        scale = 10**self.post.feed_decimals
        units = max(1, math.floor(feed_mm_per_min * scale + 1e-6))
        return self.post.feed + number(units / scale, self.post.least_decimals if self.post.feed_decimals else 0)


def _on(post: Post, setup: ProgramSetup) -> tuple[str, ...]:
    coolant = () if setup.coolant == "none" else (post.coolant[setup.coolant],)
    precise = () if setup.high_precision == "none" else HIGH_PRECISION_WORDS[setup.high_precision][:1]
    return (*coolant, *precise)


def _off(setup: ProgramSetup) -> tuple[str, ...]:
    precise = () if setup.high_precision == "none" else HIGH_PRECISION_WORDS[setup.high_precision][1:]
    return (*precise, *(() if setup.coolant == "none" else ("M9",)))


def _bytes(text: str) -> np.ndarray:
    return np.frombuffer(text.encode("ascii"), dtype=np.uint8)
