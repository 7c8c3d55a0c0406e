"""Backs up all data of a running server into one tar file, and restores it into an empty data folder: completely and
with every hash checked, or not at all.

The order makes it consistent: first the engine's database, then that of the jobs, then the objects. Tickets that the
engine lacks are submitted again, outdated ones end at once, and every object that a job names already existed. Not
included: data of the agents of mills (a mill's position is only true of that mill at that time), timelapses, scratch
files and uploads. The last member, `manifest.json`, lists the contents: a backup without it is incomplete.
`verify_store` checks that every object of the store still matches its name.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import shutil
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import IO, Any

from service.errors import FailedError, InputError, sentence_of_os_error
from service.processes.files import lock_folder, open_whole
from service.server.database.connection import connect, copy_sqlite
from service.server.database.tokens import TokenBook
from service.settings import ServerSettings
from service.store.base import MissingObjectError, Store, StoredObject
from service.store.opening import open_store

FORMAT = 1
DATABASES = ("engine.sqlite", "causticmill.sqlite")
MANIFEST = "manifest.json"


def back_up(settings: ServerSettings, target: Path) -> list[str]:
    """Write the backup; return lines about its contents and omissions. `target` - is standard output."""
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
    """Return the number of objects, their bytes, the damaged ones, and the number deleted meanwhile."""
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
    """The pieces of an object as a file, which computes their hash."""

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
    """Create a file that appears complete or not at all and that only its owner may read."""
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
    """Verify every object; FailedError names each one that does not match its name."""
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


_ARRIVING = "restoring"
_OBJECT = re.compile(r"objects/[0-9a-f]{2}/[0-9a-f]{64}")
_PIECE_BYTES = 1 << 20
_WITHOUT_DATABASE = [
    "the database is not in it: restore that with pg_restore, and then let no token in it open anything that may have "
    "been revoked since: causticmill token revoke --all"
]


def restore_backup(source: Path, settings: ServerSettings, *, keep_tokens: bool = False) -> list[str]:
    """Restore a backup; return lines about what was restored, what the backup lacked, and the tokens.

    All tokens are revoked unless keep_tokens: the backup does not know which were revoked after it was made.
    """
    with _begin_empty(settings.data), _open(source) as tar:
        folder = settings.data / _ARRIVING
        folder.mkdir()
        store = open_store(settings)
        hashes, damaged = _take(tar, folder, store)
        manifest = _manifest(folder, source)
        _require_whole(manifest, hashes, damaged, source)
        ended = None if keep_tokens else _end_tokens(folder)
        for name in manifest["databases"]:
            (folder / name).rename(settings.data / name)
        _sync(settings.data)
        shutil.rmtree(folder)
    held = sum(name not in DATABASES for name in hashes)
    lines = [f"{settings.data}: {held} objects and {len(manifest['databases'])} databases of {source}"]
    lines += _words_of_tokens(ended, settings.data) if manifest["databases"] else _WITHOUT_DATABASE
    return lines + [f"object {sha256} was damaged before the backup and is left out" for sha256 in damaged]


def _end_tokens(folder: Path) -> int:
    """Revoke all tokens of the restored database; return how many were live."""
    path = folder / DATABASES[-1]
    if not path.is_file():
        return 0
    database = connect(f"sqlite:///{path.absolute()}")
    try:
        return TokenBook(database).revoke_all()
    finally:
        database.dispose()  # the last connection leaves one file, without a log beside it


def _words_of_tokens(ended: int | None, data: Path) -> list[str]:
    if ended is None:
        return [
            "the tokens are as they were when the backup was made: one that has been revoked since opens again what it "
            f"did; `causticmill token list --data {data}` shows them"
        ]
    return [
        f"all tokens are revoked, {ended} of which were live, and no code is valid: the backup does not know which "
        f"have been revoked since it was made; `causticmill token create NAME --scope ... --data {data}` makes new ones"
    ]


def _take(tar: tarfile.TarFile, folder: Path, store: Store) -> tuple[dict[str, str], list[str]]:
    """Unpack the members; return the hash of each database and object, and the objects that do not match."""
    hashes: dict[str, str] = {}
    damaged: list[str] = []
    for member in tar:
        stream = tar.extractfile(member) if member.isreg() else None
        if stream is None or not (member.name in (*DATABASES, MANIFEST) or _OBJECT.fullmatch(member.name)):
            raise InputError(f"{member.name!r} does not belong into a backup of causticmill")
        target = folder / Path(member.name).name
        sha256 = _write(stream, target)
        if member.name.startswith("objects/"):
            if object_name(sha256) == member.name:
                store.put_file(target)
            else:
                damaged.append(target.name)
            target.unlink()
        if object_name(sha256) == member.name or member.name in DATABASES:
            hashes[member.name] = sha256
        tar.members.clear()  # type: ignore[attr-defined]
    return hashes, damaged


def _write(stream: IO[bytes], target: Path) -> str:
    digest = hashlib.sha256()
    with target.open("xb") as file:
        while piece := stream.read(_PIECE_BYTES):
            digest.update(piece)
            file.write(piece)
        file.flush()
        os.fsync(file.fileno())
    return digest.hexdigest()


def _manifest(folder: Path, source: Path) -> dict[str, Any]:
    try:
        manifest = json.loads((folder / MANIFEST).read_bytes())
        known = manifest["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError):
        raise FailedError(f"{source} is not whole: it ends before its list of contents") from None
    if not known:
        raise InputError(f"{source} was made by another version; allowed: format {FORMAT}")
    return dict(manifest)


def _require_whole(manifest: dict[str, Any], hashes: dict[str, str], damaged: list[str], source: Path) -> None:
    for name, sha256 in manifest["databases"].items():
        if name not in DATABASES or hashes.get(name) != sha256:
            raise FailedError(f"{source}: {name} is not what was backed up")
    if fresh := sorted(set(damaged) - set(manifest["damaged"])):
        raise FailedError(*(f"{source}: object {sha256} is not what was backed up" for sha256 in fresh))
    held = sum(name not in DATABASES for name in hashes)
    if held + len(damaged) != manifest["objects"]:
        raise FailedError(f"{source} holds {held} of {manifest['objects']} objects")


@contextlib.contextmanager
def _begin_empty(data: Path) -> Iterator[None]:
    """Take over an empty folder; empty it again if anything goes wrong."""
    try:
        if data.exists() and any(data.iterdir()):
            raise InputError(f"--data {data} is not empty; allowed: a new or empty folder")
        with lock_folder(data, doing="restored"):
            try:
                yield
            except BaseException:
                for path in data.iterdir():
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
                raise
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot restore into")) from None


@contextlib.contextmanager
def _open(source: Path) -> Iterator[tarfile.TarFile]:
    try:
        with tarfile.open(source, "r|*") as tar:
            yield tar
    except (tarfile.TarError, EOFError) as error:
        raise FailedError(f"{source} is not whole, or no backup: {error}") from None
    except FileNotFoundError:
        raise InputError(f"there is no {source}") from None


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
