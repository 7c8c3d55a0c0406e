"""As many jobs as a shop has made in years, put into the database in bulk: for query plans and for the benchmark."""

from __future__ import annotations

import hashlib
import json
import time
import uuid
from collections import Counter as Tally
from collections.abc import Iterator
from typing import Any

import sqlalchemy as sa

from service.job.spec.loading import resolve_spec
from service.server.database.connection import begin_reading, begin_writing, is_sqlite
from service.server.database.job_rows import Counter, add_to_counters, read_counters
from service.server.database.jobs import JobBook, JobState, count_jobs
from service.server.database.tables import (
    artifacts,
    events,
    idempotency_keys,
    jobs,
    result_files,
    runs,
    stage_results,
    stage_runs,
)

STAGES = ("image", "irradiance", "map", "heightfield", "passes", "pass-1", "pass-2", "check", "report")
MACHINES = ("alpha", "beta", "gamma")
EVERY_S = 60.0
_REPORT_BYTES = 6000
_CACHE_KB = 400_000  # of SQLite: hashes go into their indexes all over the place
_BLOCK = 1000  # jobs that are made here; all others are copies of them, made by the database
_SHARES = ((90, "succeeded"), (95, "failed"), (97, "cancelled"), (100, "queued"))
Row = dict[str, Any]


def count_states(book: JobBook) -> dict[JobState, int]:
    with begin_reading(book.database) as connection:
        return count_jobs(read_counters(connection))


def state_of(number: int) -> str:
    """Of a hundred jobs 90 have succeeded, 5 failed, 2 were cancelled, and 3 wait; the first two of all run."""
    if number < 2:
        return "running"
    return next(state for most, state in _SHARES if number % 100 < most)


def job_id(number: int) -> str:
    return _prefix(number // _BLOCK) + str(uuid.UUID(int=number % _BLOCK + 1, version=4))[8:]


def run_id(number: int) -> str:
    return _prefix(number // _BLOCK) + str(uuid.UUID(int=(1 << 64) + number % _BLOCK, version=4))[8:]


def load(database: sa.Engine, count: int) -> None:
    """One job a minute until now (count: thousands), each with all its rows, and with the counters."""
    spec, began = resolve_spec().model_dump(mode="json"), time.time() - count * EVERY_S
    rows: dict[sa.Table, list[Row]] = {}
    for number in range(_BLOCK):
        for table, row in _rows(number, began + number * EVERY_S, spec, {"text": "x" * _REPORT_BYTES}):
            rows.setdefault(table, []).append(row)
    with begin_writing(database) as connection:
        for table, its_rows in rows.items():
            connection.execute(table.insert(), its_rows)
    for block in range(1, count // _BLOCK):
        with begin_writing(database) as connection:  # one for each: a log of gigabytes is slow to take over
            if is_sqlite(database):
                connection.exec_driver_sql(f"PRAGMA cache_size = -{_CACHE_KB}")
            for table in rows:
                connection.execute(_copy(table, block))
    with begin_writing(database) as connection:
        states = connection.execute(sa.select(jobs.c.state, sa.func.count()).group_by(jobs.c.state))
        counted = {Counter("jobs", state=state): number for state, number in states}
        tries = [Counter("stage_runs", row["stage"], row["state"]) for row in rows[stage_runs]]
        add_to_counters(connection, counted | {each: n * (count // _BLOCK) for each, n in Tally(tries).items()})
    with database.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.exec_driver_sql("ANALYZE" if is_sqlite(database) else "VACUUM ANALYZE")


def _prefix(block: int) -> str:
    return f"{block:08x}"


def _copy(table: sa.Table, block: int) -> sa.Insert:
    """The rows of the first block once more: ids begin with the block's number, hashes end with it, times are later."""
    values: dict[str, sa.ColumnElement[Any]] = {}
    for column in table.columns:
        name = column.name
        if table is stage_runs and name == "id":
            continue
        if name in ("id", "job_id", "resource_id"):
            values[name] = sa.literal(_prefix(block)).concat(sa.func.substr(column, 9))
        elif name == "key" or name.endswith("sha256"):
            values[name] = sa.func.substr(column, 1, 56).concat(_prefix(block))
        elif name.endswith("_at") or name == "at":
            values[name] = column + block * _BLOCK * EVERY_S
        elif table is jobs and name == "state":
            values[name] = sa.case((column == "running", "succeeded"), else_=column)
        else:
            values[name] = column
    first = {jobs: jobs.c.id, runs: runs.c.id, idempotency_keys: idempotency_keys.c.resource_id}
    if table is result_files:
        made = sa.select(stage_results.c.key).where(stage_results.c.job_id < _prefix(1))
        chosen = result_files.c.key.in_(made)
    else:
        chosen = first.get(table, table.c.get("job_id")) < _prefix(1)
    return table.insert().from_select(list(values), sa.select(*values.values()).where(chosen))


def _rows(number: int, at: float, spec: Row, report: Row) -> Iterator[tuple[sa.Table, Row]]:
    job, state = job_id(number), state_of(number)
    ended = state not in ("queued", "running")
    begun = state != "queued"
    yield jobs, {
        "id": job, "name": f"picture-{number}.png", "state": state, "priority": (10, 100, 1000)[number % 3],
        "spec": spec, "image_sha256": _hash(job, "image"), "image_bytes": 100_000, "created_by": "somebody",
        "created_at": at, "queued_at": at, "started_at": at if begun else None, "ended_at": at + 600 if ended else None,
        "stage": "map" if begun else None, "progress": 1.0 if ended else 0.0, "error": None,
        "report": report if ended else None, "cancel_requested": False, "attempt": 1,
        "owner": "worker" if state == "running" else None, "fence": 2, "version": 9,
    }  # fmt: skip
    yield idempotency_keys, {
        "principal": "somebody", "kind": "job", "key": _hash(job, "key"), "request_sha256": _hash(job, "request"),
        "resource_id": job, "created_at": at,
    }  # fmt: skip
    yield runs, {
        "id": run_id(number), "machine": MACHINES[number % 3], "job_id": job, "program": "pass-1-rough.nc", "number": 1,
        "sha256": _hash(job, "program"), "agent_run": None, "state": "finished", "open": False, "view": None,
        "words": "", "created_by": "somebody", "created_at": at, "ended_at": at,
    }  # fmt: skip
    for seq, kind in enumerate(("queued", "started", "stage.started", "stage.committed", "ended"), start=1):
        yield events, {"job_id": job, "seq": seq, "at": at, "kind": kind, "data": {"attempt": 1, "stage": "map"}}
    for place, stage in enumerate(STAGES if begun else ()):
        key = _hash(job, stage)
        yield stage_runs, {
            "job_id": job, "attempt": 1, "number": 1, "stage": stage, "state": "committed", "key": key,
            "executor": "worker", "fence": 1, "started_at": at + place, "ended_at": at + place + 1, "peak_rss_mb": 90.0,
            "log_sha256": _hash(job, "log"), "words": None,
        }  # fmt: skip
        name, sha256 = f"{stage}.png", _hash(job, f"{stage}.png")
        yield artifacts, {
            "job_id": job, "name": name, "sha256": sha256, "bytes": 50_000, "stage": stage, "created_at": at
        }  # fmt: skip
        if place < 2:
            yield stage_results, {
                "key": key, "stage": stage, "outputs": {name: {"sha256": sha256, "bytes": 50_000}}, "report": {},
                "notes": {}, "seconds": 1.0, "peak_rss_mb": 90.0, "job_id": job, "created_at": at, "used_at": at,
            }  # fmt: skip
            yield result_files, {"key": key, "name": name, "sha256": sha256}


def _hash(job: str, word: str) -> str:
    return hashlib.sha256(json.dumps([job, word]).encode()).hexdigest()
