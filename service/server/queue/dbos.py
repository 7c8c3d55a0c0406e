"""The job engine on DBOS Transact: the only file that imports it.

A ticket is a workflow whose id is the ticket's, and its attempt is the whole workflow. The attempt is not a step: steps
let a resumed workflow skip finished work, and an attempt finds its finished work in the tables of jobs. Every setting
was measured.

On request of any process, DBOS queues a begun workflow again, even while the process that began it still works. So a
process first checks who owns it, and only one does so at a time (`_alone`).
"""

from __future__ import annotations

import fcntl
import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa
from dbos import DBOS, DBOSClient, DBOSConfig, DBOSPortableJSONSerializer, EnqueueOptions, WorkflowStatus

from service.server.database.connection import connect, use_wal
from service.server.queue.engine import Ticket, TicketRunner
from service.settings import ServerSettings

NAME = "causticmill"
QUEUE = "jobs"
WORKFLOW = "job"
# Version of the contents of the engine's rows, not of the program: another number would abandon the jobs of the old
# version.
SCHEMA_VERSION = "1"
POLL_S = 0.2
# A job may be begun this often at one worker before it counts as one that kills its workers.
MAX_RECOVERY_ATTEMPTS = 1000
POOL = {"pool_size": 4, "max_overflow": 6, "pool_pre_ping": True}
OPEN = ["ENQUEUED", "DELAYED", "PENDING"]
_LOCK = 0x63617573_71756575  # of `_alone`: "causqueu"
_MOST_ALONE_S = 10


class DbosEngine:
    """The client's side connects when first used, and costs a worker nothing."""

    def __init__(self, settings: ServerSettings) -> None:
        _redirect_logs()
        self._path = settings.data.absolute() / "engine.sqlite" if settings.embedded else None
        self._url = settings.sqlalchemy_url if self._path is None else f"sqlite:///{self._path}"
        self._client: DBOSClient | None = None
        self._lock = threading.Lock()
        self._serving = False
        self._runner: TicketRunner | None = None

    def prepare(self) -> None:
        if self._path is not None:
            connection = sqlite3.connect(self._path, timeout=30)
            use_wal(connection)
            connection.close()
        DBOS.migrate(self._url)

    def submit(self, ticket: Ticket, *, priority: int) -> None:
        options: EnqueueOptions = {
            "workflow_name": WORKFLOW,
            "queue_name": QUEUE,
            "workflow_id": ticket.text,
            "app_version": SCHEMA_VERSION,
            "priority": priority,
        }
        self._clients().enqueue(options, ticket.text)

    def cancel(self, ticket: Ticket) -> None:
        self._clients().cancel_workflow(ticket.text)

    def list_known(self, tickets: list[Ticket]) -> set[Ticket]:
        return {Ticket.of(status.workflow_id) for status in self._statuses(tickets)}

    def find_owners(self) -> dict[Ticket, str]:
        begun = self._clients().list_workflows(status="PENDING", name=WORKFLOW, load_input=False, load_output=False)
        return {Ticket.of(status.workflow_id): status.executor_id or "" for status in begun}

    def list_ended(self, tickets: list[Ticket]) -> set[Ticket]:
        return {Ticket.of(status.workflow_id) for status in self._statuses(tickets) if status.status not in OPEN}

    def forget(self, tickets: list[Ticket]) -> None:
        if ended := self.list_ended(tickets):
            self._clients().delete_workflows([ticket.text for ticket in ended])

    def serve(self, attempt: Callable[[Ticket], None], *, executor: str, slots: int) -> None:
        runner = self._runner = TicketRunner(attempt, self, executor)
        DBOS(config=self._config(executor))

        @DBOS.workflow(name=WORKFLOW, max_recovery_attempts=MAX_RECOVERY_ATTEMPTS)
        def job(text: str) -> None:
            runner.run(text)

        # Before the launch, because DBOS looks for queues only once a second.
        self._clients().register_queue(QUEUE, worker_concurrency=slots, polling_interval_sec=POLL_S)
        DBOS.launch()
        self._serving = True

    def take_over(self, executors: list[str]) -> None:
        if executors:
            with self._alone():
                self._queue_again([ticket for ticket, owner in self.find_owners().items() if owner in executors])

    def pick_up(self) -> None:
        if self._runner is not None and self._runner.list_strays(self.find_owners()):
            with self._alone():
                self._queue_again(self._runner.list_strays(self.find_owners()))

    def give_back(self, ticket: Ticket, executor: str) -> None:
        """Queue the ticket again, unless another process has it by now."""
        with self._alone():
            if self.owns(ticket, executor):
                self._queue_again([ticket])

    def close(self) -> None:
        if self._serving:
            DBOS.destroy()
            self._serving = False
        if self._client is not None:
            self._client.destroy()
            self._client = None

    def owns(self, ticket: Ticket, executor: str) -> bool:
        """Return whether the engine lets this executor run the ticket."""
        return any(s.status == "PENDING" and s.executor_id == executor for s in self._statuses([ticket]))

    def _queue_again(self, tickets: list[Ticket]) -> None:
        if tickets:
            self._clients().resume_workflows([ticket.text for ticket in tickets], queue_name=QUEUE)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Exclude all other threads and processes, so that no one queues a ticket again that another has just been
        given. PostgreSQL ends the lock of a process that hangs here for long.
        """
        if self._path is not None:
            with self._path.with_suffix(".lock").open("w") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                yield
            return
        database = connect(self._url)
        try:
            with database.begin() as connection:
                for name in ("lock_timeout", "idle_in_transaction_session_timeout"):
                    connection.execute(sa.text(f"SET LOCAL {name} = '{_MOST_ALONE_S}s'"))
                connection.execute(sa.text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _LOCK})
                yield
        finally:
            database.dispose()

    def _statuses(self, tickets: list[Ticket]) -> list[WorkflowStatus]:
        if not tickets:
            return []
        ids = [ticket.text for ticket in tickets]
        return self._clients().list_workflows(workflow_ids=ids, load_input=False, load_output=False)

    def _clients(self) -> DBOSClient:
        """Return the client, which is made at its first use; an operation fails if the database is away instead of
        waiting for it.
        """
        with self._lock:
            if self._client is None:
                self._client = DBOSClient(
                    system_database_url=self._url,
                    serializer=DBOSPortableJSONSerializer(),
                    application_name=NAME,
                    lazy=True,
                    retry_connection_errors=False,
                )
            return self._client

    def _config(self, executor: str) -> DBOSConfig:
        engine: dict[str, Any] = dict(POOL)
        return {
            "name": NAME,
            "system_database_url": self._url,
            "executor_id": executor,
            "application_version": SCHEMA_VERSION,
            "serializer": DBOSPortableJSONSerializer(),
            "notification_listener_polling_interval_sec": POLL_S,
            "log_level": "WARNING",
            "enable_otlp": False,
            "run_migrations": False,
            "db_engine_kwargs": engine,
        }


def _cut_to_first_line(record: logging.LogRecord) -> bool:
    """Cut a message to its first line: when the database is away for a moment DBOS logs whole tracebacks."""
    record.msg, record.args = record.getMessage().partition("\n")[0], None
    return True


def _redirect_logs() -> None:
    """Send DBOS's warnings and errors to the program's log; DBOS would write to stderr itself."""
    logger = logging.getLogger("dbos")
    logger.handlers[:] = [logging.NullHandler()]
    logger.filters[:] = [_cut_to_first_line]
    logger.propagate = True
    logger.setLevel(logging.WARNING)
