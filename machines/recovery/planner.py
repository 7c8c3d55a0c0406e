"""Plans the recovery of an interrupted run: from the journal to a plan that a person can check.

The plan starts at the line after the last one that was *executed* for certain, steps back one move (so that the cuts
overlap), and brings the tool there from its position: spindle on, straight up, across, down at plunge feed. Cutting
something twice is harmless; skipping, or starting in a wrong place, is not. A state that cannot be reconstructed with
certainty is refused. Nothing here reads a clock, a port or a journal, and nothing moves. If the link does not report
positions, the plan names the sequence numbers between which the control stopped.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from math import floor
from typing import Any

from machines.errors import MachineError
from machines.gcode.dialects import DIALECTS
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.program import ProgramReader
from machines.preflight.preflight import Preflight, work_zero_mm
from machines.recovery.entry import EntryPoint, find_entry
from machines.recovery.needs import axes_words, compare_offsets, find_needs, position_doubt, zero_back
from machines.recovery.plan_model import Present, RecoveryPlan, Reentry, describe_refusal
from phrases.phrase import Phrase

GRBL_DIALECTS = tuple(name for name, dialect in DIALECTS.items() if dialect.is_grbl)
_SEQUENCE = re.compile(rb"^/?N0*([0-9]+)")
_LOOK_BACK = 2000  # lines


def height_mm(present: Present, wcs: str) -> float | None:
    """Return Z of the tool in the frame in which the program is entered, which may differ from the controller's present
    one.
    """
    status, zero_mm = present.status, work_zero_mm(present.offsets or {}, wcs)
    if status.machine_mm is None or zero_mm is None:
        return status.work_mm[2] if status.work_mm is not None else None
    return status.machine_mm[2] - zero_mm[2]


def travel_height_mm(present: Present, wcs: str, facts: Preflight, reentry: Reentry) -> float:
    """Work Z at which the tool goes across: the safe height, or the greatest height of the program if that is higher.

    If the mill does not reach the safe height, it is the greatest height that it reaches, which is not below the
    program's own.
    """
    highest = facts.bounds_mm.most_mm[2] if facts.bounds_mm is not None else None
    wanted_mm = max(reentry.safe_z_mm, highest if highest is not None else reentry.safe_z_mm)
    zero_mm = work_zero_mm(present.offsets or {}, wcs)
    if present.top_mm is None or zero_mm is None or highest is None:
        return wanted_mm
    return max(min(wanted_mm, floor(1000.0 * (present.top_mm - zero_mm[2])) / 1000.0), highest)


def plan_lead_in(
    entry: EntryPoint, tool_z_mm: float, facts: Preflight, safe_mm: float, reentry: Reentry
) -> tuple[str, ...]:
    """Return blocks to the entry point: always up before across, always across before down."""
    state = entry.state
    blocks = [f"G21 G90 G94 G17 {state.wcs}"]
    turns = state.spindle != "M5" and entry.position_mm is not None
    if turns:
        blocks += [f"{state.spindle} S{state.spindle_rpm:g}", f"G4 P{reentry.spin_up_s:g}"]
    if tool_z_mm < safe_mm:
        blocks.append(f"G0 Z{_mm(safe_mm)}")
    if entry.position_mm is None:
        return (*blocks, "M5")
    x, y, z = entry.position_mm
    blocks.append(f"G0 X{_mm(x)} Y{_mm(y)}")
    if tool_z_mm > safe_mm:
        blocks.append(f"G0 Z{_mm(safe_mm)}")
    blocks += [word for word in state.coolant.split() if word != "M9"]
    slowest = facts.feeds_mm_per_min[0] if facts.feeds_mm_per_min else reentry.plunge_mm_per_min
    blocks.append(f"G1 Z{_mm(z)} F{min(slowest, reentry.plunge_mm_per_min):g}")
    if state.feed_mm_per_min is not None and state.feed_mode == "G94":
        blocks.append(f"F{state.feed_mm_per_min:g}")
    restored = [
        word for word, now in ((state.units, "G21"), (state.plane, "G17"), (state.feed_mode, "G94")) if word != now
    ]
    return (*blocks, " ".join(restored)) if restored else tuple(blocks)


def _mm(value: float) -> str:
    return f"{value:.5f}".rstrip("0").rstrip(".") if abs(value) >= 5e-6 else "0"


def find_unreadable(blocks: Sequence[str]) -> Iterator[Phrase]:
    """Read our own blocks like a program: blocks that would be refused are never sent."""
    interpreter = Interpreter(ModalState())
    for block in blocks:
        try:
            interpreter.take(block.encode("ascii"))
        except MachineError as error:
            yield Phrase("re-entry block '{block}': {error}", block=block, error=str(error))
            return


def plan_recovery(
    record: Mapping[str, Any], facts: Preflight, reader: ProgramReader, present: Present, reentry: Reentry
) -> RecoveryPlan:
    """Plan from a run's journal (`record`), its program and the mill's present state. Any exception is a bug."""
    executed = int(record.get("executed_line", 0))
    refusals: list[Phrase] = []
    entry: EntryPoint | None = None
    if record.get("sha256") != facts.sha256:
        refusals.append(
            Phrase(
                "the program is not the one of this run: sha256 {sha256}, the journal says {known}",
                sha256=facts.sha256[:12],
                known=str(record.get("sha256"))[:12],
            )
        )
    try:
        entry = find_entry(reader, executed)
    except MachineError as error:
        refusals.append(error.words)
    tells = facts.dialect in GRBL_DIALECTS
    if not tells:
        refusals.append(by_sequence_number(record, facts, reader))
    differences, zero_needs = compare_offsets(record, present, entry)
    needs = (*find_needs(record, present), *zero_needs) if tells else ()
    blocks: tuple[str, ...] = ()
    if entry is not None and tells and (tool_z_mm := height_mm(present, entry.state.wcs)) is not None:
        travel_mm = travel_height_mm(present, entry.state.wcs, facts, reentry)
        blocks = plan_lead_in(entry, tool_z_mm, facts, travel_mm, reentry)
        refusals.extend(find_unreadable(blocks))
    plan = RecoveryPlan(
        run_id=str(record.get("id", "")),
        executed_line=executed,
        resume_line=executed + 1,
        overlap_line=entry.line if entry else executed + 1,
        position_mm=entry.position_mm if entry else None,
        blocks=blocks,
        refusals=tuple(refusals),
        needs=needs,
        differences=differences,
        zero_back=zero_back(record, present, entry) if tells else "",
        motion=entry.motion if entry else "",
        spindle_on=present.status.spindle_on,
        tool_mm=present.status.work_mm,
        offsets=present.offsets or {},
    )
    return _with_words(plan, record, present, entry)


def _with_words(
    plan: RecoveryPlan, record: Mapping[str, Any], present: Present, entry: EntryPoint | None
) -> RecoveryPlan:
    words = [
        Phrase(
            "lines up to {executed_line} are cut for certain; line {resume_line} is the next one",
            executed_line=plan.executed_line,
            resume_line=plan.resume_line,
        )
        if plan.executed_line
        else Phrase("no line is cut for certain; line {resume_line} is the next one", resume_line=plan.resume_line)
    ]
    if entry is not None:
        if entry.position_mm is None:
            words.append(Phrase("nothing was cut that the new cut must join: the program starts from its top"))
        else:
            words.append(
                Phrase(
                    "the tool is put down at {position_mm} (work), line {overlap_line} is cut again as overlap "
                    "({recut_lines} line(s) are sent a second time)",
                    position_mm=axes_words(entry.position_mm),
                    overlap_line=plan.overlap_line,
                    recut_lines=plan.recut_lines,
                )
            )
        if entry.why is not None:
            words.append(entry.why)
        if entry.state.tool is not None:
            words.append(Phrase("tool T{tool} must be in the spindle", tool=entry.state.tool))
    status = present.status
    if status.spindle_on:
        words.append(Phrase("the spindle is ON now"))
    elif status.spindle_on is None:
        words.append(Phrase("it is not known whether the spindle turns: look at it"))
    if status.work_mm is not None:
        words.append(Phrase("the tool is at {work_mm} (work) now", work_mm=axes_words(status.work_mm)))
    last = record.get("work_mm")
    if last:
        words.append(
            Phrase(
                "the last position in the journal is {work_mm} (work); the mill may have gone on from there",
                work_mm=axes_words(last),
            )
        )
    if entry is not None and not status.position_trusted and position_doubt(record, present) == "":
        words.append(Phrase("the controller has not lost its count since then: its position is what it was"))
    overrides = record.get("overrides")
    if overrides and list(overrides) != [100, 100, 100]:
        feed, rapid, spindle = overrides
        words.append(
            Phrase(
                "overrides then were feed {feed_percent} %, rapid {rapid_percent} %, spindle {spindle_percent} %",
                feed_percent=feed,
                rapid_percent=rapid,
                spindle_percent=spindle,
            )
        )
    words += [Phrase("offset {difference}", difference=difference) for difference in plan.differences]
    if present.offsets is None:
        words.append(Phrase("offsets cannot be compared: the link does not report them at present"))
    if record.get("torn"):
        words.append(Phrase("the end of the journal was torn: {torn}", torn=record["torn"]))
    words += map(describe_refusal, plan.refusals)
    words += [Phrase("first: {need}", need=need.words) for need in plan.needs]
    fields = {name: getattr(plan, name) for name in plan.__slots__}
    return RecoveryPlan(**fields | {"words": tuple(words)})


def by_sequence_number(record: Mapping[str, Any], facts: Preflight, reader: ProgramReader) -> Phrase:
    """Return why there is no recovery by position, and how a person restarts at the control's own panel."""
    executed, sent = int(record.get("executed_line") or 0), int(record.get("sent_line") or 0)
    return Phrase(
        "dialect {dialect}: this link does not report where the control stopped, so recovery by position is "
        "impossible. It was given lines up to {sent} and has executed at least those up to {executed}. Read the "
        "sequence number on its screen, bring the tool to a safe height, check the zero, and restart at its panel "
        "from the last tool entry at or before that number, or park a program with the remaining lines",
        dialect=facts.dialect,
        sent=_name_line(reader, sent),
        executed=_name_line(reader, executed),
    )


def _name_line(reader: ProgramReader, line: int) -> Phrase:
    """Return the name of a line with the sequence number in force there."""
    if not line:
        return Phrase("the start of the program")
    number = None
    try:
        for one in reader.lines(max(1, line - _LOOK_BACK)):
            if one.number > line:
                break
            if (found := _SEQUENCE.match(one.text)) is not None:
                number = found[1].decode()
    except MachineError:
        number = None  # the file is refused elsewhere
    if number is None:
        return Phrase("line {line}", line=line)
    return Phrase("line {line} (N{number})", line=line, number=number)
