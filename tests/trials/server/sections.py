"""The storms as figures. A note that begins with BROKEN tells of a law that did not hold."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.timing import Figure
from tests.service.worker.postgres import running_postgres
from tests.trials.server.deployment import embedded, farm
from tests.trials.server.storm import Result, Size, storm

SQLITE = Size(jobs=64, kinds=40, kills=220)
POSTGRES = Size(jobs=64, kinds=40, kills=220, freeze_s=12.0)
LEASE_S = 5.0


def sqlite_storm(size: Size = SQLITE, *, seed: int = 1) -> Iterator[Figure]:
    """`serve` alone: supervisor, API, worker, nursery and stages killed."""
    with tempfile.TemporaryDirectory(prefix="causticmill-storm-") as folder:
        with embedded(Path(folder)) as deployment:
            result = storm(deployment, deployment.data[0] / "objects", size, seed=seed, say=_say)
        yield from _figures("storm, SQLite", result, size)


def postgres_storm(size: Size = POSTGRES, *, seed: int = 2) -> Iterator[Figure]:
    """Two workers on a real PostgreSQL: kills, frozen owners, immediate restarts of the database."""
    with tempfile.TemporaryDirectory(prefix="causticmill-storm-") as folder, running_postgres(durable=True) as database:
        place = Path(folder)
        with farm(place, database.url(), environment={"CAUSTICMILL_LEASE_S": str(LEASE_S)}) as deployment:
            restart = database.crash_and_restart
            result = storm(deployment, place / "store", size, seed=seed, restart_database=restart, say=_say)
        yield from _figures("storm, PostgreSQL, two workers", result, size)


def _figures(name: str, result: Result, size: Size) -> Iterator[Figure]:
    verdict = result.verdict
    faults = ", ".join(f"{count} x {kind}" for kind, count in sorted(result.faults.items()))
    few = [f"only {result.kills} kills"] if result.kills < size.kills else []
    yield Figure(f"{name}: processes killed", result.kills, "kills", _law(few, faults))
    yield Figure(
        f"{name}: real jobs", verdict.jobs, "jobs", f"in {result.took_s:.0f} s, {result.restarts} starts again"
    )
    yield Figure(
        f"{name}: jobs lost", len(verdict.lost), "jobs", _law(verdict.lost, "every acknowledged job succeeded")
    )
    yield Figure(f"{name}: doubled", len(verdict.doubled), "faults", _law(verdict.doubled, "one job per key, one end"))
    started = verdict.stages["stage.started"]
    words = (
        f"{started} starts for {verdict.stages['stage.committed']} commits, {verdict.stages['stage.reused']} taken over"
    )
    yield Figure(
        f"{name}: committed stages run again", len(verdict.run_again), "stages", _law(verdict.run_again, words)
    )
    words = f"{verdict.files} files read and hashed; equal jobs have equal files"
    yield Figure(f"{name}: half artifacts", len(verdict.half), "faults", _law(verdict.half, words))
    words = "no process after the stop, no stage after the last job"
    yield Figure(f"{name}: orphans", len(result.orphans), "processes", _law(result.orphans, words))


def _law(broken: list[str], words: str) -> str:
    return f"BROKEN: {' | '.join(broken[:3])[:600]}" if broken else words


def _say(line: str) -> None:
    print(f"  {line}", flush=True)
