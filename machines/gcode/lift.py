"""The same program in the air: every height raised by a lift, spindle and coolant off, for a dry pass. Only words are
accepted for which raising Z is certainly enough; any other is refused by name. Moves in machine coordinates (G53) stay:
they go to the top of the travel. The result is a program like any other: it passes its own pre-flight, and its travel
is checked at its start.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from decimal import Decimal

from machines.errors import ProgramRefusedError
from machines.gcode.dialects import DIALECTS
from machines.gcode.text import BadTextError, show_line, split_words, strip_block
from phrases.phrase import Phrase

LIFT_MM = (1.0, 200.0)  # least and most
_KEPT_G = frozenset({0, 1, 2, 3, 4, 17, 18, 19, 21, 40, 49, *range(53, 60), 80, 90, Decimal("91.1"), 94})
_KEPT_M = frozenset({0, 1, 2, 5, 6, 9, 30})
_DROPPED_M = frozenset({3, 4, 7, 8})
_KEPT_LETTERS = frozenset({b"X", b"Y", b"I", b"J", b"K", b"R", b"F", b"P", b"N", b"T"})
_MACHINE = Decimal(53)
_OFF = b"M5M9"


def require_liftable(dialect: str) -> None:
    """Raise ProgramRefusedError for a language, or a control, whose programs cannot be raised line by line."""
    known = DIALECTS.get(dialect)
    if known is None or known.tapes or known.spindle_first:
        raise ProgramRefusedError(0, "", Phrase("a dry pass of {dialect} is not possible", dialect=dialect))


def lift_program(lines: Iterable[bytes], lift_mm: float) -> Iterator[bytes]:
    """Yield the lines of the program in the air, without line ends. ProgramRefusedError at the first that cannot be."""
    yield _OFF
    lift = Decimal(repr(lift_mm))
    for number, line in enumerate(lines, 1):
        block = strip_block(line)
        try:
            words = split_words(block)
        except BadTextError:
            raise _refuse(number, line, block.decode("ascii", "replace")[:20]) from None
        if text := _lift_block(words, lift, number, line):
            yield text


def _lift_block(words: list[tuple[bytes, bytes]], lift: Decimal, number: int, line: bytes) -> bytes:
    in_machine = (b"G", _MACHINE) in [(letter, Decimal(value.decode())) for letter, value in words]
    kept = []
    for letter, text in words:
        value = Decimal(text.decode())
        if letter == b"S" or (letter == b"M" and value in _DROPPED_M):
            continue
        if letter == b"Z":
            kept.append(letter + (text if in_machine else format(value + lift, "f").encode()))
        elif (letter == b"G" and value in _KEPT_G) or (letter == b"M" and value in _KEPT_M) or letter in _KEPT_LETTERS:
            kept.append(letter + text)
        else:
            raise _refuse(number, line, f"{letter.decode()}{text.decode()}")
    return b"".join(kept)


def _refuse(number: int, line: bytes, word: str) -> ProgramRefusedError:
    return ProgramRefusedError(number, show_line(line), Phrase("{word} cannot be raised for a dry pass", word=word))
