"""Figures about all jobs, kept as they change: to count a hundred thousand rows at each scrape takes seconds.

A counter is changed in the same transaction as what it counts, so neither a crash nor a second worker can part them.
Its row is locked until that transaction ends. So that two transactions cannot wait for each other, each of them changes
the counters of stages before that of jobs, and rows of one call in the order of their keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from service.server.database.connection import is_sqlite, put_rows
from service.server.database.tables import counters


@dataclass(frozen=True, slots=True, order=True)
class Counter:
    """The key of a row: "jobs" by state, "stage_runs" and "stage_seconds" by stage and state, others by name alone."""

    name: str
    stage: str = ""
    state: str = ""


ARTIFACT_BYTES = Counter("artifact_bytes")  # as the last sweep of the store has found it
RECOVERIES = Counter("recoveries")
STAGE_RESULTS = Counter("stage_results")


def add_to_counters(connection: sa.Connection, changes: Mapping[Counter, float]) -> None:
    """Raise counters by these amounts, which may be negative."""
    insert = sqlite.insert if is_sqlite(connection) else postgresql.insert
    for counter in sorted(changes):
        row = {"name": counter.name, "stage": counter.stage, "state": counter.state, "value": changes[counter]}
        new = insert(counters).values(**row)
        raised = {"value": counters.c.value + new.excluded.value}
        connection.execute(new.on_conflict_do_update(index_elements=["name", "stage", "state"], set_=raised))


def set_counter(connection: sa.Connection, counter: Counter, value: float) -> None:
    row = {"name": counter.name, "stage": counter.stage, "state": counter.state, "value": value}
    put_rows(connection, counters, [row])


def read_counters(connection: sa.Connection) -> dict[Counter, float]:
    """Return all of them: a few dozen rows."""
    rows = connection.execute(sa.select(counters))
    return {Counter(row.name, row.stage, row.state): row.value for row in rows}
