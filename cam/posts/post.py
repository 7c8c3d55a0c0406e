"""A dialect as data, and the writer that turns paths into its blocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cam.errors import LineTooLongError
from cam.moves import Motion, Path
from cam.posts.lines import MOST_BYTES_PER_LINE, UNKNOWN, write_lines

POINTS_AT_ONCE = 40_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Post:
    """One dialect: words, decimals, first and last blocks. It decides nothing about geometry.

    start, end : blocks before and after the moves; {rpm}, {dwell_s} and {safe_z} are filled in
    """

    name: str
    suffix: str
    start: tuple[str, ...]
    end: tuple[str, ...]
    rapid: str = "G0"
    cut: str = "G1"
    feed: str = "F"
    axes: str = "XYZ"
    between_words: str = ""
    xy_decimals: int = 4
    z_decimals: int = 5
    keep_point: bool = False
    comment: tuple[str, str] = ("(", ")")
    line_end: str = "\n"
    most_characters: int = 79
    spindle_dwell_s: float = 4.0

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


def number(value: float) -> str:
    """Plain decimal, at most four places, no trailing zeros."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


class ProgramWriter:
    """Paths to blocks; words that have not changed are not repeated. Holds the modal state, nothing else."""

    def __init__(self, post: Post) -> None:
        self.post = post
        self._motion: str | None = None
        self._feed: float | None = None
        self._state = np.full(3, UNKNOWN, dtype=np.int64)
        self._letters = np.frombuffer(post.axes.encode("ascii"), dtype=np.uint8)
        self._gap = np.frombuffer(post.between_words.encode("ascii"), dtype=np.uint8)
        self._line_end = np.frombuffer(post.line_end.encode("ascii"), dtype=np.uint8)
        self._decimals = np.array([post.xy_decimals, post.xy_decimals, post.z_decimals], dtype=np.int64)
        self._buffer = np.empty(POINTS_AT_ONCE * MOST_BYTES_PER_LINE, dtype=np.uint8)

    def start(self, remarks: tuple[str, ...], *, rpm: float, safe_z_mm: float) -> bytes:
        """Remarks, then the post's first blocks: units, safe height, spindle and its dwell."""
        return b"".join(self.post.remark(r) for r in remarks) + self._blocks(self.post.start, rpm, safe_z_mm)

    def end(self, *, safe_z_mm: float) -> bytes:
        return self._blocks(self.post.end, 0, safe_z_mm)

    def _blocks(self, templates: tuple[str, ...], rpm: float, safe_z_mm: float) -> bytes:
        values = {"rpm": number(rpm), "safe_z": number(safe_z_mm), "dwell_s": number(self.post.spindle_dwell_s)}
        self._motion, self._feed = None, None  # what the templates leave is not tracked
        self._state[:] = UNKNOWN
        return b"".join(self.post.block(t.format(**values)) for t in templates)

    def write(self, path: Path) -> Iterator[bytes]:
        """Blocks of one path in pieces; a point that rounds to where the tool stands makes no block."""
        motion = self.post.rapid if path.motion is Motion.RAPID else self.post.cut
        for first in range(0, len(path.points_mm), POINTS_AT_ONCE):
            opening = motion if motion != self._motion else ""
            new_feed = path.feed_mm_per_min is not None and path.feed_mm_per_min != self._feed
            closing = self.post.feed + number(path.feed_mm_per_min) if new_feed else ""  # type: ignore[arg-type]
            size, lines = write_lines(
                path.points_mm[first : first + POINTS_AT_ONCE],
                self._state,
                self._decimals,
                self._letters,
                self._gap,
                self._line_end,
                np.frombuffer(opening.encode("ascii"), dtype=np.uint8),
                np.frombuffer(closing.encode("ascii"), dtype=np.uint8),
                self.post.keep_point,
                self._buffer,
            )
            if lines:
                self._motion = motion
                if new_feed:
                    self._feed = path.feed_mm_per_min
                yield self._buffer[:size].tobytes()
