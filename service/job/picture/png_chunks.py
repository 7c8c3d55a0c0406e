"""Passes on only those chunks of a PNG that describe its pixels: long notes never reach the decoder.

Pillow keeps all text of a PNG in memory and takes a file whose notes are long for damaged. Its colour profile is
taken out here, too, with a bound of its own.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass, field
from typing import BinaryIO

from phrases.phrase import Phrase
from service.errors import PictureError

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_KEPT = {b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"gAMA", b"cHRM", b"sRGB", b"eXIf"}
_PROFILE_BYTES = 16_000_000  # many times a table of three colours; LittleCMS reads it in a limited process
_NOTE_BYTES = 1_000_000  # of a chunk that is kept whole: no EXIF note of a camera is longer than 64 kB
_MOST_PARTS = 1000  # each is looked through at each read
_SRGB_CODES = (1, 13, 0, 1)  # primaries, curve, matrix, full range (ITU-T H.273)


@dataclass(slots=True)
class PngChunks:
    """parts: (offset, bytes) of the file that the decoder reads. profile: ICC, b"" where there is a broken one."""

    parts: list[tuple[int, int]] = field(default_factory=list)
    profile: bytes | None = None
    is_srgb: bool = False

    def keep(self, offset: int, length: int) -> None:
        """Add a part; parts that touch are one."""
        if self.parts and sum(self.parts[-1]) == offset:
            start, before = self.parts.pop()
            offset, length = start, before + length
        self.parts.append((offset, length))


def find_chunks(file: BinaryIO, name: str) -> PngChunks | None:
    """Return which parts of a PNG to decode; None for another file. PictureError for colours that are not read.

    Where the sequence of chunks is broken, the decoder gets the whole rest of the file, and reports the damage.
    """
    file.seek(0)
    if file.read(len(_SIGNATURE)) != _SIGNATURE:
        file.seek(0)
        return None
    end = file.seek(0, io.SEEK_END)
    chunks, at = PngChunks([(0, len(_SIGNATURE))]), len(_SIGNATURE)
    while at + 12 <= end and len(chunks.parts) < _MOST_PARTS:
        file.seek(at)
        length, kind = struct.unpack(">I4s", file.read(8))
        if at + 12 + length > end or not kind.isalpha():
            break
        if kind == b"iCCP" and chunks.profile is None:
            chunks.profile = _read_profile(file.read(min(length, _PROFILE_BYTES)))
        elif kind == b"cICP":
            _require_srgb(file.read(min(length, 4)), name)
            chunks.is_srgb = True
        elif kind in _KEPT and (kind != b"eXIf" or length <= _NOTE_BYTES):
            chunks.keep(at, 12 + length)
        at += 12 + length
        if kind == b"IEND":
            return chunks
    chunks.keep(at, end - at)
    return chunks


def _read_profile(chunk: bytes) -> bytes:
    _, _, rest = chunk.partition(b"\0")
    inflate = zlib.decompressobj()
    try:
        profile = inflate.decompress(rest[1:], _PROFILE_BYTES)
    except zlib.error:
        return b""
    return profile if inflate.eof and rest[:1] == b"\0" else b""


def _require_srgb(code: bytes, name: str) -> None:
    if tuple(code) != _SRGB_CODES:
        words = Phrase(
            "{name}: this PNG stores wide or high dynamic range colours (cICP {code}), which are not read; save it as "
            "a PNG in sRGB",
            name=name,
            code=", ".join(map(str, code)),
        )
        raise PictureError(words)


class PartsOfFile(io.RawIOBase):
    """Some parts of a file, one after the other, as a file to read; nothing is held in memory."""

    def __init__(self, file: BinaryIO, parts: list[tuple[int, int]]) -> None:
        self._file = file
        self._parts: list[tuple[int, int, int]] = []  # where it begins here, and in the file; its length
        self._size = self._at = 0
        for offset, length in parts:
            self._parts.append((self._size, offset, length))
            self._size += length

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, origin: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[origin]
        self._at = max(0, base + offset)
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        for begin, start, length in self._parts:
            if begin <= self._at < begin + length:
                self._file.seek(start + self._at - begin)
                piece = self._file.read(min(len(buffer), begin + length - self._at))
                buffer[: len(piece)] = piece
                self._at += len(piece)
                return len(piece)
        return 0
