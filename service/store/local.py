"""The artifact store in a folder: objects/ab/<sha256>, each a read-only file that appears complete or not at all.

A file on the store's own file system is *linked* into it: nothing is copied, and its name in the scratch folder stays.
It is made read-only before it is hashed and refused if it changed meanwhile; the file system refuses to open it for
writing later (except for root: do not write to stored files). Everything else is copied to `incoming`, synced and
renamed. Data reaches the disk before the name, and the name before `put_file` returns.

`incoming` holds a file only while its writer holds the file's lock, so the files of a killed writer have a free lock
and are swept when the next process opens the store. Writers share the lock `guard`, and deletion holds it exclusively,
so that an object that was just renewed is not deleted by a process that looked at it before.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from service.errors import FailedError, sentence_of_os_error
from service.processes.files import make_private
from service.store.base import MissingObjectError, StoredObject

PIECE_BYTES = 1 << 20
_HASH = re.compile(r"[0-9a-f]{64}")
_CANNOT_LINK = {errno.EXDEV, errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EACCES}


class LocalStore:
    """Objects below `root`; `shared`: a person states that all hosts of the farm see the same folder."""

    def __init__(self, root: Path, *, shared: bool = False) -> None:
        self.root = root.absolute()
        self.shared = shared
        self._incoming = self.root / "incoming"
        self._guard = self.root / "guard"
        with _translate_errors(f"cannot use the artifact store {self.root}"):
            if not shared:  # a person sets the permissions of a folder of the whole farm
                make_private(self.root, holding=("guard",))
            self._incoming.mkdir(parents=True, exist_ok=True)
            self._guard.touch()
            self._sweep()

    def put_file(self, path: Path) -> StoredObject:
        """Link or copy a file into the store; FailedError, one line, if the disk refuses or the file changes."""
        with _translate_errors("cannot store"), path.open("rb") as file:
            facts = os.fstat(file.fileno())
            if self._may_be_linked(facts):
                os.fchmod(file.fileno(), 0o400)
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
                os.fsync(file.fileno())
                _require_unchanged(path, file, facts)
                if self._link(path, sha256, facts.st_size):
                    return self.head(sha256)
                file.seek(0)
            with self._begin_arrival() as (part, copy):
                sha256 = _copy(file, copy)
                _require_unchanged(path, file, facts)
                os.fchmod(copy.fileno(), 0o400)
                os.fsync(copy.fileno())
                self._rename(part, sha256, facts.st_size)
        return self.head(sha256)

    def head(self, sha256: str) -> StoredObject:
        try:
            facts = self._place(sha256).stat()
        except OSError:
            raise MissingObjectError(sha256) from None
        return StoredObject(sha256=sha256, bytes=facts.st_size, stored_at=facts.st_mtime)

    def open_range(self, sha256: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        try:
            file = self._place(sha256).open("rb", buffering=0)
        except OSError:
            raise MissingObjectError(sha256) from None
        return _pieces(file, start, end)

    def fetch(self, sha256: str, target: Path) -> None:
        source = self._place(sha256)
        with _translate_errors("cannot fetch an artifact to"):
            target.unlink(missing_ok=True)
            try:
                os.link(source, target)
            except FileNotFoundError:
                if not target.parent.is_dir():
                    raise
                raise MissingObjectError(sha256) from None
            except OSError as error:
                if error.errno not in _CANNOT_LINK:
                    raise
                write_verified(self.open_range(sha256), target, sha256)

    def url(self, sha256: str, *, file_name: str, media_type: str) -> str | None:
        return None

    def path(self, sha256: str) -> Path | None:
        place = self._place(sha256)
        return place if place.is_file() else None

    def delete(self, sha256: str, *, stored_before: float | None = None) -> None:
        with (
            contextlib.suppress(MissingObjectError),
            _translate_errors("cannot delete"),
            self._take_lock(fcntl.LOCK_EX),
        ):
            if stored_before is None or self.head(sha256).stored_at < stored_before:
                self._place(sha256).unlink(missing_ok=True)

    def list(self, prefix: str = "") -> Iterator[StoredObject]:
        folders = [self.root / prefix] if prefix else [each for each in self.root.iterdir() if len(each.name) == 2]
        for folder in folders:
            for name in os.listdir(folder) if folder.is_dir() else ():  # noqa: PTH208 - plain names, quickly
                with contextlib.suppress(MissingObjectError):  # deleted meanwhile
                    yield self.head(name)

    def check(self) -> None:
        word = secrets.token_bytes(32)
        with _translate_errors("cannot write to the artifact store"), self._begin_arrival() as (part, file):
            file.write(word)
            os.fsync(file.fileno())
            if part.read_bytes() != word:
                raise FailedError(f"the artifact store {self.root} does not return what is written to it")

    def _place(self, sha256: str) -> Path:
        if not _HASH.fullmatch(sha256):
            raise MissingObjectError(sha256)
        return self.root / sha256[:2] / sha256

    def _may_be_linked(self, facts: os.stat_result) -> bool:
        return facts.st_dev == self.root.stat().st_dev and facts.st_uid == os.geteuid()

    def _link(self, path: Path, sha256: str, size: int) -> bool:
        """Link; return False if this file system does not link."""
        target = self._prepare_place(sha256)
        with self._take_lock(fcntl.LOCK_SH):
            if not _renew(target, size):
                try:
                    os.link(path, target)
                except FileExistsError:  # stored by another process just now
                    pass
                except OSError as error:
                    if error.errno in _CANNOT_LINK:
                        return False
                    raise
                os.utime(target)
        _sync_folder(target.parent)
        return True

    def _rename(self, part: Path, sha256: str, size: int) -> None:
        target = self._prepare_place(sha256)
        with self._take_lock(fcntl.LOCK_SH):
            if not _renew(target, size):
                part.rename(target)
        _sync_folder(target.parent)

    def _prepare_place(self, sha256: str) -> Path:
        target = self._place(sha256)
        if not target.parent.is_dir():
            target.parent.mkdir(exist_ok=True)
            _sync_folder(self.root)
        return target

    @contextlib.contextmanager
    def _take_lock(self, kind: int) -> Iterator[None]:
        with self._guard.open("rb") as guard:
            fcntl.flock(guard, kind)
            yield

    @contextlib.contextmanager
    def _begin_arrival(self) -> Iterator[tuple[Path, IO[bytes]]]:
        """Open a new locked file in `incoming`; remove it at the end unless it was renamed."""
        while True:
            part = self._incoming / f"{secrets.token_hex(8)}.part"
            with part.open("xb", buffering=0) as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                if not part.exists():  # swept before it was locked
                    continue
                try:
                    yield part, file
                finally:
                    part.unlink(missing_ok=True)
                return

    def _sweep(self) -> None:
        for part in self._incoming.iterdir():
            with contextlib.suppress(OSError), part.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                part.unlink(missing_ok=True)


def write_verified(pieces: Iterator[bytes], target: Path, sha256: str) -> None:
    """Write an object's bytes as a read-only file; FailedError, and no file, if the bytes have another hash."""
    digest = hashlib.sha256()
    try:
        with target.open("xb", buffering=0) as file:
            for piece in pieces:
                digest.update(piece)
                file.write(piece)
            os.fchmod(file.fileno(), 0o400)
        if digest.hexdigest() != sha256:
            raise FailedError(f"the artifact store returned other bytes than were stored as {sha256}")
    except BaseException:
        target.unlink(missing_ok=True)
        raise


def _copy(source: IO[bytes], target: IO[bytes]) -> str:
    digest = hashlib.sha256()
    while piece := source.read(PIECE_BYTES):
        digest.update(piece)
        target.write(piece)
    return digest.hexdigest()


def _pieces(file: IO[bytes], start: int, end: int | None) -> Iterator[bytes]:
    with file:
        file.seek(start)
        left = (1 << 62) if end is None else end - start
        while left > 0 and (piece := file.read(min(left, PIECE_BYTES))):
            left -= len(piece)
            yield piece


def _renew(target: Path, size: int) -> bool:
    """Renew the time of an existing object, and return True. Delete an object of another size (a damaged disk)."""
    with contextlib.suppress(FileNotFoundError):
        if target.stat().st_size == size:
            os.utime(target)
            return True
        target.unlink()
    return False


def _require_unchanged(path: Path, file: IO[bytes], before: os.stat_result) -> None:
    after = os.fstat(file.fileno())
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        raise FailedError(f"cannot store {path}: it is still being written")


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _translate_errors(doing: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing=doing)) from None
