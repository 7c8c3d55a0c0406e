"""Whether the server says what is wrong with it, refuses what it cannot do, and recovers."""

from __future__ import annotations

import resource
import shutil
import sqlite3
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from service.server.api import monitoring
from service.server.database.connection import begin_writing
from service.server.database.tables import executors
from tests.service.server.api.server import ApiServer, api_server, png, problem
from tests.waiting import PATIENCE_S, until


@pytest.fixture
def own(tmp_path: Path) -> Iterator[ApiServer]:
    with api_server(tmp_path / "data") as running:
        beat(running)
        yield running


def beat(server: ApiServer, *, ago_s: float = 0) -> None:
    row = {"id": "w", "host": "h", "pid": 1, "boot": "b", "version": "1", "started_at": 0.0}
    with begin_writing(server.services.database) as connection:
        connection.execute(executors.delete())
        connection.execute(executors.insert().values(**row, seen_at=time.time() - ago_s))


def test_ready_when_everything_works(own: ApiServer) -> None:
    assert own.client.get("/livez").json() == {"alive": True}
    checks = {"database": "ok", "store": "ok", "worker": "ok", "disk": "ok"}
    assert own.client.get("/readyz").json() == {"ready": True, "checks": checks}


def test_a_worker_that_was_not_heard_of_is_named(own: ApiServer) -> None:
    beat(own, ago_s=own.services.settings.lease_s + 1)
    body = problem(own.client.get("/readyz"), 503, "worker")
    assert body["type"].endswith(":not-ready") and body["checks"]["database"] == "ok"


def test_twenty_who_ask_while_the_database_is_locked_share_one_check(
    own: ApiServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each used to hold a thread of the pool that everything else needs, for as long as the lock lasted."""
    checks: list[object] = []

    def noted_writing(database: sa.Engine) -> Any:
        checks.append(database)
        return begin_writing(database)

    monkeypatch.setattr(monitoring, "begin_writing", noted_writing)
    monkeypatch.setattr(monitoring, "_WAIT_S", 1.0)
    with sqlite3.connect(own.services.settings.data / "causticmill.sqlite", isolation_level=None) as other:
        other.execute("BEGIN IMMEDIATE")
        with ThreadPoolExecutor(20) as pool:
            answers = list(pool.map(lambda _: own.client.get("/readyz"), range(20)))
        late = own.client.get("/readyz")
        assert len(checks) == 1
        other.execute("ROLLBACK")
    for answer in (*answers, late):
        assert problem(answer, 503, "database")["checks"] == {
            "database": "no answer in 1 s", "store": "ok", "worker": "ok", "disk": "ok"
        }  # fmt: skip
    until(lambda: own.client.get("/readyz").status_code == 200)


def test_scrapes_at_the_same_time_count_once(own: ApiServer, monkeypatch: pytest.MonkeyPatch) -> None:
    counted: list[None] = []
    go_on = threading.Event()

    def noted_count(*_: object) -> list[Any]:
        counted.append(None)
        go_on.wait(PATIENCE_S)
        return []

    monkeypatch.setattr("service.server.api.monitoring._jobs", noted_count)
    with ThreadPoolExecutor(10) as pool:
        asked = [pool.submit(own.client.get, "/metrics") for _ in range(10)]
        until(lambda: len(counted) > 0)
        assert own.client.get("/livez").status_code == 200
        time.sleep(0.3)  # the others have come, too
        go_on.set()
        assert {one.result().status_code for one in asked} == {200}
    assert len(counted) == 1


def test_no_space_means_no_new_job_and_says_so(tmp_path: Path) -> None:
    with api_server(tmp_path / "data", free_disk_mb=10**9) as server:
        beat(server)
        problem(server.client.post("/v1/jobs", files={"image": png()}), 507)
        problem(server.client.get("/readyz"), 503, "disk")
        assert server.files() == set()


def test_a_lost_database_is_a_problem_until_it_is_back(own: ApiServer) -> None:
    """Its file is replaced by something that is none, and put back."""
    job, data = own.submit(), own.services.settings.data
    path = data / "causticmill.sqlite"
    own.services.database.dispose()
    kept = data.parent / "kept"
    kept.mkdir()
    for part in data.glob("causticmill.sqlite*"):
        shutil.move(part, kept / part.name)
    path.mkdir()
    before = own.files()
    for answer in (own.client.get(f"/v1/jobs/{job['id']}"), own.client.post("/v1/jobs", files={"image": png()})):
        body = problem(answer, 503)
        assert str(data) not in answer.text and "Traceback" not in answer.text and body["type"].endswith(":unavailable")
    problem(own.client.get("/readyz"), 503, "database")
    assert own.client.get("/livez").status_code == 200
    assert own.client.get("/metrics").text.count("causticmill_database_up 0.0") == 1
    assert {name for name in own.files() - before if not name.startswith("objects")} == set()
    path.rmdir()
    for part in kept.iterdir():
        shutil.move(part, data / part.name)
    assert own.client.get(f"/v1/jobs/{job['id']}").json()["id"] == job["id"]
    assert own.submit()["state"] == "queued" and own.client.get("/readyz").status_code == 200


@pytest.mark.thorough
def test_a_lost_store_is_a_problem_until_it_is_back(own: ApiServer) -> None:
    objects, kept = own.services.settings.data / "objects", own.services.settings.data / "kept"
    job_id = own.submit()["id"]
    own.put_artifact(job_id, "lens.stl", b"solid")
    objects.rename(kept)
    objects.write_text("")
    before = own.files()
    problem(own.client.post("/v1/jobs", files={"image": png()}), 503)
    problem(own.client.get(f"/v1/jobs/{job_id}/artifacts/lens.stl"), 503)
    problem(own.client.get("/readyz"), 503, "store")
    assert own.files() == before
    objects.unlink()
    kept.rename(objects)
    assert own.client.get(f"/v1/jobs/{job_id}/artifacts/lens.stl").content == b"solid"
    assert own.submit()["state"] == "queued" and own.client.get("/readyz").status_code == 200


def test_a_full_disk_is_told_and_nothing_is_left(own: ApiServer) -> None:
    """No file may grow beyond 200 kB for a moment: what the system says of a full disk."""
    before, limit = own.files(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limit[1]))
    try:
        answer = own.client.post("/v1/jobs", files={"image": png() + bytes(400_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    problem(answer, 507)
    assert own.files() == before and own.submit()["state"] == "queued"


@pytest.mark.thorough
def test_a_full_database_is_told_and_nothing_is_left(own: ApiServer) -> None:
    job_id, database = own.submit()["id"], own.services.database

    def full(connection: Any, _record: object) -> None:
        (pages,) = connection.execute("PRAGMA page_count").fetchone()
        connection.execute(f"PRAGMA max_page_count = {pages}")

    sa.event.listen(database, "connect", full)
    database.dispose()
    answers = [own.client.post("/v1/jobs", files={"image": png()}) for _ in range(60)]
    assert problem(answers[-1], 507)["type"].endswith(":no-space")
    made = [answer.json()["id"] for answer in answers if answer.status_code == 202]
    sa.event.remove(database, "connect", full)
    database.dispose()
    listed = own.client.get("/v1/jobs?limit=200").json()["jobs"]
    assert [job["id"] for job in listed] == [*made[::-1], job_id]  # what was told is there, and nothing else
    assert own.submit()["state"] == "queued"


def test_metrics_count_jobs_and_requests(own: ApiServer) -> None:
    job_id = own.submit()["id"]
    own.put_stage(job_id, "image")
    own.put_stage(job_id, "map", "interrupted")
    own.client.get("/v1/jobs/unknown")
    text = own.client.get("/metrics").text
    for line in (
        'causticmill_jobs{state="queued"} 1.0',
        'causticmill_jobs{state="failed"} 0.0',
        "causticmill_artifact_bytes 0.0",
        "causticmill_interruptions 1.0",
        'causticmill_stage_runs{stage="map",state="interrupted"} 1.0',
        'causticmill_request_seconds_count{method="POST",route="/v1/jobs",status="202"} 1.0',
        'causticmill_worker_beat_age_seconds{executor="w"}',
        "causticmill_database_up 1.0",
    ):
        assert line in text, line
    assert "unknown" not in text  # no address becomes a label
