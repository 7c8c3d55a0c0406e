"""The life of a job and of its stages: the states and the one table of allowed moves between them."""

from __future__ import annotations

from enum import StrEnum


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


_S = JobState

TRANSITIONS: dict[JobState, frozenset[JobState]] = {
    _S.QUEUED: frozenset({_S.RUNNING, _S.CANCELLED, _S.FAILED}),
    _S.RUNNING: frozenset({_S.SUCCEEDED, _S.FAILED, _S.CANCELLED}),
    _S.SUCCEEDED: frozenset(),
    _S.FAILED: frozenset({_S.QUEUED}),  # :retry
    _S.CANCELLED: frozenset({_S.QUEUED}),
}
ENDED = frozenset({_S.SUCCEEDED, _S.FAILED, _S.CANCELLED})
RETRYABLE = frozenset(state for state in ENDED if TRANSITIONS[state])


class JobStateError(Exception):
    """A move that the table does not allow."""

    def __init__(self, before: JobState, doing: str, allowed: frozenset[JobState]) -> None:
        words = ", ".join(sorted(allowed)) or "none"
        super().__init__(f"the job is {before}; {doing} is allowed in: {words}")


class JobOnMillError(JobStateError):
    """A run of one of the job's programs is open: what the mill is doing must stay explained."""

    def __init__(self, run_id: str) -> None:
        Exception.__init__(self, f"run {run_id} of a program of this job is open; abort it or let it finish first")


def require_move(before: JobState, after: JobState) -> None:
    """Raise JobStateError unless the table allows it."""
    if after not in TRANSITIONS[before]:
        allowed = frozenset(state for state, targets in TRANSITIONS.items() if after in targets)
        raise JobStateError(before, f"becoming {after}", allowed)
