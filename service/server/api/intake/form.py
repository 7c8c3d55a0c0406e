"""Receives a form piece by piece: its picture goes straight to a file; only small parts are kept in memory.

Every limit applies while the bytes arrive, so a form that is too large is refused before it has filled disk or memory.
The file lives in `uploads` in the data folder, locked while its request lasts: a file without a lock was left by a
server that was killed, and the next one removes it. Free space on the disk is checked before the form is accepted,
while its picture arrives, and for the programs that the job would make.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import hashlib
import re
import secrets
import shutil
import time
import unicodedata
from collections.abc import AsyncIterator, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from urllib.parse import unquote_to_bytes

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import ClientDisconnect, Request

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.job.planning.program_size import SURE, job_bytes
from service.job.spec.model import JobSpec
from service.settings import ServerSettings

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

SPEC_BYTES = 1_000_000
_CHUNK_WAIT_S = 30.0
_SLOWEST_BYTES_PER_S = 10_000
_LINGER_S = 2.0
_LINGER_BYTES = 8_000_000
_OVERHEAD_BYTES = 100_000  # boundaries, headers and the small parts
_SMALL = {"spec": SPEC_BYTES, "priority": 40}
_PARTS = 8
_LOOK_BYTES = 4_000_000
_CONTENT_TYPE_CHARS = 300
_LONGEST = 100
_KEPT_ENDING = 12
_QUOTED = re.compile(rb'"(?:[^"\\]|\\.)*"')
_EXTENDED_NAME = re.compile(rb";\s*filename\*\s*=\s*(utf-8|iso-8859-1)'[^';]*'([^\s;]+)", re.IGNORECASE)


@dataclass(slots=True, kw_only=True)
class JobForm:
    """The contents of a request. path: of the picture; texts: the small parts, for a job `spec` and `priority`."""

    path: Path
    image_name: str = ""
    image_bytes: int = 0
    image_sha256: str = ""
    texts: dict[str, bytearray] = field(default_factory=dict)


@contextlib.asynccontextmanager
async def receive_form(
    request: Request, settings: ServerSettings, *, picture: str = "image", small: Mapping[str, int] = _SMALL
) -> AsyncIterator[JobForm]:
    """Receive the whole form; its file is removed at the end. Problem if it is not such a form, is too large or has too
    many parts, or if the disk has no space for it.

    picture : name of the part that holds the picture
    small   : names of the other parts that are accepted, with the most bytes of each
    """
    body, space, most = RequestBody(request), Space(settings), settings.max_upload_bytes
    await asyncio.to_thread(space.require)
    try:
        with _create_file(settings.data / "uploads") as (path, file):
            yield await _read(request, body, _Reader(JobForm(path=path), file, most, space, picture, small))
    except Problem:
        await body.linger()
        raise


async def _read(request: Request, body: RequestBody, reader: _Reader) -> JobForm:
    boundary, most = _boundary(request), reader.most + SPEC_BYTES + _OVERHEAD_BYTES
    _require_fitting(request, most, reader.picture)
    parser = MultipartParser(boundary, reader.callbacks(), max_header_count=8, max_header_size=2048)
    taken = 0
    async for piece in body.pieces():
        taken += len(piece)
        if taken > most:
            raise _too_large(reader.most, reader.picture)
        try:
            await asyncio.to_thread(parser.write, piece)
        except FormParserError:
            raise Problem(400, Phrase("the body is not multipart/form-data, or is malformed"), field="body") from None
    return await asyncio.to_thread(reader.finish)


def sweep_uploads(folder: Path) -> None:
    """Remove the files that killed servers left; an upload under way keeps its lock."""
    for path in folder.glob("*.upload"):
        with contextlib.suppress(OSError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)


class _Reader:
    """The parser's callbacks: they identify each part and store its bytes."""

    def __init__(
        self,
        form: JobForm,
        file: BinaryIO,
        max_image_bytes: int,
        space: Space,
        picture: str,
        small: Mapping[str, int],
    ) -> None:
        self.most = max_image_bytes
        self.picture = picture
        self._small = small
        self._form = form
        self._file = file
        self._space = space
        self._next_look = _LOOK_BYTES
        self._digest = hashlib.sha256()
        self._header = (bytearray(), bytearray())
        self._disposition = b""
        self._part = ""
        self._seen: list[str] = []
        self._ended = False

    def callbacks(self) -> MultipartCallbacks:
        return {
            "on_part_begin": self._begin,
            "on_header_field": lambda data, start, end: self._header[0].extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._header[1].extend(data[start:end]),
            "on_header_end": self._take_header,
            "on_headers_finished": self._begin_content,
            "on_part_data": self._take_content,
            "on_end": self._note_end,
        }

    def finish(self) -> JobForm:
        """Return the form if it is complete."""
        self._file.flush()
        if not self._ended:
            raise Problem(400, Phrase("the body ends in the middle of the form"), field="body")
        if self.picture not in self._seen:
            raise Problem(
                422, Phrase("the form has no part '{name}' with the picture", name=self.picture), field=self.picture
            )
        if not self._form.image_bytes:
            raise Problem(422, Phrase("the part '{name}' is empty", name=self.picture), field=self.picture)
        self._form.image_sha256 = self._digest.hexdigest()
        return self._form

    def _begin(self) -> None:
        self._disposition = b""
        if len(self._seen) >= _PARTS:
            raise Problem(422, Phrase("the form has more than {most} parts", most=_PARTS), field="body")

    def _take_header(self) -> None:
        name, value = (bytes(text) for text in self._header)
        self._header = (bytearray(), bytearray())
        if name.strip().lower() == b"content-disposition":
            self._disposition = value
        elif name.strip().lower() == b"content-transfer-encoding" and value.strip().lower() not in (b"binary", b"8bit"):
            raise Problem(422, Phrase("parts must be sent as they are, without a transfer encoding"), field="body")

    def _begin_content(self) -> None:
        kind, options = _options(self._disposition)
        name = harmless_name(options.get(b"name", b""), default="")
        if kind != b"form-data" or not name:
            raise Problem(400, Phrase("a part of the form has no name"), field="body")
        if name not in (self.picture, *self._small):
            allowed = ", ".join((self.picture, *self._small))
            words = Phrase("the form has a part '{name}'; allowed: {allowed}", name=name[:60], allowed=allowed)
            raise Problem(422, words, field=name[:60])
        if name in self._seen:
            raise Problem(422, Phrase("the form has two parts '{name}'; allowed: one", name=name), field=name)
        self._seen.append(name)
        self._part = name
        if name == self.picture:
            self._form.image_name = harmless_name(_file_name(self._disposition, options), default="picture")
        else:
            self._form.texts[name] = bytearray()

    def _take_content(self, data: bytes, start: int, end: int) -> None:
        piece = data[start:end]
        if self._part == self.picture:
            self._form.image_bytes += len(piece)
            if self._form.image_bytes > self.most:
                raise _too_large(self.most, self.picture)
            if self._form.image_bytes >= self._next_look:
                self._next_look += _LOOK_BYTES
                self._space.require()  # many pictures may be coming at once
            self._digest.update(piece)
            self._file.write(piece)
            return
        self._form.texts[self._part] += piece
        if len(self._form.texts[self._part]) > self._small[self._part]:
            most = self._small[self._part]
            words = Phrase("the part '{name}' is longer than {most} bytes", name=self._part, most=most)
            raise Problem(413, words, field=self._part)

    def _note_end(self) -> None:
        self._ended = True


def _boundary(request: Request) -> bytes:
    header = request.headers.get("content-type", "")
    if len(header) > _CONTENT_TYPE_CHARS:  # the parser takes quadratic time
        words = Phrase("the Content-Type is longer than {most} characters", most=_CONTENT_TYPE_CHARS)
        raise Problem(400, words, field="Content-Type")
    kind, options = _options(header.encode("latin-1"))
    if kind != b"multipart/form-data":
        raise Problem(415, Phrase("the Content-Type must be multipart/form-data"), field="Content-Type")
    boundary = options.get(b"boundary", b"")
    if not 1 <= len(boundary) <= 70:
        raise Problem(400, Phrase("the Content-Type names no boundary of 1 to 70 characters"), field="Content-Type")
    return boundary


def _options(header: bytes) -> tuple[bytes, dict[bytes, bytes]]:
    """Return a header's value and its parameters; empty if it is malformed."""
    try:
        kind, options = parse_options_header(header)
    except (ValueError, LookupError, TypeError):
        return b"", {}
    return kind, options


def _file_name(disposition: bytes, options: Mapping[bytes, bytes]) -> bytes | str:
    """Return a part's file name: as RFC 8187 spells it, else the quoted one, where %22 is a quote (WHATWG)."""
    if extended := _EXTENDED_NAME.search(_QUOTED.sub(b'""', disposition)):
        charset, name = extended.groups()
        return unquote_to_bytes(name).decode(charset.decode("ascii"), "replace")
    return options.get(b"filename", b"").replace(b"%22", b'"')


def _require_fitting(request: Request, most: int, picture: str) -> None:
    length = request.headers.get("content-length", "")
    if length.isascii() and length.isdigit() and (len(length) > 15 or int(length) > most):
        raise _too_large(most, picture)


def _too_large(most: int, picture: str) -> Problem:
    return Problem(413, Phrase("the picture is too large; allowed: {most_mb:g} MB", most_mb=most / 1e6), field=picture)


@contextlib.contextmanager
def _create_file(folder: Path) -> Iterator[tuple[Path, BinaryIO]]:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{secrets.token_hex(8)}.upload"
    try:
        with path.open("xb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield path, file
    finally:
        path.unlink(missing_ok=True)


def harmless_name(given: bytes | str, *, default: str) -> str:
    """Return the last part of a path of any operating system, printable, at most 100 characters; `default` if it is
    empty.
    """
    text = given if isinstance(given, str) else given.decode("utf-8", "replace")
    text = unicodedata.normalize("NFC", text.replace("\\", "/").rpartition("/")[2])
    text = "".join(c if c.isprintable() and c not in '<>:"|?*' else "_" for c in text).strip(" .")
    if len(text) > _LONGEST:
        stem, dot, ending = text.rpartition(".")
        kept = f"{dot}{ending}" if 0 < len(ending) <= _KEPT_ENDING else ""
        text = (stem if kept else text)[: _LONGEST - len(kept)] + kept
    return text or default


_RETRY = {"Retry-After": "60"}


def too_little_space(free_mb: float, needed_mb: int) -> Phrase:
    return Phrase("{free_mb:.0f} MB are free; new jobs need {needed_mb} MB", free_mb=free_mb, needed_mb=needed_mb)


class Space:
    """Free space on the disk of the data folder."""

    def __init__(self, settings: ServerSettings) -> None:
        self._folder = settings.data
        self._floor_mb = settings.free_disk_mb
        self._makes_programs = settings.embedded and settings.store_url is None

    def require(self) -> None:
        """Raise Problem 507 if less space is free than the settings require."""
        free_mb = self._free_mb()
        if free_mb < self._floor_mb:
            raise Problem(507, too_little_space(free_mb, self._floor_mb), headers=_RETRY)

    def require_for_programs(self, spec: dict[str, Any]) -> None:
        """Raise Problem 507 for a job whose programs this disk cannot hold; other computers' disks are not known."""
        if not self._makes_programs:
            return
        wanted_mb, free_mb = job_bytes(JobSpec.model_validate(spec)) / 1e6, self._free_mb()
        if free_mb < wanted_mb / SURE:
            words = Phrase(
                "the programs need about {wanted_mb:.0f} MB, {disk} has {free_mb:.0f} MB free",
                wanted_mb=wanted_mb,
                disk=Phrase("the server's disk"),
                free_mb=free_mb,
            )
            raise Problem(507, words, field="spec.passes")

    def _free_mb(self) -> float:
        return shutil.disk_usage(self._folder).free / 1e6


class RequestBody:
    """The body of a request, piece by piece, within time limits; read once. After a refusal it reads a little of what
    the client still sends.
    """

    def __init__(self, request: Request, *, wait_s: float = _CHUNK_WAIT_S) -> None:
        self._request = request
        self._wait_s = wait_s
        self._more = True

    async def pieces(self) -> AsyncIterator[bytes]:
        """Yield the body; Problem 408 if the client stops sending or sends too slowly; ClientDisconnect if it
        disconnects.
        """
        began, taken = time.monotonic(), 0
        while self._more:
            try:
                async with asyncio.timeout(self._wait_s):
                    piece = await self._receive_piece()
            except TimeoutError:
                words = Phrase("the request stopped arriving; nothing came for {wait_s:g} s", wait_s=self._wait_s)
                raise Problem(408, words) from None
            taken += len(piece)
            if time.monotonic() - began > 2 * self._wait_s + taken / _SLOWEST_BYTES_PER_S:
                words = Phrase(
                    "{count} bytes in {seconds:.0f} s are too slow; allowed: {least} kB/s at least",
                    count=taken,
                    seconds=time.monotonic() - began,
                    least=_SLOWEST_BYTES_PER_S // 1000,
                )
                raise Problem(408, words)
            yield piece

    async def linger(self) -> None:
        """Read a little of what a refused client still sends: if the connection closed at once, the client could lose
        the answer.
        """
        if "expect" in self._request.headers:
            return
        taken = 0
        with contextlib.suppress(TimeoutError, ClientDisconnect):
            async with asyncio.timeout(_LINGER_S):
                while self._more and taken < _LINGER_BYTES:
                    taken += len(await self._receive_piece())

    async def _receive_piece(self) -> bytes:
        message = await self._request.receive()
        if message["type"] != "http.request":
            self._more = False
            raise ClientDisconnect
        self._more = bool(message.get("more_body"))
        return bytes(message.get("body", b""))
