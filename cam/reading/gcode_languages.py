"""What each control reads, as its manual has it: known here apart from what our posts write, so that neither trusts the
other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

DWELL_P, DWELL_X, DWELL_F = range(3)
TAPE, DWELL, TWO_DIGITS, POINTED, DECIMALS, LETTERS, BLENDS, OFFSETS_BY_H, COOLANT, PRECISE, RULES = range(11)


@dataclass(frozen=True, slots=True, kw_only=True)
class Language:
    """One control's language.

    kind          : words of G-code, or commands of RML-1
    tape          : % stands first and last, then a name: O and letters or digits
    dwell         : G4 by P or by F in seconds, or by X in seconds
    two_digits    : G01, not G1
    pointed       : letters whose numbers need a decimal point
    most_decimals : more would be cut off, or refused
    blends        : G64 P Q, and G61.1
    coolant       : M7, M8, M9
    precise       : G5.1 Q and G8 P, 1 for on and 0 for off
    offsets_by_h  : the work offset is G15 H, not G54, and machine coordinates for one block G16 H0, not G53
    digit_mm      : the finest height that it can state
    """

    name: str
    kind: Literal["words", "rml"] = "words"
    tape: bool = False
    dwell: int = DWELL_P
    two_digits: bool = False
    pointed: str = ""
    most_decimals: int = 17
    blends: bool = False
    coolant: bool = True
    precise: bool = False
    offsets_by_h: bool = False
    digit_mm: float = 1e-5

    def rules(self) -> np.ndarray:
        """Return the rules as the compiled reader takes them: (RULES,) int64."""
        rules = np.zeros(RULES, dtype=np.int64)
        rules[TAPE], rules[DWELL], rules[TWO_DIGITS] = self.tape, self.dwell, self.two_digits
        rules[POINTED], rules[DECIMALS] = _bits(self.pointed), self.most_decimals
        rules[LETTERS] = _bits("FNPSXYZ" + "Q" * (self.blends or self.precise) + "H" * self.offsets_by_h)
        rules[BLENDS], rules[OFFSETS_BY_H] = self.blends, self.offsets_by_h
        rules[COOLANT], rules[PRECISE] = self.coolant, self.precise
        return rules


def _bits(letters: str) -> int:
    return sum(1 << (ord(letter) - ord("A")) for letter in letters)


GRBL = Language(name="grbl")
LANGUAGES: dict[str, Language] = {
    language.name: language
    for language in (
        GRBL,
        Language(name="grblhal"),
        Language(name="fluidnc"),
        Language(name="linuxcnc", tape=True, blends=True),
        Language(name="fanuc", tape=True, dwell=DWELL_X, pointed="XYZ", most_decimals=3, precise=True, digit_mm=0.001),
        Language(
            name="okuma",
            tape=True,
            dwell=DWELL_F,
            pointed="XYZF",
            most_decimals=3,
            offsets_by_h=True,
            digit_mm=0.001,
        ),
        Language(
            name="roland-nc",
            tape=True,
            two_digits=True,
            pointed="XYZF",
            most_decimals=3,
            coolant=False,
            digit_mm=0.001,
        ),
        Language(name="rml-1", kind="rml", digit_mm=0.01),
    )
}
