"""What a worker refuses to start with, because jobs could be lost or done twice: one clear line each."""

from __future__ import annotations

import fcntl
import hashlib
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

import sqlalchemy as sa

from service.errors import FailedError, InputError, sentence_of_os_error
from service.settings import ServerSettings

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
    """Raise InputError where the SQLite file would lie on a disk of another computer: its locks do not hold there."""
    if not settings.embedded:
        return
    try:
        kind = file_system_of(settings.data, mounts())
    except OSError:
        return  # not Linux: nobody says
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
    """Make this process the one worker of a data folder with its own database; the file is to be kept open."""
    try:
        file = (settings.data / LOCK_NAME).open("a+", encoding="ascii")
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot use the data folder")) from None
    if not _within(TIMEOUT_S, lambda: _try_flock(file)):
        file.close()
        raise InputError(f"CAUSTICMILL_DATA: another worker has {settings.data}; a SQLite database is for one worker")
    return file


class NameLock:
    """The lock of a worker's name in PostgreSQL; it ends with its connection. InputError where it is taken."""

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
        """Lock it again where the connection was lost. Who took it meanwhile has written his name over our lease."""
        try:
            self._connection.execute(sa.text("SELECT 1"))
        except sa.exc.SQLAlchemyError:
            self._connection.close()  # closed it stays, and fails the next time, until there is a new one
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
