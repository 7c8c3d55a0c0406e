"""The tokens that may stop mills, kept in a file beside the database, so that a stop never waits for the database.

The file holds SHA-256 digests of secrets of 256 random bits, which give no access, and only its account can read it.
The API writes it; the processes that serve stops read it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from service.processes.files import write_whole

FILE = "stop-tokens.json"  # in the data folder


@dataclass(frozen=True, slots=True)
class Stopper:
    """The owner of a token that may stop mills."""

    id: str
    name: str


def hash_secret(secret: str) -> str:
    """Return the digest by which a secret is looked up."""
    return hashlib.sha256(secret.encode()).hexdigest()


def read_stoppers(path: Path) -> dict[str, Stopper]:
    """Return those who may stop mills, by the digests of their tokens; empty if the file cannot be read."""
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):
        return {str(digest): Stopper(**row) for digest, row in json.loads(path.read_bytes()).items()}
    return {}


def write_stoppers(path: Path, stoppers: Mapping[str, Stopper]) -> None:
    """Write the file as a whole or not at all. OSError."""
    write_whole(path, json.dumps({digest: asdict(stopper) for digest, stopper in stoppers.items()}), 0o600)


class StopperFile:
    """The present contents of the file; it is read again only if it has changed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, int] | None = None
        self._stoppers: dict[str, Stopper] = {}

    def find(self, secret: str) -> Stopper | None:
        """Return the owner of this token if it may stop mills."""
        with contextlib.suppress(OSError):
            status = self._path.stat()
            if (seen := (status.st_mtime_ns, status.st_ino)) != self._seen:
                self._seen, self._stoppers = seen, read_stoppers(self._path)
        return self._stoppers.get(hash_secret(secret)) if secret else None
