"""Short storms over real workers: nothing lost, nothing doubled, no committed stage run again, nobody left over."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from service.settings import ServerSettings
from tests.service.server.worker.postgres import Postgres, missing, running_postgres
from tests.service.server.worker.storm import Storm, rage
from tests.waiting import until

pytestmark = pytest.mark.thorough

LEASE_S = 2.0


def test_storm_on_sqlite(tmp_path: Path) -> None:
    """One worker, seven kills of it and of its stages."""
    storm = Storm(tmp_path, {"only": ServerSettings(data=tmp_path / "data", lease_s=LEASE_S, free_disk_mb=0)})
    jobs = storm.submit(6)
    rage(storm, seed=1, kills=7, calm_s=(0.2, 1.0), restart=None)
    storm.await_all(jobs)
    broken = storm.broken(jobs)
    storm.stop()
    assert broken + storm.left_over() == []


def test_storm_on_postgresql_with_two_workers(tmp_path: Path) -> None:
    """Kills, an owner frozen for two leases, the database crashed: the other worker takes over."""
    if reason := missing():
        pytest.skip(reason)
    with running_postgres(durable=True) as server:
        storm = Storm(tmp_path, two_workers(tmp_path, server))
        jobs = storm.submit(6)
        rage(storm, seed=2, kills=6, calm_s=(0.2, 1.0), restart=server.crash_and_restart)
        storm.await_all(jobs)
        broken = storm.broken(jobs)
        storm.stop()
        assert broken + storm.left_over() == []


def test_two_live_workers_both_work(tmp_path: Path) -> None:
    """Also after each of them was killed, whoever has got its tickets since."""
    if reason := missing():
        pytest.skip(reason)
    with running_postgres(durable=True) as server:
        storm = Storm(tmp_path, two_workers(tmp_path, server), pause_s=1.0)
        jobs = storm.submit(6)

        def at_work(since: float) -> set[str]:
            runs = [run for job in jobs for run in storm.book.list_stages(job)]
            return {run.executor for run in runs if run.state == "running" and run.started_at > since}

        for name in ("one", "two", None):
            killed_at = time.time()
            until(lambda: at_work(killed_at) == {"one", "two"}, what="both workers at work")  # noqa: B023
            if name is not None:
                storm.kill(name)
        storm.stop()
        assert storm.left_over() == []


def two_workers(folder: Path, server: Postgres) -> dict[str, ServerSettings]:
    """Two "hosts": a folder of its own each, one database, one store."""
    url, store = server.url(), (folder / "store").as_uri()
    return {
        name: ServerSettings(
            data=folder / name,
            executor=name,
            database_url=url,
            store_url=store,
            store_is_shared=True,
            lease_s=LEASE_S,
            free_disk_mb=0,
        )
        for name in ("one", "two")
    }
