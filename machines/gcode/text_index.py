"""Index of a program in a language other than G-code: pieces of whole lines and their digests, no modal state."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator

from machines.errors import ProgramRefusedError
from machines.gcode.modal import ModalState
from machines.gcode.program import DIGEST_BYTES, IndexEntry, ProgramIndex
from machines.gcode.words import shown

EVERY_LINES = 20_000
PIECE_BYTES = 1 << 18
LONGEST_LINE = 1 << 16


class TextIndex:
    """Fed by `passing`, which hands the chunks on; complete when they have ended."""

    def __init__(self, dialect: str) -> None:
        self.blocks = 0
        self._dialect = dialect
        self._entries: list[IndexEntry] = []
        self._lines = 0
        self._bytes = 0

    @property
    def index(self) -> ProgramIndex:
        return ProgramIndex(
            every_lines=EVERY_LINES,
            entries=tuple(self._entries),
            lines=self._lines,
            bytes=self._bytes,
            dialect=self._dialect,
        )

    def passing(self, chunks: Iterable[bytes]) -> Iterator[bytes]:
        """The chunks as they are; on the way they are cut into pieces. ProgramRefusedError at an endless line."""
        rest = b""
        for chunk in chunks:
            yield chunk
            rest = self._take(rest + chunk)
        if rest or not self._entries:
            self._close(rest)

    def _take(self, data: bytes) -> bytes:
        """Close all whole pieces of the data; what is left of it."""
        at = 0
        while len(data) - at >= PIECE_BYTES:
            end = data.rfind(b"\n", at, at + PIECE_BYTES) + 1
            if end <= at:
                text = shown(data[at : at + 60])
                reason = f"a line of more than {LONGEST_LINE} bytes; put a line end after every few commands"
                raise ProgramRefusedError(self._lines + 1, text, reason)
            self._close(data[at:end])
            at = end
        return data[at:]

    def _close(self, piece: bytes) -> None:
        digest = hashlib.blake2b(piece, digest_size=DIGEST_BYTES).hexdigest()
        self._entries.append(IndexEntry(self._lines + 1, self._bytes, digest, ModalState()))
        lines = piece.removesuffix(b"\n").split(b"\n") if piece else []
        self.blocks += sum(1 for line in lines if line.strip())
        self._lines += len(lines)
        self._bytes += len(piece)
