"""A dialect as data, and the writer that turns paths into its blocks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cam.errors import LineTooLongError
from cam.moves import Motion, Path
from cam.posts.digits import Digits
from cam.posts.lines import MOST_BYTES_PER_LINE, UNKNOWN, write_lines
from cam.posts.writer import Writer

POINTS_AT_ONCE = 40_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Post:
    """One dialect of G-code: words, decimals, first and last blocks. It decides nothing about geometry.

    tape           : before the remarks: what a control wants first, such as % and the program's name
    start, end     : blocks before and after the moves. {number}, {rpm}, {dwell_s} and {safe_z} are filled in
    least_decimals : 1 where a control reads 5 as 5 least inputs, and only 5.0 as 5 mm
    feed_decimals  : of F, which is rounded down to them; where there are any, it has a point like the coordinates
    number_every   : an N word on every so many-th line, from which an interrupted program can be entered; 0: none
    """

    name: str
    suffix: str
    start: tuple[str, ...]
    end: tuple[str, ...]
    tape: tuple[str, ...] = ()
    rapid: str = "G0"
    cut: str = "G1"
    feed: str = "F"
    axes: str = "XYZ"
    between_words: str = ""
    xy_decimals: int = 4
    z_decimals: int = 5
    least_decimals: int = 0
    feed_decimals: int = 4
    number_every: int = 0
    comment: tuple[str, str] = ("(", ")")
    line_end: str = "\n"
    most_characters: int = 79
    spindle_dwell_s: float = 4.0

    @property
    def digits(self) -> Digits:
        """The raster on which this dialect can write a position."""
        return Digits(xy_mm=10.0**-self.xy_decimals, z_mm=10.0**-self.z_decimals)

    def writer(self) -> ProgramWriter:
        return ProgramWriter(self)

    def block(self, text: str) -> bytes:
        """One block of plain ASCII; refused if the controller's line buffer cannot hold it."""
        if len(text) > self.most_characters:
            raise LineTooLongError(line=text, allowed=self.most_characters)
        return (text + self.line_end).encode("ascii")

    def remark(self, text: str) -> bytes:
        """A comment, cut to the line length; what would end or break it is replaced."""
        opening, closing = self.comment
        plain = "".join(c if c.isascii() and c.isprintable() and c not in opening + closing else "_" for c in text)
        return self.block(opening + plain[: self.most_characters - len(opening) - len(closing)] + closing)


def number(value: float, least_decimals: int = 0) -> str:
    """Plain decimal, at most four places, no trailing zeros beyond the least."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return text if "." in text or not least_decimals else text + "." + "0" * least_decimals


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

    def start(self, remarks: tuple[str, ...], *, rpm: float, safe_z_mm: float, program: int = 1) -> bytes:
        """Tape mark and name, remarks, then the first blocks: modes, safe height, spindle and its dwell."""
        values = {"number": program, "rpm": number(rpm), "safe_z": self._number(safe_z_mm)}
        values["dwell_s"] = self._number(self.post.spindle_dwell_s)
        tape = self._blocks(self.post.tape, values)
        return tape + b"".join(self.post.remark(r) for r in remarks) + self._blocks(self.post.start, values)

    def end(self, *, safe_z_mm: float) -> bytes:
        return self._blocks(self.post.end, {"safe_z": self._number(safe_z_mm)})

    def _number(self, value: float) -> str:
        return number(value, self.post.least_decimals)

    def _blocks(self, templates: tuple[str, ...], values: dict[str, object]) -> bytes:
        self._motion, self._feed = None, None  # what the templates leave is not tracked
        self._state[:3] = UNKNOWN
        return b"".join(self.post.block(t.format(**values)) for t in templates)

    def write(self, path: Path) -> Iterator[bytes]:
        """Blocks of one path in pieces; a point that rounds to where the tool stands makes no block."""
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


def _bytes(text: str) -> np.ndarray:
    return np.frombuffer(text.encode("ascii"), dtype=np.uint8)
