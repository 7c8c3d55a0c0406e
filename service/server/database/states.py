"""The life of a job and of its stages: the states and the one table of allowed moves between them."""

from __future__ import annotations

from enum import StrEnum

from phrases.phrase import Phrase, join


class JobState(StrEnum):
    """The words of the API."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"


class StageState(StrEnum):
    """What became of one try of one stage."""

    RUNNING = "running"
    COMMITTED = "committed"
    REUSED = "reused"  # the same work had been done before, for this job or another
    INTERRUPTED = "interrupted"  # its process or its worker died, or lost its lease; it is tried again
    FAILED = "failed"
    CANCELLED = "cancelled"


PREPARING, PARKED, REFUSED = "preparing", "parked", "refused"
FINISHED, ABORTED, INTERRUPTED, LOST = "finished", "aborted", "interrupted", "lost"
"""States of runs: the agents' words, and ours (preparing, refused, lost)."""

_S = JobState

TRANSITIONS: dict[JobState, frozenset[JobState]] = {
    _S.QUEUED: frozenset({_S.RUNNING, _S.CANCELLED, _S.FAILED}),
    _S.RUNNING: frozenset({_S.SUCCEEDED, _S.FAILED, _S.CANCELLED}),
    _S.SUCCEEDED: frozenset(),
    _S.FAILED: frozenset({_S.QUEUED}),  # :retry
    _S.CANCELLED: frozenset({_S.QUEUED}),
}
STATE_WORDS: dict[JobState, Phrase] = {
    _S.QUEUED: Phrase("queued"),
    _S.RUNNING: Phrase("running"),
    _S.SUCCEEDED: Phrase("succeeded"),
    _S.FAILED: Phrase("failed"),
    _S.CANCELLED: Phrase("cancelled"),
}
ENDED = frozenset({_S.SUCCEEDED, _S.FAILED, _S.CANCELLED})
RETRYABLE = frozenset(state for state in ENDED if TRANSITIONS[state])


class JobStateError(Exception):
    """A move that the table does not allow."""

    def __init__(self, before: JobState, doing: Phrase, allowed: frozenset[JobState]) -> None:
        super().__init__(
            Phrase(
                "the job is {before}; {doing} is allowed in: {states}",
                before=STATE_WORDS[before],
                doing=doing,
                states=join(", ", [STATE_WORDS[state] for state in sorted(allowed)]) if allowed else Phrase("none"),
            )
        )


class JobOnMillError(JobStateError):
    """A run of one of the job's programs is open: what the mill is doing must stay explained."""

    def __init__(self, run_id: str) -> None:
        Exception.__init__(
            self,
            Phrase("run {run_id} of a program of this job is open; abort it or let it finish first", run_id=run_id),
        )


def require_move(before: JobState, after: JobState) -> None:
    """Raise JobStateError unless the table allows it."""
    if after not in TRANSITIONS[before]:
        allowed = frozenset(state for state, targets in TRANSITIONS.items() if after in targets)
        raise JobStateError(before, Phrase("becoming {state}", state=STATE_WORDS[after]), allowed)
