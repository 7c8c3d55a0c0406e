"""The files of the page as they are served: read when asked for, packed once, known by their content."""

from __future__ import annotations

import gzip
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent
INDEX = "index.html"
_TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "png": "image/png",
    "webmanifest": "application/manifest+json",
}
_PATH = re.compile(rf"(?:[A-Za-z0-9_-]+/){{0,4}}[A-Za-z0-9_.-]+\.({'|'.join(_TYPES)})")
_PACKED_BEFORE = frozenset({"png"})


@dataclass(frozen=True, slots=True, kw_only=True)
class PageFile:
    """packed : the content gzipped; None where that makes it no smaller. etag : of the content"""

    content: bytes
    packed: bytes | None
    media_type: str
    etag: str


class PageFiles:
    """Files of one folder. One that is changed on disk is read anew: who works on the page just loads it again."""

    def __init__(self, folder: Path = FOLDER) -> None:
        self._folder = folder
        self._known: dict[str, tuple[tuple[int, int], PageFile]] = {}

    def file(self, path: str) -> PageFile | None:
        """Return the file; None where there is none, or none that belongs to the page."""
        kind = _PATH.fullmatch(path)
        if kind is None:
            return None
        try:
            found = (self._folder / path).stat()
            stamp = (found.st_mtime_ns, found.st_size)
            known = self._known.get(path)
            if known is None or known[0] != stamp:
                known = self._known[path] = stamp, _page_file((self._folder / path).read_bytes(), kind[1])
        except OSError:
            return None
        return known[1]


def _page_file(content: bytes, kind: str) -> PageFile:
    packed = None if kind in _PACKED_BEFORE else gzip.compress(content, 9, mtime=0)
    return PageFile(
        content=content,
        packed=packed if packed is not None and len(packed) < len(content) else None,
        media_type=_TYPES[kind],
        etag=hashlib.sha256(content).hexdigest()[:32],
    )
