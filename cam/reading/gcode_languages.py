"""The language that each control reads, according to its manual. It is stated here independently of the posts, so that
neither relies on the other. Also the sentences for lines that are refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from cam.errors import CamError
from phrases.phrase import Phrase

ALLOWED = (
    "G0 to G4 G17 G20 G21 G28 G40 G43 G49 G53 to G59 G80 G90 G91 G94, M0 to M3 M5 to M9 M30, F H I J N P R S T X Y Z, "
    "comments in ( ) and after ;"
)
ALLOWED_RML = "^DF ^PA ^PR !MC !RC V W Z, each ended by ; on its line"

(
    LONG,
    NO_LETTER,
    NO_NUMBER,
    WRONG_WORD,
    REPEATED,
    OPEN_COMMENT,
    NO_FEED,
    BAD_FEED,
    NO_MOTION,
    BLIND,
    BAD_DWELL,
    NO_SPEED,
    AFTER_END,
    PERCENT,
    ARC,
    DWELL_MOVES,
    GROUP_TWICE,
    USELESS_P,
    PERCENT_PLACE,
    BAD_NAME,
    NEEDS_POINT,
    DECIMALS_LEFT_OUT,
    TWO_DIGITS_ONLY,
    USELESS_WORD,
    NO_COMMAND,
    BAD_NUMBERS,
    NO_SEMICOLON,
    RELATIVE,
    NO_VELOCITY,
    ALONE,
    BAD_OFFSET,
    OFFSET_CHANGES,
    RAISED_WRONG,
    TOOL_LATE,
    NO_TOOL,
    HOME_MIDDLE,
    BLIND_ARC,
    BAD_ARC,
    HUGE_ARC,
) = range(1, 40)

REFUSALS = {
    LONG: Phrase("a line may have at most 79 characters"),
    NO_LETTER: Phrase("a word starts with a letter; allowed: {words}", words=ALLOWED),
    NO_NUMBER: Phrase("a letter must be followed by a plain decimal number of at most 17 digits"),
    WRONG_WORD: Phrase("a word that is not allowed here; allowed: {words}", words=ALLOWED),
    REPEATED: Phrase("the same word is on the line twice"),
    OPEN_COMMENT: Phrase("a comment that opens with ( must close with ) on the same line"),
    NO_FEED: Phrase("G1 needs a feed: give F above 0 mm/min on this line or before"),
    BAD_FEED: Phrase("a feed must be above 0 mm/min"),
    NO_MOTION: Phrase("coordinates need G0 or G1 on this line or before"),
    BLIND: Phrase(
        "the position is not known yet: first G0 Z to the safe height, or G53 G0 Z, then G0 X Y, absolute (G90)"
    ),
    BAD_DWELL: Phrase("G4 needs P (seconds), 0 or more (on some controls X or F instead)"),
    NO_SPEED: Phrase("M3 needs a speed: give S above 0 rpm on this line or before"),
    AFTER_END: Phrase("nothing may follow M2 or M30"),
    PERCENT: Phrase("no % marks in this dialect (GRBL answers error:1); delete the line"),
    ARC: Phrase("an arc needs its plane's end and I, J or R, in G17"),
    DWELL_MOVES: Phrase("G4 must stand alone, without a motion"),
    GROUP_TWICE: Phrase("two words of one modal group on the line (such as G0 and G1)"),
    TOOL_LATE: Phrase(
        "a tool change or a tool's length in the middle is not read: check one program for each tool, with T, M6 and "
        "G43 H before the first move"
    ),
    NO_TOOL: Phrase("M6 needs T, and G43 needs H, on this line or before"),
    HOME_MIDDLE: Phrase(
        "what follows G28, or a raised head, in the middle of a program is not read: where the tool stands is known to "
        "the control only"
    ),
    BLIND_ARC: Phrase("an arc needs a known start: give X, Y and Z before it"),
    BAD_ARC: Phrase("start and end of the arc are not equally far from its centre"),
    HUGE_ARC: Phrase("an arc of more than 20 000 chords is not read"),
    USELESS_P: Phrase("P belongs to G4"),
    PERCENT_PLACE: Phrase("% must stand alone, on the first line of the program and after its end"),
    BAD_NAME: Phrase(
        "a program's name must be O and 1 to 16 letters or digits, alone on its line before the first move"
    ),
    NEEDS_POINT: Phrase(
        "this control reads a coordinate or feed without a decimal point in its least input (X8.0, not X8)"
    ),
    DECIMALS_LEFT_OUT: Phrase("more decimals than this control takes"),
    TWO_DIGITS_ONLY: Phrase("this control takes G and M words with two digits only (G01, not G1)"),
    USELESS_WORD: Phrase("H belongs to G43, or to G15, G16 and G56; Q to G64 or G5.1; I, J and R to G2 and G3"),
    RAISED_WRONG: Phrase(
        "machine coordinates are allowed only for G0 Z, absolute (G90), to raise the head before it moves across"
    ),
    ALONE: Phrase("G5.1 must stand alone with Q, G8 with P: 1 for on, 0 for off"),
    BAD_OFFSET: Phrase("G15 needs H, the work offset, 1 to 6"),
    OFFSET_CHANGES: Phrase("a program must use one work offset and name it before its first move"),
    NO_COMMAND: Phrase("not a command that is read here; allowed: {words}", words=ALLOWED_RML),
    BAD_NUMBERS: Phrase("the command takes other numbers: whole ones for Z (three), !RC, !MC (0 or 1), W (1 or more)"),
    NO_SEMICOLON: Phrase("each command ends with ; on its own line"),
    RELATIVE: Phrase(
        "after ^PR and until ^PA only Z0,0,n, straight up, is allowed; a move across only after Z0,0,10500, at "
        "that height"
    ),
    NO_VELOCITY: Phrase("a move needs a speed: V, from 0.1 to 50 mm/s"),
}


class ProgramError(CamError):
    """A program line that is not allowed. Attributes: line (from 1), text, reason."""

    def __init__(self, line: int, text: bytes, reason: Phrase) -> None:
        shown = text.strip(b"\r\n").decode("ascii", "backslashreplace")
        self.line = line
        self.text = shown if len(shown) <= 100 else shown[:97] + "..."
        self.reason = reason
        super().__init__(Phrase('line {line}, "{text}": {reason}', line=line, text=self.text, reason=reason))


DWELL_P, DWELL_X, DWELL_F = range(3)
TAPE, DWELL, TWO_DIGITS, POINTED, DECIMALS, LETTERS, BLENDS, OFFSETS_BY_H, COOLANT, PRECISE, TOOLS, RULES = range(12)
CHANGES_IN_MIDDLE = 2  # of the rule TOOLS: in the middle, too, where the head is at its top and the spindle off


@dataclass(frozen=True, slots=True, kw_only=True)
class Language:
    """One control's language.

    kind          : words of G-code, or commands of RML-1
    tape          : % stands first and last, then a name: O and letters or digits
    dwell         : G4 by P or by F in seconds, or by X in seconds
    two_digits    : G01, not G1
    pointed       : letters whose numbers need a decimal point
    most_decimals : more would be cut off, or refused; one more in inches
    blends        : G64 P Q, and G61.1
    coolant       : M7, M8, M9
    precise       : G5.1 Q and G8 P, 1 for on and 0 for off
    tools         : T and M6 change tools, G43 H takes a length from the table (G56 H where offsets are by H)
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
    tools: bool = False
    offsets_by_h: bool = False
    digit_mm: float = 1e-5

    def rules(self) -> np.ndarray:
        """Return the rules in the form of the compiled reader: (RULES,) int64."""
        rules = np.zeros(RULES, dtype=np.int64)
        rules[TAPE], rules[DWELL], rules[TWO_DIGITS] = self.tape, self.dwell, self.two_digits
        rules[POINTED], rules[DECIMALS] = _bits(self.pointed), self.most_decimals
        rules[LETTERS] = _bits(
            "FIJNPRSXYZ"
            + "T" * self.tools
            + "Q" * (self.blends or self.precise)
            + "H" * (self.offsets_by_h or self.tools)
        )
        rules[BLENDS], rules[OFFSETS_BY_H] = self.blends, self.offsets_by_h
        rules[COOLANT], rules[PRECISE], rules[TOOLS] = self.coolant, self.precise, self.tools
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
        Language(name="linuxcnc", tape=True, blends=True, tools=True),
        Language(
            name="fanuc",
            tape=True,
            dwell=DWELL_X,
            pointed="XYZIJR",
            most_decimals=3,
            precise=True,
            tools=True,
            digit_mm=0.001,
        ),
        Language(
            name="okuma",
            tape=True,
            dwell=DWELL_F,
            pointed="XYZIJRF",
            most_decimals=3,
            tools=True,
            offsets_by_h=True,
            digit_mm=0.001,
        ),
        Language(
            name="roland-nc",
            tape=True,
            two_digits=True,
            pointed="XYZIJRF",
            most_decimals=3,
            coolant=False,
            digit_mm=0.001,
        ),
        Language(name="rml-1", kind="rml", digit_mm=0.01),
    )
}
