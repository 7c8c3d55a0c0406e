"""The agent's own copies of programs, by content: the name is the SHA-256 of the file's contents.

A program arrives in pieces, is hashed as it arrives, and gets its name only when it is complete, correct and on disk.
Disk work happens in a thread, so that a hold never waits for a disk.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import re
import secrets
import shutil
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from urllib.parse import urlsplit

from phrases.phrase import Phrase
from service.http.problems import Problem

_PIECE_BYTES = 1 << 20
_SPARE_BYTES = 64 << 20  # reserved for the journal: a program must not fill the disk
_SHA256 = re.compile(r"[0-9a-f]{64}")
_SUFFIX, _PART = ".nc", ".part"
_WAIT_S = 30.0
_REDIRECTS = 3


@dataclass(frozen=True, slots=True)
class StoredProgram:
    sha256: str
    bytes: int
    stored_at_s: float  # seconds since 1970

    def as_dict(self) -> dict[str, object]:
        return {"sha256": self.sha256, "bytes": self.bytes, "stored_at_s": self.stored_at_s}


def valid_sha256(text: str) -> str:
    if not _SHA256.fullmatch(text):
        raise Problem(
            422, Phrase("'{text}' is not a SHA-256; allowed: 64 digits 0-9a-f", text=text[:80]), field="sha256"
        )
    return text


class ProgramStore:
    """Programs in one folder, which only this process uses."""

    def __init__(self, folder: Path, *, max_bytes: int) -> None:
        self._folder = folder
        self._max_bytes = max_bytes
        folder.mkdir(parents=True, exist_ok=True)
        for abandoned in folder.glob(f"*{_PART}"):
            abandoned.unlink(missing_ok=True)

    def path_of(self, sha256: str) -> Path:
        """Return where the program lies; a Problem if there is none."""
        self.entry(sha256)
        return self._path(sha256)

    def entry(self, sha256: str) -> StoredProgram:
        try:
            facts = self._path(valid_sha256(sha256)).stat()
        except FileNotFoundError:
            raise Problem(
                404,
                Phrase("no program {sha256} here; PUT /v1/programs/{sha256} uploads it", sha256=sha256),
                field="program",
            ) from None
        return StoredProgram(sha256, facts.st_size, round(facts.st_mtime, 3))

    def entries(self) -> Iterator[StoredProgram]:
        """Yield all programs, newest first."""
        names = [path.stem for path in self._folder.glob(f"*{_SUFFIX}") if _SHA256.fullmatch(path.stem)]
        yield from sorted(map(self.entry, names), key=lambda entry: -entry.stored_at_s)

    def remove(self, sha256: str) -> None:
        self.path_of(sha256).unlink()

    def add(self, write: Callable[[Path], None], *, about_bytes: int) -> Path:
        """Keep a program that `write` makes; return where it lies."""
        self._require_room(about_bytes)
        hidden = self._folder / f"{secrets.token_hex(8)}{_PART}"
        try:
            write(hidden)
            with hidden.open("rb") as file:
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
                os.fsync(file.fileno())
            self._publish(hidden, sha256)
            return self._path(sha256)
        finally:
            hidden.unlink(missing_ok=True)

    async def receive(
        self, sha256: str, pieces: AsyncIterator[bytes], *, announced_bytes: int | None
    ) -> tuple[StoredProgram, bool]:
        """Receive a program; return it and whether it is new. An existing one is not written again."""
        valid_sha256(sha256)
        if await asyncio.to_thread(self._path(sha256).exists):
            async for _ in pieces:  # a client that is still sending could not read an early answer
                pass
            return await asyncio.to_thread(self.entry, sha256), False
        await asyncio.to_thread(self._require_room, announced_bytes)
        hidden = self._folder / f"{sha256}.{secrets.token_hex(4)}{_PART}"
        try:
            with await asyncio.to_thread(hidden.open, "wb") as file:
                found = await self._write(file, pieces)
                if found != sha256:
                    raise Problem(
                        422,
                        Phrase(
                            "what came has SHA-256 {found}, not {sha256}; nothing is kept", found=found, sha256=sha256
                        ),
                        field="sha256",
                    )
                await asyncio.to_thread(_sync, file)
            await asyncio.to_thread(self._publish, hidden, sha256)
        finally:
            await asyncio.to_thread(hidden.unlink, missing_ok=True)
        return await asyncio.to_thread(self.entry, sha256), True

    async def _write(self, file: BinaryIO, pieces: AsyncIterator[bytes]) -> str:
        digest, size, waiting = hashlib.sha256(), 0, bytearray()

        def store(data: bytes) -> None:
            digest.update(data)
            file.write(data)

        async for piece in pieces:
            size += len(piece)
            if size > self._max_bytes:
                raise Problem(
                    413,
                    Phrase("the program is longer than {most_bytes} bytes", most_bytes=self._max_bytes),
                    field="program",
                )
            waiting += piece
            if len(waiting) >= _PIECE_BYTES:
                await asyncio.to_thread(store, bytes(waiting))
                waiting.clear()
        await asyncio.to_thread(store, bytes(waiting))
        return digest.hexdigest()

    def _require_room(self, announced_bytes: int | None) -> None:
        if announced_bytes is None:
            return
        if announced_bytes > self._max_bytes:
            raise Problem(
                413,
                Phrase(
                    "the program has {announced_bytes} bytes; allowed: up to {most_bytes}",
                    announced_bytes=announced_bytes,
                    most_bytes=self._max_bytes,
                ),
                field="program",
            )
        free = shutil.disk_usage(self._folder).free
        if announced_bytes + _SPARE_BYTES > free:
            raise Problem(
                507,
                Phrase(
                    "the program has {announced_bytes} bytes and the disk {free} free; {spare_bytes} stay reserved "
                    "for the journal",
                    announced_bytes=announced_bytes,
                    free=free,
                    spare_bytes=_SPARE_BYTES,
                ),
                field="program",
            )

    def _publish(self, hidden: Path, sha256: str) -> None:
        hidden.replace(self._path(sha256))
        descriptor = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def _path(self, sha256: str) -> Path:
        return self._folder / f"{sha256}{_SUFFIX}"


def _sync(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())


async def fetch_program(store: ProgramStore, url: str, sha256: str, *, token: str | None) -> tuple[StoredProgram, bool]:
    """Bring the program at `url` into the store. `token` goes to that host only, never along a redirect elsewhere."""
    import httpx  # costs memory and is seldom needed

    if urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).hostname:
        raise Problem(422, Phrase("url is '{url}'; allowed: http:// or https:// addresses", url=url[:100]), field="url")
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    client = httpx.AsyncClient(
        timeout=_WAIT_S,
        follow_redirects=True,
        max_redirects=_REDIRECTS,
        trust_env=False,
        headers={"User-Agent": "causticmill"},
    )
    try:
        async with client, client.stream("GET", url, headers=headers) as response:
            if response.status_code != 200:
                raise Problem(502, Phrase("{url} answered {status}", url=url, status=response.status_code), field="url")
            announced = response.headers.get("content-length", "")
            encoded = "content-encoding" in response.headers
            size = int(announced) if announced.isdigit() and not encoded else None
            return await store.receive(sha256, response.aiter_bytes(), announced_bytes=size)
    except httpx.InvalidURL as error:
        raise Problem(422, Phrase("url is '{url}': {error}", url=url[:100], error=error), field="url") from None
    except httpx.HTTPError as error:
        reason = str(error) or type(error).__name__
        raise Problem(502, Phrase("cannot fetch {url}: {reason}", url=url, reason=reason), field="url") from None
