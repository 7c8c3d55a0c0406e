"""What is counted as it changes is what a count of all rows would give, whatever happened and whoever came between."""

from __future__ import annotations

import random
from collections import Counter as Tally
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import sqlalchemy as sa

from service.job.stages.order import FileRef, StageResult
from service.server.database.claims import StageClose, WorkBook, interrupt_tries
from service.server.database.connection import begin_reading, begin_writing, clock
from service.server.database.job_rows import Counter, end_job, read_counters
from service.server.database.jobs import JobBook
from service.server.database.records import JobState, JobStateError, NewJob, StageState, UnknownJobError
from service.server.database.tables import jobs, stage_results, stage_runs
from service.server.queue.engine import Fenced, Ticket
from tests.service.server.database.many_jobs import count_states

NEW = NewJob(name="a", spec={}, image_sha256="0" * 64, image_bytes=1, created_by="me", request_sha256="r")


def count_rows(connection: sa.Connection) -> Tally[Counter]:
    """What the counters should be."""
    found: Tally[Counter] = Tally()
    for row in connection.execute(sa.select(jobs.c.state)):
        found[Counter("jobs", state=row.state)] += 1
    ended = sa.select(stage_runs.c.stage, stage_runs.c.state).where(stage_runs.c.state != "running")
    for row in connection.execute(ended):
        found[Counter("stage_runs", row.stage, row.state)] += 1
    results = connection.execute(sa.select(sa.func.count()).select_from(stage_results)).scalar_one()
    found[Counter("stage_results")] = results
    return found


def live_through(database: sa.Engine, seed: int) -> None:
    """A few jobs at random: cancelled, retried, run by stages, interrupted, ended. None is deleted."""
    chance, book, work = random.Random(seed), JobBook(database), WorkBook(database, lease_s=30.0)
    ids = [book.create(NEW)[0].id for _ in range(3)]
    for _ in range(30):
        job_id = chance.choice(ids)
        with suppress(JobStateError, UnknownJobError, Fenced):
            match chance.randrange(4):
                case 0:
                    book.request_cancel(job_id, "me")
                case 1:
                    book.retry(job_id, "me")
                case _:
                    run_a_stage(database, work, book, job_id, chance)


def run_a_stage(database: sa.Engine, work: WorkBook, book: JobBook, job_id: str, chance: random.Random) -> None:
    claim = work.claim(Ticket(job_id, book.get(job_id).attempt), "here")
    if claim is None:
        return
    key, stage = f"key {chance.randrange(5)}", chance.choice(["map", "light"])
    if work.reuse_stage(claim, stage, key, whole=0.5) is not None:
        return
    begun = work.begin_stage(claim, stage, key)
    match chance.randrange(5):
        case 0:
            work.end_stage(claim, begun, StageClose(state=StageState.FAILED, words=""))
            work.finish(claim, JobState.FAILED)
        case 1:
            with begin_writing(database) as connection:
                interrupt_tries(connection, claim.job, at=clock(connection))
        case 2:
            work.forget_result(key)
        case _:
            made = {"a.png": FileRef("a" * 64, 1)}
            result = StageResult(outputs=made, report={}, notes={}, seconds=0.0, peak_rss_mb=1.0)
            work.commit_stage(claim, begun, result, log=None, whole=0.5)
            if chance.random() < 0.5:
                work.finish(claim, JobState.SUCCEEDED)


def test_counters_are_what_a_count_gives(database: sa.Engine) -> None:
    """Four at a time, so that their transactions meet at the counters' rows."""
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda seed: live_through(database, seed), range(8)))
    with begin_reading(database) as connection:
        counted = {key: value for key, value in read_counters(connection).items() if value}
        expected = {key: value for key, value in count_rows(connection).items() if value}
        compared = {key: counted.get(key) for key in counted if key.name in ("jobs", "stage_runs", "stage_results")}
        assert compared == expected
    assert count_states(JobBook(database)) == {
        state: expected.get(Counter("jobs", state=state), 0) for state in JobState
    }


def test_a_change_that_is_not_made_is_not_counted(database: sa.Engine) -> None:
    """The counter belongs to the transaction of what it counts: a crash takes both or neither."""
    book = JobBook(database)
    job, _ = book.create(NEW)
    with suppress(RuntimeError), begin_writing(database) as connection:
        end_job(connection, job, JobState.FAILED, at=1.0)
        raise RuntimeError
    assert count_states(book)[JobState.QUEUED] == 1 and count_states(book)[JobState.FAILED] == 0


def test_a_deleted_job_is_counted_no_more(database: sa.Engine) -> None:
    book = JobBook(database)
    for _ in range(2):
        job, _ = book.create(NEW)
    book.delete(job.id)
    assert count_states(book)[JobState.QUEUED] == 1


def test_a_claim_beyond_the_first_is_a_recovery(database: sa.Engine) -> None:
    book, work = JobBook(database), WorkBook(database, lease_s=0.0)
    job, _ = book.create(NEW)
    for executor in ("first", "second", "third"):
        assert work.claim(Ticket(job.id, 1), executor) is not None
    with begin_reading(database) as connection:
        assert read_counters(connection)[Counter("recoveries")] == 2
