"""Checks before a program is sent: its file, the modes on which it relies, whether it stays within the machine.

A controller with soft limits would stop in the middle of the cut; one without would hit the end of its travel. Machine
coordinates are valid if the machine was homed, or if the controller itself uses them (soft limits); otherwise a misfit
is only reported, and the operator decides.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from machines.driver import MillStatus, Triple
from machines.errors import MachineError, NotAllowedError, ProgramChangedError
from machines.gcode.dialects import RML
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.program import ProgramReader
from machines.grbl.settings import ControllerSettings
from machines.mill.run import Run
from machines.preflight.preflight import Bounds, Preflight, placement_problems, work_zero_mm
from machines.preflight.way_in import WAY_IN, find_risk, read_from_place, read_way_in
from phrases.phrase import Phrase

_PRESUMED = ("G54", "G17", "G94")  # that a program relies on without stating them, besides `Preflight.assumed`
LINES_LOOKED_AT = 50_000  # in the search for the first line that leaves the travel: half a second


@dataclass(frozen=True, slots=True)
class Placement:
    """The misfits, one sentence each. `certain`: machine coordinates are known to be right."""

    problems: tuple[Phrase, ...] = ()
    certain: bool = False


def check_file(run: Run, facts: Preflight) -> None:
    try:
        size = run.path.stat().st_size
    except OSError as error:
        raise ProgramChangedError(
            Phrase("{path}: can no longer be read ({reason})", path=run.path, reason=error.strerror)
        ) from None
    if size != facts.bytes:
        raise ProgramChangedError(
            Phrase(
                "{path}: has {size_bytes} bytes, pre-flight read {read_bytes}; load it again",
                path=run.path,
                size_bytes=size,
                read_bytes=facts.bytes,
            )
        )


def check_modes(facts: Preflight, answer: dict[str, Any] | None) -> None:
    """Raise NotAllowedError if the program relies on modes that the controller is not in."""
    modes = str((answer or {}).get("parser_state") or "").split()
    if not modes:
        return
    missing = [mode for mode in (*facts.assumed, *_PRESUMED) if mode not in modes]
    missing += ["G0"] if any(mode.startswith("G38") for mode in modes) else []  # axis words alone would probe
    if missing:
        raise NotAllowedError(
            Phrase(
                "start: the program assumes {missing}, but the controller is in {modes}: send '{missing}' first",
                missing=" ".join(missing),
                modes=" ".join(modes),
            )
        )


def check_homed(facts: Preflight, settings: ControllerSettings | None, *, homed: bool) -> None:
    """Raise NotAllowedError if the program uses machine coordinates (G53), which are not valid here."""
    if settings is None or "machine" not in facts.bounds_by_frame or homed or settings.soft_limits:
        return
    way = Phrase("home the mill")
    if not settings.homing:
        way = Phrase("this mill has no homing: write it with a profile without top_z_mm")
    raise NotAllowedError(
        Phrase("start: the program uses machine coordinates (G53), which are valid only after homing: {way}", way=way)
    )


def check_way_in(
    facts: Preflight, reader: ProgramReader, place_mm: Triple | None, offsets: Mapping[str, Sequence[float]]
) -> None:
    """Raise NotAllowedError if the program may hit something on its way in from the tool's position.

    place_mm : of the tool, in machine coordinates, None: not known; offsets: of the controller, by name
    The greatest height of the program is safe, because it crosses at that height all the time.
    """
    if facts.dialect == RML:  # such a mill does not report its position: pre-flight has judged the program for any
        for finding in facts.findings:
            if finding.code == WAY_IN:
                raise NotAllowedError(Phrase("start: {risk}", risk=finding.words))
        return
    lines, dialect = list[tuple[int, bytes]](), reader.index.dialect
    way = read_way_in(_keep_lines(reader, lines), dialect=dialect)
    box, zero_mm = facts.bounds_by_frame.get(way.frame), work_zero_mm(offsets, way.frame)
    over = None
    if place_mm is not None and box is not None and zero_mm is not None:
        x, y, z = (place - zero for place, zero in zip(place_mm, zero_mm, strict=True))
        way, over = read_from_place(lines, dialect=dialect, wcs=way.frame, place_mm=(x, y, z)), box
    highest_mm = max((box.most_mm[2] or 0.0 for box in facts.bounds_by_frame.values()), default=0.0)
    risk = find_risk(way.motions, safe_z_mm=highest_mm, top_z_mm=None, over=over)
    if risk is not None:
        raise NotAllowedError(Phrase("start: {risk}", risk=risk))


def _keep_lines(reader: ProgramReader, lines: list[tuple[int, bytes]]) -> Iterator[tuple[int, bytes]]:
    """Yield the program's lines and append each to `lines`."""
    with suppress(ProgramChangedError):  # the run reports it when it reaches that piece, and sends nothing of it
        for line in reader.lines(1):
            lines.append((line.number, line.text))
            yield lines[-1]


def program_placement(
    facts: Preflight, reader: ProgramReader, settings: ControllerSettings | None, status: MillStatus
) -> Placement:
    """Check the whole program at the present offsets."""
    if settings is None:
        return Placement()
    problems = placement_problems(facts, settings)
    if not problems:
        return Placement()
    where = _first_outside(facts, reader, settings)
    return Placement(
        tuple(Phrase("{problem} ({where})", problem=problem, where=where) for problem in problems),
        _certain(settings, status),
    )


def recovery_placement(
    blocks: Sequence[str],
    facts: Preflight,
    reader: ProgramReader,
    settings: ControllerSettings | None,
    status: MillStatus,
) -> Placement:
    """Check the way in, and the whole rest of the program; the part that is already cut has fitted."""
    whole = program_placement(facts, reader, settings, status)
    way = _way_in_placement(blocks, facts, settings, status)
    return Placement((*whole.problems, *way.problems), whole.certain or way.certain)


def _way_in_placement(
    blocks: Sequence[str], facts: Preflight, settings: ControllerSettings | None, status: MillStatus
) -> Placement:
    """Check the blocks of a recovery, from the tool's position."""
    if settings is None or status.work_mm is None:
        return Placement()
    interpreter = Interpreter(ModalState(position_mm=status.work_mm))
    points = []
    for block in blocks:
        try:
            step = interpreter.take(block.encode("ascii"))
        except MachineError:
            return Placement()  # refused elsewhere, with the block
        if step.moves:
            points.append(step.end_mm)
    if not points:
        return Placement()
    box = _box(points)
    problems = placement_problems(replace(facts, bounds_by_frame={interpreter.state.wcs: box}), settings)
    return Placement(
        tuple(Phrase("on the way back in {problem}", problem=problem) for problem in problems),
        _certain(settings, status),
    )


def _certain(settings: ControllerSettings, status: MillStatus) -> bool:
    return bool(settings.soft_limits) or (bool(settings.homing) and status.position_trusted)


def _box(points: Sequence[tuple[float | None, float | None, float | None]]) -> Bounds:
    known = [[point[axis] for point in points if point[axis] is not None] for axis in range(3)]
    least = [min(values, default=None) for values in known]  # type: ignore[type-var]
    most = [max(values, default=None) for values in known]  # type: ignore[type-var]
    return Bounds((least[0], least[1], least[2]), (most[0], most[1], most[2]))


def _first_outside(facts: Preflight, reader: ProgramReader, settings: ControllerSettings) -> Phrase:
    """Return in words the first line that leaves the travel."""
    interpreter = Interpreter(ModalState(), dialect=reader.index.dialect)
    last = 0
    try:
        for line in reader.lines(1):
            step = interpreter.take(line.text)
            last = line.number
            if step.moves and not interpreter.state.shifted:
                box = Bounds(step.end_mm, step.end_mm)
                if placement_problems(replace(facts, bounds_by_frame={interpreter.state.wcs: box}), settings):
                    return Phrase("from line {line} of {count} on", line=last, count=facts.lines)
            if last >= LINES_LOOKED_AT:
                break
    except MachineError:
        pass
    return Phrase("after line {line} of {count}", line=last, count=facts.lines)
