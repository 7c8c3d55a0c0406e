"""What goes: ended jobs by age and quota, and files that nobody names. What stays: everything else, whoever races."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
import sqlalchemy as sa

from service.job.stages.order import FileRef, StageResult
from service.server.database.claims import WorkBook
from service.server.database.connection import begin_reading, begin_writing, clock
from service.server.database.job_rows import ARTIFACT_BYTES, read_counters
from service.server.database.jobs import JobBook
from service.server.database.records import JobState, NewJob, UnknownJobError
from service.server.database.runs import RunBook, RunRow
from service.server.database.tables import artifacts, jobs, stage_results
from service.server.queue.dbos import DbosEngine
from service.server.queue.engine import Ticket
from service.server.worker.retention import DAY_S, Retention
from service.settings import ServerSettings
from service.store.base import MissingObjectError
from service.store.opening import open_store
from tests.levels import mostly_thorough
from tests.service import databases


class Stand:
    """A database, a real engine, a real store, and jobs of one stage with a file of 1 MB each."""

    def __init__(self, settings: ServerSettings, database: sa.Engine, folder: Path) -> None:
        self.database = database
        self.folder = folder
        self.settings = settings
        self.store = open_store(settings)
        self.book = JobBook(database, self.store)
        self.work = WorkBook(database, lease_s=10.0)
        self.engine = DbosEngine(settings)

    def file(self, content: bytes) -> FileRef:
        path = self.folder / "file"
        path.unlink(missing_ok=True)  # it may be the store's own file by now
        path.write_bytes(content)
        stored = self.store.put_file(path)
        return FileRef(stored.sha256, stored.bytes)

    def job(self, number: int, *, ended_days_ago: float | None) -> tuple[str, FileRef]:
        picture, made = self.file(b"picture %d" % number), self.file(b"%d" % number * 1_000_000)
        new = NewJob(
            name="a",
            spec={},
            image_sha256=picture.sha256,
            image_bytes=picture.bytes,
            created_by="me",
            request_sha256="r",
        )
        job, _ = self.book.create(new)
        claim = self.work.claim(Ticket(job.id, 1), "here")
        assert claim is not None
        result = StageResult(outputs={"a.png": made}, report={}, notes={}, seconds=1.0, peak_rss_mb=1.0)
        begun = self.work.begin_stage(claim, "image", f"key {number}")
        self.work.commit_stage(claim, begun, result, log=None, whole=1.0)
        if ended_days_ago is not None:
            self.work.finish(claim, JobState.SUCCEEDED)
            self.age(job.id, f"key {number}", ended_days_ago)
        return job.id, made

    def age(self, job_id: str, key: str, days: float) -> None:
        with begin_writing(self.database) as connection:
            at = clock(connection) - days * DAY_S
            connection.execute(jobs.update().where(jobs.c.id == job_id).values(ended_at=at))
            connection.execute(stage_results.update().where(stage_results.c.key == key).values(used_at=at))

    def age_files(self) -> None:
        """As if everything in the store had been there for a day."""
        root = self.settings.data / "objects" if self.settings.embedded else self.folder / "store"
        day_ago = time.time() - DAY_S
        for path in root.rglob("*"):
            os.utime(path, (day_ago, day_ago))

    def turn(self, **changes: object) -> None:
        Retention(self.database, self.store, self.engine, self.settings.model_copy(update=changes)).clean_up()

    def has(self, file: FileRef) -> bool:
        try:
            return self.store.head(file.sha256).bytes == file.bytes
        except MissingObjectError:
            return False

    def lives(self, job_id: str) -> bool:
        try:
            return self.book.get(job_id).id == job_id
        except UnknownJobError:
            return False


@pytest.fixture(params=mostly_thorough(("sqlite", "postgresql"), quick=("sqlite",)))
def farm(request: pytest.FixtureRequest, tmp_path: Path) -> ServerSettings:
    return databases.farm(request, tmp_path)


@pytest.fixture
def stand(farm: ServerSettings, database: sa.Engine, tmp_path: Path) -> Stand:
    return Stand(farm, database, tmp_path)


def test_without_a_rule_nothing_named_goes(stand: Stand) -> None:
    job_id, made = stand.job(1, ended_days_ago=1000)
    stand.age_files()
    stand.turn()
    assert stand.lives(job_id)
    assert stand.has(made)


def test_old_ended_jobs_go_with_their_files(stand: Stand) -> None:
    (old, old_file), (new, new_file) = stand.job(1, ended_days_ago=8), stand.job(2, ended_days_ago=6)
    running, its_file = stand.job(3, ended_days_ago=None)
    stand.age_files()
    stand.turn(keep_days=7.0)
    assert [stand.lives(one) for one in (old, new, running)] == [False, True, True]
    assert [stand.has(one) for one in (old_file, new_file, its_file)] == [False, True, True]


def test_the_quota_takes_the_oldest_first_and_no_more_than_needed(stand: Stand) -> None:
    made = [stand.job(number, ended_days_ago=10 - number) for number in range(4)]
    stand.age_files()
    stand.turn(quota_mb=2)
    assert [stand.lives(job_id) for job_id, _ in made] == [False, False, False, True]
    assert [stand.has(file) for _, file in made] == [False, False, False, True]
    stand.turn(quota_mb=2)
    assert stand.lives(made[3][0])


def test_a_job_that_a_mill_has_in_hand_stays(stand: Stand) -> None:
    """Also where the mill got it after the old jobs were looked up."""
    job_id, made = stand.job(1, ended_days_ago=8)
    new = RunRow(machine="m", job_id=job_id, program="p.nc", number=1, sha256="0" * 64, created_by="me")
    RunBook(stand.database).create(new)
    stand.age_files()
    stand.turn(keep_days=7.0, quota_mb=1)
    retention = Retention(stand.database, stand.store, stand.engine, stand.settings)
    assert not retention._drop_job(job_id)
    assert stand.lives(job_id)
    assert stand.has(made)


def test_a_file_that_is_young_or_stored_again_is_not_swept(stand: Stand) -> None:
    """Between being stored and being named there is a moment: the picture of a job that is just being made."""
    old, renewed = stand.file(b"long forgotten"), stand.file(b"long forgotten, and now wanted again")
    stand.age_files()
    young = stand.file(b"just stored")
    stand.file(b"long forgotten, and now wanted again")
    stand.turn()
    assert [stand.has(one) for one in (young, old, renewed)] == [True, False, True]


def test_the_engine_forgets_what_was_deleted(stand: Stand) -> None:
    job_id, _ = stand.job(1, ended_days_ago=8)
    ticket = Ticket(job_id, 1)
    stand.engine.submit(ticket, priority=1)
    stand.engine.cancel(ticket)  # in place of a worker that has run it
    stand.turn(keep_days=7.0)
    assert stand.engine.list_known([ticket]) == set()


def test_what_the_engine_has_forgotten_is_not_asked_for_again(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    """It used to be looked at every five minutes for two days."""
    first, _ = stand.job(1, ended_days_ago=0.5)
    asked: list[list[Ticket]] = []
    monkeypatch.setattr(stand.engine, "forget", asked.append)
    retention = Retention(stand.database, stand.store, stand.engine, stand.settings)
    for _ in range(3):
        retention.clean_up()
    assert asked == [[Ticket(first, 1)]]


def test_the_store_is_swept_a_part_at_a_time(stand: Stand) -> None:
    """All of it once, to know its size; then a sixteenth each turn, so that all of it has its turn."""
    named, made = stand.job(1, ended_days_ago=1)
    retention = Retention(stand.database, stand.store, stand.engine, stand.settings)
    retention.clean_up()
    orphans = [stand.file(b"orphan %d" % number) for number in range(20)]
    stand.age_files()
    retention.clean_up()
    assert any(stand.has(one) for one in orphans)
    for _ in range(15):
        retention.clean_up()
    assert not any(stand.has(one) for one in orphans)
    assert stand.lives(named) and stand.has(made)


def test_the_bytes_of_all_artifacts_are_counted(stand: Stand) -> None:
    """Each content once, with the pictures that jobs were made from."""
    stand.job(1, ended_days_ago=1)
    stand.job(2, ended_days_ago=1)
    stand.file(b"named by nobody")
    stand.turn()
    with begin_reading(stand.database) as connection:
        assert read_counters(connection)[ARTIFACT_BYTES] == 2 * (1_000_000 + len(b"picture 1"))


def test_files_that_another_job_names_stay(stand: Stand) -> None:
    """The same result was offered by both: it goes with the second of them."""
    (old, made), (young, _) = stand.job(1, ended_days_ago=8), stand.job(2, ended_days_ago=1)
    with begin_writing(stand.database) as connection:
        row = {"job_id": young, "name": "b.png", "sha256": made.sha256, "bytes": made.bytes}
        connection.execute(artifacts.insert().values(**row, stage="image", created_at=0.0))
    stand.age_files()
    stand.turn(keep_days=7.0)
    assert not stand.lives(old) and stand.has(made)
    stand.turn(keep_days=0.5)
    assert not stand.has(made)
