"""What becomes of a ticket that a worker has taken: its attempt is called again, after a pause, as long as it is fenced
and the ticket is still this worker's.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Protocol

from service.server.queue.engine import Busy, Fenced, Ticket

RETRY_PAUSE_S = 0.5  # after a lost lease, a full disk, a database that is away, or a stage that another still runs
STRAY_S = 5.0


class Ownership(Protocol):
    """Whose a ticket is, as the engine has it."""

    def owns(self, ticket: Ticket, executor: str) -> bool: ...

    def give_back(self, ticket: Ticket, executor: str) -> None: ...


class TicketRunner:
    """What DBOS calls: the attempt, again and again while it is fenced and the ticket is still ours."""

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
                    # DBOS sees for itself that the ticket is no longer ours, and records nothing.
                    return None

    def _try_give_back(self, ticket: Ticket) -> bool:
        try:
            self._engine.give_back(ticket, self._executor)
        except Exception:  # the database is away: it stays ours
            return False
        return True

    def _is_lost(self, ticket: Ticket) -> bool:
        try:
            return not self._engine.owns(ticket, self._executor)
        except Exception:  # the database is away: the attempt finds out
            return False
