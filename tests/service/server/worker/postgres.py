"""A real PostgreSQL server for the tests, of their own: made in a temporary folder, gone afterwards.

Its programs come from the PATH or from where Debian puts them. Run by root it runs as another user, as PostgreSQL
refuses root.
"""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import psycopg

DEBIAN = Path("/usr/lib/postgresql")
USERS = ("postgres", "nobody")
FAST = ("fsync=off", "synchronous_commit=off", "full_page_writes=off")


@dataclass(frozen=True)
class Postgres:
    """A running server; `url()` makes a database of its own for whoever asks."""

    programs: Path
    folder: Path
    port: int
    user: str | None
    options: tuple[str, ...]

    def url(self, name: str = "", *, template: str = "template1") -> str:
        """A fresh database: empty, or a copy of the template."""
        name = name or f"t{uuid4().hex[:12]}"
        with psycopg.connect(self.url_of("postgres"), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name} TEMPLATE {template}")
        return self.url_of(name)

    def url_of(self, name: str) -> str:
        return f"postgresql://tester@127.0.0.1:{self.port}/{name}"

    def start(self) -> None:
        settings = (f"port={self.port}", "listen_addresses=127.0.0.1", "unix_socket_directories=", *self.options)
        options = " ".join(f"-c {one}" for one in settings)
        log = self.folder / "log"
        self._run("pg_ctl", "-D", str(self.folder / "data"), "-l", str(log), "-w", "-t", "60", "-o", options, "start")

    def stop(self, mode: str = "fast") -> None:
        """mode "immediate" is a crash: nothing is finished, and the next start recovers."""
        self._run("pg_ctl", "-D", str(self.folder / "data"), "-w", "-m", mode, "stop")

    def crash_and_restart(self) -> None:
        self.stop("immediate")
        self.start()

    def _run(self, program: str, *arguments: str) -> None:
        path = self.programs / program
        found = subprocess.run(
            [path, *arguments], user=self.user, cwd="/", stdin=subprocess.DEVNULL, capture_output=True, text=True
        )
        assert found.returncode == 0, f"{program}: {found.stderr or found.stdout}"


def missing() -> str:
    """Why there can be no server here, in one line; "" where there can."""
    if _programs() is None:
        return "no PostgreSQL server here: initdb and pg_ctl are neither in the PATH nor where Debian puts them"
    if os.geteuid() == 0 and _other_user() is None:
        return "PostgreSQL does not run as root, and there is no other user to run it as"
    return ""


@contextmanager
def running_postgres(*, durable: bool = False) -> Iterator[Postgres]:
    """A server of the caller's own. durable: with fsync, for trials that crash it."""
    programs = _programs()
    assert programs is not None, missing()
    user = _other_user() if os.geteuid() == 0 else None
    folder = Path(tempfile.mkdtemp(prefix="causticmill-pg-"))
    try:
        if user is not None:
            shutil.chown(folder, user)
        server = Postgres(programs, folder, _free_port(), user, () if durable else FAST)
        server._run("initdb", "-D", str(folder / "data"), "-U", "tester", "-A", "trust", "-E", "UTF8", "--no-sync")
        server.start()
        try:
            yield server
        finally:
            server.stop("immediate")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _programs() -> Path | None:
    """The newest of Debian's, or those in the PATH: real files, as scripts in front of them may take other options."""
    versions = sorted(DEBIAN.glob("*/bin"), key=lambda path: float(path.parent.name), reverse=True)
    in_path = [Path(found).resolve().parent for found in [shutil.which("pg_ctl")] if found]
    for folder in (*versions, *in_path):
        if all((folder / name).exists() for name in ("initdb", "pg_ctl", "postgres", "createdb")):
            return folder
    return None


def _other_user() -> str | None:
    for name in USERS:
        try:
            return pwd.getpwnam(name).pw_name
        except KeyError:
            continue
    return None


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])
