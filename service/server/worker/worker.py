"""A worker, put together: what it is made of, in which order it starts, and how it stops.

Threads: heart (lease), watch (wishes and progress of running jobs), reconcile, retention, and those of the engine.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version

import sqlalchemy as sa
import structlog

from service.processes import lifeline
from service.server.database.claims import WorkBook
from service.server.database.schema import open_database
from service.server.queue.dbos import DbosEngine
from service.server.worker.attempt import Attempt
from service.server.worker.context import WorkerContext
from service.server.worker.lease import Lease, LeaseRenewer
from service.server.worker.monitor import Watch
from service.server.worker.preconditions import NameLock, executor_name, lock_data, refuse_network_disk
from service.server.worker.process.pool import StageProcesses
from service.server.worker.reconcile import PeriodicThread, Reconciler
from service.server.worker.retention import Retention
from service.settings import ServerSettings
from service.store.opening import open_store

DRAIN_S = 8.0
EXIT_NAME_TAKEN = 3
RETENTION_S = 300.0
log = structlog.get_logger()


@contextmanager
def open_worker(settings: ServerSettings, processes: StageProcesses) -> Iterator[Worker]:
    """Open a worker that is the only one of its name. InputError where it would not be safe to work."""
    refuse_network_disk(settings)
    executor = executor_name(settings)
    with ExitStack() as stack:
        if settings.embedded:
            stack.enter_context(lock_data(settings))
        store = open_store(settings)
        store.check()
        engine = DbosEngine(settings)
        database = open_database(settings)
        name = None if settings.embedded else NameLock(database, executor)
        # The engine's tables first: who finds ours up to date may use both.
        engine.prepare()
        open_database(settings, migrate=True).dispose()
        ours = version("causticmill")
        lease = Lease(database, executor, settings.lease_s, pid=os.getpid(), version=ours, alone=settings.embedded)
        work = WorkBook(database, lease_s=settings.lease_s)
        watch = Watch(work, lease)
        context = WorkerContext(settings, executor, work, store, processes, lease, watch)
        yield Worker(context, database, engine, name)


@dataclass
class Worker:
    """All parts of a worker, put together."""

    context: WorkerContext
    database: sa.Engine
    engine: DbosEngine
    name: NameLock | None

    def __post_init__(self) -> None:
        context = self.context
        settings = context.settings
        self._renewer = LeaseRenewer(context.lease, self._leave)
        self._attempt = Attempt(context)
        self._reconciler = Reconciler(
            self.database,
            self.engine,
            executor=context.executor,
            lease_s=settings.lease_s,
            list_active=self._attempt.list_active,
        )
        every_s = min(max(settings.lease_s / 6, 0.3), 3.0)
        retention = Retention(self.database, context.store, self.engine, settings)
        self._threads = [
            PeriodicThread("reconcile", self._reconciler.reconcile, every_s=every_s),
            PeriodicThread("retention", retention.clean_up, every_s=RETENTION_S),
        ]
        if self.name is not None:
            self._threads.append(PeriodicThread("name", self.name.keep, every_s=settings.lease_s / 6))

    def start(self) -> None:
        """Renew the lease first, then run jobs: no job is begun without a lease."""
        shutil.rmtree(self.context.scratch, ignore_errors=True)
        self.context.lease.take()
        self._renewer.start()
        lifeline.healthy = self._renewer.is_turning
        self.context.watch.start()
        self._reconciler.release_claims()
        self.engine.serve(self._attempt, executor=self.context.executor, slots=self.context.settings.slots)
        for rounds in self._threads:
            rounds.start()
        log.info("worker ready")

    def stop(self) -> None:
        """Stop running stages and note them as interrupted; their jobs go on at the next start, or elsewhere."""
        log.info("worker stops")
        self.context.watch.stopping.set()
        for rounds in self._threads:
            rounds.stop()
        if not self.context.watch.is_idle_within(DRAIN_S):
            log.warning("jobs did not stop in time")
        else:
            shutil.rmtree(self.context.scratch, ignore_errors=True)
        self._renewer.stop()
        try:
            self.context.lease.give_back()
        except sa.exc.SQLAlchemyError as error:
            log.warning("the lease was not given back", error=str(error).splitlines()[0])

    def _leave(self) -> None:
        """End, with everything that runs, as another process works under our name and must not be hindered."""
        self.context.processes.close()
        os._exit(EXIT_NAME_TAKEN)
