"""The interface of every artifact store. Objects are named by the SHA-256 of their content and never change."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredObject:
    """An object of the store: hash of its content, size, and when it was stored (seconds since 1970)."""

    sha256: str
    bytes: int
    stored_at: float


class MissingObjectError(LookupError):
    """The store has no object of this hash."""

    def __init__(self, sha256: str) -> None:
        super().__init__(f"the artifact store has no object {sha256}")
        self.sha256 = sha256


class Store(Protocol):
    """Objects appear complete or not at all; storing an existing object only renews its stored_at."""

    shared: bool  # may workers on other hosts use it?

    def put_file(self, path: Path) -> StoredObject:
        """Store a file's content. The file may be linked or moved into the store: do not write to it afterwards.

        FailedError, one line, if the disk or the network refuses.
        """

    def head(self, sha256: str) -> StoredObject:
        """Return the object's size and time; MissingObjectError if there is none."""

    def open_range(self, sha256: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        """Yield bytes start to end (exclusive), in pieces of at most a megabyte. MissingObjectError at the call."""

    def fetch(self, sha256: str, target: Path) -> None:
        """Fetch the object as a read-only file at `target` (a link if possible). MissingObjectError."""

    def url(self, sha256: str, *, file_name: str, media_type: str) -> str | None:
        """Return a short-lived address where a client may fetch the object itself; None: serve it with open_range."""

    def path(self, sha256: str) -> Path | None:
        """Return the object as a file of this computer, to be served by sendfile; None if there is no such file."""

    def delete(self, sha256: str, *, stored_before: float | None = None) -> None:
        """Delete the object if it exists, unless it was stored (again) at or after `stored_before`."""

    def list(self, prefix: str = "") -> Iterator[StoredObject]:
        """Yield every object, or those whose hash begins with these two digits, in no order."""

    def check(self) -> None:
        """Write, read and remove a small object; FailedError, one line, if that fails."""
