"""A farm as its commands start it: API here, workers there, PostgreSQL and a store that all of them reach."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.service.server.supervisor.processes import Serving, is_alive, running, served
from tests.service.server.supervisor.test_serve import submitted, until_at_work, until_beyond
from tests.service.server.worker.postgres import Postgres
from tests.waiting import until

pytestmark = pytest.mark.thorough


@contextmanager
def working(data: Path, **environment: str) -> Iterator[Serving]:
    """`causticmill worker`."""
    with running([sys.executable, "-m", "service.cli.main", "worker"], data, environment) as process:
        yield process


def settings(postgres: Postgres, store_url: str) -> dict[str, str]:
    return {
        "CAUSTICMILL_DATABASE_URL": postgres.url(),
        "CAUSTICMILL_STORE_URL": store_url,
        "CAUSTICMILL_STORE_IS_SHARED": "true",
        "CAUSTICMILL_LEASE_S": "4",
        "CAUSTICMILL_START_AGENTS": "false",
    }


@pytest.mark.parametrize("kind", ["folder", "s3"])
def test_a_dead_hosts_job_goes_on_at_another(
    postgres: Postgres, tmp_path: Path, kind: str, request: pytest.FixtureRequest
) -> None:
    url = (tmp_path / "store").as_uri() if kind == "folder" else next(request.getfixturevalue("s3_urls"))
    farm = settings(postgres, url)
    with (
        working(tmp_path / "a", CAUSTICMILL_EXECUTOR="a", **farm) as first,
        served("--no-worker", data=tmp_path / "api", **farm) as serving,
    ):
        serving.until_ready()
        job = submitted(serving)
        until_at_work(serving, job)
        with working(tmp_path / "b", CAUSTICMILL_EXECUTOR="b", **farm):
            first.kill(first.pid, signal.SIGKILL)
            until_beyond(serving, job, "heightfield")


def test_a_worker_stops_by_a_word_however_often_it_is_said(postgres: Postgres, tmp_path: Path) -> None:
    farm = settings(postgres, (tmp_path / "store").as_uri())
    with working(tmp_path / "a", **farm) as worker:
        until(lambda: worker.out or worker.process.poll() is not None, what="a worker that works")
        assert worker.out, worker.err
        for _ in range(1000):
            worker.kill(worker.pid, signal.SIGTERM)
        assert worker.ended() == 0
        assert not is_alive(worker.pid)
