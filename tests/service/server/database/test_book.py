"""Laws of the job book, on both databases: one change, one event; no gaps; one job per key."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace

import pytest
import sqlalchemy as sa

from phrases.phrase import Phrase, phrases_in
from service.job.stages.order import FileRef, StageResult
from service.server.database.claims import Claim, StageClose, WorkBook
from service.server.database.connection import begin_writing
from service.server.database.jobs import JobBook
from service.server.database.records import (
    ClientKey,
    JobState,
    JobStateError,
    KeyReusedError,
    NewJob,
    StageState,
    UnknownArtifactError,
    UnknownJobError,
)
from service.server.database.runs import RunBook, RunRow
from service.server.database.tables import artifacts
from service.server.queue.engine import Fenced, Ticket
from tests.service.server.database.many_jobs import count_states

NEW = NewJob(
    name="a.png", spec={}, image_sha256="0" * 64, image_bytes=1, created_by="me", request_sha256="r", priority=100
)
KEY = ClientKey("token", "k")
FILE = FileRef("a" * 64, 10)


@pytest.fixture
def book(database: sa.Engine) -> JobBook:
    return JobBook(database)


@pytest.fixture
def work(database: sa.Engine) -> WorkBook:
    return WorkBook(database, lease_s=30)


def result(**outputs: FileRef) -> StageResult:
    named = {name.replace("_", "."): file for name, file in outputs.items()}
    return StageResult(outputs=named, report={}, notes={}, seconds=1.0, peak_rss_mb=10.0)


def claimed(book: JobBook, work: WorkBook, new: NewJob = NEW) -> Claim:
    job, _ = book.create(new)
    claim = work.claim(Ticket(job.id, 1), "here")
    assert claim is not None
    return claim


def commit(work: WorkBook, claim: Claim, stage: str, key: str, made: StageResult) -> None:
    work.commit_stage(claim, work.begin_stage(claim, stage, key), made, log=None, whole=0.5)


def test_twenty_requests_with_one_key_make_one_job(book: JobBook) -> None:
    new = replace(NEW, key=KEY)
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: book.create(new), range(20)))
    assert len({job.id for job, _ in made}) == 1
    assert [first for _, first in made].count(True) == 1
    assert len(book.list_rows()) == 1


def test_a_key_is_for_one_request_of_one_token(book: JobBook) -> None:
    mine, others = (replace(NEW, key=key) for key in (KEY, ClientKey("another token", "k")))
    made = [book.create(new) for new in (mine, others)]
    assert [first for _, first in made] == [True, True]
    with pytest.raises(KeyReusedError):
        book.create(replace(mine, request_sha256="other"))
    assert [book.create(new) for new in (mine, others)] == [(job, False) for job, _ in made]


def test_events_have_no_gaps_whoever_writes_them(book: JobBook) -> None:
    """Eight threads cancel and retry one job: seq is 1..n, and as many changes as versions."""
    job, _ = book.create(NEW)

    def stir(_: int) -> None:
        for change in (book.request_cancel, book.retry):
            with suppress(JobStateError):
                change(job.id, "me")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(stir, range(24)))
    assert [event.seq for event in book.list_events(job.id)] == list(range(1, len(book.list_events(job.id)) + 1))
    retried = sum(event.kind == "retried" for event in book.list_events(job.id))
    assert book.get(job.id).attempt == 1 + retried


def test_a_queued_job_is_cancelled_at_once_and_cancelling_again_changes_nothing(book: JobBook) -> None:
    job, _ = book.create(NEW)
    first = book.request_cancel(job.id, "me")
    assert (first.state, first.version) == (JobState.CANCELLED, 2)
    assert book.request_cancel(job.id, "me").version == 2
    assert [event.kind for event in book.list_events(job.id)] == ["queued", "cancel.requested", "ended"]


def test_what_the_table_of_states_forbids_is_refused(book: JobBook, work: WorkBook) -> None:
    claim = claimed(book, work)
    with pytest.raises(JobStateError):
        book.retry(claim.job.id, "me")
    with pytest.raises(JobStateError):
        book.delete(claim.job.id)
    work.finish(claim, JobState.SUCCEEDED)
    with pytest.raises(JobStateError):
        book.request_cancel(claim.job.id, "me")
    with pytest.raises(JobStateError):
        book.retry(claim.job.id, "me")
    book.delete(claim.job.id)
    with pytest.raises(UnknownJobError):
        book.get(claim.job.id)


def test_a_job_that_a_mill_has_in_hand_is_not_deleted(book: JobBook, work: WorkBook, database: sa.Engine) -> None:
    claim = claimed(book, work)
    work.finish(claim, JobState.SUCCEEDED)
    new = RunRow(machine="m", job_id=claim.job.id, program="p.nc", number=1, sha256="0" * 64, created_by="me")
    run, _ = RunBook(database).create(new)
    with pytest.raises(JobStateError, match=run.id):
        book.delete(claim.job.id)
    RunBook(database).close(run.id, "aborted", "")
    book.delete(claim.job.id)


def test_the_list_goes_from_new_to_old_in_pages(book: JobBook) -> None:
    ids = [book.create(NEW)[0].id for _ in range(5)]
    first = book.list_rows(limit=2)
    rest = book.list_rows(limit=5, before=first[-1].id)
    assert [job.id for job in first + rest] == ids[::-1]
    assert book.list_rows(states=[JobState.RUNNING]) == []
    assert count_states(book)[JobState.QUEUED] == 5


def test_the_queue_goes_by_priority_then_by_age(book: JobBook) -> None:
    slow, first, second = (book.create(replace(NEW, priority=p))[0].id for p in (1000, 10, 10))
    assert book.read_queue_positions() == {first: 1, second: 2, slow: 3}


def test_programs_are_offered_once_checked_and_internal_files_never(book: JobBook, work: WorkBook) -> None:
    claim = claimed(book, work)
    commit(work, claim, "pass-1", "k1", result(pass_nc=FILE, _stock=FILE))
    assert book.list_artifacts(claim.job.id) == []
    with pytest.raises(UnknownArtifactError):
        book.find_artifact(claim.job.id, "pass.nc")
    commit(work, claim, "check", "k2", result(toolpath_png=FILE))
    assert [one.name for one in book.list_artifacts(claim.job.id)] == ["pass.nc", "toolpath.png"]
    with pytest.raises(UnknownArtifactError):
        book.find_artifact(claim.job.id, ".stock")


def test_a_retried_job_offers_no_program_before_it_is_checked_again(book: JobBook, work: WorkBook) -> None:
    claim = claimed(book, work)
    commit(work, claim, "pass-1", "k1", result(pass_nc=FILE))
    commit(work, claim, "check", "k2", result())
    work.finish(claim, JobState.FAILED)
    assert book.find_artifact(claim.job.id, "pass.nc")
    book.retry(claim.job.id, "me")
    again = work.claim(Ticket(claim.job.id, 2), "here")
    assert again is not None
    assert work.reuse_stage(again, "pass-1", "k1", whole=0.1) is not None
    assert book.list_artifacts(claim.job.id) == []
    assert work.reuse_stage(again, "check", "k2", whole=0.2) is not None
    assert book.find_artifact(claim.job.id, "pass.nc")


def test_a_check_is_worth_nothing_for_programs_made_after_it(book: JobBook, work: WorkBook) -> None:
    """The worker was stopped, updated and started again in the middle of a job: its stages have other keys now."""
    first = claimed(book, work)
    commit(work, first, "pass-1", "old", result(pass_nc=FILE))
    commit(work, first, "check", "k", result(toolpath_png=FILE))
    again = work.claim(Ticket(first.job.id, 1), "here")
    assert again is not None
    assert book.find_artifact(first.job.id, "pass.nc")
    commit(work, again, "pass-1", "new", result(pass_nc=replace(FILE, sha256="b" * 64)))
    with pytest.raises(UnknownArtifactError):
        book.find_artifact(first.job.id, "pass.nc")
    assert work.reuse_stage(again, "check", "k", whole=0.5) is not None  # the same programs after all
    assert book.find_artifact(first.job.id, "pass.nc").sha256 == "b" * 64


def test_a_dead_owner_changes_nothing_any_more(book: JobBook, work: WorkBook, database: sa.Engine) -> None:
    """Every late write of a worker whose job was claimed by another raises Fenced, and leaves no trace."""
    old = claimed(book, work)
    begun = work.begin_stage(old, "map", "k")
    new = work.claim(Ticket(old.job.id, 1), "there")  # "here" has no live lease
    assert new is not None
    before = book.get(old.job.id), book.list_events(old.job.id), book.list_stages(old.job.id)
    late = (
        lambda: work.begin_stage(old, "map", "k"),
        lambda: work.commit_stage(old, begun, result(map_npz=FILE), log=None, whole=1.0),
        lambda: work.end_stage(old, begun, StageClose(state=StageState.FAILED, words="late")),
        lambda: work.finish(old, JobState.FAILED),
    )
    for write in late:
        with pytest.raises(Fenced):
            write()
    work.note_progress(old, "map", 0.9, whole=0.9)
    assert (book.get(old.job.id), book.list_events(old.job.id), book.list_stages(old.job.id)) == before
    assert [run.state for run in book.list_stages(old.job.id)] == [StageState.INTERRUPTED]
    assert work.read_wishes([old])[old.job.id] == "fenced"
    assert work.read_wishes([new])[old.job.id] == "go"
    with begin_writing(database) as connection:
        assert connection.execute(sa.select(sa.func.count()).select_from(artifacts)).scalar() == 0


def test_a_commit_whose_answer_was_lost_can_be_sent_again(book: JobBook, work: WorkBook) -> None:
    claim = claimed(book, work)
    begun = work.begin_stage(claim, "map", "k")
    for _ in range(2):
        work.commit_stage(claim, begun, result(map_npz=FILE), log=FILE, whole=0.5)
    kinds = [event.kind for event in book.list_events(claim.job.id)]
    assert kinds == ["queued", "started", "stage.started", "stage.committed"]
    assert [one.name for one in book.list_artifacts(claim.job.id)] == ["map.log", "map.npz"]


def test_equal_work_is_taken_from_another_job_and_own_work_without_a_word(book: JobBook, work: WorkBook) -> None:
    first = claimed(book, work)
    commit(work, first, "map", "k", result(map_npz=FILE))
    second = claimed(book, work)
    assert work.reuse_stage(second, "map", "k", whole=0.4) == result(map_npz=FILE)
    assert work.reuse_stage(second, "map", "other", whole=0.4) is None
    assert [run.state for run in book.list_stages(second.job.id)] == [StageState.REUSED]
    assert book.list_events(second.job.id)[-1].data == {"stage": "map", "from": first.job.id}
    resumed = work.claim(Ticket(first.job.id, 1), "here")
    assert resumed is not None
    seen = book.list_events(first.job.id)
    assert work.reuse_stage(resumed, "map", "k", whole=0.4) == result(map_npz=FILE)
    assert book.list_events(first.job.id) == seen


def test_cancelled_in_the_last_moment_is_cancelled(book: JobBook, work: WorkBook) -> None:
    claim = claimed(book, work)
    assert book.request_cancel(claim.job.id, "me").state == JobState.RUNNING
    assert work.read_wishes([claim])[claim.job.id] == "cancelled"
    work.finish(claim, JobState.SUCCEEDED, report={})
    assert book.get(claim.job.id).state == JobState.CANCELLED


def test_why_a_job_failed_can_be_said_in_another_language(book: JobBook, work: WorkBook) -> None:
    claim = claimed(book, work)
    detail = Phrase("the stage took longer than {limit_s:g} s", limit_s=60)
    work.finish(claim, JobState.FAILED, error={"stage": "map", "detail": detail, "field": None})
    told = {**(book.get(claim.job.id).error or {})}
    assert told == {"stage": "map", "detail": detail, "field": None, "phrases": phrases_in(detail)}
    assert book.list_events(claim.job.id)[-1].data["error"] == told


def test_news_of_many_jobs_come_together(book: JobBook, work: WorkBook) -> None:
    claim, (other, _) = claimed(book, work), book.create(NEW)
    work.begin_stage(claim, "map", "k")
    work.note_progress(claim, "map", 0.5, whole=0.25)
    news = book.read_news({claim.job.id: 2, other.id: 0})
    assert {(event.job_id, event.seq) for event in news.events} == {(claim.job.id, 3), (other.id, 1)}
    assert (news.progress[claim.job.id].share, news.progress[claim.job.id].progress) == (0.5, 0.25)
    assert set(news.progress) == {claim.job.id}


def test_the_report_grows_with_every_stage_of_this_attempt(book: JobBook, work: WorkBook) -> None:
    """Long before a job has ended its figures are told; what was reused counts, what was interrupted does not."""
    claim = claimed(book, work)
    assert book.report_so_far(claim.job) is None
    commit(work, claim, "image", "k1", replace(result(), report={"source": {"width": 8}}))
    commit(work, claim, "pass-1", "k2", replace(result(), report={"passes": [{"lines": 3}]}))
    work.begin_stage(claim, "pass-2", "k3")
    assert book.report_so_far(claim.job) == {"source": {"width": 8}, "passes": [{"lines": 3}]}
    other = claimed(book, work)
    assert work.reuse_stage(other, "image", "k1", whole=0.1) is not None
    assert book.report_so_far(other.job) == {"source": {"width": 8}}
