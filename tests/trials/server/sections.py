"""The storms as figures. A note that begins with BROKEN tells of a law that did not hold."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.timing import Figure
from tests.service.server.worker.postgres import running_postgres
from tests.trials.server.chaos import SHARES
from tests.trials.server.deployment import Deployment, embedded, farm
from tests.trials.server.judge import Verdict
from tests.trials.server.storm import Result, Size, counted, storm

LEASE_S = 5.0
LEAST = 10  # of every kind
SQLITE = Size(jobs=36, kinds=26, kills=125, freezes=12, freeze_s=9.0, pause_s=(1.0, 5.0), patience_s=2400.0)
POSTGRES = Size(
    jobs=36, kinds=26, kills=125, freezes=12, freeze_s=9.0, restarts=12, pause_s=(1.0, 5.0), patience_s=2400.0
)
_SHORT_LEASE = {"CAUSTICMILL_LEASE_S": str(LEASE_S)}


def sqlite_storm(size: Size = SQLITE, *, seed: int = 1) -> Iterator[Figure]:
    """`serve` alone: supervisor, API, worker, fork server, stages and picture checker killed; workers frozen."""
    with tempfile.TemporaryDirectory(prefix="causticmill-storm-") as folder:
        with embedded(Path(folder), environment=_SHORT_LEASE | {"CAUSTICMILL_SLOTS": "2"}) as deployment:
            result = storm(deployment, deployment.data[0] / "objects", size, seed=seed, say=_say)
        _keep_logs(deployment, "sqlite", result)
        yield from _figures("storm, SQLite", result, size)


def postgres_storm(size: Size = POSTGRES, *, seed: int = 2) -> Iterator[Figure]:
    """Two workers on a real PostgreSQL: kills, frozen owners, immediate restarts of the database."""
    with tempfile.TemporaryDirectory(prefix="causticmill-storm-") as folder, running_postgres(durable=True) as database:
        place, url = Path(folder), database.url()
        with farm(place, url, environment=_SHORT_LEASE) as deployment:
            restart = database.crash_and_restart
            result = storm(
                deployment, place / "store", size, seed=seed, restart_database=restart, database_url=url, say=_say
            )
        _keep_logs(deployment, "postgres", result)
        yield from _figures("storm, PostgreSQL, two workers", result, size)


def _keep_logs(deployment: Deployment, name: str, result: Result) -> None:
    """Of a storm that broke a law: what the server wrote, and every broken law, in out/."""
    if result.broken:
        out = Path("out")
        out.mkdir(exist_ok=True)
        (out / f"storm-{name}.log").write_text(deployment.log())
        (out / f"storm-{name}.broken").write_text("\n".join(result.broken) + "\n")


def _figures(name: str, result: Result, size: Size) -> Iterator[Figure]:
    verdict = result.verdict
    load = f"load {os.getloadavg()[1]:.1f}"
    kinds = [*SHARES, *["freeze"] * bool(size.freezes), *["database restart"] * bool(size.restarts)]
    few = [f"only {n} x {kind}" for kind in kinds if (n := result.faults.get(kind, 0)) < LEAST]
    few = result.short + few
    yield Figure(f"{name}: processes killed", result.kills, "kills", _law(few, f"{counted(result.faults)}; {load}"))
    words = f"in {result.took_s:.0f} s, {result.restarts} starts again; answers {counted(result.answers)}"
    yield Figure(f"{name}: real jobs", verdict.jobs, "jobs", words)
    laws: tuple[tuple[str, list[str], str], ...] = (
        ("jobs lost", verdict.lost, "every acknowledged job succeeded"),
        ("doubled", verdict.doubled, "one job per key, one end per job, never two processes at one job"),
        ("committed stages run again", verdict.run_again, _stage_words(verdict)),
        ("half artifacts", verdict.half, f"{verdict.files} files read and hashed, the whole store too"),
        ("equal jobs that differ", verdict.differing, f"{verdict.equal} jobs compared with an equal one"),
        ("orphans", result.orphans, "no stage after the last job, no process after the stop"),
        ("files left", result.left, "scratch and uploads are empty, before the stop and after it"),
    )
    for what, broken, words in laws:
        yield Figure(f"{name}: {what}", len(broken), "faults", _law(broken, words))


def _stage_words(verdict: Verdict) -> str:
    count = verdict.stages
    return (
        f"{count['stage.started']} starts for {count['stage.committed']} commits, {count['stage.reused']} taken over, "
        f"{count['stage.interrupted']} interrupted"
    )


def _law(broken: list[str], words: str) -> str:
    return f"BROKEN: {' | '.join(broken[:3])[:600]}" if broken else words


def _say(line: str) -> None:
    print(f"  {line}", flush=True)
