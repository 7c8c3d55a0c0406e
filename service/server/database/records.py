"""Records that the job book returns: the states of a job and of its stages, the one table of allowed moves between
them, rows of the database as frozen values, and refusals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any, Self

from phrases.phrase import Phrase, join


class JobState(StrEnum):
    """The words of the API."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"


class StageState(StrEnum):
    """The outcome of one try of one stage."""

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
    """A run of one of the job's programs is open, so the job must stay: it describes the program on the mill."""

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


Json = dict[str, Any]


PRIORITIES: dict[str, int] = {"high": 10, "normal": 100, "low": 1000}
"""Words of the API, numbers of the queue: smaller ones run earlier."""
NORMAL = PRIORITIES["normal"]


class UnknownJobError(LookupError):
    """There is no job of this id."""

    def __init__(self, job_id: str) -> None:
        super().__init__(Phrase("there is no job {job_id}", job_id=job_id))
        self.job_id = job_id


class UnknownArtifactError(LookupError):
    """The job has no artifact of this name, or does not offer it yet."""

    def __init__(self, job_id: str, name: str) -> None:
        super().__init__(Phrase("job {job_id} has no artifact {name}", job_id=job_id, name=name))
        self.job_id = job_id
        self.name = name


class KeyReusedError(Exception):
    """An idempotency key was used again for a different request."""

    def __init__(self, key: str) -> None:
        super().__init__(Phrase("this Idempotency-Key was used before, for another request; use a new one"))
        self.key = key


@dataclass(frozen=True, slots=True)
class ClientKey:
    """An Idempotency-Key, and the id of the token that it came with: another token of that name does not share it."""

    token: str
    text: str


class _Row:
    """A frozen dataclass whose fields are columns."""

    @classmethod
    def of(cls, row: Mapping[Any, Any]) -> Self:
        return cls(**{field.name: row[field.name] for field in fields(cls)})  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, kw_only=True)
class NewJob:
    """The data from which a job is made.

    figures        : the figures that the names in the spec stand for; None: the worker looks them up
    key            : the caller's Idempotency-Key
    request_sha256 : of everything that the caller sent
    """

    name: str
    spec: Json
    image_sha256: str
    image_bytes: int
    created_by: str
    request_sha256: str
    figures: str | None = None
    priority: int = NORMAL
    key: ClientKey | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class JobListRow(_Row):
    """A row of `jobs` without its long columns, for lists."""

    id: str
    name: str
    state: JobState
    priority: int
    image_sha256: str
    image_bytes: int
    created_by: str
    created_at: float
    queued_at: float
    started_at: float | None
    ended_at: float | None
    stage: str | None
    progress: float
    error: Json | None
    cancel_requested: bool
    attempt: int
    owner: str | None
    fence: int
    version: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "state", JobState(self.state))

    @property
    def ended(self) -> bool:
        return self.state in ENDED


@dataclass(frozen=True, slots=True, kw_only=True)
class JobFacts:
    """The parts of a job's spec and report that a list shows; hours: of all programs, once they are known."""

    lens_mm: tuple[float, float]
    machine: str
    hours: float | None

    @classmethod
    def of(cls, spec: Json, report: Json | None) -> JobFacts:
        programs = [*(report or {}).get("passes", ()), *(report or {}).get("around", {}).values()]
        times_s = [row.get("time_s") for row in programs]
        return cls(
            lens_mm=(spec["optics"]["width_mm"], spec["optics"]["height_mm"]),
            machine=spec["machine"]["profile"],
            hours=sum(times_s) / 3600 if times_s and all(times_s) else None,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Job(JobListRow):
    """A whole row of `jobs`."""

    spec: Json
    figures: str | None
    report: Json | None


@dataclass(frozen=True, slots=True, kw_only=True)
class StageRun(_Row):
    """A row of `stage_runs`: one try of one stage."""

    id: int
    job_id: str
    attempt: int
    number: int
    stage: str
    state: StageState
    key: str
    executor: str
    fence: int
    started_at: float
    ended_at: float | None
    peak_rss_mb: float | None
    log_sha256: str | None
    words: str | None

    def __post_init__(self) -> None:
        object.__setattr__(self, "state", StageState(self.state))


@dataclass(frozen=True, slots=True, kw_only=True)
class Artifact(_Row):
    """A row of `artifacts`: a file of a job."""

    job_id: str
    name: str
    sha256: str
    bytes: int
    stage: str
    created_at: float


@dataclass(frozen=True, slots=True, kw_only=True)
class JobEvent(_Row):
    """A row of `events`. data holds "stage" where it is about one."""

    job_id: str
    seq: int
    at: float
    kind: str
    data: Json


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress(_Row):
    """The progress of a job's running stage (share 0..1 of the stage), and of the whole job."""

    job_id: str
    stage: str
    share: float
    progress: float
    at: float


@dataclass(frozen=True, slots=True, kw_only=True)
class News:
    """What happened to some jobs since the last query: events in order, and the running stages' progress by job."""

    events: list[JobEvent]
    progress: dict[str, Progress]


def priority_word(number: int) -> str:
    """Return the priority word nearest to a number of the queue."""
    return min(PRIORITIES, key=lambda word: abs(PRIORITIES[word] - number))
