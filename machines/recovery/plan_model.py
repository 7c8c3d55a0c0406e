"""The parts of a recovery: how the tool returns, the state of the mill, and the plan that a person checks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from machines.driver import MillStatus, ProgramLine, Triple
from machines.errors import MillCode
from machines.gcode.program import ProgramReader
from machines.grbl.settings import ControllerSettings, list_frame_changes
from phrases.phrase import Phrase, phrases_in

_NOT_THERE = Phrase(
    "The part was begun within the travel, so its position or its work zero has changed: home the mill and put the "
    "same zero back. Where only the height at which the tool travels is too high, lower safe_z_mm in the profile. "
    "Do not move the work zero: the rest would be cut beside what is cut already"
)


def describe_refusal(refusal: Phrase) -> Phrase:
    """Return a refusal for the texts of a plan."""
    return Phrase("REFUSED: {refusal}", refusal=refusal)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reentry:
    """How the tool is brought back.

    safe_z_mm : work Z at which it travels, of the profile; the highest Z of the program itself if that is higher
    plunge_mm_per_min : fastest plunge; the slowest feed of the program if that is lower
    spin_up_s : dwell after the spindle is switched on
    """

    safe_z_mm: float
    plunge_mm_per_min: float = 300.0
    spin_up_s: float = 4.0


@dataclass(frozen=True, slots=True)
class Need:
    """A need that must be met first. `code`: CONNECT, WAIT, STAND_STILL, UNLOCK, POSITION or ZERO."""

    code: MillCode
    words: Phrase
    values: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Present:
    """The present state of the mill. `offsets` and `parser_state` are None if the link does not report them.

    restarted : a restart of the controller was seen since the run stopped
    frame_changes : settings of the frame that have changed since the run was cut, in figures
    vouched_axes : axes of which a person has set the work zero anew since the run stopped
    homed : machine coordinates are those of a homing cycle
    top_mm : highest machine Z that can be reached; None if that is not certain
    """

    status: MillStatus
    offsets: Mapping[str, Sequence[float]] | None = None
    parser_state: str | None = None
    restarted: bool = False
    frame_changes: tuple[str, ...] = ()
    vouched_axes: str = ""
    homed: bool = False
    top_mm: float | None = None

    @staticmethod
    def of_run(
        record: Mapping[str, Any], status: MillStatus, parser_state: str | None, settings: ControllerSettings | None
    ) -> Present:
        """Return the present state of the mill, as far as it concerns the run of this record."""
        then = (record.get("settings") or {}).get("values") or {}
        now = settings.values if settings is not None else {}
        return Present(
            status=status,
            parser_state=parser_state,
            restarted=bool(record.get("restarted")),
            frame_changes=list_frame_changes({int(number): str(value) for number, value in then.items()}, now),
            vouched_axes=str(record.get("zeroed") or ""),
        )


def _round(values_mm: Sequence[float] | None) -> list[float] | None:
    """Round to the digits that a controller reports."""
    return None if values_mm is None else [round(value, 3) + 0.0 for value in values_mm]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveryPlan:
    """The plan of a recovery. It may be carried out when `refusals` and `needs` are both empty.

    executed_line : certainly cut up to here     resume_line : the next one
    overlap_line  : the line that is sent first  recut_lines : lines sent again
    position_mm   : where the tool comes down (work frame); None: the program starts at its first line
    blocks        : sent before the program
    zero_back     : a block that restores the work zero at which the run was cut; "" if it is the same, or not certain
    spindle_on    : whether it turns now; None if the link does not report it
    tool_mm       : where the tool is now (work frame)
    offsets       : all offsets now, by name
    """

    run_id: str
    executed_line: int
    resume_line: int
    overlap_line: int
    position_mm: Triple | None
    blocks: tuple[str, ...]
    refusals: tuple[Phrase, ...] = ()
    needs: tuple[Need, ...] = ()
    differences: tuple[Phrase, ...] = ()
    words: tuple[Phrase, ...] = ()
    zero_back: str = ""
    motion: str = ""  # motion word put before the first line, which relies on an earlier one
    spindle_on: bool | None = None
    tool_mm: Triple | None = None
    offsets: Mapping[str, Sequence[float]] = field(default_factory=dict)

    @property
    def ready(self) -> bool:
        return not self.refusals and not self.needs

    @property
    def recut_lines(self) -> int:
        return max(0, self.resume_line - self.overlap_line)

    @property
    def digest(self) -> str:
        """Return a hash that identifies the plan: a person confirms the plan that they have read.

        It covers facts only: the words may change while the plan does not.
        """
        facts = {
            "run": self.run_id,
            "executed_line": self.executed_line,
            "overlap_line": self.overlap_line,
            "position_mm": _round(self.position_mm),
            "blocks": self.blocks,
            "motion": self.motion,
            "ready": self.ready,
            "needs": [(need.code, sorted(need.values.items())) for need in self.needs],
            "zero_back": self.zero_back,
            "spindle_on": self.spindle_on,
            "tool_mm": _round(self.tool_mm),
            "offsets": {name: _round(values) for name, values in self.offsets.items()},
        }
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]

    def as_dict(self) -> dict[str, Any]:
        members = {
            "run": self.run_id,
            "executed_line": self.executed_line,
            "resume_line": self.resume_line,
            "overlap_line": self.overlap_line,
            "recut_lines": self.recut_lines,
            "position_mm": list(self.position_mm) if self.position_mm else None,
            "blocks": list(self.blocks),
            "ready": self.ready,
            "refusals": list(self.refusals),
            "needs": [{"code": need.code, "values": need.values, "words": need.words} for need in self.needs],
            "differences": list(self.differences),
            "zero_back": self.zero_back,
            "words": list(self.words),
        }
        return members | {"plan": self.digest, "phrases": phrases_in(members)}

    def with_place(self, problems: tuple[Phrase, ...], *, refused: bool) -> RecoveryPlan:
        """Return the plan with the moves that leave the travel: as a refusal if machine coordinates are certain, else
        as a remark.

        They are not certain while there are needs: a mill that must be homed counts from an unknown place.
        """
        if not problems:
            return self
        if refused and not self.needs:
            refusals = tuple(Phrase("{problem}. {why}", problem=problem, why=_NOT_THERE) for problem in problems)
            words = tuple(map(describe_refusal, refusals))
            return replace(self, refusals=(*self.refusals, *refusals), words=(*self.words, *words))
        words = tuple(
            Phrase("according to the present position, which is not certain: {problem}", problem=problem)
            for problem in problems
        )
        return replace(self, words=(*self.words, *words))

    def lines(self, reader: ProgramReader) -> Iterator[ProgramLine]:
        """Yield all that is sent: the way in (as lines 0), then the program from the overlap line on."""
        for block in self.blocks:
            yield ProgramLine(0, 0, block.encode("ascii"))
        program = reader.lines(self.overlap_line)
        if self.motion:
            first = next(program, None)
            if first is not None:
                yield ProgramLine(first.number, first.offset, self.motion.encode("ascii") + first.text)
        yield from program
