"""Finds the line at which a program can be re-entered: the last move that was certainly cut, and the modal state before
it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from machines.driver import Triple
from machines.errors import MachineError
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.program import ProgramReader
from phrases.phrase import Phrase

_MOTION_WORD = re.compile(rb"G(?:0*[0123]|38\.[2-5]|80)(?![0-9.])")
_MOTIONS = ("G0", "G1", "G2", "G3")


class NoEntryError(MachineError):
    """The program cannot be entered there; the text gives the reason and the alternatives."""

    def __init__(self, line: int, why: Phrase) -> None:
        super().__init__(Phrase("line {line} cannot be entered: {why}", line=line, why=why))


@dataclass(frozen=True, slots=True, kw_only=True)
class EntryPoint:
    """Send from `line` on, with `state` before it and the tool at `position_mm` (None: from the top of the program).

    motion : word to put before that line, which relies on an earlier motion word; "" if it has its own
    why    : the reason for an entry away from the usual place, in words
    """

    line: int
    state: ModalState
    position_mm: Triple | None
    motion: str = ""
    why: Phrase | None = None


def find_entry(reader: ProgramReader, executed_line: int) -> EntryPoint:
    """Return the place one move back from the first line not executed. NoEntryError, or ProgramChangedError from the
    reader.
    """
    entries = reader.index.entries
    for number in range(reader.index.before(executed_line + 1), -1, -1):
        found = _last_move(reader, entries[number].line, entries[number].state, executed_line)
        if found is not None:
            line, text, why = found
            return _entry(reader, line, text, why)
    return EntryPoint(line=1, state=ModalState(), position_mm=None)


def _last_move(
    reader: ProgramReader, from_line: int, state: ModalState, executed_line: int
) -> tuple[int, bytes, Phrase | None] | None:
    """Return the last executed move whose start is known, in the piece from `from_line`; after a tool change, the first
    there.

    A tool change (T, M0, M1) is never stepped back over: the overlap would be cut with another tool.
    """
    interpreter = Interpreter(state, dialect=reader.index.dialect)
    best: tuple[int, bytes, Phrase | None] | None = None
    stop = 0  # the last stop, while no move after it has been seen
    begun = None not in state.position_mm  # before the first known place there is nothing to join
    for line in reader.lines(from_line):
        after = line.number > executed_line
        if after and not stop:
            return best
        step = interpreter.take(line.text)
        if step.moves and not step.probes and None not in step.start_mm:
            why = Phrase("no overlap: line {line} is a stop or a tool change", line=stop) if stop else None
            best, stop, begun = (line.number, line.text, why), 0, True
            if after:
                return best
        elif after and step.moves:
            raise NoEntryError(line.number, Phrase("the program does not say where the tool is before it"))
        if (step.withholds_ok or b"T" in line.text) and begun and not after:
            stop = line.number
    if stop:
        raise MachineError(
            Phrase("nothing is left to cut after line {line}, which was executed: the program is done", line=stop)
        )
    return best


def _entry(reader: ProgramReader, line: int, text: bytes, why: Phrase | None) -> EntryPoint:
    state = reader.state_before(line)
    if state.distance != "G90":
        words = Phrase("the program is in G91 (incremental) there; start it from its top, or from a G90 version")
        raise NoEntryError(line, words)
    if state.shifted:
        words = Phrase(
            "the program has moved its own frame (G10, G92, G43.1), or changed its tool and taken its length from the "
            "control's table (M6, G43 H), before it; start it from its top"
        )
        raise NoEntryError(line, words)
    if state.ended:
        raise NoEntryError(line, Phrase("the program has ended (M2, M30) before it"))
    x, y, z = state.position_mm
    if x is None or y is None or z is None:
        words = Phrase("the program does not say where the tool is before it; start it from its top")
        raise NoEntryError(line, words)
    motion = ""
    if not _MOTION_WORD.search(text):
        if state.motion not in _MOTIONS:
            words = Phrase("the motion mode there is {mode}, which recovery cannot restore", mode=state.motion)
            raise NoEntryError(line, words)
        motion = state.motion
    return EntryPoint(line=line, state=state, position_mm=(x, y, z), motion=motion, why=why)
