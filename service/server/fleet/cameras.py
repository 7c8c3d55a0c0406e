"""What the camera beside a mill sees, a picture at a time. Only the server knows where cameras are, and asks them.

A camera answers with one JPEG, or with JPEGs without end (multipart/x-mixed-replace), of which the first whole one is
taken. Who asks within half a second of another gets the same answer.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import httpx

from service.http.problems import Problem

FRESH_S = 0.5
MOST_BYTES = 8_000_000
_WAIT_S = 5.0
_JPEG = b"\xff\xd8\xff"
_MOST_HEAD = 4096  # bytes of a part's own headers


@dataclass(slots=True)
class _Camera:
    """lock: one question at a time. answered_s: when its last picture, or its failure, came on the monotonic clock."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    last: bytes | Problem = b""
    answered_s: float = -FRESH_S


class Cameras:
    """For one event loop."""

    def __init__(self) -> None:
        self._client = httpx.AsyncClient(timeout=_WAIT_S, follow_redirects=False, trust_env=False)
        self._cameras: dict[str, _Camera] = {}

    async def take_picture(self, url: str) -> bytes:
        """Return a JPEG of now. Problem 502 where the camera sends none, 504 where it takes longer than 5 s."""
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

    async def aclose(self) -> None:
        await self._client.aclose()

    async def _ask(self, url: str) -> bytes:
        try:
            async with asyncio.timeout(_WAIT_S), self._client.stream("GET", url) as answer:
                if answer.status_code != 200:
                    raise Problem(502, f"the camera answers with status {answer.status_code}")
                kind, _, rest = answer.headers.get("content-type", "").partition(";")
                chunks = answer.aiter_raw()
                if kind.strip().lower().startswith("multipart/"):
                    picture = await _read_part(chunks, rest.partition("boundary=")[2].partition(";")[0].strip(' "-'))
                else:
                    picture = await _read(chunks)
        except TimeoutError:
            raise Problem(504, f"the camera sends no whole picture within {_WAIT_S:g} s") from None
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise Problem(502, f"the camera does not answer: {error or type(error).__name__}") from None
        if not picture.startswith(_JPEG):
            raise Problem(502, "what the camera sends is no JPEG")
        return picture


async def _read(chunks: AsyncIterator[bytes]) -> bytes:
    data = b""
    async for chunk in chunks:
        data = _with_more(data, chunk)
    return data


async def _read_part(chunks: AsyncIterator[bytes], boundary: str) -> bytes:
    """Return the first part, as long as its own Content-Length says or else up to the next boundary."""
    mark, data = b"--" + boundary.encode("latin-1"), b""
    async for chunk in chunks:
        data = _with_more(data, chunk)
        begin = data.find(mark)
        head_end = data.find(b"\r\n\r\n", begin)
        if begin < 0 or head_end < 0:
            if len(data) > _MOST_HEAD:
                break
            continue
        head, body = data[begin:head_end], data[head_end + 4 :]
        length = _length_in(head)
        if length is None:
            end = body.find(b"\r\n" + mark)
            if end >= 0:
                return body[:end]
        elif len(body) >= length:
            return body[:length]
    raise Problem(502, "the camera sends no whole picture")


def _length_in(head: bytes) -> int | None:
    for line in head.split(b"\r\n"):
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-length" and value.strip().isdigit():
            return int(value)
    return None


def _with_more(data: bytes, chunk: bytes) -> bytes:
    if len(data) + len(chunk) > MOST_BYTES:
        raise Problem(502, f"the camera sends more than {MOST_BYTES / 1e6:g} MB for a picture")
    return data + chunk
