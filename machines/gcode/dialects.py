"""The controls for which a program can be meant, as data: what each accepts in addition to the common language.

Source: the table in the comparison of dialects (GRBL 1.1h and grblHAL measured, others from their manuals).
"""

from __future__ import annotations

from dataclasses import dataclass

from machines.gcode import refusals
from machines.gcode.language import (
    ACCEPT,
    CHANGE,
    DWELL_BY_F,
    DWELL_MS,
    LENGTH_BY_H,
    MACHINE_BY_H,
    MOVES_FRAME,
    OFFSET_BY_H,
)
from phrases.phrase import Phrase

RML = "rml-1"  # not a dialect of G-code but Roland's own language: its programs are sent unchanged
SHARED_LETTERS = "DFHIJKLNPQRSTXYZ"  # D, H and Q belong to words that GRBL lacks: refused with those words, by name

Own = tuple[tuple[int, int, int, int], ...]


def _letters(text: str) -> int:
    return sum(1 << (ord(letter) - 65) for letter in text)


def _g(action: int, numbers: tuple[float, ...], letters: str = "") -> Own:
    return tuple((round(number * 10), action, _letters(letters), 0) for number in numbers)


def _m(action: int, numbers: tuple[float, ...], letters: str = "") -> Own:
    return tuple((round(number * 10) + 100_000, action, _letters(letters), 0) for number in numbers)


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """One control.

    title              : what sentences call it
    is_grbl            : GRBL or a relative, whose link reports the mill's position
    line_limit         : characters of code it holds, comments and blanks not counted
    n_limit            : greatest N word
    percent            : takes a line that is only %
    letters            : letters it takes in addition to SHARED_LETTERS
    own                : its own words for language.execute_block, and the refusals of words that it lacks
    two_digits         : G and M words have two digits
    needs_point        : letters whose numbers carry a decimal point
    bare_zero          : 0 needs no decimal point (it is 0 in any unit)
    name_digits        : fewest and most digits of the O word; (0, 0) where the letter O is not taken
    arcs_by_r          : arcs may be given by R, not only by I, J, K
    named              : O is followed by a name of letters and digits, not by a number
    decimals           : most decimals
    spindle_first      : S and M03 must come before the first cutting move
    g53_absolute       : G53 only in G90
    numbered           : an interrupted program can be entered at an N word
    mist               : accepts M7 in its standard version
    """

    name: str
    title: str
    is_grbl: bool = False
    line_limit: int = 79
    n_limit: int = 10_000_000
    percent: bool = False
    letters: str = ""
    own: Own = ()
    two_digits: bool = False
    needs_point: str = ""
    bare_zero: bool = True
    name_digits: tuple[int, int] = (0, 0)
    named: bool = False
    arcs_by_r: bool = True
    decimals: int = 17
    spindle_first: bool = False
    g53_absolute: bool = False
    numbered: bool = True
    mist: bool = True

    @property
    def letter_bits(self) -> int:
        return _letters(SHARED_LETTERS + self.letters + "O" * self.tapes)

    @property
    def tapes(self) -> bool:
        """Programs have a name, O ..., and % before and after."""
        return self.named or self.name_digits[1] > 0

    @property
    def point_bits(self) -> int:
        return _letters(self.needs_point)

    @property
    def name_rule(self) -> Phrase:
        least, most = self.name_digits
        if self.named:
            return Phrase("O and at most 16 letters and digits")
        if least == most:
            return Phrase("O and {most} digits", most=most)
        return Phrase("O and {least} to {most} digits", least=least, most=most)

    def name_offset(self, number: int) -> str:
        """Return the name of work offset 1 to 6 in a program for this control."""
        by_h = any(action == OFFSET_BY_H for _, action, _, _ in self.own)
        return f"G15 H{number}" if by_h else f"G{53 + number}"

    @property
    def dwell_rule(self) -> Phrase:
        actions = {action for code, action, _, _ in self.own if code == 40}
        if DWELL_MS in actions:
            return Phrase("P (milliseconds) or X (seconds)")
        return Phrase("F (seconds)") if DWELL_BY_F in actions else Phrase("P (seconds)")

    def reason_for(self, code: int) -> Phrase:
        """Return the sentence of a refusal by this control."""
        return refusals.make_reasons(
            limit=self.line_limit,
            n_limit=self.n_limit,
            dialect=self.title,
            decimals=self.decimals,
            name_rule=self.name_rule,
            dwell_rule=self.dwell_rule,
        )[code]


_CYCLES = (73, 74, 76, 81, 82, 83, 84, 85, 86, 87, 88, 89)
_NOT_HERE = (
    *_g(-refusals.CYCLE, (*_CYCLES, 98, 99)),
    *_g(-refusals.COMPENSATION, (41, 42, 41.1, 42.1)),
    *_g(-refusals.ABSOLUTE_ARCS, (90.1,)),
    *_g(-refusals.SUBPROGRAM, (65, 66)),
    *_m(-refusals.SUBPROGRAM, (97, 98, 99)),
)
_NO_CHANGER = (*_m(-refusals.TOOL_CHANGE, (6, 60, 61)), *_g(-refusals.LENGTH_TABLE, (43, 43.2, 44)))
_MORE_OFFSETS = _g(MOVES_FRAME, (59.1, 59.2, 59.3))
_CNC_OWN = (
    *_NOT_HERE,
    *_g(ACCEPT, (64, 61.1, 97, 50, 69, 95.1), "PQ"),
    *_m(CHANGE, (6,)),
    *_m(ACCEPT, (48, 49, 19, 60)),
)
_PRECISE = (*_g(ACCEPT, (5.1,), "Q"), *_g(ACCEPT, (8,), "P"))  # high-precision modes, on and off
_LENGTHS = (*_g(LENGTH_BY_H, (43,), "H"), *_g(MOVES_FRAME, (44,), "HZ"))
# Words that GRBL and LinuxCNC share, and that controls of other families lack or use differently.
_NOT_ON_ISO = _g(-refusals.NOT_HERE, (28.1, 30.1, 38.2, 38.3, 38.4, 38.5, 43.1, 91.1, 92.1))

DIALECTS: dict[str, Dialect] = {
    dialect.name: dialect
    for dialect in (
        Dialect(name="grbl", title="GRBL", is_grbl=True, mist=False, own=(*_NOT_HERE, *_NO_CHANGER)),
        Dialect(
            name="grblhal", title="grblHAL", is_grbl=True, line_limit=255, percent=True,
            own=(*_NOT_HERE, *_NO_CHANGER, *_MORE_OFFSETS),
        ),
        Dialect(
            name="fluidnc", title="FluidNC", is_grbl=True, line_limit=254, percent=True,
            own=(*_NOT_HERE, *_NO_CHANGER, *_MORE_OFFSETS),
        ),
        Dialect(
            name="linuxcnc", title="LinuxCNC", line_limit=254, n_limit=99_999_999, percent=True,
            own=(*_CNC_OWN, *_LENGTHS, *_MORE_OFFSETS),
        ),
        Dialect(
            name="fanuc", title=Phrase("a Fanuc-like control"), line_limit=128, n_limit=99_999_999, percent=True,
            name_digits=(1, 4), needs_point="XYZIJKR",  # F in mm/min is a whole number on these
            own=(*_CNC_OWN, *_LENGTHS, *_NOT_ON_ISO, *_g(MOVES_FRAME, (54.1,), "P"), *_g(DWELL_MS, (4,), "PX"),
                 *_g(ACCEPT, (30,), "P"), *_PRECISE),
        ),
        Dialect(
            name="okuma", title="Okuma OSP", line_limit=157, n_limit=99_999_999, percent=True, named=True,
            needs_point="XYZIJKRF",
            own=(*_CNC_OWN, *_NOT_ON_ISO, *_g(OFFSET_BY_H, (15,), "H"), *_g(MACHINE_BY_H, (16,), "H"),
                 *_g(LENGTH_BY_H, (56,), "H"),
                 *_g(DWELL_BY_F, (4,), "F"), *_g(ACCEPT, (30,), "P"),
                 *_g(-refusals.OSP_OFFSETS, (10, 43, 44, 49, 53, 54, 55, 57, 58, 59))),
        ),
        Dialect(
            name="roland-nc", title="Roland NC", line_limit=254, n_limit=99_999_999, percent=True, name_digits=(8, 8),
            two_digits=True, numbered=False, needs_point="XYZIJKRF", bare_zero=False, arcs_by_r=False, decimals=3,
            spindle_first=True, g53_absolute=True,
            own=(*_NOT_HERE, *_NO_CHANGER, *_NOT_ON_ISO, *_g(-refusals.NOT_HERE, (10, 30, 61, 93)),
                 *_m(-refusals.NOT_HERE, (4, 7, 8, 9))),
        ),
    )
}  # fmt: skip
