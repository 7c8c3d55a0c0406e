"""What the API, the engine or a dead worker has left undone is done by the next turn of any worker."""

from __future__ import annotations

import pytest
import sqlalchemy as sa

from service.server.database.claims import WorkBook
from service.server.database.connection import begin_writing, clock
from service.server.database.jobs import JobBook
from service.server.database.records import Job, JobState, NewJob, StageState
from service.server.database.tables import executors, jobs
from service.server.queue.dbos import DbosEngine
from service.server.queue.engine import Fenced, Ticket
from service.server.worker import reconcile
from service.server.worker.lease import Lease
from service.server.worker.reconcile import Reconciler
from service.settings import ServerSettings

NEW = NewJob(name="a", spec={}, image_sha256="0" * 64, image_bytes=1, created_by="me", request_sha256="r")


class Stand:
    """A database, a real engine that nobody serves, and the reconcile loop of worker "me"."""

    def __init__(self, settings: ServerSettings, database: sa.Engine) -> None:
        self.database = database
        self.book = JobBook(database)
        self.work = WorkBook(database, lease_s=10.0)
        self.engine = DbosEngine(settings)
        self.running: set[str] = set()
        self.me = Lease(database, "me", 10.0, pid=1, version="1")
        self.me.take()
        self.loop = Reconciler(database, self.engine, executor="me", lease_s=10.0, list_active=lambda: self.running)

    def job(self, *, age_s: float = 60.0) -> Job:
        job, _ = self.book.create(NEW)
        with begin_writing(self.database) as connection:
            queued_at = clock(connection) - age_s
            connection.execute(jobs.update().where(jobs.c.id == job.id).values(queued_at=queued_at))
        return job

    def kill(self, executor: str) -> None:
        with begin_writing(self.database) as connection:
            connection.execute(executors.delete().where(executors.c.id == executor))


@pytest.fixture
def stand(farm: ServerSettings, database: sa.Engine) -> Stand:
    return Stand(farm, database)


def test_a_job_that_never_reached_the_engine_is_submitted(stand: Stand) -> None:
    """The API died between the two; one that was made just now is left to it."""
    old, new = stand.job(), stand.job(age_s=0.0)
    stand.loop.reconcile()
    assert stand.engine.list_known([Ticket(old.id, 1), Ticket(new.id, 1)]) == {Ticket(old.id, 1)}
    stand.loop.reconcile()
    assert stand.book.get(old.id).state == JobState.QUEUED


def test_a_running_job_to_be_cancelled_whose_worker_is_dead_is_cancelled(stand: Stand) -> None:
    other = Lease(stand.database, "other", 10.0, pid=2, version="1")
    other.take()
    job = stand.job()
    stand.work.claim(Ticket(job.id, 1), "other")
    stand.book.request_cancel(job.id, "me")
    stand.loop.reconcile()
    assert stand.book.get(job.id).state == JobState.RUNNING  # its worker lives: it does it itself
    stand.kill("other")
    stand.loop.reconcile()
    assert stand.book.get(job.id).state == JobState.CANCELLED


@pytest.mark.thorough
def test_a_job_of_my_own_former_life_to_be_cancelled_is_cancelled(stand: Stand) -> None:
    """This worker is alive, but does not have the job in hand."""
    job = stand.job()
    stand.work.claim(Ticket(job.id, 1), "me")
    stand.book.request_cancel(job.id, "me")
    stand.running = {job.id}
    stand.loop.reconcile()
    assert stand.book.get(job.id).state == JobState.RUNNING
    stand.running = set()
    stand.loop.reconcile()
    assert stand.book.get(job.id).state == JobState.CANCELLED


@pytest.mark.thorough
def test_a_job_that_the_engine_has_given_up_fails_with_words(stand: Stand) -> None:
    job = stand.job()
    stand.engine.submit(Ticket(job.id, 1), priority=1)
    stand.work.claim(Ticket(job.id, 1), "dead")
    stand.loop.reconcile()
    assert stand.book.get(job.id).state == JobState.RUNNING
    stand.engine.cancel(Ticket(job.id, 1))  # in place of too many starts
    stand.loop.reconcile()
    found = stand.book.get(job.id)
    assert found.state == JobState.FAILED
    assert found.error is not None
    assert "gave the job up" in found.error["detail"]
    assert stand.book.list_events(job.id)[-1].kind == "ended"


def test_what_stands_under_my_name_without_being_in_my_hands_is_let_go(stand: Stand) -> None:
    """A worker that was killed and is back: its ticket may be another's by now, who must be able to claim the job."""
    job = stand.job()
    before = stand.work.claim(Ticket(job.id, 1), "me")
    assert before is not None
    stand.work.begin_stage(before, "image", "k")
    with pytest.raises(Fenced):
        stand.work.claim(Ticket(job.id, 1), "other")
    stand.running = {job.id}
    stand.loop.reconcile()
    assert stand.work.read_wishes([before])[job.id] == "go"
    stand.running = set()
    stand.loop.reconcile()
    assert stand.work.read_wishes([before])[job.id] == "fenced"
    assert [run.state for run in stand.book.list_stages(job.id)] == [StageState.INTERRUPTED]
    assert stand.work.claim(Ticket(job.id, 1), "other") is not None


def test_a_claim_in_the_same_moment_is_not_let_go(stand: Stand) -> None:
    """Who claims has said before that he is about the job; what was read earlier is asked again under the lock."""
    job = stand.job()
    stand.work.claim(Ticket(job.id, 1), "me")
    asked: list[None] = []

    def in_hand() -> set[str]:
        asked.append(None)
        return {job.id} if len(asked) > 1 else set()

    loop = Reconciler(stand.database, stand.engine, executor="me", lease_s=10.0, list_active=in_hand)
    loop.release_claims()
    assert stand.book.get(job.id).owner == "me"


def test_a_long_queue_is_looked_through_a_part_at_a_time(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    """A turn costs the same whatever waits; after the end of the queue it is looked at from its head again."""
    monkeypatch.setattr(reconcile, "CHUNK", 2)
    tickets = [Ticket(stand.job().id, 1) for _ in range(5)]
    for known in (2, 4, 5):
        stand.loop.reconcile()
        assert len(stand.engine.list_known(tickets)) == known
    late = stand.job(age_s=1000.0)  # its place is at the head
    stand.loop.reconcile()
    assert stand.engine.list_known([Ticket(late.id, 1)])
