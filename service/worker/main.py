"""The worker's process: `python -m service.worker.main`, configured by the environment (service/settings.py).

Brings the database up to date, makes sure that it is the only worker of its name, and runs jobs until SIGTERM. Threads:
heart (lease), watch (wishes and progress of running jobs), reconcile, retention, those of the engine, and this one.
"""

from __future__ import annotations

import gc
import os
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version

import sqlalchemy as sa
import structlog

from service.errors import EXIT_FAILURE, JobError
from service.host import lifeline
from service.jobs.database import open_database
from service.jobs.work_book import WorkBook
from service.logs import configure_logs
from service.settings import ServerSettings
from service.store.opening import open_store
from service.worker.bench import Bench
from service.worker.body import Body
from service.worker.dbos_engine import DbosEngine
from service.worker.leases import Heart, Lease
from service.worker.processes import StageProcesses
from service.worker.reconcile import Reconciler, Rounds
from service.worker.refusals import NameLock, executor_name, lock_data, refuse_network_disk
from service.worker.retention import Retention
from service.worker.watch import Watch

STAGE_ENTRY = "service.worker.stage_entry:run_stage"
DRAIN_S = 8.0
EXIT_NAME_TAKEN = 3
RETENTION_S = 300.0
log = structlog.get_logger()


def main(*, entry: str = STAGE_ENTRY) -> int:
    """Run until told to stop; one line on stderr and a code where that cannot be. entry: what stages run."""
    end = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: end.set())
    try:
        settings = ServerSettings.load()
        configure_logs(settings.log_level, executor=executor_name(settings))
        with open_worker(settings, entry) as worker:
            worker.start()
            print(f"ready: worker {worker.bench.executor}", flush=True)
            gc.freeze()  # what is here now stays: not worth looking at again and again
            end.wait()
            worker.stop()
    except JobError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return error.exit_code
    except sa.exc.SQLAlchemyError as error:
        reason = str(getattr(error, "orig", None) or error).splitlines()[0]
        print(f"error: the database cannot be used: {reason}", file=sys.stderr, flush=True)
        return EXIT_FAILURE
    # The engine's threads wait for tickets that this worker has left for its next start: they are not waited for.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


@contextmanager
def open_worker(settings: ServerSettings, entry: str = STAGE_ENTRY) -> Iterator[Worker]:
    """A worker that is the only one of its name. InputError where it would not be safe to work."""
    refuse_network_disk(settings)
    executor = executor_name(settings)
    with ExitStack() as stack:
        if settings.embedded:
            stack.enter_context(lock_data(settings))
        settings.data.mkdir(parents=True, exist_ok=True)
        store = open_store(settings)
        store.check()
        engine = DbosEngine(settings)
        database = open_database(settings)
        name = None if settings.embedded else NameLock(database, executor)
        # The engine's tables first: who finds ours up to date may use both.
        engine.prepare()
        open_database(settings, migrate=True).dispose()
        lease = Lease(database, executor, settings.lease_s, pid=os.getpid(), version=version("causticmill"))
        work = WorkBook(database, lease_s=settings.lease_s)
        watch = Watch(work, lease)
        processes = StageProcesses(settings, entry=entry)
        stack.callback(processes.close)
        bench = Bench(settings, executor, work, store, processes, lease, watch)
        yield Worker(bench, database, engine, name)


@dataclass
class Worker:
    """All parts of a worker, put together."""

    bench: Bench
    database: sa.Engine
    engine: DbosEngine
    name: NameLock | None

    def __post_init__(self) -> None:
        bench = self.bench
        settings = bench.settings
        self._heart = Heart(bench.lease, self._leave)
        reconciler = Reconciler(
            self.database,
            self.engine,
            executor=bench.executor,
            lease_s=settings.lease_s,
            running=bench.watch.running,
        )
        every_s = min(max(settings.lease_s / 6, 0.3), 3.0)
        retention = Retention(self.database, bench.store, self.engine, settings)
        self._rounds = [
            Rounds("reconcile", reconciler.turn, every_s=every_s),
            Rounds("retention", retention.turn, every_s=RETENTION_S),
        ]
        if self.name is not None:
            self._rounds.append(Rounds("name", self.name.keep, every_s=settings.lease_s / 6))

    def start(self) -> None:
        """Beat first, then run jobs: no job is begun without a lease."""
        shutil.rmtree(self.bench.scratch, ignore_errors=True)
        self.bench.lease.take()
        self._heart.start()
        lifeline.healthy = self._heart.is_turning
        self.bench.watch.start()
        self.engine.serve(Body(self.bench), executor=self.bench.executor, slots=self.bench.settings.slots)
        for rounds in self._rounds:
            rounds.start()
        log.info("worker ready")

    def stop(self) -> None:
        """Running stages are stopped and noted as interrupted; their jobs go on at the next start, or elsewhere."""
        log.info("worker stops")
        self.bench.watch.stopping.set()
        for rounds in self._rounds:
            rounds.stop()
        if not self.bench.watch.is_idle_within(DRAIN_S):
            log.warning("jobs did not stop in time")
        else:
            shutil.rmtree(self.bench.scratch, ignore_errors=True)
        self._heart.stop()
        try:
            self.bench.lease.give_back()
        except sa.exc.SQLAlchemyError as error:
            log.warning("the lease was not given back", error=str(error).splitlines()[0])

    def _leave(self) -> None:
        """Another process works under our name: end, with everything that runs, before it is in its way."""
        self.bench.processes.close()
        os._exit(EXIT_NAME_TAKEN)


if __name__ == "__main__":
    sys.exit(main())
