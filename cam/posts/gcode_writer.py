"""The writer that turns paths into the blocks of a dialect of G-code."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from cam.moves import Array, Motion, Path
from cam.posts.lines import MOST_BYTES_PER_LINE, UNKNOWN, write_lines
from cam.posts.post import Post, number
from cam.posts.setup import HIGH_PRECISION_WORDS, ProgramSetup

POINTS_AT_ONCE = 40_000


class ProgramWriter:
    """Paths to blocks; words that have not changed are not repeated. Holds the modal state, nothing else."""

    def __init__(self, post: Post) -> None:
        self.post = post
        self._raised = False  # the head stands at its top: the tool must get over its place before it comes down
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
        first, *further = setup.spindle_steps(rpm, dwell_s=post.spindle_dwell_s)
        values: dict[str, object] = {"number": program, "blend": self._blend(setup), **self._heights(setup, safe_z_mm)}
        values |= {"offset": f"G{53 + setup.work_offset}", "offset_number": setup.work_offset}
        begin, zero = {**values, **self._spin(*first)}, post.zero.format(**values)
        self._raised = setup.top_z_mm is not None
        return b"".join(
            [
                self._write_templates(post.tape, values),
                *(post.remark(remark) for remark in (*remarks, zero, _word_beginning(setup, safe_z_mm)) if remark),
                self._write_templates((*post.start, self._way_up(setup)), begin),
                *(piece for path in trace for piece in self.write(path)),
                self._write_templates(post.spin, begin),
                *(self._write_templates(post.faster or post.spin, self._spin(*step)) for step in further),
                self._write_templates(_on(post, setup), {}),
            ]
        )

    def end(self, *, safe_z_mm: float, setup: ProgramSetup | None = None) -> bytes:
        """Write the way up, what the start switched on off again, spindle off, end."""
        setup = setup or ProgramSetup()
        return self._write_templates(
            (self._way_up(setup), *_off(setup), *self.post.end), self._heights(setup, safe_z_mm)
        )

    def _way_up(self, setup: ProgramSetup) -> str:
        return self.post.lift if setup.top_z_mm is None else self.post.top

    def _heights(self, setup: ProgramSetup, safe_z_mm: float) -> dict[str, object]:
        top_mm = setup.top_z_mm
        return {"safe_z": self._number(safe_z_mm), "top": "" if top_mm is None else self._number(top_mm)}

    def _blend(self, setup: ProgramSetup) -> str:
        tolerance_mm = self.post.usual_blend_mm if setup.blend_tolerance_mm is None else setup.blend_tolerance_mm
        rounded, stopped = self.post.blend
        return rounded.format(tolerance=number(tolerance_mm)) if tolerance_mm > 0 else stopped

    def _spin(self, rpm: float, dwell_s: float) -> dict[str, object]:
        return {"rpm": number(rpm), "dwell_s": self._number(dwell_s), "whole_dwell_s": f"{math.ceil(dwell_s)}"}

    def _number(self, value: float) -> str:
        return number(value, self.post.least_decimals)

    def _write_templates(self, templates: tuple[str, ...], values: dict[str, object]) -> bytes:
        self._motion, self._feed = None, None  # what the templates leave is not tracked
        self._state[:3] = UNKNOWN
        return b"".join(self.post.block(t.format(**values)) for t in templates)

    def write(self, path: Path) -> Iterator[bytes]:
        """Yield blocks of one path in pieces; a point that rounds to where the tool stands makes no block."""
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
        """Write the way across to where a path begins, at the height of the raised head."""
        self._raised, self._motion = False, self.post.rapid
        over_mm = path.points_mm[:1]
        self._state[2] = math.floor(over_mm[0, 2] * 10**self.post.z_decimals + 0.5)  # as if reached: no Z is written
        text = self._lines(over_mm, self.post.rapid, "")
        self._state[2] = UNKNOWN
        return text

    def _lines(self, points_mm: Array, opening: str, closing: str) -> bytes:
        size, _ = write_lines(
            np.ascontiguousarray(points_mm),
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
        units = max(1, math.floor(feed_mm_per_min * scale + 1e-6))
        return self.post.feed + number(units / scale, self.post.least_decimals if self.post.feed_decimals else 0)


def _word_beginning(setup: ProgramSetup, safe_z_mm: float) -> str:
    """Return in words where the tool may stand when the program begins."""
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
