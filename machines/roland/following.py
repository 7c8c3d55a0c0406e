"""Which lines are certainly cut, from reported positions: the mill is on the earliest line its position could be on.

Lines are executed in order. If a report lies on several lines (a path that comes back), the earliest of those not yet
known to be cut is taken: the line really being cut matches its own position, so nothing before the earliest match can
be uncut. Where no line matches (blended corner, dwell off the path), nothing is learned.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from machines.driver import Triple
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.step import Step
from machines.roland.rml import RmlInterpreter
from machines.roland.rml_commands import parse

NEAR_MM = 0.01  # reports are in 0.001 mm, a step is 0.002 mm; closer than the finest pitch of rows in use (0.02 mm)
_MOST_PENDING = 5000  # the mill holds a few blocks; more than this is not a buffer


@dataclass(frozen=True, slots=True)
class Travel:
    """What one line does: its moves, and the highest Z they reach [mm, work frame], None if that is not known."""

    ways: tuple[Step, ...]
    highest_z_mm: float | None


def nc_reader(dialect: str, start_mm: Triple | None = None) -> Callable[[bytes], Travel]:
    """Return a reader of lines of G-code, in order, to what they do. `start_mm` is where the mill stands (work frame):
    without it the first moves have no beginning, could be under way anywhere, and the mill would never be known to have
    left them."""
    interpreter = Interpreter(ModalState(position_mm=start_mm) if start_mm else None, dialect=dialect)

    def read(text: bytes) -> Travel:
        step = interpreter.take(text)
        ends = [z for z in (step.start_mm[2], step.end_mm[2]) if z is not None]
        return Travel((step,), max(ends) if ends else None) if step.moves else Travel((), None)

    return read


def rml_reader(start_mm: Triple | None = None) -> Callable[[bytes], Travel]:
    """Return a reader of lines of RML-1, each with any number of commands, to what they do."""
    interpreter = RmlInterpreter(position_mm=start_mm or (None, None, None))

    def read(text: bytes) -> Travel:
        commands = [parse(part) for part in text.split(b";")]
        return Travel(tuple(move for c in commands if c is not None for move in interpreter.take(c)), None)

    return read


@dataclass(slots=True)
class Follower:
    """Lines taken by the mill and not yet known to be cut."""

    executed_line: int = 0
    lost: bool = False  # too many lines without a match: nothing more can be said until the mill stands still
    _pending: deque[tuple[int, tuple[Step, ...]]] = field(default_factory=deque)
    _last_line: int = 0

    def take(self, line: int, ways: Iterable[Step]) -> None:
        self._last_line = line or self._last_line
        if self.lost:
            return
        self._pending.append((line, tuple(ways)))
        if len(self._pending) > _MOST_PENDING:
            self._pending.clear()
            self.lost = True

    def take_position(self, work_mm: Triple) -> None:
        """Take a reported position."""
        if self.lost:
            return
        for index, (_, ways) in enumerate(self._pending):
            if any(way.distance_mm(work_mm) <= NEAR_MM for way in ways):
                for _ in range(index):
                    self._note_done(self._pending.popleft()[0])
                return

    def finish(self) -> None:
        """Count all as executed that the mill was given."""
        self._pending.clear()
        self._note_done(self._last_line)
        self.lost = False

    def _note_done(self, line: int) -> None:
        self.executed_line = line or self.executed_line
