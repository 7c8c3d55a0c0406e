"""A dialect of G-code as data, without arrays, so that a job can be refused where nothing is computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from cam.errors import LineTooLongError
from cam.posts.digits import Digits


@dataclass(frozen=True, slots=True, kw_only=True)
class Post:
    """One dialect of G-code: words, decimals, first and last blocks. It decides nothing about geometry.

    tape           : before the remarks: what a control wants first, such as % and the program's name
    start, end     : blocks before and after the moves. {number}, {rpm}, {dwell_s} and the work offset, {offset} or
                     {offset_number}, are filled in
    zero           : what the work zero counts from on this control, in words: a remark
    lift           : the block that brings the tool to {safe_z} over the work zero, after the start and before the end
    top            : the same to {top}, a height in machine coordinates, from wherever the tool stands
    spin           : blocks after the start that bring the spindle up to speed; faster: the same for every further speed
                     of a warm-up, where the start has switched it on already
    blend          : blocks for corners rounded within {tolerance}, and for an exact stop; {blend} of the start is one;
                     empty where the control cannot be told
    coolant        : words that switch on "air", "mist" or "flood", where the control has them
    high_precision : whether it has the modes of HIGH_PRECISION_WORDS
    least_decimals : 1 where a control reads 5 as 5 least inputs, and only 5.0 as 5 mm
    feed_decimals  : of F, which is rounded down to them; where there are any, it has a point like the coordinates
    capitals       : small letters in a comment are an alarm, or are lost
    number_every   : an N word on every so many-th line, from which an interrupted program can be entered; 0: none
    """

    name: str
    suffix: str
    start: tuple[str, ...]
    end: tuple[str, ...]
    zero: str = ""
    lift: str = "G0Z{safe_z}"
    top: str = "G53G0Z{top}"
    tape: tuple[str, ...] = ()
    spin: tuple[str, ...] = ()
    faster: tuple[str, ...] = ()
    blend: tuple[str, str] = ("", "")
    coolant: Mapping[str, str] = field(default_factory=dict)
    high_precision: bool = False
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
    capitals: bool = False
    line_end: str = "\n"
    most_characters: int = 79
    spindle_dwell_s: float = 4.0
    usual_blend_mm: float = 0.001

    @property
    def digits(self) -> Digits:
        """The raster on which this dialect can write a position."""
        return Digits(xy_mm=10.0**-self.xy_decimals, z_mm=10.0**-self.z_decimals)

    @property
    def offsets(self) -> bool:
        """Whether programs can name their work offset."""
        return any("{offset" in block for block in self.start)

    @property
    def blends(self) -> bool:
        """Whether it can be told how far corners may be rounded."""
        return any(self.blend)

    @property
    def traces_with_spindle_on(self) -> bool:
        """Whether the spindle turns before the first move, and so while the block is traced."""
        return any("M03" in block or "M3" in block for block in self.start)

    def block(self, text: str) -> bytes:
        """Return one block of plain ASCII; refused if the controller's line buffer cannot hold it."""
        if len(text) > self.most_characters:
            raise LineTooLongError(line=text, allowed=self.most_characters)
        return (text + self.line_end).encode("ascii")

    def remark(self, text: str) -> bytes:
        """Return a comment, cut to the line length; what would end or break it is replaced."""
        opening, closing = self.comment
        text = text.upper() if self.capitals else text
        plain = "".join(c if c.isascii() and c.isprintable() and c not in opening + closing else "_" for c in text)
        return self.block(opening + plain[: self.most_characters - len(opening) - len(closing)] + closing)


def number(value: float, least_decimals: int = 0) -> str:
    """Return a plain decimal, at most four places, no trailing zeros beyond the least."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return text if "." in text or not least_decimals else text + "." + "0" * least_decimals
