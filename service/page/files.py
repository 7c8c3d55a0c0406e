"""The files of the page: read on request, compressed once, identified by their content.

Some modules are not files: the server generates them from its own data.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent
INDEX = "index.html"
_TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "json": "application/json",
    "svg": "image/svg+xml",
    "png": "image/png",
    "jpg": "image/jpeg",
    "avif": "image/avif",
    "webmanifest": "application/manifest+json",
}
_PATH = re.compile(rf"(?:[A-Za-z0-9_-]+/){{0,4}}[A-Za-z0-9_.-]+\.({'|'.join(_TYPES)})")
_PACKED_BEFORE = frozenset({"png", "jpg", "avif"})


@dataclass(frozen=True, slots=True, kw_only=True)
class PageFile:
    """packed : the content gzipped; None if that makes it no smaller. etag : of the content"""

    content: bytes
    packed: bytes | None
    media_type: str
    etag: str


class PageFiles:
    """Files of one folder. A file that is changed on disk is read again, so a developer only has to reload the page.

    made : by path, the name that a module exports and the function that returns its value, as JSON
    """

    def __init__(
        self, folder: Path = FOLDER, made: Mapping[str, tuple[str, Callable[[], object]]] | None = None
    ) -> None:
        self._folder = folder
        self._made = made or {}
        self._modules: dict[str, PageFile] = {}
        self._known: dict[str, tuple[tuple[int, int], PageFile]] = {}

    def file(self, path: str) -> PageFile | None:
        """Return the file; None if there is no such file of the page."""
        if path in self._made:
            return self._module(path)
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

    def _module(self, path: str) -> PageFile:
        if path not in self._modules:
            name, value = self._made[path]
            text = f"export const {name} = {json.dumps(value(), separators=(',', ':'))};\n"
            self._modules[path] = _page_file(text.encode(), "js")
        return self._modules[path]


def _page_file(content: bytes, kind: str) -> PageFile:
    packed = None if kind in _PACKED_BEFORE else gzip.compress(content, 9, mtime=0)
    return PageFile(
        content=content,
        packed=packed if packed is not None and len(packed) < len(content) else None,
        media_type=_TYPES[kind],
        etag=hashlib.sha256(content).hexdigest()[:32],
    )
