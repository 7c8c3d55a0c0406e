"""One stored object as an HTTP answer: whole or a range, from the store's own address where it has one."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass

from starlette.responses import RedirectResponse, Response, StreamingResponse

from phrases.phrase import Phrase
from service.http.disposition import name_download
from service.http.problems import Problem
from service.server.api.answers.job_views import media_type
from service.server.database.records import Artifact
from service.store.base import Store

_INLINE = ("image/png", "application/json", "text/html; charset=utf-8", "text/plain; charset=utf-8")
# A report is a page with pictures beside it and no scripts: it gets no rights over this server's pages.
_PAGE_POLICY = "sandbox; default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'"
_ONE_RANGE = re.compile(r"bytes=\s*(\d{0,18})-(\d{0,18})\s*", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Conditions:
    """The request's headers of these names."""

    range: str | None
    if_range: str | None
    if_none_match: str | None


async def download(
    store: Store, file: Artifact, conditions: Conditions, *, with_body: bool, elsewhere: bool = True
) -> Response:
    """Send the file; MissingObjectError where the store lost it. `elsewhere`: the caller may be sent to the store
    itself.

    A bucket knows the file by its hash only: pages, and the pictures in them, always come from here.
    """
    kind, tag = media_type(file.name), f'"{file.sha256}"'
    headers = _headers(file, kind, tag)
    if matches(conditions.if_none_match, tag):
        return Response(status_code=304, headers=headers)
    asked = conditions.range if with_body else None  # RFC 9110, 14.2: GET is the only method that has ranges
    part = parse_range(asked, conditions.if_range, size=file.bytes, etag=tag)
    if with_body and elsewhere and kind not in _INLINE:
        url = await asyncio.to_thread(store.url, file.sha256, file_name=file.name, media_type=kind)
        if url is not None:
            named = headers["Content-Disposition"]
            return RedirectResponse(
                url, status_code=307, headers={"ETag": tag, "Cache-Control": "no-store", "Content-Disposition": named}
            )
    start, end = part or (0, file.bytes)
    if part is not None:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{file.bytes}"
    headers["Content-Length"] = str(end - start)
    status = 200 if part is None else 206
    if not with_body:
        await asyncio.to_thread(store.head, file.sha256)
        return Response(status_code=status, headers=headers, media_type=kind)
    pieces = await asyncio.to_thread(store.open_range, file.sha256, start, end)
    return StreamingResponse(iterate_in_threads(pieces), status_code=status, headers=headers, media_type=kind)


async def iterate_in_threads(pieces: Iterator[bytes]) -> AsyncIterator[bytes]:
    """Make each piece in a thread, when the one before has been taken; one more is ready at any time."""
    ahead = asyncio.ensure_future(asyncio.to_thread(next, pieces, None))
    try:
        while (piece := await ahead) is not None:
            ahead = asyncio.ensure_future(asyncio.to_thread(next, pieces, None))
            yield piece
    finally:
        await asyncio.wait({ahead})
        with contextlib.suppress(asyncio.CancelledError, Exception):
            ahead.result()  # else the loop complains of an error nobody looked at
        if close := getattr(pieces, "close", None):
            close()


def _headers(file: Artifact, kind: str, tag: str) -> dict[str, str]:
    headers = {
        "ETag": tag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",
        "Content-Disposition": name_download("inline" if kind in _INLINE else "attachment", file.name),
        "X-Content-Type-Options": "nosniff",
    }
    return headers | ({"Content-Security-Policy": _PAGE_POLICY} if kind.startswith("text/html") else {})


def matches(if_none_match: str | None, etag: str) -> bool:
    """Return whether the client has this version already (weak comparison)."""
    if if_none_match is None:
        return False
    given = {tag.strip().removeprefix("W/") for tag in if_none_match.split(",")}
    return "*" in given or etag in given


def parse_range(range_header: str | None, if_range: str | None, *, size: int, etag: str) -> tuple[int, int] | None:
    """Start and end (exclusive); None for the whole file. Problem 416 where there is no such part.

    What is no range, or asks for several, is answered with the whole file, as the RFC allows. An If-Range that is not
    this very ETag means that the client's beginning belongs to another version.
    """
    if range_header is None or (if_range is not None and if_range.strip() != etag):
        return None
    asked = _ONE_RANGE.fullmatch(range_header)
    if asked is None or not any(asked.groups()):
        return None
    first, last = asked.groups()
    if not first:
        start, end = max(0, size - int(last)), size
    else:
        start, end = int(first), min(size, int(last) + 1) if last else size
        if last and int(last) < start:
            return None
    if start >= end:
        words = Phrase("the file has {size} bytes", size=size)
        raise Problem(416, words, field="Range", headers={"Content-Range": f"bytes */{size}"})
    return start, end
