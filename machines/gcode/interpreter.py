"""Interprets block after block in plain Python, for the streaming process, which must stay small and quick.

Straight moves, nearly all of a program, take a fast path; everything else goes through language.execute_block, the
source that the scanner of whole programs compiles.
"""

from __future__ import annotations

import math
import re

from machines.errors import MachineError, ProgramRefusedError
from machines.gcode import language, refusals
from machines.gcode.dialects import DIALECTS
from machines.gcode.modal import Arc, ModalState, Position, Step, state_of, vector_of
from machines.gcode.text import BadTextError, show_line, split_words, strip_block
from phrases.phrase import Phrase

_NUMBER = rb"([-+]?(?:\d{1,9}(?:\.\d{0,8})?|\.\d{1,8}))"
_STRAIGHT = re.compile(rb"(?:G0?([01]))?" + b"".join(rb"(?:%c%s)?" % (c, _NUMBER) for c in b"XYZF")).fullmatch
_KINDS = {
    language.NONE: "none",
    language.RAPID: "rapid",
    language.CUT: "feed",
    language.ARC: "arc",
    language.DWELL: "dwell",
    language.JUMP: "rapid",
    language.MACHINE: "rapid",
    language.PROBE: "feed",
}
_PLANES = {17.0: (0, 1, 2), 18.0: (2, 0, 1), 19.0: (1, 2, 0)}
_FAR_MM = 100_000.0
_WHOLE = {b"%d" % n: 10 * n for n in range(100)}  # nearly all G and M numbers


class Interpreter:
    """Keeps the modal state of a program; `take` executes one block of it."""

    __slots__ = ("_dialect", "_letters", "_out", "_plain", "_position", "_vector")
    _plain: bool
    _position: Position

    def __init__(self, state: ModalState | None = None, *, dialect: str = "grbl") -> None:
        if dialect not in DIALECTS:
            raise MachineError(
                Phrase("dialect {dialect}: not G-code, so nothing modal can be rebuilt from its lines", dialect=dialect)
            )
        self._dialect = DIALECTS[dialect]
        self._letters = self._dialect.letter_bits
        self._vector = vector_of(state or ModalState())
        self._out = [0.0] * language.OUT_SIZE
        self._settle()

    @property
    def state(self) -> ModalState:
        return state_of(self._sync())

    def take(self, text: bytes) -> Step:
        """Carry out one block. ProgramRefusedError with line 0 where it may not run."""
        match = _STRAIGHT(text) if self._plain else None
        if match is None:
            return self._general(text)
        motion, x_text, y_text, z_text, feed_text = match.groups()
        vector = self._vector
        if motion is not None:
            mode = 10.0 if motion == b"1" else 0.0
        else:
            mode = vector[language.MOTION]
            if mode > 10.0 and (x_text or y_text or z_text):
                return self._general(text)
        if feed_text is not None:
            feed = float(feed_text)
            if not feed > 0.0:
                raise self._refuse(text, refusals.BAD_FEED)
        else:
            feed = vector[language.FEED]
        start = self._position
        x, y, z = start
        dx = dy = dz = 0.0
        if x_text is not None:
            new = float(x_text)
            dx = new - x if x is not None else 0.0
            x = new
        if y_text is not None:
            new = float(y_text)
            dy = new - y if y is not None else 0.0
            y = new
        if z_text is not None:
            new = float(z_text)
            dz = new - z if z is not None else 0.0
            z = new
        elif x_text is None and y_text is None:
            return self._general(text)  # no coordinates: a lone mode or feed
        if mode and not feed > 0.0:
            raise self._refuse(text, refusals.NO_FEED)
        vector[language.FEED] = feed
        vector[language.MOTION] = mode
        end: Position = (x, y, z)
        for value in end:
            if value is not None and not -_FAR_MM <= value <= _FAR_MM:
                raise self._refuse(text, refusals.OUT_OF_RANGE)
        self._position = end
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if mode:
            return Step("feed", start, end, feed, length)
        return Step("rapid", start, end, None, length)

    def _general(self, text: bytes) -> Step:
        """Interpret any block with language.execute_block."""
        block = strip_block(text)
        if block == b"%" and self._dialect.percent:
            return Step("none", self._position, self._position)
        if block[:1] == b"O" and self._dialect.named:
            return Step("none", self._position, self._position)
        values, seen, g, m = [0.0] * 26, 0, [], []
        try:
            for letter, number in split_words(block):
                place = letter[0] - 65
                if letter == b"G":
                    g.append(self._code(block, number, refusals.WRONG_G))
                elif letter == b"M":
                    m.append(self._code(block, number, refusals.WRONG_M))
                elif not (self._letters >> place) & 1:
                    raise BadTextError(refusals.WRONG_LETTER)
                elif (seen >> place) & 1:
                    raise BadTextError(refusals.REPEATED)
                else:
                    seen |= 1 << place
                    values[place] = float(number)
        except BadTextError as error:
            raise self._refuse(text, error.code) from None
        vector, out, dialect = self._sync(), self._out, self._dialect
        code = language.execute_block(vector, values, seen, g, len(g), m, len(m), dialect.own, dialect.n_limit, out)
        if code:
            raise self._refuse(text, code)
        self._settle()
        return self._step()

    def _code(self, block: bytes, number: bytes, refusal: int) -> int:
        if number in _WHOLE:
            return _WHOLE[number]
        tenths = float(number) * 10.0
        code = round(tenths)
        if abs(tenths - code) > 1e-6 or code < 0:
            raise BadTextError(refusal)
        return code

    def _step(self) -> Step:
        out = self._out
        kind, flags = int(out[language.KIND]), int(out[language.FLAGS])
        end = self._position
        if kind == language.PROBE:
            end = _make_position(out[language.END], out[language.END + 1], out[language.END + 2])
        start = _make_position(out[language.START], out[language.START + 1], out[language.START + 2])
        arc = None
        if kind == language.ARC:
            u, v, w = _PLANES[self._vector[language.PLANE]]
            arc = Arc(u, v, w, *out[language.CENTRE_U : language.SWEEP + 1])
        machine = None
        if kind == language.MACHINE:
            machine = _make_position(out[language.END], out[language.END + 1], out[language.END + 2])
        feed = out[language.BLOCK_FEED]
        return Step(
            _KINDS[kind],
            start,
            end,
            feed if feed == feed else None,
            out[language.LENGTH],
            out[language.PAUSE],
            bool(flags & language.WAITS),
            bool(flags & language.WITHHOLDS),
            bool(flags & language.ENDS),
            bool(flags & language.WRITES),
            kind == language.PROBE,
            arc,
            machine,
            kind == language.JUMP,
        )

    def _sync(self) -> list[float]:
        """Return the vector after writing back the position of the fast path."""
        x, y, z = self._position
        self._vector[:3] = (
            math.nan if x is None else x, math.nan if y is None else y, math.nan if z is None else z,
        )  # fmt: skip
        return self._vector

    def _settle(self) -> None:
        """Set the position, and whether the fast path is allowed, from the vector."""
        v = self._vector
        self._position = _make_position(v[0], v[1], v[2])
        self._plain = (
            v[language.MM] == 1.0 and v[language.ABSOLUTE] == 1.0 and v[language.FEED_MODE] == 94.0
            and v[language.ENDED] == 0.0
        )  # fmt: skip

    def _refuse(self, text: bytes, code: int) -> ProgramRefusedError:
        return ProgramRefusedError(0, show_line(text), self._dialect.reason_for(code))


def _make_position(x: float, y: float, z: float) -> Position:
    return (x if x == x else None, y if y == y else None, z if z == z else None)
