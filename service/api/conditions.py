"""Conditional and ranged requests (RFC 9110): what If-None-Match, If-Range and Range ask for."""

from __future__ import annotations

import re

from service.web.problems import Problem

_ONE_RANGE = re.compile(r"bytes=\s*(\d{0,18})-(\d{0,18})\s*", re.IGNORECASE)


def matches(if_none_match: str | None, etag: str) -> bool:
    """True where the client has this version already (weak comparison)."""
    if if_none_match is None:
        return False
    given = {tag.strip().removeprefix("W/") for tag in if_none_match.split(",")}
    return "*" in given or etag in given


def wanted_range(range_header: str | None, if_range: str | None, *, size: int, etag: str) -> tuple[int, int] | None:
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
        raise Problem(
            416, f"the file has {size} bytes", field="Range", headers={"Content-Range": f"bytes */{size}"}
        )  # fmt: skip
    return start, end
