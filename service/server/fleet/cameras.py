"""Fetches pictures from the cameras beside mills, one at a time. Only the server knows the cameras' addresses.

A camera answers with one JPEG, or with JPEGs without end (multipart/x-mixed-replace), of which the first whole one is
taken. Callers within half a second of each other get the same answer.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field

import httpx

from phrases.phrase import Phrase
from service.http.problems import Problem

FRESH_S = 0.5
MOST_BYTES = 8_000_000
_WAIT_S = 5.0
_JPEG = b"\xff\xd8\xff"
_MOST_HEAD = 4096  # bytes of a part's own headers


@dataclass(slots=True)
class _Camera:
    """lock: allows one request at a time. answered_s: time of its last picture or failure, on the monotonic clock."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    last: bytes | Problem = b""
    answered_s: float = -FRESH_S


class Cameras:
    """client: the HTTP client, made in the loop that uses it."""

    def __init__(self, client: Callable[[], httpx.AsyncClient]) -> None:
        self._client = client
        self._cameras: dict[str, _Camera] = {}

    async def take_picture(self, url: str) -> bytes:
        """Return a present JPEG. Problem 502 if the camera sends none, 504 if it takes longer than 5 s."""
        camera = self._cameras.setdefault(url, _Camera())
        async with camera.lock:
            if time.monotonic() - camera.answered_s >= FRESH_S:
                try:
                    camera.last = await self._ask(url)
                except Problem as problem:
                    camera.last = problem
                camera.answered_s = time.monotonic()
        if isinstance(camera.last, Problem):
            raise camera.last
        return camera.last

    async def _ask(self, url: str) -> bytes:
        try:
            async with asyncio.timeout(_WAIT_S), self._client().stream("GET", url, timeout=_WAIT_S) as answer:
                if answer.status_code != 200:
                    raise Problem(502, Phrase("the camera answers with status {status}", status=answer.status_code))
                kind, _, rest = answer.headers.get("content-type", "").partition(";")
                chunks = answer.aiter_raw()
                if kind.strip().lower().startswith("multipart/"):
                    picture = await _read_part(chunks, rest.partition("boundary=")[2].partition(";")[0].strip(' "-'))
                else:
                    picture = await _read(chunks)
        except TimeoutError:
            raise Problem(
                504, Phrase("the camera sends no whole picture within {seconds:g} s", seconds=_WAIT_S)
            ) from None
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise Problem(
                502, Phrase("the camera does not answer: {reason}", reason=error or type(error).__name__)
            ) from None
        if not picture.startswith(_JPEG):
            raise Problem(502, Phrase("the camera does not send a JPEG"))
        return picture


async def _read(chunks: AsyncIterator[bytes]) -> bytes:
    data = bytearray()
    async for chunk in chunks:
        _add_chunk(data, chunk)
    return bytes(data)


async def _read_part(chunks: AsyncIterator[bytes], boundary: str) -> bytes:
    """Return the first part, as long as its own Content-Length says or else up to the next boundary."""
    mark, data = b"--" + boundary.encode("latin-1"), bytearray()
    async for chunk in chunks:
        _add_chunk(data, chunk)
        begin = data.find(mark)
        head_end = data.find(b"\r\n\r\n", begin)
        if begin < 0 or head_end < 0:
            if len(data) > _MOST_HEAD:
                break
            continue
        start, length = head_end + 4, _read_length(data[begin:head_end])
        end = data.find(b"\r\n" + mark, start) if length is None else start + length
        if 0 <= end <= len(data):
            return bytes(data[start:end])
    raise Problem(502, Phrase("the camera sends no whole picture"))


def _read_length(head: bytearray) -> int | None:
    for line in head.split(b"\r\n"):
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-length" and value.strip().isdigit():
            return int(value)
    return None


def _add_chunk(data: bytearray, chunk: bytes) -> None:
    if len(data) + len(chunk) > MOST_BYTES:
        raise Problem(502, Phrase("the camera sends more than {most_mb:g} MB for a picture", most_mb=MOST_BYTES / 1e6))
    data.extend(chunk)
