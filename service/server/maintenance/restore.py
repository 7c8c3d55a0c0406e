"""A backup back into an empty data folder: whole and with every hash checked, or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from service.errors import FailedError, InputError, sentence_of_os_error
from service.processes.files import lock_folder
from service.server.database.connection import connect
from service.server.database.tokens import TokenBook
from service.server.maintenance.backup import DATABASES, FORMAT, MANIFEST, object_name
from service.settings import ServerSettings
from service.store.base import Store
from service.store.opening import open_store

_ARRIVING = "restoring"
_OBJECT = re.compile(r"objects/[0-9a-f]{2}/[0-9a-f]{64}")
_PIECE_BYTES = 1 << 20
_WITHOUT_DATABASE = [
    "the database is not in it: restore that with pg_restore, and then let no token in it open anything that may have "
    "been revoked since: causticmill token revoke --all"
]
_MANIFEST_BYTES = 1 << 30


def restore_backup(source: Path, settings: ServerSettings, *, keep_tokens: bool = False) -> list[str]:
    """Restore; return lines that say what was restored, what the backup lacked, and what became of the tokens.

    They are all revoked unless keep_tokens: the backup does not know which of them have been since it was made.
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
    """Revoke what the arrived database holds; how many were live."""
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
    """Take what arrived; return the hash of each database and object, and objects that are not what they are called."""
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
    """Begin with an empty folder of our own; as empty again if anything goes wrong."""
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
