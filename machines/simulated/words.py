"""Reads one line of G-code as GRBL's parser does: its words, and its errors in GRBL's order.

Error numbers are those of GRBL 1.1 ("error:N"); they are raised where the firmware's parser meets them: letter by
letter for words, modal groups and repeats. The meaning of the words together is checked in `interpreter`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field


class GcodeError(Exception):
    """error:code"""

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


LETTER, NUMBER, NEGATIVE, MODAL_GROUP, NOT_INTEGER, AXIS_CONFLICT, REPEATED, UNSUPPORTED, LARGEST_TOOL = (
    1, 2, 4, 21, 23, 24, 25, 20, 38,
)  # fmt: skip

_WORD = re.compile(rb"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")
_VALUES = frozenset("FIJKLNPRSTXYZ")
_NOT_NEGATIVE = frozenset("FNPTS")

# One modal group of GRBL per command; "axis": the command takes the axis words of the line.
_G_GROUPS: dict[str, tuple[str, bool]] = {
    "G4": ("non-modal", False), "G10": ("non-modal", True), "G28": ("non-modal", True), "G28.1": ("non-modal", False),
    "G30": ("non-modal", True), "G30.1": ("non-modal", False), "G53": ("non-modal", False),
    "G92": ("non-modal", True), "G92.1": ("non-modal", False),
    "G0": ("motion", True), "G1": ("motion", True), "G2": ("motion", True), "G3": ("motion", True),
    "G38.2": ("motion", True), "G38.3": ("motion", True), "G38.4": ("motion", True), "G38.5": ("motion", True),
    "G80": ("motion", False), "G17": ("plane", False), "G18": ("plane", False), "G19": ("plane", False),
    "G90": ("distance", False), "G91": ("distance", False), "G91.1": ("arc-distance", False),
    "G93": ("feed-mode", False), "G94": ("feed-mode", False), "G20": ("units", False), "G21": ("units", False),
    "G40": ("cutter-comp", False), "G43.1": ("tool-length", True), "G49": ("tool-length", True),
    "G54": ("wcs", False), "G55": ("wcs", False), "G56": ("wcs", False), "G57": ("wcs", False),
    "G58": ("wcs", False), "G59": ("wcs", False), "G61": ("control", False),
}  # fmt: skip
# For these numbers any other fraction is "unsupported"; for the rest it is "not an integer".
_FRACTION_UNSUPPORTED = frozenset((28, 30, 92, 38, 43, 61, 90, 91))
_M_GROUPS = {0: "flow", 1: "flow", 2: "flow", 30: "flow", 3: "spindle", 4: "spindle", 5: "spindle",
             7: "coolant", 8: "coolant", 9: "coolant"}  # fmt: skip


@dataclass(slots=True)
class Words:
    """The content of one line. commands: group -> command ("G1", "M3"); values: letter -> number, as written.

    axis_command : "" | "motion" | "non-modal" | "tool-length": the command that takes the axis words
    """

    commands: dict[str, str] = field(default_factory=dict)
    values: dict[str, float] = field(default_factory=dict)
    axis_command: str = ""
    non_modal: str = ""

    @property
    def axes(self) -> str:
        return "".join(a for a in "XYZ" if a in self.values)


def read_words(code: bytes, *, mist: bool) -> Words:
    """Return words of a line without spaces and comments, upper case. Raises GcodeError."""
    words = Words()
    at = 0
    while at < len(code):
        match = _WORD.match(code, at)
        if match is None:
            raise GcodeError(NUMBER if 65 <= code[at] <= 90 else LETTER)
        at = match.end()
        letter, value = chr(code[match.start()]), float(match.group(2))
        if letter == "G":
            _take_g_word(words, value)
        elif letter == "M":
            _take_m_word(words, value, mist)
        elif letter not in _VALUES:
            raise GcodeError(UNSUPPORTED)
        else:
            if letter == "T" and value > 255:
                raise GcodeError(LARGEST_TOOL)
            if letter in words.values:
                raise GcodeError(REPEATED)
            if value < 0 and letter in _NOT_NEGATIVE:
                raise GcodeError(NEGATIVE)
            words.values[letter] = value
    return words


def _take_g_word(words: Words, value: float) -> None:
    whole = int(value)
    hundredths = round(100 * (value - whole))
    name = f"G{whole}.{hundredths // 10}" if hundredths and hundredths % 10 == 0 else f"G{whole}"
    if hundredths % 10 or name not in _G_GROUPS:
        if f"G{whole}" in _G_GROUPS and whole not in _FRACTION_UNSUPPORTED:
            raise GcodeError(NOT_INTEGER)
        raise GcodeError(UNSUPPORTED)
    group, takes_axes = _G_GROUPS[name]
    if takes_axes:
        if words.axis_command:
            raise GcodeError(AXIS_CONFLICT)
        words.axis_command = group
    if group in words.commands:
        raise GcodeError(MODAL_GROUP)
    words.commands[group] = name
    if group == "non-modal":
        words.non_modal = name


def _take_m_word(words: Words, value: float, mist: bool) -> None:
    whole = int(value)
    if round(100 * (value - whole)):
        raise GcodeError(NOT_INTEGER)
    group = _M_GROUPS.get(whole)
    if group is None or (whole == 7 and not mist):
        raise GcodeError(UNSUPPORTED)
    if group in words.commands:
        raise GcodeError(MODAL_GROUP)
    words.commands[group] = f"M{whole}"
