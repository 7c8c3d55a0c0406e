"""The interface of the job engine. It guarantees that a submitted ticket runs until it has ended. Jobs and their states
are not its concern; they are in service/server/database.

A ticket that a worker has taken is run here: its attempt is called again, after a pause, as long as it is fenced and
the ticket is still this worker's.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Ticket:
    """A ticket for one attempt of one job, which the engine runs. `text` is its name in the engine."""

    job_id: str
    attempt: int

    @property
    def text(self) -> str:
        return f"{self.job_id}.{self.attempt}"

    @classmethod
    def of(cls, text: str) -> Ticket:
        job_id, _, attempt = text.rpartition(".")
        return cls(job_id, int(attempt))


class Fenced(Exception):
    """Raised by an attempt that may not go on: another worker owns the job, or this one may have lost its lease.

    The ticket has not ended. As long as it is still this executor's, the attempt is called again a little later.
    """


class Busy(Fenced):
    """Raised by an attempt when every slot of this worker is taken: the ticket is queued again, for any worker that is
    free.
    """


class JobEngine(Protocol):
    """The client's side may be used in any process; `serve` only in a worker."""

    def prepare(self) -> None:
        """Create or upgrade the engine's tables in the database. Workers only."""

    def submit(self, ticket: Ticket, *, priority: int) -> None:
        """Queue a ticket durably. A known ticket is left as it is. A smaller priority runs earlier."""

    def cancel(self, ticket: Ticket) -> None:
        """Prevent a ticket from being started (again). A running attempt is not stopped: it reads the job's own
        cancel_requested.
        """

    def list_known(self, tickets: list[Ticket]) -> set[Ticket]:
        """List those of these tickets that the engine will run, is running, or has run."""

    def find_owners(self) -> dict[Ticket, str]:
        """Find the executor of each ticket that has begun and not ended."""

    def list_ended(self, tickets: list[Ticket]) -> set[Ticket]:
        """List those of these tickets that the engine will not run (again)."""

    def forget(self, tickets: list[Ticket]) -> None:
        """Drop the history of tickets that have ended."""

    def serve(self, attempt: Callable[[Ticket], None], *, executor: str, slots: int) -> None:
        """Start running tickets in threads of this process, first those that this executor had begun before."""

    def take_over(self, executors: list[str]) -> None:
        """Run here the tickets that these dead executors had begun. Safe to repeat and to race."""

    def pick_up(self) -> None:
        """Run the tickets that, according to the engine, this executor has begun but that do not run here: the answer
        to their start was lost.
        """

    def close(self) -> None: ...


RETRY_PAUSE_S = 0.5  # after a lost lease, a full disk, a database that is away, or a stage that another still runs
STRAY_S = 5.0


class Ownership(Protocol):
    """The owner of a ticket, according to the engine."""

    def owns(self, ticket: Ticket, executor: str) -> bool: ...

    def give_back(self, ticket: Ticket, executor: str) -> None: ...


class TicketRunner:
    """Called by DBOS: runs the attempt again and again while it is fenced and the ticket is still ours."""

    def __init__(self, attempt: Callable[[Ticket], None], engine: Ownership, executor: str) -> None:
        self._attempt = attempt
        self._engine = engine
        self._executor = executor
        self._pause = threading.Event()
        self._running: Counter[Ticket] = Counter()
        self._strays: dict[Ticket, float] = {}

    def run(self, text: str) -> None:
        ticket = Ticket.of(text)
        self._running[ticket] += 1
        try:
            self._go_on(ticket)
        finally:
            self._running[ticket] -= 1

    def list_strays(self, owners: dict[Ticket, str]) -> list[Ticket]:
        """List tickets that have been ours for a while, and are not running: DBOS may just be about to call us."""
        now = time.monotonic()
        mine = {t for t, owner in owners.items() if owner == self._executor and not self._running[t]}
        self._strays = {ticket: self._strays.get(ticket, now) for ticket in mine}
        return [ticket for ticket, since in self._strays.items() if now - since > STRAY_S]

    def _go_on(self, ticket: Ticket) -> None:
        while True:
            try:
                return self._attempt(ticket)
            except Fenced as error:
                self._pause.wait(RETRY_PAUSE_S)
                if (isinstance(error, Busy) and self._try_give_back(ticket)) or self._is_lost(ticket):
                    # DBOS itself notices that the ticket is no longer ours, and records nothing.
                    return None

    def _try_give_back(self, ticket: Ticket) -> bool:
        try:
            self._engine.give_back(ticket, self._executor)
        except Exception:  # the database is away: the ticket stays ours
            return False
        return True

    def _is_lost(self, ticket: Ticket) -> bool:
        try:
            return not self._engine.owns(ticket, self._executor)
        except Exception:  # the database is away: the attempt finds out
            return False
