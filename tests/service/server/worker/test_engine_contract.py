"""What the rest of the service relies on in a job engine, on both databases, with real processes that are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing
from pathlib import Path

import pytest
import sqlalchemy as sa

from service.server.database.connection import begin_writing, connect
from service.server.queue.dbos import DbosEngine
from service.server.queue.engine import Ticket
from service.settings import ServerSettings
from tests.waiting import until

SCRIPT = Path(__file__).parent / "engine_process.py"


class Stand:
    """An engine to submit to, processes that serve it, and the notes that their bodies made."""

    def __init__(self, settings: ServerSettings, folder: Path) -> None:
        self.settings = settings
        self.folder = folder
        settings.data.mkdir(parents=True, exist_ok=True)
        self.engine = DbosEngine(settings)
        self.engine.prepare()
        self._processes: list[subprocess.Popen[str]] = []

    def serve(self, executor: str, *dead: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, SCRIPT, executor, self.folder, *dead],
            env=self.settings.environment(),
            stdout=subprocess.PIPE,
            text=True,
        )
        self._processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    def notes(self, word: str = "begin") -> list[tuple[str, str]]:
        """(ticket, executor) of each note, in order."""
        path = self.folder / "notes"
        lines = path.read_text().splitlines() if path.exists() else []
        return [(line.split()[1], line.split()[2]) for line in lines if line.split()[0] == word]

    def await_notes(self, count: int, word: str = "begin") -> list[tuple[str, str]]:
        until(lambda: len(self.notes(word)) >= count, what=f"{count} times '{word}'")
        return self.notes(word)

    def await_end(self, *tickets: Ticket) -> None:
        until(lambda: self.engine.list_ended(list(tickets)) == set(tickets), what=f"the end of {tickets}")

    def close(self) -> None:
        self.engine.close()
        for process in self._processes:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()


@pytest.fixture
def stand(farm: ServerSettings, tmp_path: Path) -> Iterator[Stand]:
    made = Stand(farm, tmp_path)
    yield made
    made.close()


@pytest.mark.thorough
def test_submitted_tickets_run_once_in_order_of_priority(stand: Stand) -> None:
    """Submitted twice is submitted once; smaller numbers first, then as they came; cancelled ones never."""
    order = {"low": 1000, "first": 100, "second": 100, "high": 10, "gone": 1}
    for name, priority in order.items():
        for _ in range(2):
            stand.engine.submit(Ticket(name, 1), priority=priority)
    stand.engine.cancel(Ticket("gone", 1))
    stand.serve("a")
    stand.await_end(*(Ticket(name, 1) for name in order))
    assert [ticket for ticket, _ in stand.notes("end")] == ["high.1", "first.1", "second.1", "low.1"]
    stand.engine.submit(Ticket("low", 1), priority=1)  # has run: stays as it is
    stand.engine.submit(Ticket("low", 2), priority=1)
    stand.await_end(Ticket("low", 2))
    assert [ticket for ticket, _ in stand.notes()][4:] == ["low.2"]


@pytest.mark.thorough
def test_known_ended_forgotten(stand: Stand) -> None:
    done, waits, unheard = Ticket("done", 1), Ticket("slow", 1), Ticket("unheard", 1)
    stand.engine.submit(done, priority=1)
    stand.serve("a")
    stand.await_end(done)
    stand.engine.submit(waits, priority=1)
    stand.await_notes(2)
    assert stand.engine.list_known([done, waits, unheard]) == {done, waits}
    assert stand.engine.list_ended([done, waits, unheard]) == {done}
    assert stand.engine.find_owners() == {waits: "a"}
    stand.engine.forget([done, waits, unheard])
    assert stand.engine.list_known([done, waits, unheard]) == {waits}


@pytest.mark.thorough
def test_a_fenced_body_is_called_again(stand: Stand) -> None:
    stand.engine.submit(Ticket("fenced", 1), priority=1)
    stand.serve("a")
    stand.await_end(Ticket("fenced", 1))
    assert (len(stand.notes()), len(stand.notes("end"))) == (2, 1)


@pytest.mark.thorough
def test_a_ticket_for_which_there_is_no_slot_runs_elsewhere(stand: Stand) -> None:
    """Given back it waits in the queue for anybody; its end is recorded once."""
    ticket = Ticket("busy", 1)
    stand.engine.submit(ticket, priority=1)
    stand.serve("a")
    stand.await_notes(2)
    stand.serve("b")
    stand.await_end(ticket)
    assert stand.notes("end") == [("busy.1", "b")]


@pytest.mark.thorough
def test_a_killed_process_goes_on_at_its_next_start(stand: Stand) -> None:
    ticket = Ticket("slow", 1)
    stand.engine.submit(ticket, priority=1)
    process = stand.serve("a")
    stand.await_notes(1)
    process.kill()
    process.wait()
    assert stand.engine.find_owners() == {ticket: "a"}
    stand.serve("a")
    stand.await_notes(2)
    (stand.folder / "release").touch()
    stand.await_end(ticket)
    assert len(stand.notes("end")) == 1


@pytest.mark.thorough
def test_two_that_take_over_from_a_dead_one_run_its_ticket_once(stand: Stand) -> None:
    """Both try again and again, as the reconcile loop does: one gets it, and nothing runs twice."""
    ticket = Ticket("slow", 1)
    stand.engine.submit(ticket, priority=1)
    process = stand.serve("a")
    stand.await_notes(1)
    process.kill()
    process.wait()
    for name in ("b", "c"):
        stand.serve(name, "a")
    heirs = stand.await_notes(2)[1:]
    until(lambda: stand.engine.find_owners() == {ticket: heirs[0][1]}, what="the new owner")
    (stand.folder / "release").touch()
    stand.await_end(ticket)
    assert (len(stand.notes()), len(stand.notes("end"))) == (2, 1)


@pytest.mark.parametrize(
    "call", [lambda engine, _: engine.take_over(["a"]), lambda engine, t: engine.give_back(t, "a")]
)
def test_what_another_has_been_given_meanwhile_is_not_queued_again(
    stand: Stand, call: Callable[[DbosEngine, Ticket], None]
) -> None:
    """Who queues again what an executor had begun looks whose it is when no other can be at the same."""
    ticket, other = Ticket("moved", 1), DbosEngine(stand.settings)
    stand.engine.submit(ticket, priority=1)
    begin_unheard(stand.settings, ticket, "a")
    with ThreadPoolExecutor(1) as pool, closing(other):
        with stand.engine._alone():
            asking = pool.submit(call, other, ticket)
            assert not wait([asking], timeout=0.5).done
            begin_unheard(stand.settings, ticket, "b")
        asking.result()
    assert stand.engine.find_owners() == {ticket: "b"}


@pytest.mark.thorough
def test_a_frozen_owner_that_wakes_up_changes_nothing(stand: Stand) -> None:
    """Taken over while stopped; its body returns late, and the ticket stays with the one who has it."""
    ticket = Ticket("slow", 1)
    stand.engine.submit(ticket, priority=1)
    frozen = stand.serve("a")
    stand.await_notes(1)
    os.kill(frozen.pid, signal.SIGSTOP)
    stand.serve("b", "a")
    stand.await_notes(2)
    (stand.folder / "release").touch()
    stand.await_end(ticket)
    os.kill(frozen.pid, signal.SIGCONT)
    stand.await_notes(2, "end")
    assert stand.engine.list_ended([ticket]) == {ticket}
    assert stand.engine.find_owners() == {}


@pytest.mark.thorough
def test_a_ticket_that_was_begun_without_anybody_knowing_runs(stand: Stand) -> None:
    """The database died after it had noted that the executor begins, and before the executor heard of it.

    Where the computer is too busy to call it within STRAY_S it is begun once more; a job finds its stages made.
    """
    first, stray = Ticket("slow", 1), Ticket("stray", 1)
    stand.serve("a")
    stand.engine.submit(first, priority=1)
    stand.await_notes(1)
    stand.engine.submit(stray, priority=1)
    begin_unheard(stand.settings, stray, "a")
    (stand.folder / "release").touch()
    stand.await_end(first, stray)
    begun = [ticket for ticket, _ in stand.notes()]
    assert (begun[0], set(begun[1:])) == ("slow.1", {"stray.1"})


def begin_unheard(settings: ServerSettings, ticket: Ticket, executor: str) -> None:
    """What the engine's own table holds after such an accident."""
    embedded = f"sqlite:///{settings.data / 'engine.sqlite'}"
    table = "workflow_status" if settings.embedded else "dbos.workflow_status"
    database = connect(embedded if settings.embedded else settings.sqlalchemy_url)
    with begin_writing(database) as connection:
        begun = sa.text(f"UPDATE {table} SET status = 'PENDING', executor_id = :e WHERE workflow_uuid = :t")
        assert connection.execute(begun, {"e": executor, "t": ticket.text}).rowcount == 1
    database.dispose()
