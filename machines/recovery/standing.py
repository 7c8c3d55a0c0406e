"""Finds what a mill has executed from the position at which it stands after it went on unattended with its buffered
lines.

A controller that has lost its link executes its buffer and stops at the end of a line that was sent. The first line
after the last one known to be executed on which the mill can stand is assumed: if a later line really was the last, the
mill has passed this one. A mill at the end of that line has cut it; a mill within it has cut the line before. So if a
path returns to a place, more lines may be sent again than necessary, but never fewer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from machines.driver import Triple
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState, Position
from machines.gcode.program import ProgramReader
from machines.grbl.settings import MM_PER_INCH, ControllerSettings
from machines.preflight.preflight import work_zero_mm
from machines.recovery.needs import OFFSET_TOLERANCE_MM

LINES_AFTER_LAST_MARK = 2000  # beyond the last journaled line of an owner that died: 1 s of short lines and a buffer
_LINES_BEFORE_PLACE = 200  # by then a program has stated all axes
_STEP_MM = 0.01  # if the controller does not report one


def tolerance_at_rest_mm(settings: ControllerSettings) -> float:
    """Return how far from the end of a line a mill that stands there may be reported, per axis.

    Half a step of the axis, and half the last digit of the position and of each of G54, G92 and tool length. Larger is
    safer: a line that is assumed too early is cut again.
    """
    digit_mm = 0.0001 * MM_PER_INCH if settings.reports_in_inch else 0.001
    step_mm = max(settings.step_mm or (_STEP_MM,))
    return 0.5 * step_mm + 4 * 0.5 * digit_mm


def frame_offset_mm(record: Mapping[str, Any], wcs: str) -> Triple | None:
    """Work zero of a run in machine coordinates, from its journal; None if that is not certain."""
    zero_mm, reported = work_zero_mm(record.get("offsets") or {}, wcs), record.get("work_offset_mm")
    if zero_mm is None or reported is None:
        return None
    agree = all(abs(a - b) <= OFFSET_TOLERANCE_MM for a, b in zip(reported, zero_mm, strict=True))
    return zero_mm if agree else None


def count_executed_at_rest(
    reader: ProgramReader, record: Mapping[str, Any], machine_mm: Triple, *, last_line: int, tolerance_mm: float
) -> int:
    """Return the last line that was executed for certain, not below the journal's and not above `last_line`.

    record : a run's journal. The mill must stand idle where its own blocks have left it: no restart, nothing sent.
    """
    executed = int(record.get("executed_line") or 0)
    if int(record.get("answered_line") or 0) <= 0:
        return executed  # it may stand on the way in, which is not part of the program
    state = reader.state_before(executed + 1)
    offset_mm = frame_offset_mm(record, state.wcs)
    if offset_mm is None:
        return executed
    if None in state.position_mm and executed < _LINES_BEFORE_PLACE:
        state = _from_its_start(reader, record, offset_mm, executed)
    if state.shifted or None in state.position_mm:
        return executed
    x, y, z = (m - o for m, o in zip(machine_mm, offset_mm, strict=True))
    return _first_place(reader, state, (x, y, z), executed, last_line, tolerance_mm)


def _from_its_start(reader: ProgramReader, record: Mapping[str, Any], offset_mm: Triple, executed: int) -> ModalState:
    """Return the state after the first lines of a program, with the axes it has not moved yet where they began."""
    state, began = reader.state_before(1), record.get("began_mm")
    if began is not None:
        x, y, z = (float(m) - o for m, o in zip(began, offset_mm, strict=True))
        state = replace(state, position_mm=(x, y, z))
    interpreter = Interpreter(state, dialect=reader.index.dialect)
    for line in reader.lines(1):
        if line.number > executed:
            break
        interpreter.take(line.text)
    return interpreter.state


def _first_place(
    reader: ProgramReader, state: ModalState, place_mm: Triple, executed: int, last_line: int, tolerance_mm: float
) -> int:
    if _at(state.position_mm, place_mm, tolerance_mm):
        return executed
    wcs, before = state.wcs, executed
    interpreter = Interpreter(state, dialect=reader.index.dialect)
    for line in reader.lines(executed + 1):
        if line.number > last_line:
            break
        step = interpreter.take(line.text)
        now = interpreter.state
        place_is_known = not (step.moves and (step.probes or None in step.end_mm))
        if not place_is_known or now.shifted or now.wcs != wcs or step.withholds_ok:
            break  # from here on the program does not determine the mill's position, or a person may have moved it
        if step.moves and step.distance_mm(place_mm) <= 3**0.5 * tolerance_mm:
            return line.number if _at(step.end_mm, place_mm, tolerance_mm) else before
        before = line.number
    return executed


def _at(end_mm: Position, place_mm: Triple, tolerance_mm: float) -> bool:
    return all(e is not None and abs(e - p) <= tolerance_mm for e, p in zip(end_mm, place_mm, strict=True))
