"""The short form of the storms of `make soak`: real jobs while processes are killed at random, and the same judge."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from tests.service.worker.postgres import missing, running_postgres
from tests.trials.server.deployment import embedded, farm
from tests.trials.server.judge import half_objects
from tests.trials.server.storm import Size, storm
from tests.waiting import PATIENCE_S

SHORT = Size(jobs=5, kinds=4, kills=10, pause_s=(0.2, 1.5), patience_s=PATIENCE_S)


@pytest.mark.thorough
def test_nothing_is_lost_in_a_storm_on_sqlite(tmp_path: Path) -> None:
    with embedded(tmp_path) as deployment:
        result = storm(deployment, deployment.data[0] / "objects", SHORT, seed=11)
    assert result.broken == [], result.faults
    assert result.kills >= SHORT.kills


@pytest.mark.thorough
@pytest.mark.skipif(bool(missing()), reason=missing())
def test_nothing_is_lost_in_a_storm_on_postgresql(tmp_path: Path) -> None:
    """Two workers; the database is restarted in the middle, and an owner stands still for longer than its lease."""
    size = Size(
        jobs=5, kinds=4, kills=10, freezes=1, restarts=1, pause_s=(0.2, 1.5), freeze_s=6.0, patience_s=PATIENCE_S
    )
    lease = {"CAUSTICMILL_LEASE_S": "4"}
    with running_postgres(durable=True) as database:
        url, restart = database.url(), database.crash_and_restart
        with farm(tmp_path, url, environment=lease) as deployment:
            result = storm(deployment, tmp_path / "store", size, seed=12, restart_database=restart, database_url=url)
    assert result.broken == [], result.faults
    assert result.kills >= size.kills


def test_the_judge_sees_half_objects(tmp_path: Path) -> None:
    """A judge that sees nothing would pass every storm."""
    whole = b"whole"
    name = hashlib.sha256(whole).hexdigest()
    (tmp_path / name).write_bytes(whole)
    assert half_objects(tmp_path) == []
    (tmp_path / name).write_bytes(whole[:-1])
    (tmp_path / ".tmp-1").write_bytes(b"")
    assert len(half_objects(tmp_path)) == 2
