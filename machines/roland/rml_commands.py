"""RML-1 commands and what their parameters may be.

Source: Roland's RML-1 programming guideline (2002): mode 1 `D F H I M R V W Z @ ^`, mode 2 `DF IN PA PD PR PU VS`,
common `!DW !MC !NR !PZ !RC !VZ !ZM !ZO !ZZ !ZE`; whole numbers -32768..32767, others up to 8388608. Ranges of V, W
and !RC on the MDX-40 branch: Autodesk's Roland RML post. Coordinates are whole hundredths of a millimetre; `^` calls
a mode 2 command from mode 1.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from machines.gcode.text import shown
from phrases.phrase import Phrase

UNIT_MM = 0.01
NO_HEIGHT = 10_500  # in units, and above: the mill stops at its top [src: posts lift by it, and go across at it]
FASTEST_MM_PER_S = 50.0  # V of the MDX-40: 3000 mm/min
LONGEST_DWELL_MS = 32767
MOST_COMMAND_BYTES = 256  # far above any command of use; a file without `;` is not RML
LARGEST = 8388608.0
SPEED_CODES = 15  # !RC 0..15: evenly from the slowest to the fastest spindle speed

_NAME = re.compile(rb"\^?(DF|IN|PA|PD|PR|PU|VS|![A-Z]{2}|[DFHIMRVWZ@])")
_NUMBER = re.compile(rb"[+-]?(\d+(\.\d*)?|\.\d+)\Z")
_LOOKS_LIKE_NC = re.compile(rb"[%(]|[GMNOST][0-9]")
_ORIGIN_WORDS = re.compile(rb"([XYZA][+-]?\d+)+\Z")


@dataclass(frozen=True, slots=True)
class Shape:
    """Parameters of one command: how many (any multiple of `group` beyond `least` if `repeats`), and their range."""

    least: int
    most: int
    low: float = -LARGEST
    high: float = LARGEST
    whole: bool = True
    repeats: bool = False


_XY = Shape(0, 2, repeats=True)
SHAPES = {
    "D": _XY, "I": _XY, "M": _XY, "R": _XY, "PA": _XY, "PR": _XY, "PD": _XY, "PU": _XY,
    "Z": Shape(3, 3, repeats=True), "!ZZ": Shape(3, 3, repeats=True),
    "!ZM": Shape(1, 1), "!PZ": Shape(1, 2), "@": Shape(0, 2),
    "V": Shape(1, 1, 0.1, FASTEST_MM_PER_S, whole=False), "F": Shape(1, 1, 0.1, FASTEST_MM_PER_S, whole=False),
    "VS": Shape(1, 1, 0.1, FASTEST_MM_PER_S, whole=False), "!VZ": Shape(1, 1, 0.1, FASTEST_MM_PER_S, whole=False),
    "W": Shape(1, 1, 1, LONGEST_DWELL_MS), "!DW": Shape(1, 1, 1, LONGEST_DWELL_MS),
    "!MC": Shape(0, 1, 0, 1), "!RC": Shape(1, 1, 0, 100000),
    "DF": Shape(0, 0), "IN": Shape(0, 0), "H": Shape(0, 0), "!NR": Shape(0, 0),
}  # fmt: skip
_NO_COMMAND = Phrase("is not an RML-1 command")
REFUSED = {
    "!ZO": Phrase("moves the zero of Z in the middle of a job: set the zero at the mill"),
}


class RmlFault(ValueError):
    """What is wrong with one command, in words."""

    def __init__(self, words: Phrase) -> None:
        super().__init__(words)


@dataclass(frozen=True, slots=True)
class Command:
    """One command: its name without `^`, its numbers as they stand (hundredths of a mm, mm/s, ms ...)."""

    name: str
    numbers: tuple[float, ...]
    words: bytes = b""  # !ZE: axis words


def parse(text: bytes) -> Command | None:
    """Return the command in `text` (no `;`); None for an empty one. RmlFault says what is wrong."""
    body = text.strip()
    if not body:
        return None
    if len(body) > MOST_COMMAND_BYTES:
        raise RmlFault(
            Phrase(
                "{count} bytes without ';' are not an RML-1 command (at most {most})",
                count=len(body),
                most=MOST_COMMAND_BYTES,
            )
        )
    found = _NAME.match(body)
    if not found:
        if _LOOKS_LIKE_NC.match(body):
            raise RmlFault(Phrase('is not an RML-1 command; NC code needs a machine with dialect = "roland-nc"'))
        raise RmlFault(_NO_COMMAND)
    if b"\n" in body:  # a line is what the mill is fed with and what recovery counts by
        raise RmlFault(Phrase("goes on in the next line; end each command with ';' on its own line"))
    name = found[1].decode("ascii")
    rest = body[found.end() :].strip()
    if name in REFUSED:
        raise RmlFault(REFUSED[name])
    if name == "!ZE":
        if not _ORIGIN_WORDS.match(rest):
            raise RmlFault(Phrase("!ZE takes axis words such as X0Y0"))
        return Command(name, (), rest)
    if name not in SHAPES:
        raise RmlFault(_NO_COMMAND)
    shape = SHAPES[name]
    numbers = tuple(_number(part, shape) for part in re.split(rb"[,\s]+", rest)) if rest else ()
    _count(name, numbers, shape)
    return Command(name, numbers)


def spindle_rpm(code: float, slowest: float, fastest: float) -> float:
    """Return the speed that `!RC code` asks for: 0..15 evenly over the range, more is the speed itself."""
    return slowest + code * (fastest - slowest) / SPEED_CODES if code <= SPEED_CODES else code


def _number(part: bytes, shape: Shape) -> float:
    if not _NUMBER.match(part):
        raise RmlFault(Phrase("'{text}' is not a number", text=shown(part)))
    if shape.whole and b"." in part:
        raise RmlFault(
            Phrase("{text} must be a whole number (coordinates are hundredths of a millimetre)", text=part.decode())
        )
    value = float(part)
    if not shape.low <= value <= shape.high:
        raise RmlFault(
            Phrase("{text} is outside {low:g}..{high:g}", text=part.decode(), low=shape.low, high=shape.high)
        )
    return value


def _count(name: str, numbers: tuple[float, ...], shape: Shape) -> None:
    n = len(numbers)
    ok = n % shape.most == 0 and n >= shape.least if shape.repeats else shape.least <= n <= shape.most
    if not ok:
        wanted = str(shape.least)
        if shape.least != shape.most:
            wanted = Phrase("{least} to {most}", least=shape.least, most=shape.most)
        if shape.repeats:
            raise RmlFault(
                Phrase(
                    "{name} takes {wanted} numbers (or sets of them), not {count}", name=name, wanted=wanted, count=n
                )
            )
        raise RmlFault(Phrase("{name} takes {wanted} numbers, not {count}", name=name, wanted=wanted, count=n))
