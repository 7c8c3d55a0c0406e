"""Everything that a server knows as one tar file, made while it runs.

Order makes it consistent: the engine's database first, then that of the jobs, then the objects. What the engine knows
late is submitted again, what it knows too long ends at once, and every object a job names was there before. Left out:
what agents of mills keep (where a mill stands is true of that mill at that time only), scratch files and uploads. The
last member, `manifest.json`, says what must be in it: a backup without it is not whole. Whether every object of the
store still is what its name says, `verify_store` tells.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import IO

from service.errors import FailedError, InputError, sentence_of_os_error
from service.processes.files import open_whole
from service.server.database.connection import copy_sqlite
from service.settings import ServerSettings
from service.store.base import MissingObjectError, Store, StoredObject
from service.store.opening import open_store

FORMAT = 1
DATABASES = ("engine.sqlite", "causticmill.sqlite")
MANIFEST = "manifest.json"


def back_up(settings: ServerSettings, target: Path) -> list[str]:
    """Write the backup; the lines say what is in it, and what is not. `target` - is standard output."""
    if settings.embedded and not (settings.data / DATABASES[-1]).is_file():
        raise InputError(f"--data {settings.data}: there is no {DATABASES[-1]}; allowed: the folder of a server")
    store = open_store(settings)
    with _create_whole(target) as file, tarfile.open(fileobj=file, mode="w|", format=tarfile.PAX_FORMAT) as tar:
        manifest: dict[str, object] = {
            "format": FORMAT,
            "version": metadata.version("causticmill"),
            "made_at": time.time(),
            "databases": _add_databases(tar, settings) if settings.embedded else {},
        }
        objects, size, damaged, gone = _add_objects(tar, store)
        manifest |= {"objects": objects, "damaged": damaged}
        _add(tar, MANIFEST, io.BytesIO(json.dumps(manifest, indent=1).encode()), time.time())
    lines = [f"{target}: {objects} objects, {size / 1e6:.1f} MB"]
    if gone:
        lines.append(f"{gone} objects were deleted meanwhile")
    if not settings.embedded:
        lines.append("the database is not in it: back that up FIRST, with pg_dump --format=custom DATABASE_URL")
    if damaged:
        raise FailedError(*lines, *(f"object {sha256} is damaged in the store" for sha256 in damaged))
    return lines


def _add_databases(tar: tarfile.TarFile, settings: ServerSettings) -> dict[str, str]:
    """Add snapshots by SQLite's own backup, which neither waits for writers nor stops them; return name and hash of
    each.
    """
    hashes = {}
    with tempfile.TemporaryDirectory(dir=settings.data, prefix="backup-") as folder:
        for name in DATABASES:
            if (settings.data / name).is_file():
                snapshot = Path(folder) / name
                copy_sqlite(settings.data / name, snapshot)
                with snapshot.open("rb") as file:
                    hashes[name] = hashlib.file_digest(file, "sha256").hexdigest()
                    file.seek(0)
                    _add(tar, name, file, time.time())
                snapshot.unlink()
    return hashes


def _add_objects(tar: tarfile.TarFile, store: Store) -> tuple[int, int, list[str], int]:
    """Return how many, how many bytes, which of them are damaged, how many went meanwhile."""
    count = size = gone = 0
    damaged = []
    for stored in store.list():
        try:
            reader = _Hashing(store.open_range(stored.sha256))
        except MissingObjectError:
            gone += 1
            continue
        _add(tar, object_name(stored.sha256), reader, stored.stored_at, stored)
        if reader.hexdigest() != stored.sha256:
            damaged.append(stored.sha256)
        count, size = count + 1, size + stored.bytes
    return count, size, damaged, gone


def object_name(sha256: str) -> str:
    return f"objects/{sha256[:2]}/{sha256}"


class _Hashing(io.RawIOBase):
    """The pieces of an object as a file, hashed on the way."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces = pieces
        self._rest = b""
        self._digest = hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        while size < 0 or len(self._rest) < size:
            piece = next(self._pieces, None)
            if piece is None:
                break
            self._digest.update(piece)
            self._rest += piece
        taken = self._rest if size < 0 else self._rest[:size]
        self._rest = self._rest[len(taken) :]
        return taken

    def hexdigest(self) -> str:
        return self._digest.hexdigest()


def _add(
    tar: tarfile.TarFile, name: str, file: IO[bytes] | _Hashing, at: float, of: StoredObject | None = None
) -> None:
    member = tarfile.TarInfo(name)
    member.size = of.bytes if of is not None else file.seek(0, os.SEEK_END)
    if of is None:
        file.seek(0)
    member.mtime, member.mode = int(at), 0o400
    tar.addfile(member, file)
    tar.members.clear()  # type: ignore[attr-defined]  # there may be millions


@contextlib.contextmanager
def _create_whole(target: Path) -> Iterator[IO[bytes]]:
    """Create a file that appears whole or not at all; nobody else may read it."""
    if str(target) == "-":
        yield sys.stdout.buffer
        return
    if target.exists():
        raise InputError(f"{target} is there already; allowed: a new file")
    try:
        with open_whole(target, 0o600) as file:
            yield file
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot write the backup")) from None


def verify_store(settings: ServerSettings) -> list[str]:
    """Verify every object; FailedError names each that is not what it is called."""
    store, count, size, damaged = open_store(settings), 0, 0, []
    for stored in store.list():
        digest = hashlib.sha256()
        try:
            for piece in store.open_range(stored.sha256):
                digest.update(piece)
        except MissingObjectError:  # deleted meanwhile
            continue
        count, size = count + 1, size + stored.bytes
        if digest.hexdigest() != stored.sha256:
            damaged.append(stored.sha256)
    if damaged:
        raise FailedError(*(f"object {sha256} is damaged" for sha256 in damaged))
    return [f"{count} objects, {size / 1e6:.1f} MB: all are what they were stored as"]
