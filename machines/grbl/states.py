"""Phases of a session in one table of allowed moves, and what a status report means for the operator."""

from __future__ import annotations

from enum import Enum

from machines.driver import MillState
from machines.grbl.replies import Status
from phrases.phrase import Phrase


class Phase(Enum):
    """The phases of a session."""

    CLOSED = "closed"  # no link, or given up
    HAILING = "hailing"  # '?' until a status report comes back; nothing else is sent
    IDENTIFYING = "identifying"  # $I $$ $# $G, only while the mill stands
    READY = "ready"  # nothing under way
    COMMAND = "command"  # one command, send and wait
    STREAMING = "streaming"  # a program: lines are sent or still answered and executed
    STOPPING = "stopping"  # '!' is sent; waits until the mill stands
    CLEARING = "clearing"  # Ctrl-X is sent from standstill; waits for the banner


# The one table. A banner leads to HAILING from everywhere, a lost link to CLOSED.
MOVES: dict[Phase, frozenset[Phase]] = {
    Phase.CLOSED: frozenset({Phase.HAILING}),
    Phase.HAILING: frozenset({Phase.IDENTIFYING, Phase.STOPPING, Phase.CLEARING}),
    Phase.IDENTIFYING: frozenset({Phase.READY, Phase.STOPPING, Phase.CLEARING}),
    Phase.READY: frozenset({Phase.COMMAND, Phase.STREAMING, Phase.STOPPING, Phase.CLEARING}),
    Phase.COMMAND: frozenset({Phase.READY, Phase.STOPPING, Phase.CLEARING}),
    Phase.STREAMING: frozenset({Phase.READY, Phase.STOPPING, Phase.CLEARING}),
    Phase.STOPPING: frozenset({Phase.CLEARING}),
    Phase.CLEARING: frozenset({Phase.STOPPING}),
}
FROM_EVERYWHERE = frozenset({Phase.CLOSED, Phase.HAILING})


# A program continues from these states when a person resumes it.
HELD_STATES = frozenset({"Hold", "Door", "Sleep", "Tool"})


def may_move(before: Phase, after: Phase) -> bool:
    return after in FROM_EVERYWHERE or after in MOVES[before]


_STATES = {
    "Idle": MillState.IDLE,
    "Run": MillState.RUN,
    "Jog": MillState.JOG,
    "Home": MillState.HOMING,
    "Alarm": MillState.ALARM,
    "Check": MillState.CHECK,
    "Sleep": MillState.SLEEP,
    "Door": MillState.DOOR,
    "Tool": MillState.TOOL,
}
_DOOR = {
    0: Phrase("door closed, ready to resume"),
    1: Phrase("stopped, door still open"),
    2: Phrase("door opened, the mill is coming to rest"),
    3: Phrase("door closed, going back to work"),
}


def mill_state(report: Status) -> MillState:
    """Return the operator's word for a reported state."""
    if report.state == "Hold":
        return MillState.HELD if not report.sub else MillState.HOLDING
    return _STATES[report.state]


def detail_words(report: Status) -> Phrase:
    if report.state == "Door":
        return _DOOR.get(report.sub or 0, Phrase("{state}", state="door"))
    if report.state == "Alarm":
        return Phrase("locked: home ($H) or unlock ($X)")
    return Phrase("")


def stands(report: Status) -> bool:
    """No axis moves, and none will without a resume or a new block: a reset now keeps the position."""
    if report.state == "Hold":
        return not report.sub
    if report.state == "Door":
        return report.sub in (0, 1)
    return report.state in ("Idle", "Alarm", "Check", "Sleep", "Tool")
