"""Laws of the run book, on both databases: one open run on a mill, and the agent's word is what a run is."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import pytest
import sqlalchemy as sa

from service.server.database.connection import begin_reading, begin_writing
from service.server.database.job_rows import open_run_of
from service.server.database.jobs import JobBook
from service.server.database.records import ClientKey, KeyReusedError, NewJob, UnknownJobError
from service.server.database.runs import JobNotReadyError, MachineTakenError, RunBook, RunRow, UnknownRunError
from service.server.database.tables import jobs
from service.server.fleet.representation import make_live_run


@pytest.fixture
def book(database: sa.Engine) -> RunBook:
    return RunBook(database)


@pytest.fixture
def new(database: sa.Engine) -> RunRow:
    """A program of a succeeded job."""
    job, _ = JobBook(database).create(
        NewJob(name="a", spec={}, image_sha256="0" * 64, image_bytes=1, created_by="me", request_sha256="r")
    )
    with begin_writing(database) as connection:
        connection.execute(jobs.update().values(state="succeeded"))
    return RunRow(machine="m", job_id=job.id, program="pass-1-a.nc", number=1, sha256="a" * 64, created_by="me")


def view(state: str, **more: Any) -> dict[str, Any]:
    return {"id": "20261121-1", "state": state, "words": "", **more}


def made(book: RunBook, new: RunRow, state: str = "parked") -> RunRow:
    run, _ = book.create(new)
    assert book.confirm_parked(run.id, view("parked"))
    return book.record_report(book.get(run.id), view(state))


def test_why_a_run_is_in_its_state_is_kept_as_a_code_and_as_words_alone_where_there_is_none(
    book: RunBook, new: RunRow
) -> None:
    run = made(book, new, "running")
    lost = view("interrupted", words="alarm: ALARM:3", code="alarm", values={"alarm": 3})
    assert book.record_report(run, lost).reason == book.get(run.id).reason == {"code": "alarm", "values": {"alarm": 3}}
    of_before = book.record_report(book.get(run.id), view("held", words="by hand"))
    assert (of_before.words, of_before.reason) == ("by hand", None)
    book.close(run.id, "aborted", "given up", {"code": "run_given_up", "values": {"state": "held"}})
    assert make_live_run(book.get(run.id)).code == "run_given_up"


def test_of_many_at_once_one_gets_the_mill(book: RunBook, new: RunRow) -> None:
    def attempt(_: int) -> str:
        try:
            return book.create(new)[0].id
        except MachineTakenError as taken:
            return f"taken by {taken.other}"

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(attempt, range(16)))
    (winner,) = {one for one in found if not one.startswith("taken")}
    assert found.count(f"taken by {winner}") == 15
    assert book.create(replace(new, machine="other"))[1]


def test_one_key_makes_one_run(book: RunBook, new: RunRow) -> None:
    keyed = new, ClientKey("t", "k"), "r"
    run, first = book.create(*keyed)
    assert first and book.create(*keyed) == (run, False)
    with pytest.raises(KeyReusedError):
        book.create(new, ClientKey("t", "k"), "other")
    assert book.find_made_before(ClientKey("another token", "k"), "r") is None
    book.close(run.id, "refused", "no", forget_key=True)
    assert book.create(*keyed)[0].id != run.id


@pytest.mark.parametrize(("ended", "is_open"), [("finished", False), ("aborted", False), ("interrupted", True)])
def test_the_mill_is_free_when_the_agent_says_so(book: RunBook, new: RunRow, ended: str, is_open: bool) -> None:
    run = made(book, new, ended)
    assert (run.state, run.open) == (ended, is_open)
    assert (book.open_on("m") is None) is not is_open
    assert book.list_finished(new.job_id, "m") == ({new.sha256} if ended == "finished" else frozenset())


def test_a_run_that_goes_on_again_takes_the_mill_again(book: RunBook, new: RunRow) -> None:
    run = made(book, new, "aborted")
    assert book.record_report(run, view("recovering")).open
    assert book.record_report(book.get(run.id), view("aborted")).open is False


def test_it_does_not_where_another_has_the_mill(book: RunBook, new: RunRow) -> None:
    run = made(book, new, "aborted")
    other = made(book, new)
    told = book.record_report(run, view("recovering"))
    assert (told.state, told.open) == ("recovering", False)
    with pytest.raises(MachineTakenError, match=other.id):
        book.reopen(run)


def test_what_was_given_up_stays_so(book: RunBook, new: RunRow) -> None:
    run = made(book, new, "interrupted")
    book.close(run.id, "aborted", "given up")
    assert book.record_report(book.get(run.id), view("interrupted")).open is False
    assert not book.confirm_parked(run.id, view("parked"))


def test_news_only_are_written(book: RunBook, new: RunRow) -> None:
    """How far it is changes all the time: it is told, as the agent has it now, and not written down."""
    run = made(book, new, "running")
    seen = book.record_report(run, view("running", executed_line=5, share=0.5))
    assert seen.view is not None and (seen.view["executed_line"], seen.view["share"]) == (5, 0.5)
    assert book.get(run.id) == run
    assert book.record_report(run, view("held")).state == "held"


@pytest.mark.parametrize("state", ["queued", "running", "failed", "cancelled"])
def test_only_programs_that_have_been_checked(book: RunBook, new: RunRow, database: sa.Engine, state: str) -> None:
    with begin_writing(database) as connection:
        connection.execute(jobs.update().values(state=state))
    with pytest.raises(JobNotReadyError, match=state):
        book.create(new)
    with pytest.raises(UnknownJobError):
        book.create(replace(new, job_id="none"))


def test_an_open_run_is_known_by_its_job(book: RunBook, new: RunRow, database: sa.Engine) -> None:
    run = made(book, new)
    with begin_reading(database) as connection:
        assert open_run_of(connection, new.job_id) == run.id
    book.record_report(run, view("finished"))
    with begin_reading(database) as connection:
        assert open_run_of(connection, new.job_id) is None


def test_pages_are_newest_first_and_do_not_overlap(book: RunBook, new: RunRow) -> None:
    ids = [made(book, new, "finished").id for _ in range(5)]
    first = [run.id for run in book.list_rows(machine="m", limit=2)]
    second = [run.id for run in book.list_rows(machine="m", limit=3, before=first[-1])]
    assert set(first + second) == set(ids) and len(first + second) == 5
    assert book.list_rows(job="none") == [] == book.list_rows(machine="none")
    with pytest.raises(UnknownRunError):
        book.list_rows(before="none")


def test_what_cannot_be_written_down_is_told_all_the_same(book: RunBook, new: RunRow, database: sa.Engine) -> None:
    """A full disk must not hide from a person what the mill does; the next look writes it down."""
    run = made(book, new, "running")

    def refuse(*_: object) -> None:
        raise sa.exc.OperationalError("UPDATE", {}, Exception("database or disk is full"))

    sa.event.listen(database, "before_cursor_execute", refuse)
    told = book.record_report(run, view("held", words="by hand"))
    sa.event.remove(database, "before_cursor_execute", refuse)
    assert (told.state, told.words, told.open) == ("held", "by hand", True)
    assert book.get(run.id).state == "running"
    assert book.record_report(run, view("held")).state == book.get(run.id).state == "held"
