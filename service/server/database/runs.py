"""Runs in the database: who handed which program to which mill, and the agent's last report.

The agent is authoritative for the runs that it knows. The table records that a run exists, so that a restarted server
finds it again, and its unique index ensures that a mill has one open run at a time.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self
from uuid import uuid4

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError, OperationalError

from machines.runs import LIVE, RunState
from phrases.phrase import Phrase, phrases_in
from service.http.problems import Problem
from service.server.database.connection import begin_reading, begin_writing, clock
from service.server.database.job_rows import claim_key, find_by_key, lock_job, may_be_milled
from service.server.database.records import (
    ABORTED,
    FINISHED,
    LOST,
    PREPARING,
    REFUSED,
    STATE_WORDS,
    ClientKey,
    Job,
    JobState,
)
from service.server.database.tables import idempotency_keys, runs

Json = dict[str, Any]

ENDED = frozenset({FINISHED, ABORTED})  # of the agent's words
LIVE_WORDS = frozenset(state.value for state in LIVE)
_WORDS = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRow:
    """A row of `runs`: a program of a job for a mill, and its state.

    id     : empty until the row is stored
    state  : the agent's word, or preparing, refused, lost; reason: `words` as code and values
    lift_mm: of a dry pass, which cuts nothing; None: the program as it is
    view   : the agent's last report: `as_dict` of machines.runs.RunReport
    away   : no column: why its agent could not be asked now (None: it was asked, or there was no need)
    """

    id: str = ""
    machine: str
    job_id: str
    program: str
    number: int
    sha256: str
    lift_mm: float | None = None
    agent_run: str | None = None
    state: str = PREPARING
    open: bool = True
    view: Json | None = None
    words: str | None = None
    reason: Json | None = None
    created_by: str
    created_at: float = 0.0
    ended_at: float | None = None
    away: Problem | None = None

    @classmethod
    def of(cls, row: sa.RowMapping) -> Self:
        return cls(**{field.name: row[field.name] for field in fields(cls) if field.name != "away"})


class UnknownRunError(LookupError):
    def __init__(self, run_id: str) -> None:
        super().__init__(Phrase("there is no run {run_id}", run_id=run_id))


class MachineTakenError(Exception):
    """The mill has an open run already."""

    def __init__(self, machine: str, other: str) -> None:
        super().__init__(
            Phrase(
                "machine '{machine}' has an open run, {run_id}; it must be finished or aborted first",
                machine=machine,
                run_id=other,
            )
        )
        self.other = other


class JobNotReadyError(Exception):
    """The job's programs may not be run: not all of them have been checked, or the job has failed or was cancelled."""

    def __init__(self, job: Job) -> None:
        ending = job.state is JobState.RUNNING and job.cancel_requested
        super().__init__(
            Phrase(
                "job {job_id} is {state}; its programs may be run once all of them have been checked, and not those of "
                "failed or cancelled jobs",
                job_id=job.id,
                state=Phrase("being cancelled") if ending else STATE_WORDS[job.state],
            )
        )


class RunBook:
    """May be used from any thread and any process."""

    def __init__(self, database: sa.Engine) -> None:
        self._database = database

    def find_made_before(self, key: ClientKey, request_sha256: str) -> RunRow | None:
        """Return the run that this key has made. KeyReusedError if the key belongs to another request."""
        with begin_reading(self._database) as connection:
            run_id = find_by_key(connection, "run", key, request_sha256)
            return None if run_id is None else _get(connection, run_id)

    def create(self, new: RunRow, key: ClientKey | None = None, request_sha256: str = "") -> tuple[RunRow, bool]:
        """Create a run in state preparing; False if the key made it before. MachineTakenError, JobNotReadyError.

        key: the caller's Idempotency-Key, request_sha256: of its request. The job's row is locked meanwhile, so that no
        one deletes the job and no retry begins.
        """
        run_id = str(uuid4())
        try:
            with begin_writing(self._database) as connection:
                job = lock_job(connection, new.job_id)
                if not may_be_milled(connection, job):
                    raise JobNotReadyError(job)
                at = clock(connection)
                if key is None or claim_key(connection, "run", key, request_sha256, run_id, at=at):
                    connection.execute(runs.insert().values(**_first_row(new, run_id, at)))
                    return _get(connection, run_id), True
        except IntegrityError:
            raise MachineTakenError(new.machine, self._open_id(new.machine)) from None
        assert key is not None
        before = self.find_made_before(key, request_sha256)
        if before is None:  # meanwhile made and refused by another caller
            raise MachineTakenError(new.machine, self._open_id(new.machine))
        return before, False

    def get(self, run_id: str) -> RunRow:
        with begin_reading(self._database) as connection:
            return _get(connection, run_id)

    def open_on(self, machine: str) -> RunRow | None:
        with begin_reading(self._database) as connection:
            query = sa.select(runs).where(runs.c.machine == machine, runs.c.open)
            row = connection.execute(query).mappings().first()
            return None if row is None else RunRow.of(row)

    def open_ones(self) -> list[RunRow]:
        with begin_reading(self._database) as connection:
            return [RunRow.of(row) for row in connection.execute(sa.select(runs).where(runs.c.open)).mappings()]

    def list_rows(
        self, *, machine: str | None = None, job: str | None = None, limit: int = 50, before: str | None = None
    ) -> list[RunRow]:
        """List runs, newest first; those older than the run `before`. UnknownRunError if that is gone."""
        query = sa.select(runs).order_by(runs.c.created_at.desc(), runs.c.id.desc()).limit(limit)
        if machine is not None:
            query = query.where(runs.c.machine == machine)
        if job is not None:
            query = query.where(runs.c.job_id == job)
        with begin_reading(self._database) as connection:
            if before is not None:
                at = _get(connection, before).created_at
                query = query.where(sa.tuple_(runs.c.created_at, runs.c.id) < sa.tuple_(at, before))
            return [RunRow.of(row) for row in connection.execute(query).mappings()]

    def list_finished(self, job_id: str, machine: str) -> frozenset[str]:
        """Return hashes of the job's programs that this mill has finished."""
        return self.list_finished_by_mill([job_id]).get((job_id, machine), frozenset())

    def list_finished_by_mill(self, job_ids: Collection[str]) -> dict[tuple[str, str], frozenset[str]]:
        """List by job and mill the hashes of programs that the mill has finished. A dry pass finishes none."""
        query = sa.select(runs.c.job_id, runs.c.machine, runs.c.sha256).where(runs.c.lift_mm.is_(None)).distinct()
        found: dict[tuple[str, str], frozenset[str]] = {}
        with begin_reading(self._database) as connection:
            for row in connection.execute(query.where(runs.c.job_id.in_(job_ids), runs.c.state == FINISHED)):
                key = row.job_id, row.machine
                found[key] = found.get(key, frozenset()) | {row.sha256}
        return found

    # ------------------------------------------------------------------ what happens to a run

    def confirm_parked(self, run_id: str, view: Json) -> bool:
        """Note that the agent has the run. False if the run was closed meanwhile."""
        values = {"agent_run": str(view["id"]), "state": str(view["state"]), "view": view} | read_reason(view)
        with begin_writing(self._database) as connection:
            mine = sa.and_(runs.c.id == run_id, runs.c.open)
            return connection.execute(runs.update().where(mine).values(**values)).rowcount == 1

    def record_report(self, run: RunRow, view: Json) -> RunRow:
        """Record the agent's report and return the run. A run that has ended is closed; one that continues is reopened.

        If another run has taken the mill meanwhile the run stays closed, and its state is still returned. So is a state
        that a full or busy database cannot store now; it is stored at the next poll.
        """
        state = str(view["state"])
        is_open = state not in ENDED and (run.open or state in LIVE_WORDS)
        values: Json = {"state": state, "view": view, "open": is_open} | read_reason(view)
        values["ended_at"] = view.get("ended_s") if not is_open else None
        if run.state == state and run.open == values["open"] and not _news(run.view, view):
            return replace(run, view=view)  # with its progress, although that is not stored
        try:
            self._write(run.id, values)
        except IntegrityError:
            self._write(run.id, values | {"open": False})
        except OperationalError:
            return replace(run, **values)
        return self.get(run.id)

    def close(
        self, run_id: str, state: str, words: str, reason: Json | None = None, *, forget_key: bool = False
    ) -> None:
        """Close a run that was never handed over, was taken back, or is given up. An ended run does not change."""
        with begin_writing(self._database) as connection:
            mine = sa.and_(runs.c.id == run_id, runs.c.open)
            phrases = phrases_in((words, reason))
            reason = (reason or {}) | {"phrases": phrases} if phrases else reason
            values = {"open": False, "state": state, "words": words[:_WORDS], "reason": reason}
            values["ended_at"] = clock(connection)
            closed = connection.execute(runs.update().where(mine).values(**values)).rowcount
            if closed and forget_key:
                connection.execute(idempotency_keys.delete().where(idempotency_keys.c.resource_id == run_id))

    def reopen(self, run: RunRow) -> None:
        """Reopen a run before a recovery, which reserves the mill. MachineTakenError."""
        try:
            self._write(run.id, {"open": True})
        except IntegrityError:
            raise MachineTakenError(run.machine, self._open_id(run.machine)) from None

    def _write(self, run_id: str, values: Json) -> None:
        with begin_writing(self._database) as connection:
            connection.execute(runs.update().where(runs.c.id == run_id).values(**values))

    def _open_id(self, machine: str) -> str:
        other = self.open_on(machine)
        return other.id if other is not None else Phrase("which has just ended")


def _get(connection: sa.Connection, run_id: str) -> RunRow:
    row = connection.execute(sa.select(runs).where(runs.c.id == run_id)).mappings().first()
    if row is None:
        raise UnknownRunError(run_id)
    return RunRow.of(row)


def _first_row(new: RunRow, run_id: str, at: float) -> Json:
    names = ("machine", "job_id", "program", "number", "sha256", "lift_mm", "created_by")
    given = {name: getattr(new, name) for name in names}
    return given | {"id": run_id, "state": PREPARING, "open": True, "created_at": at}


def word_state(state: str) -> str:
    """Return a run's state as words of a sentence."""
    own = {PREPARING: Phrase("preparing"), REFUSED: Phrase("refused"), LOST: Phrase("lost")}
    return own[state] if state in own else RunState(state).words


def read_reason(view: Json) -> Json:
    """Return why a run is in its state, by its agent: the columns `words` and `reason`."""
    reason = make_reason(str(view.get("code") or ""), view.get("values"))
    return {"words": str(view.get("words", ""))[:_WORDS], "reason": reason}


def make_reason(code: str, values: Mapping[str, object] | None = None) -> Json | None:
    """Make `reason` of a row; None if there is no code, but only words."""
    return {"code": code, "values": dict(values or {})} if code else None


def _news(before: Json | None, now: Json) -> bool:
    """Return whether the report is worth storing. Line numbers alone are not: they change all the time, and the agent
    has them.
    """
    names = ("words", "code", "values", "recoveries", "operator", "started_s", "ended_s")
    return before is None or any(before.get(name) != now.get(name) for name in names)
