"""How to go on with a run that was interrupted: from what the journal knows to a plan that a person can check.

The plan starts at the line after the last one that was *executed* for certain, steps back one move (so that the cut
is joined, not butted), and brings the tool there from wherever it stands: spindle, straight up, across, down at
plunging feed. Cutting something twice is harmless, skipping or starting in a wrong place is not; what cannot be rebuilt
for certain is refused. Nothing here reads a clock, a port or a journal, and nothing moves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from machines.driver import MillState, MillStatus, ProgramLine, Triple
from machines.errors import MachineError
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.preflight import Preflight
from machines.gcode.program import ProgramReader
from machines.recovery_entry import EntryPoint, find_entry

GRBL_DIALECTS = ("grbl", "grblhal", "fluidnc")
OFFSET_TOLERANCE_MM = 0.0015  # offsets are reported with three decimals


@dataclass(frozen=True, slots=True, kw_only=True)
class Reentry:
    """How the tool is brought back.

    safe_z_mm : work Z at which it travels; the highest Z of the program itself if that is higher
    plunge_mm_per_min : fastest plunge; the slowest feed of the program if that is lower
    spin_up_s : dwell after the spindle is switched on
    """

    safe_z_mm: float = 5.0
    plunge_mm_per_min: float = 300.0
    spin_up_s: float = 4.0


@dataclass(frozen=True, slots=True)
class Need:
    """What must be done first. `code`: "connect", "stand still", "unlock", "position" or "zero"."""

    code: str
    words: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Present:
    """What is known of the mill now. `offsets` and `parser_state` are None where the link does not tell.

    restarted : a restart of the controller was seen since the run stopped
    vouched_axes : axes of which a person has set the work zero anew since the run stopped
    """

    status: MillStatus
    offsets: Mapping[str, Sequence[float]] | None = None
    parser_state: str | None = None
    restarted: bool = False
    vouched_axes: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveryPlan:
    """The way on. It may be carried out when `refusals` and `needs` are both empty.

    executed_line : certainly cut up to here     resume_line : the next one
    overlap_line  : the line that is sent first  recut_lines : lines sent again
    position_mm   : where the tool is put down (work frame); None: the program starts from its top
    blocks        : sent before the program
    """

    run_id: str
    executed_line: int
    resume_line: int
    overlap_line: int
    position_mm: Triple | None
    blocks: tuple[str, ...]
    refusals: tuple[str, ...] = ()
    needs: tuple[Need, ...] = ()
    differences: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    motion: str = ""  # motion word put before the first line, which relies on an earlier one

    @property
    def ready(self) -> bool:
        return not self.refusals and not self.needs

    @property
    def recut_lines(self) -> int:
        return max(0, self.resume_line - self.overlap_line)

    def as_dict(self) -> dict[str, Any]:
        return {
            "run": self.run_id,
            "executed_line": self.executed_line,
            "resume_line": self.resume_line,
            "overlap_line": self.overlap_line,
            "recut_lines": self.recut_lines,
            "position_mm": list(self.position_mm) if self.position_mm else None,
            "blocks": list(self.blocks),
            "ready": self.ready,
            "refusals": list(self.refusals),
            "needs": [{"code": need.code, "words": need.words} for need in self.needs],
            "differences": list(self.differences),
            "words": list(self.words),
        }

    def lines(self, reader: ProgramReader) -> Iterator[ProgramLine]:
        """All that is sent: the way in (as lines 0), then the program from the overlap line on."""
        for block in self.blocks:
            yield ProgramLine(0, 0, block.encode("ascii"))
        program = reader.lines(self.overlap_line)
        if self.motion:
            first = next(program, None)
            if first is not None:
                yield ProgramLine(first.number, first.offset, self.motion.encode("ascii") + first.text)
        yield from program


def plan_recovery(
    record: Mapping[str, Any], facts: Preflight, reader: ProgramReader, present: Present, reentry: Reentry
) -> RecoveryPlan:
    """Plan from a run's journal (`record`), its program and the mill as it is now. Raises nothing but bugs."""
    executed = int(record.get("executed_line", 0))
    refusals: list[str] = []
    entry: EntryPoint | None = None
    if record.get("sha256") != facts.sha256:
        refusals.append(f"the program is not the one of this run: sha256 {facts.sha256[:12]}, the journal says "
                        f"{str(record.get('sha256'))[:12]}")  # fmt: skip
    try:
        entry = find_entry(reader, executed)
    except MachineError as error:
        refusals.append(str(error))
    if facts.dialect not in GRBL_DIALECTS:
        refusals.append(f"dialect {facts.dialect}: such a control does not tell what it has executed; recover by hand, "
                        "from a sequence number or with a program of the rest")  # fmt: skip
    differences, zero_needs = _offsets(record, present, entry)
    needs = (*_needs(record, present), *zero_needs)
    blocks: tuple[str, ...] = ()
    if entry is not None and present.status.work_mm is not None:
        blocks = _blocks(entry, present.status.work_mm[2], facts, reentry)
        refusals.extend(_unreadable(blocks))
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
        motion=entry.motion if entry else "",
    )
    return _with_words(plan, record, present, entry)


# ---------------------------------------------------------------------- what must be done first


def _needs(record: Mapping[str, Any], present: Present) -> Iterator[Need]:
    status = present.status
    if status.state in (MillState.DISCONNECTED, MillState.CONNECTING):
        yield Need("connect", f"the mill is {status.state.value}: connect it; it does not move by that")
        return
    if status.state is MillState.ALARM:
        yield Need(
            "unlock", f"the mill is locked ({status.detail or 'alarm'}): home it, or unlock it and set the zero anew"
        )
    elif status.state in (MillState.RUN, MillState.HOLDING, MillState.JOG, MillState.HOMING):
        yield Need(
            "stand still", f"the mill is {status.state.value}: wait until it has carried out what it holds, or hold it"
        )
    elif status.state is not MillState.IDLE:
        yield Need("stand still", f"the mill is {status.state.value} and may hold unfinished blocks: reset it, "
                                  "which clears them and, from standstill, keeps the position")  # fmt: skip
    elif status.work_mm is None:
        yield Need("connect", "the mill has not reported its position yet: wait a second")
    if (words := position_doubt(record, present)) != "":
        yield Need("position", f"{words}: home the mill, or touch off and set the work zero of X, Y, Z anew, or, if "
                               "you know that it is right, say so (trust position)")  # fmt: skip


def position_doubt(record: Mapping[str, Any], present: Present) -> str:
    """Why machine coordinates may not mean what they meant when the run was cut, in words; "" if they do."""
    if present.status.position_trusted:
        return ""
    if present.restarted:
        return "the controller has restarted since the run stopped, its position is lost"
    if not record.get("position_trusted"):
        return "the position was not vouched for when the run stopped"
    if not never_restarted(present.parser_state):
        return "nothing shows that the controller went on without a restart while it was out of sight"
    return ""


def never_restarted(parser_state: str | None) -> bool:
    """A restart sets feed, spindle speed and spindle to nothing ($G: M5 F0 S0). What is still set was never reset."""
    words = (parser_state or "").split()
    return any(word in ("M3", "M4") or (word[0] == "F" and _number(word[1:]) > 0.0) for word in words)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _offsets(
    record: Mapping[str, Any], present: Present, entry: EntryPoint | None
) -> tuple[tuple[str, ...], tuple[Need, ...]]:
    """Offsets then and now: each difference in words, and whether one of them moves this program."""
    then: Mapping[str, Sequence[float]] = record.get("offsets") or {}
    if not then or present.offsets is None:
        return (), ()
    used = {entry.state.wcs if entry else "G54", "G92", "TLO"}
    words, moving = [], []
    for name in sorted(then):
        was, now = then[name], present.offsets.get(name)
        if now is None:
            words.append(f"{name} was {_triple(was)}, the controller does not name it now")
            axes = "XYZ"
        else:
            pairs = zip("XYZ", was, now, strict=False)
            axes = "".join(axis for axis, a, b in pairs if abs(a - b) > OFFSET_TOLERANCE_MM)
            if not axes:
                continue
            words.append(f"{name} was {_triple(was)}, is {_triple(now)}")
        if name in used and set(axes) - set(present.vouched_axes):
            moving.append(name)
    if not moving:
        return tuple(words), ()
    need = Need("zero", f"{', '.join(moving)} differs from when the program was cut: restore it (G10 L2, G92, "
                        "G43.1), or set the work zero anew")  # fmt: skip
    return tuple(words), (need,)


def _triple(values: Sequence[float]) -> str:
    return " ".join(f"{axis}{value:.3f}" for axis, value in zip("XYZ", values, strict=False))


# ---------------------------------------------------------------------- the way in


def _blocks(entry: EntryPoint, tool_z_mm: float, facts: Preflight, reentry: Reentry) -> tuple[str, ...]:
    """From where the tool stands to the entry point. Always up before across, always across before down."""
    state = entry.state
    highest = facts.bounds_mm.most_mm[2] if facts.bounds_mm is not None else None
    safe_mm = max(reentry.safe_z_mm, highest if highest is not None else reentry.safe_z_mm)
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


def _unreadable(blocks: Sequence[str]) -> Iterator[str]:
    """Our own blocks go through the same reader as a program: what it refuses is never sent."""
    interpreter = Interpreter(ModalState())
    for block in blocks:
        try:
            interpreter.take(block.encode("ascii"))
        except MachineError as error:
            yield f"re-entry block '{block}': {error}"
            return


# ---------------------------------------------------------------------- in words


def _with_words(
    plan: RecoveryPlan, record: Mapping[str, Any], present: Present, entry: EntryPoint | None
) -> RecoveryPlan:
    words = [f"lines up to {plan.executed_line} are cut for certain; line {plan.resume_line} is the next one"]
    if entry is not None:
        if entry.position_mm is None:
            words.append("nothing was cut that has to be joined: the program starts from its top")
        else:
            words.append(
                f"the tool is put down at {_triple(entry.position_mm)} (work), line {plan.overlap_line} is cut again "
                f"as overlap ({plan.recut_lines} line(s) are sent a second time)"
            )
        if entry.why:
            words.append(entry.why)
        if entry.state.tool is not None:
            words.append(f"tool T{entry.state.tool} must be in the spindle")
    status = present.status
    if status.spindle_on:
        words.append("the spindle is ON now")
    if status.work_mm is not None:
        words.append(f"the tool is at {_triple(status.work_mm)} (work) now")
    last = record.get("work_mm")
    if last:
        words.append(
            f"the last position in the journal is {_triple(last)} (work); the mill may have gone on from there"
        )
    if entry is not None and not status.position_trusted and position_doubt(record, present) == "":
        words.append("the controller never restarted (its feed or spindle is still set): its position is what it was")
    overrides = record.get("overrides")
    if overrides and list(overrides) != [100, 100, 100]:
        words.append(f"overrides then were feed {overrides[0]} %, rapid {overrides[1]} %, spindle {overrides[2]} %")
    words += [f"offset {difference}" for difference in plan.differences]
    if present.offsets is None:
        words.append("offsets cannot be compared: the link does not tell them at present")
    if record.get("torn"):
        words.append(f"the end of the journal was torn: {record['torn']}")
    words += [f"REFUSED: {refusal}" for refusal in plan.refusals]
    words += [f"first: {need.words}" for need in plan.needs]
    fields = {name: getattr(plan, name) for name in plan.__slots__}
    return RecoveryPlan(**fields | {"words": tuple(words)})
