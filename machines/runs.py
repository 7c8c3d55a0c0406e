"""The life of a run: its states, the one table of allowed moves between them, and how it looks from outside."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from machines.errors import NotAllowedError
from phrases.phrase import Phrase, join, phrases_in


class RunState(Enum):
    """One word per thing; the words are those of the API."""

    PARKED = "parked"  # known and checked, waits for a person
    RUNNING = "running"
    HOLDING = "holding"  # a hold was ordered; still moving
    HELD = "held"
    STOPPING = "stopping"  # abort under way
    INTERRUPTED = "interrupted"  # stopped by a fault; only `recover` goes on
    RECOVERING = "recovering"  # the way back to the place of interruption
    FINISHED = "finished"
    ABORTED = "aborted"

    @property
    def words(self) -> Phrase:
        """The state as words of a sentence."""
        return _STATE_WORDS[self]


_STATE_WORDS = {
    RunState.PARKED: Phrase("parked"),
    RunState.RUNNING: Phrase("running"),
    RunState.HOLDING: Phrase("holding"),
    RunState.HELD: Phrase("held"),
    RunState.STOPPING: Phrase("stopping"),
    RunState.INTERRUPTED: Phrase("interrupted"),
    RunState.RECOVERING: Phrase("recovering"),
    RunState.FINISHED: Phrase("finished"),
    RunState.ABORTED: Phrase("aborted"),
}

_S = RunState
_ON_THE_MILL = {_S.HOLDING, _S.HELD, _S.STOPPING, _S.INTERRUPTED, _S.FINISHED}

TRANSITIONS: dict[RunState, frozenset[RunState]] = {
    _S.PARKED: frozenset({_S.RUNNING, _S.ABORTED}),
    _S.RUNNING: frozenset(_ON_THE_MILL),
    _S.RECOVERING: frozenset(_ON_THE_MILL | {_S.RUNNING}),
    _S.HOLDING: frozenset(_ON_THE_MILL - {_S.HOLDING} | {_S.RUNNING, _S.RECOVERING}),
    _S.HELD: frozenset(_ON_THE_MILL - {_S.HELD} | {_S.RUNNING, _S.RECOVERING}),
    _S.STOPPING: frozenset({_S.ABORTED, _S.INTERRUPTED}),
    _S.INTERRUPTED: frozenset({_S.RECOVERING, _S.ABORTED}),
    _S.FINISHED: frozenset(),
    # A panicked abort at hour 40 must not cost the part: the cut lines are known, so a person may continue.
    _S.ABORTED: frozenset({_S.RECOVERING}),
}
LIVE = frozenset({_S.RUNNING, _S.HOLDING, _S.HELD, _S.STOPPING, _S.RECOVERING})
RECOVERABLE = frozenset({_S.INTERRUPTED, _S.ABORTED})

START_CHECKS = frozenset({"tool", "zero", "stock", "clear"})
RECOVER_CHECKS = START_CHECKS | {"position"}


def move_state(before: RunState, after: RunState) -> RunState:
    """Return `after` if the table allows the move; otherwise NotAllowedError names both states."""
    if after not in TRANSITIONS[before]:
        allowed = join(", ", sorted(state.words for state in TRANSITIONS[before])) or Phrase("nothing")
        raise NotAllowedError(
            Phrase(
                "a run that is {before} cannot become {after}; allowed: {allowed}",
                before=before.words,
                after=after.words,
                allowed=allowed,
            )
        )
    return after


@dataclass(frozen=True, slots=True)
class Confirmation:
    """A person's statement, with the name, that these things were checked."""

    operator: str
    checks: frozenset[str]

    def demand(self, needed: frozenset[str], doing: str) -> None:
        """Raise NotAllowedError naming what was not confirmed."""
        if not self.operator.strip():
            raise NotAllowedError(Phrase("{doing} needs the operator's name", doing=doing))
        if missing := needed - self.checks:
            words = ", ".join(sorted(missing))
            raise NotAllowedError(
                Phrase("{doing} needs the operator's confirmation of: {checks}", doing=doing, checks=words)
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport:
    """The report of a mill's owner on a run at one moment.

    words         : why it is in this state, for the operator; code, values: the same for programs ("": only words)
    lift_mm       : of a dry pass: the program raised by this, spindle off; it cuts nothing. None: the program unchanged
    lifted_from   : digest of the program that a dry pass is made from; "" of others
    travel_in_doubt : one of the warnings is that the program may not fit the travel
    executed_line : every line up to this one has certainly been cut
    time_s        : estimate for the whole program, cut_s of it for the lines up to executed_line
    time_left_s   : the rest, scaled by how the run has kept to the estimate; None = unknown
    created_s ... : wall clock, seconds since 1970; None = not yet
    """

    id: str
    name: str
    program: str
    path: str
    state: RunState
    words: str = ""
    code: str = ""
    values: dict[str, Any] = field(default_factory=dict)
    operator: str = ""
    lines: int = 0
    bytes: int = 0
    sent_line: int = 0
    executed_line: int = 0
    time_s: float = 0.0
    cut_s: float = 0.0
    time_left_s: float | None = None
    created_s: float = 0.0
    started_s: float | None = None
    ended_s: float | None = None
    recoveries: int = 0
    warnings: tuple[str, ...] = field(default=())
    lift_mm: float | None = None
    lifted_from: str = ""
    travel_in_doubt: bool = False

    @property
    def live(self) -> bool:
        return self.state in LIVE

    @property
    def share(self) -> float:
        """The share that is certainly cut, 0 to 1: by time, and by lines where no time is known."""
        if self.state is _S.FINISHED:
            return 1.0
        done, whole = (self.cut_s, self.time_s) if self.time_s else (self.executed_line, self.lines)
        return min(1.0, done / whole) if whole else 0.0

    def as_dict(self) -> dict[str, Any]:
        values = {name: getattr(self, name) for name in self.__slots__}
        view = values | {
            "state": self.state.value,
            "warnings": list(self.warnings),
            "share": self.share,
            "live": self.live,
        }
        return view | {"phrases": phrases_in((self.words, self.values, view["warnings"]))}
