"""One attempt of one job: its stages in order, each reused, or run in a process of its own and committed.

Called by the engine as often as it takes. It returns once the job has ended, for whatever reason; it raises `Fenced`
where this worker must not go on now, and then another call, here or elsewhere, goes on after the last committed stage.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import structlog

from phrases.phrase import Phrase
from service.errors import ServiceError
from service.server.database.claims import Claim
from service.server.database.states import JobState
from service.server.queue.engine import Busy, Fenced, Ticket
from service.server.worker.context import AWAY, WorkerContext, fence_outage, retry_while_away
from service.server.worker.stage_runner import StageRunner

MEGA = 1_000_000
log = structlog.get_logger()


class Attempt:
    """What the engine calls with each ticket, from several threads."""

    def __init__(self, context: WorkerContext) -> None:
        self._context = context
        self._slots = threading.BoundedSemaphore(context.settings.slots)
        self._active: set[str] = set()
        self._lock = threading.Lock()
        self._disk_is_full = False

    def __call__(self, ticket: Ticket) -> None:
        ids = structlog.contextvars.bound_contextvars(job=ticket.job_id, attempt=ticket.attempt)
        with ids, self._hold_slot(), self._hold_job(ticket), fence_outage():
            self._require_fitness()
            claim = self._context.work.claim(ticket, self._context.executor)
            if claim is not None:
                self._run(claim)

    def list_active(self) -> set[str]:
        """List ids of the jobs that this worker is about: those it may be claiming just now included."""
        with self._lock:
            return set(self._active)

    def _run(self, claim: Claim) -> None:
        with self._context.watch.follow(claim) as watched:
            try:
                StageRunner(self._context, claim, watched).run()
            except (Fenced, *AWAY):
                raise
            except ServiceError as error:
                self._fail(claim, {"stage": None, "detail": str(error), "field": None})
            except Exception:
                log.exception("fault of the worker")
                words = Phrase("internal server error; see the server's log")
                self._fail(claim, {"stage": None, "detail": words, "field": None})

    def _fail(self, claim: Claim, error: dict[str, object]) -> None:
        retry_while_away(lambda: self._context.work.finish(claim, JobState.FAILED, error=error))

    def _require_fitness(self) -> None:
        """Begin nothing without a lease, while stopping, or on a disk that is full."""
        context = self._context
        if context.watch.stopping.is_set() or not context.lease.is_safe():
            raise Fenced("this worker may not work now")
        needed_mb, was_full = context.settings.free_disk_mb, self._disk_is_full
        self._disk_is_full = shutil.disk_usage(context.settings.data).free < needed_mb * MEGA
        if self._disk_is_full:
            if not was_full:
                log.warning("jobs wait: too little free disk space", needed_mb=needed_mb)
            raise Fenced("too little free disk space")

    @contextmanager
    def _hold_slot(self) -> Iterator[None]:
        """Hold a slot. The engine counts, too, but may hand out one more while a ticket is on its way to a thread."""
        if not self._slots.acquire(blocking=False):
            raise Busy("all slots are taken")
        try:
            yield
        finally:
            self._slots.release()

    @contextmanager
    def _hold_job(self, ticket: Ticket) -> Iterator[None]:
        """Hold the job: one call per job at a time in this process, whatever the engine believes."""
        with self._lock:
            if ticket.job_id in self._active:
                raise Fenced("it runs here already")
            self._active.add(ticket.job_id)
        try:
            yield
        finally:
            with self._lock:
                self._active.remove(ticket.job_id)
