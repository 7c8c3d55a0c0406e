"""A worker stops by its own clock before others take over by the database's; its name is its own."""

from __future__ import annotations

import threading

import pytest
import sqlalchemy as sa

from service.server.database.claims import WorkBook
from service.server.database.connection import begin_writing, clock
from service.server.database.jobs import JobBook
from service.server.database.records import JobState, NewJob
from service.server.database.tables import executors
from service.server.queue.engine import Fenced, Ticket
from service.server.worker.lease import Lease, LeaseRenewer, NameTakenError, list_live_executors
from tests.waiting import PATIENCE_S

NEW = NewJob(name="a", spec={}, image_sha256="0" * 64, image_bytes=1, created_by="me", request_sha256="r")


class Clock:
    """Seconds that pass when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def lease(database: sa.Engine, name: str = "a", lease_s: float = 10.0, clock: Clock | None = None) -> Lease:
    return Lease(database, name, lease_s, pid=1, version="1", monotonic=clock or Clock())


def age(database: sa.Engine, name: str, seconds: float) -> None:
    """As if the last beat had been so long ago, by the database's clock."""
    with begin_writing(database) as connection:
        seen_at = clock(connection) - seconds
        connection.execute(executors.update().where(executors.c.id == name).values(seen_at=seen_at))


def test_a_lease_is_safe_for_six_tenths_of_it_after_a_good_beat(database: sa.Engine) -> None:
    time = Clock()
    mine = lease(database, clock=time)
    assert not mine.is_safe()
    mine.take()
    time.now += 5.9
    assert mine.is_safe()
    mine.renew()
    time.now += 5.9
    assert mine.is_safe()
    time.now += 0.2
    assert not mine.is_safe()


def test_who_cannot_be_taken_over_need_not_stop_while_the_database_is_away(database: sa.Engine) -> None:
    time = Clock()
    mine = Lease(database, "a", 10.0, pid=1, version="1", alone=True, monotonic=time)
    assert not mine.is_safe()
    mine.take()
    time.now += 1000.0
    assert mine.is_safe()
    mine.give_back()
    assert not mine.is_safe()


def test_the_time_that_a_beat_took_counts_against_it(database: sa.Engine) -> None:
    """The answer came 5 s after the question: 1 s is left of 6."""

    class Slow(Clock):
        def __call__(self) -> float:
            self.now += 5.0
            return self.now

    mine = lease(database, clock=Slow())
    mine.take()  # asked at 105
    assert mine._good_at == 105.0


def test_others_are_alive_for_a_whole_lease_by_the_databases_clock(database: sa.Engine) -> None:
    lease(database).take()
    with begin_writing(database) as connection:
        assert list_live_executors(connection, 10.0) == {"a"}
    age(database, "a", 9.0)
    with begin_writing(database) as connection:
        assert list_live_executors(connection, 10.0) == {"a"}
    age(database, "a", 11.0)
    with begin_writing(database) as connection:
        assert list_live_executors(connection, 10.0) == set()


def test_who_starts_under_a_name_ends_the_one_who_had_it(database: sa.Engine) -> None:
    old, new = lease(database, lease_s=1.0), lease(database, lease_s=1.0)
    old.take()
    new.take()
    with pytest.raises(NameTakenError):
        old.renew()
    new.renew()
    taken = threading.Event()
    LeaseRenewer(old, taken.set).start()
    assert taken.wait(PATIENCE_S)
    old.give_back()  # not his to give
    new.renew()


def test_a_live_workers_job_is_not_claimed_a_dead_ones_is(database: sa.Engine) -> None:
    book, work = JobBook(database), WorkBook(database, lease_s=10.0)
    lease(database, "a").take()
    job, _ = book.create(NEW)
    first = work.claim(Ticket(job.id, 1), "a")
    assert first is not None
    with pytest.raises(Fenced):
        work.claim(Ticket(job.id, 1), "b")
    assert work.read_wishes([first])[job.id] == "go"
    age(database, "a", 11.0)
    second = work.claim(Ticket(job.id, 1), "b")
    assert second is not None
    assert second.fence > first.fence
    assert work.read_wishes([first, second])[job.id] == "go"
    assert work.read_wishes([first])[job.id] == "fenced"


def test_nothing_is_claimed_of_jobs_that_ended_are_gone_or_were_retried(database: sa.Engine) -> None:
    book, work = JobBook(database), WorkBook(database, lease_s=10.0)
    job, _ = book.create(NEW)
    book.request_cancel(job.id, "me")
    assert work.claim(Ticket(job.id, 1), "a") is None
    book.retry(job.id, "me")
    assert work.claim(Ticket(job.id, 1), "a") is None
    assert work.claim(Ticket(job.id, 2), "a") is not None
    assert work.claim(Ticket("no such job", 1), "a") is None
    assert book.get(job.id).state == JobState.RUNNING
