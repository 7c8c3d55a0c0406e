"""Index of a program in a language other than G-code: pieces of whole lines and their digests, no modal state."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from machines.errors import ProgramRefusedError
from machines.gcode.modal import ModalState
from machines.gcode.program import IndexEntry, ProgramIndex, piece_digest
from machines.gcode.words import shown, strip_ends

EVERY_LINES = 20_000  # about: pieces end by their bytes
PIECE_BYTES = 1 << 18
LONGEST_LINE = 500  # a line is the unit of feeding, of progress and of what is cut again; USB takes 512 bytes at once


class TextIndex:
    """Fed by `cut_into_pieces`, which hands the chunks on; complete when they have ended."""

    def __init__(self, dialect: str, *, piece_bytes: int = PIECE_BYTES) -> None:
        self.blocks = 0
        self._piece_bytes = piece_bytes
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

    def cut_into_pieces(self, chunks: Iterable[bytes]) -> Iterator[bytes]:
        """Yield the chunks as they are; on the way they are cut into pieces. ProgramRefusedError at a line too long."""
        rest = b""
        for chunk in chunks:
            yield chunk
            rest = self._take(rest + chunk)
        if rest or not self._entries:
            self._close(rest)

    def _take(self, data: bytes) -> bytes:
        """Close all whole pieces of the data; what is left of it."""
        at = 0
        while len(data) - at >= self._piece_bytes:
            end = data.rfind(b"\n", at, at + self._piece_bytes) + 1
            if end <= at:
                self._refuse_long(self._lines + 1, data[at:])
            self._close(data[at:end])
            at = end
        return data[at:]

    def _close(self, piece: bytes) -> None:
        self._entries.append(IndexEntry(self._lines + 1, self._bytes, piece_digest(piece), ModalState()))
        lines = piece.removesuffix(b"\n").split(b"\n") if piece else []
        for number, line in enumerate(lines, self._lines + 1):
            block = strip_ends(line)
            self.blocks += bool(block)
            if len(block) > LONGEST_LINE:
                self._refuse_long(number, block)
        self._lines += len(lines)
        self._bytes += len(piece)

    def _refuse_long(self, number: int, text: bytes) -> None:
        reason = f"a line of more than {LONGEST_LINE} bytes; put a line end behind each command (sed 's/;/;\\n/g')"
        raise ProgramRefusedError(number, shown(text[:60]), reason)
