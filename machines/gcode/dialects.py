"""The controls a program can be meant for, as data: what each takes beside the language all of them share.

Source: the table in the comparison of dialects (GRBL 1.1h and grblHAL measured, others from their manuals).
"""

from __future__ import annotations

from dataclasses import dataclass

from machines.gcode import refusals
from machines.gcode.language import ACCEPT, MOVES_FRAME

SHARED_LETTERS = "DFHIJKLNPQRSTXYZ"  # D, H and Q belong to words GRBL has not: refused by those, in their name

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

    line_limit         : characters of code it holds, comments and blanks not counted
    n_limit            : greatest N word
    percent            : takes a line that is only %
    letters            : letters it takes beside SHARED_LETTERS
    own                : its own words for language.block, and the refusals of words it has not
    two_digits         : G and M words have two digits
    needs_point        : X Y Z F ... carry a decimal point
    decimals           : most decimals
    spindle_first      : S and M03 must come before the first cutting move
    g53_absolute       : G53 only in G90
    """

    name: str
    line_limit: int = 79
    n_limit: int = 10_000_000
    percent: bool = False
    letters: str = ""
    own: Own = ()
    two_digits: bool = False
    needs_point: bool = False
    decimals: int = 17
    spindle_first: bool = False
    g53_absolute: bool = False

    @property
    def letter_bits(self) -> int:
        return _letters(SHARED_LETTERS + self.letters)

    @property
    def is_grbl(self) -> bool:
        return self.name in ("grbl", "grblhal", "fluidnc")

    @property
    def title(self) -> str:
        return _TITLES[self.name]


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
    *_g(MOVES_FRAME, (43, 44, 54.1), "HPZ"),
    *_m(MOVES_FRAME, (6,)),
    *_m(ACCEPT, (48, 49, 19, 60)),
)

DIALECTS: dict[str, Dialect] = {
    dialect.name: dialect
    for dialect in (
        Dialect(name="grbl", own=(*_NOT_HERE, *_NO_CHANGER)),
        Dialect(name="grblhal", line_limit=255, percent=True, own=(*_NOT_HERE, *_NO_CHANGER, *_MORE_OFFSETS)),
        Dialect(name="fluidnc", line_limit=254, percent=True, own=(*_NOT_HERE, *_NO_CHANGER, *_MORE_OFFSETS)),
        Dialect(
            name="linuxcnc", line_limit=254, n_limit=99_999_999, percent=True, letters="O",
            own=(*_CNC_OWN, *_MORE_OFFSETS),
        ),
        Dialect(
            name="fanuc", line_limit=128, n_limit=99_999_999, percent=True, letters="O", needs_point=True,
            own=_CNC_OWN,
        ),
        Dialect(
            name="okuma", line_limit=157, n_limit=99_999_999, percent=True, letters="O", needs_point=True,
            own=(*_CNC_OWN, *_g(MOVES_FRAME, (15, 16, 56), "H")),
        ),
        Dialect(
            name="roland-nc", line_limit=254, n_limit=99_999_999, percent=True, letters="O", two_digits=True,
            needs_point=True, decimals=3, spindle_first=True, g53_absolute=True, own=(*_NOT_HERE, *_NO_CHANGER),
        ),
    )
}  # fmt: skip

_TITLES = {
    "grbl": "GRBL",
    "grblhal": "grblHAL",
    "fluidnc": "FluidNC",
    "linuxcnc": "LinuxCNC",
    "fanuc": "a Fanuc-like control",
    "okuma": "Okuma OSP",
    "roland-nc": "Roland NC",
}
