"""The inputs of a program writer: a dialect, of G-code or RML-1, and a set-up. The set-up is what a program does
besides cutting: work offset, raising the head first and last, coolant, corners, the spindle. Plain data without arrays,
so that a job can be refused without computing anything.

RML-1 of Roland's mills has straight moves in whole hundredths of a millimetre at a speed in mm/s, ended by `;`. There
is no rapid, no comment and no arc: rapids run at the greatest speed, and cutting stays below it. A hundredth is a
thousand times the height of a scallop; the report says what that does to the light.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from cam.errors import LineTooLongError


@dataclass(frozen=True, slots=True, kw_only=True)
class Digits:
    """The resolution of positions in a dialect or on a mill: the last digit of X and Y, and that of Z."""

    xy_mm: float
    z_mm: float

    def coarsen(self, step_mm: float) -> Digits:
        """Return the resolution on a mill with these steps: whole steps where they are coarser than the digits."""
        return Digits(xy_mm=_coarser(self.xy_mm, step_mm), z_mm=_coarser(self.z_mm, step_mm))


def _coarser(digit_mm: float, step_mm: float) -> float:
    """Return a step that the digits can state exactly and that is no finer than either; the digit if the steps are
    finer.
    """
    return max(1, round(step_mm / digit_mm)) * digit_mm


@dataclass(frozen=True, slots=True, kw_only=True)
class Post:
    """One dialect of G-code: words, decimals, first and last blocks. It decides nothing about geometry.

    tape           : before the remarks: what a control requires first, such as % and the program's name
    start, end     : blocks before and after the moves. {number}, {rpm}, {dwell_s} and the work offset, {offset} or
                     {offset_number}, are filled in
    offset_name    : the control's name for the work offset in a sentence, with the same two placeholders
    zero           : a remark that states from what this control measures the work zero
    lift           : the block that brings the tool to {safe_z} over the work zero, after the start and before the end
    top            : the same to {top}, a height in machine coordinates, from wherever the tool stands
    guesses_top    : whether it is a guess that `top` leaves the tool's length out
    spin           : blocks after the start that bring the spindle up to speed; faster: the same for every further speed
                     of a warm-up, where the start has switched it on already
    blend          : blocks for corners rounded within {tolerance}, and for an exact stop; {blend} of the start is one;
                     empty where the control has no word for it
    change         : blocks that bring {tool} into the spindle; empty where programs have no word for it
    length         : the word that takes its length into account, before the first Z of a program
    stop           : an optional stop; empty: none
    inches         : programs may be in inches
    unit_mm        : of lengths and feeds: 1, or 25.4
    coolant        : words that switch on "air", "mist" or "flood", where the control has them
    high_precision : whether the control has the modes of HIGH_PRECISION_WORDS
    least_decimals : 1 where a control reads 5 as 5 least inputs, and only 5.0 as 5 mm
    feed_decimals  : of F, which is rounded down to them; where there are any, it has a point like the coordinates
    capitals       : small letters in a comment are an alarm, or are lost
    number_every   : an N word on every n-th line, at which an interrupted program can be entered again; 0: none
    """

    name: str
    suffix: str
    start: tuple[str, ...]
    end: tuple[str, ...]
    offset_name: str = "{offset}"
    zero: str = ""
    lift: str = "G0Z{safe_z}"
    top: str = "G53G0Z{top}"
    guesses_top: bool = False
    tape: tuple[str, ...] = ()
    spin: tuple[str, ...] = ()
    faster: tuple[str, ...] = ()
    blend: tuple[str, str] = ("", "")
    change: tuple[str, ...] = ()
    length: str = ""
    stop: str = ""
    inches: bool = False
    unit_mm: float = 1.0
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
        """The resolution of positions that this dialect can write."""
        return Digits(xy_mm=self.unit_mm * 10.0**-self.xy_decimals, z_mm=self.unit_mm * 10.0**-self.z_decimals)

    def adapt(self, *, units: str, number_every: int | None) -> Post:
        """Return this dialect as a shop keeps its programs: "mm" or "inch", with an N word on every n-th line."""
        post = self if number_every is None else replace(self, number_every=number_every)
        if units == "mm":
            return post
        return replace(
            post,
            start=tuple(block.replace("G21", "G20", 1) for block in post.start),
            unit_mm=MM_PER_INCH,
            xy_decimals=post.xy_decimals + 1,
            z_decimals=post.z_decimals + 1,
            feed_decimals=min(4, post.feed_decimals + 2),
        )

    @property
    def offsets(self) -> bool:
        """Whether programs can name their work offset."""
        return any("{offset" in block for block in self.start)

    def name_offset(self, number: int) -> str:
        """Return the name of work offset 1 to 6 in a sentence."""
        return self.offset_name.format(offset=f"G{53 + number}", offset_number=number)

    @property
    def blends(self) -> bool:
        """Whether a program can say how far corners may be rounded."""
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
        """Return a comment, cut to the line length. Characters that would end or break it are replaced."""
        opening, closing = self.comment
        text = text.upper() if self.capitals else text
        plain = "".join(c if c.isascii() and c.isprintable() and c not in opening + closing else "_" for c in text)
        return self.block(opening + plain[: self.most_characters - len(opening) - len(closing)] + closing)


def number(value: float, least_decimals: int = 0, *, decimals: int = 4) -> str:
    """Return a plain decimal with at most `places` places, and no trailing zeros beyond the least number of them."""
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return text if "." in text or not least_decimals else text + "." + "0" * least_decimals


@dataclass(frozen=True, slots=True, kw_only=True)
class RmlPost:
    """RML-1 as the MDX-40 family uses it: V in tenths of a mm/s up to 50, !RC in rpm, W in milliseconds. It has no
    words for coolant or corners.
    """

    name: str = "rml-1"
    suffix: str = ".rml"
    unit_mm: float = 0.01
    line_end: str = "\r\n"
    coolant: Mapping[str, str] = field(default_factory=dict)
    blends: bool = False
    offsets: bool = False
    high_precision: bool = False
    traces_with_spindle_on: bool = False
    change: tuple[str, ...] = ()
    stop: str = ""
    inches: bool = False
    number_every: int = 0

    def adapt(self, *, units: str, number_every: int | None) -> RmlPost:
        """Return this dialect unchanged: it has no options for a shop."""
        return self

    @property
    def digits(self) -> Digits:
        return Digits(xy_mm=self.unit_mm, z_mm=self.unit_mm)


RML = RmlPost()


Coolant = Literal["none", "air", "mist", "flood"]
HighPrecision = Literal["none", "g05.1", "g08"]

HIGH_PRECISION_WORDS: Mapping[str, tuple[str, str]] = {"g05.1": ("G05.1Q1", "G05.1Q0"), "g08": ("G08P1", "G08P0")}
"""Words that switch the mode on and off, on Fanuc-like controls that have the option."""

MM_PER_INCH = 25.4

WARM_UP_SHARES = (0.25, 0.5, 0.75, 1.0)
"""Shares of the program's spindle speed, one step after the other, each for the same time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramSetup:
    """What a program switches on before its first cut and off after its last.

    work_offset        : 1 to 6: G54 to G59, or what the control calls them
    blend_tolerance_mm : how far the path may leave its corners; 0: an exact stop at each; None: as the post has it
    warm_up_s          : the spindle comes up in WARM_UP_SHARES within this time; 0: at once
    slowest_rpm        : of the spindle; no step of the warm-up is slower
    tool               : number that programs change to, with its length; 0: the tool stands in the spindle, and Z0 is
                         set with it
    optional_stop      : before the spindle turns
    top_z_mm           : machine Z of the raised head, to which the program goes before it goes across, and at its end;
                         None: not known, it goes to the safe height over the work zero
    """

    coolant: Coolant = "none"
    work_offset: int = 1
    blend_tolerance_mm: float | None = None
    high_precision: HighPrecision = "none"
    warm_up_s: float = 0.0
    slowest_rpm: float = 0.0
    tool: int = 0
    optional_stop: bool = False
    top_z_mm: float | None = None

    def without_warm_up(self) -> ProgramSetup:
        """Return this set-up for a program that follows another one."""
        return replace(self, warm_up_s=0.0)

    def spindle_steps(self, rpm: float, *, dwell_s: float) -> tuple[tuple[float, float], ...]:
        """Return the steps (speed [rpm], dwell [s]) in order; the last speed is rpm.

        dwell_s : time that the spindle needs to come up to speed at all
        """
        if not self.warm_up_s > 0:
            return ((rpm, dwell_s),)
        each_s = max(dwell_s, self.warm_up_s / len(WARM_UP_SHARES))
        steps: list[tuple[float, float]] = []
        for share in WARM_UP_SHARES:
            speed = min(rpm, max(float(round(share * rpm)), self.slowest_rpm)) if share < 1.0 else rpm
            if steps and steps[-1][0] == speed:
                steps[-1] = (speed, steps[-1][1] + each_s)
            else:
                steps.append((speed, each_s))
        return tuple(steps)
