"""A worker as a whole: the conditions under which it refuses to start, because jobs could be lost or done twice; its
parts, their starting order, and how it stops.

Threads: heart (lease), watch (requests to running jobs, and their progress), reconcile, retention, and those of the
engine.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import IO

import sqlalchemy as sa
import structlog

from service.errors import FailedError, InputError, sentence_of_os_error
from service.processes import lifeline
from service.server.database.claims import WorkBook
from service.server.database.schema import open_database
from service.server.queue.dbos import DbosEngine
from service.server.worker.attempt import Attempt, WorkerContext
from service.server.worker.lease import Lease, LeaseRenewer, Watch
from service.server.worker.reconcile import PeriodicThread, Reconciler
from service.server.worker.retention import Retention
from service.server.worker.stage_process import StageProcesses
from service.settings import ServerSettings
from service.store.opening import open_store

NETWORK = frozenset(
    [
        "nfs",
        "nfs3",
        "nfs4",
        "cifs",
        "smb",
        "smb2",
        "smb3",
        "smbfs",
        "9p",
        "afs",
        "ceph",
        "glusterfs",
        "lustre",
        "gpfs",
        "beegfs",
        "ocfs2",
        "gfs2",
        "ncpfs",
        "davfs",
        "fuse.sshfs",
        "fuse.glusterfs",
        "fuse.ceph",
        "fuse.s3fs",
        "fuse.rclone",
        "fuse.davfs",
        "fuse.juicefs",
    ]
)
MOUNTS = Path("/proc/self/mountinfo")
LOCK_NAME = "worker.lock"
TIMEOUT_S = 2.0  # a worker that was killed just now may not be quite gone


def executor_name(settings: ServerSettings) -> str:
    """Return the worker's name: stable, so that after a crash it finds its own jobs again at once."""
    if settings.executor is not None:
        return settings.executor
    if settings.embedded:
        return "local"
    folder = hashlib.sha256(str(settings.data.resolve()).encode()).hexdigest()[:8]
    host = "".join(c if c.isalnum() or c in "_.-" else "-" for c in socket.gethostname())
    return f"{host[:60].lstrip('_.-') or 'host'}:{folder}"


def refuse_network_disk(settings: ServerSettings, mounts: Callable[[], str] = MOUNTS.read_text) -> None:
    """Raise InputError if the SQLite file would be on another computer's disk, where its locks do not work."""
    if not settings.embedded:
        return
    try:
        kind = file_system_of(settings.data, mounts())
    except OSError:
        return  # not Linux: there is no way to find out
    if kind in NETWORK:
        raise InputError(
            f"CAUSTICMILL_DATA: {settings.data} is on a network file system ({kind}), where a SQLite database is not "
            "safe; allowed: a folder on a local disk, or CAUSTICMILL_DATABASE_URL=postgresql://..."
        )


def file_system_of(folder: Path, mounts: str) -> str:
    """Return the kind of the file system that holds `folder` (or would), from the text of /proc/self/mountinfo."""
    path, best, kind = str(folder.resolve()), "", ""
    for line in mounts.splitlines():
        fields, _, rest = line.partition(" - ")
        point = fields.split()[4].replace("\\040", " ")
        inside = path == point or path.startswith(point.rstrip("/") + "/")
        if inside and len(point) >= len(best):
            best, kind = point, rest.split()[0]
    return kind


def lock_data(settings: ServerSettings) -> IO[str]:
    """Make this process the only worker of a data folder with its own database. The caller keeps the returned file
    open.
    """
    try:
        file = (settings.data / LOCK_NAME).open("a+", encoding="ascii")
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot use the data folder")) from None
    if not _within(TIMEOUT_S, lambda: _try_flock(file)):
        file.close()
        raise InputError(f"CAUSTICMILL_DATA: another worker has {settings.data}; a SQLite database is for one worker")
    return file


class NameLock:
    """The lock of a worker's name in PostgreSQL; it ends with its connection. InputError if it is taken."""

    def __init__(self, database: sa.Engine, executor: str) -> None:
        self._database = database
        self._number = int.from_bytes(
            hashlib.sha256(f"causticmill {executor}".encode()).digest()[:8], "big", signed=True
        )
        self._connection = self._connect()
        if not _within(TIMEOUT_S, self._take):
            self._connection.close()
            raise InputError(
                f"CAUSTICMILL_EXECUTOR: another worker runs as {executor}; give each worker a name of its own"
            )

    def keep(self) -> None:
        """Lock it again if the connection was lost. A worker that took it meanwhile has overwritten our lease."""
        try:
            self._connection.execute(sa.text("SELECT 1"))
        except sa.exc.SQLAlchemyError:
            self._connection.close()  # it stays closed, so the next use fails, until there is a new one
            self._connection = self._connect()
            self._take()

    def close(self) -> None:
        self._connection.close()

    def _connect(self) -> sa.Connection:
        return self._database.connect().execution_options(isolation_level="AUTOCOMMIT")

    def _take(self) -> bool:
        found = self._connection.execute(sa.text("SELECT pg_try_advisory_lock(:n)"), {"n": self._number})
        return bool(found.scalar())


def _try_flock(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    file.truncate(0)
    file.write(f"{os.getpid()}\n")
    file.flush()
    return True


def _within(timeout_s: float, attempt: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + timeout_s
    while not attempt():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.1)
    return True


DRAIN_S = 8.0
EXIT_NAME_TAKEN = 3
RETENTION_S = 300.0
log = structlog.get_logger()


@contextmanager
def open_worker(settings: ServerSettings, processes: StageProcesses) -> Iterator[Worker]:
    """Open the only worker of its name. InputError if it would not be safe to work."""
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
        # The engine's tables first: a process that finds ours up to date may use both.
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
    """A worker with all its parts."""

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
        """End this process and everything it runs: another process works under our name and must not be disturbed."""
        self.context.processes.close()
        os._exit(EXIT_NAME_TAKEN)
