"""A real worker, told to stop, to cancel, and given stages that crash; stand-ins do the stages' work."""

from __future__ import annotations

import os
import signal
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from service.server.database.records import JobState, StageState
from service.server.queue.engine import Ticket
from service.settings import ServerSettings
from tests.levels import mostly_thorough
from tests.service import databases
from tests.service.server.worker.stage_bench import PROMPT_S
from tests.service.server.worker.storm import Storm
from tests.waiting import PATIENCE_S, until


@pytest.fixture(params=mostly_thorough(("sqlite", "postgresql"), quick=("sqlite",)))
def farm(request: pytest.FixtureRequest, tmp_path: Path) -> ServerSettings:
    return databases.farm(request, tmp_path)


@pytest.fixture
def make(farm: ServerSettings) -> Iterator[Callable[[float], Storm]]:
    made: list[Storm] = []

    def storm(pause_s: float) -> Storm:
        settings = farm.model_copy(update={"lease_s": 15.0, "free_disk_mb": 0, "executor": "one"})
        made.append(Storm(settings.data.parent / "work", {"one": settings}, pause_s=pause_s))
        return made[-1]

    yield storm
    for one in made:
        for pid, _ in one.kin():
            os.kill(pid, signal.SIGKILL)


def stage_pid(storm: Storm, count: int = 1) -> int:
    """The process of the stage that began as the count-th."""
    until(lambda: len(storm.noted("begin")) >= count, what=f"{count} stages")
    return int(str(storm.noted("begin")[count - 1]["pid"]))


def is_gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


@pytest.mark.thorough
def test_told_to_stop_it_leaves_its_job_to_its_next_start(make: Callable[[float], Storm]) -> None:
    """The stage is noted as interrupted, nobody is left, and the next start goes on with the same stage."""
    storm = make(30.0)
    job_id = storm.submit(2)[1]
    stage_pid(storm)
    storm._workers["one"].terminate()
    assert storm._workers["one"].wait(timeout=PATIENCE_S) == 0
    assert storm.kin() == []
    assert [run.state for run in storm.book.list_stages(job_id)] == [StageState.INTERRUPTED]
    assert storm.book.get(job_id).state == JobState.RUNNING
    storm.pause_s = 0.05
    storm.start("one")
    until(lambda: storm.book.get(job_id).ended, what="the job")
    assert storm.broken([job_id]) == []
    storm.stop()
    assert storm.left_over() == []


@pytest.mark.thorough
def test_cancel_ends_the_stage_and_the_job(make: Callable[[float], Storm]) -> None:
    storm = make(30.0)
    job_id = storm.submit(2)[1]
    pid = stage_pid(storm)
    asked = time.monotonic()
    storm.book.request_cancel(job_id, "me")
    until(lambda: is_gone(pid), what="the end of the stage")
    took_s = time.monotonic() - asked
    until(lambda: storm.book.get(job_id).ended, what="the end of the job")
    assert storm.book.get(job_id).state == JobState.CANCELLED
    assert [run.state for run in storm.book.list_stages(job_id)] == [StageState.CANCELLED]
    assert took_s < PROMPT_S
    storm.stop()
    assert storm.left_over() == []


@pytest.mark.thorough
def test_a_database_that_is_locked_for_long_costs_no_work(tmp_path: Path) -> None:
    """By a backup of the file, for longer than a lease: nobody else could take over, so the stage goes on."""
    settings = ServerSettings(data=tmp_path / "data", lease_s=3.0, free_disk_mb=0)
    storm = Storm(tmp_path, {"one": settings}, pause_s=4.0)
    (job_id,) = storm.submit(1, first=1)
    stage_pid(storm)
    with closing(sqlite3.connect(settings.sqlite)) as other:
        other.execute("BEGIN IMMEDIATE")
        until(lambda: len(storm.noted("end")) == 1, what="the end of the stage")
        time.sleep(settings.lease_s)
        other.rollback()
    until(lambda: storm.book.list_stages(job_id)[0].ended_at is not None, what="its commit")
    assert storm.book.list_stages(job_id)[0].state == StageState.COMMITTED
    storm.stop()


@pytest.mark.thorough
def test_on_a_full_disk_nothing_is_begun_and_the_log_says_so_once(tmp_path: Path) -> None:
    settings = ServerSettings(data=tmp_path / "data", free_disk_mb=1_000_000_000)
    storm = Storm(tmp_path, {"one": settings})
    (job_id,) = storm.submit(1, first=1)

    def told() -> int:
        return (tmp_path / "one.log").read_text().count("too little free disk space")

    until(lambda: told() > 0, what="the warning")
    until(lambda: storm.engine.find_owners() == {Ticket(job_id, 1): "local"}, what="the ticket's beginning")
    time.sleep(1.5)  # some more calls of the body
    assert told() == 1
    assert storm.book.get(job_id).state == JobState.QUEUED
    storm.stop()


@pytest.mark.thorough
def test_a_stage_that_crashes_three_times_fails_the_job(make: Callable[[float], Storm]) -> None:
    storm = make(30.0)
    job_id = storm.submit(2)[1]
    for count in (1, 2, 3):
        os.kill(stage_pid(storm, count), signal.SIGKILL)
    until(lambda: storm.book.get(job_id).ended, what="the end of the job")
    job = storm.book.get(job_id)
    assert job.state == JobState.FAILED
    assert job.error is not None
    assert job.error["stage"] == "image"
    assert "3 times" in job.error["detail"]
    states = [run.state for run in storm.book.list_stages(job_id)]
    assert states == [StageState.INTERRUPTED, StageState.INTERRUPTED, StageState.FAILED]
    storm.book.retry(job_id, "me")
    assert storm.book.get(job_id).state == JobState.QUEUED
    stage_pid(storm, 4)  # the reconcile loop submits what the engine does not know
    storm.stop()
