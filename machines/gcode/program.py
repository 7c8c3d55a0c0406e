"""Reads a program on disk for streaming: verified piece by piece, from any line, in constant memory.

Pre-flight leaves an index: every few thousand lines the byte offset, the modal state there and a digest of the piece
that follows. A line is handed out only after the digest of its whole piece has matched, from the very bytes that were
hashed, so that exactly the bytes that pre-flight has read are sent. The index of a program in another language than
G-code has no modal state; it is made here, that of G-code where programs are scanned.
"""

from __future__ import annotations

import hashlib
import os
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from machines.driver import ProgramLine
from machines.errors import ProgramChangedError, ProgramRefusedError
from machines.gcode.dialects import DIALECTS, RML
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.text import show_line, strip_block, strip_ends
from phrases.phrase import Phrase

DIGEST_BYTES = 16
_TEXT_LINES = 20_000  # about: pieces end by their bytes
_TEXT_BYTES = 1 << 18
LONGEST_LINE = 500  # a line is the unit of feeding, of progress and of what is cut again; USB takes 512 bytes at once


def piece_digest(data: bytes | memoryview) -> str:
    return hashlib.blake2b(data, digest_size=DIGEST_BYTES).hexdigest()


class IndexEntry(NamedTuple):
    """Before line `line` (from 1), at byte `offset`, the modal state is `state`; `digest` is of the piece up to the
    next entry.
    """

    line: int
    offset: int
    digest: str
    state: ModalState


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramIndex:
    """Places a program can be entered at. Entries are about `every_lines` apart, closer where lines are long."""

    every_lines: int
    entries: tuple[IndexEntry, ...]
    lines: int
    bytes: int
    dialect: str = "grbl"
    _line_numbers: list[int] = field(init=False, repr=False, compare=False, default_factory=list)

    def __post_init__(self) -> None:
        self._line_numbers.extend(entry.line for entry in self.entries)

    def before(self, line: int) -> int:
        """Return the number of the last entry at or before `line`."""
        return max(0, bisect_right(self._line_numbers, line) - 1)

    def end_of(self, entry: int) -> int:
        """Return the byte offset at which the piece of this entry ends."""
        return self.entries[entry + 1].offset if entry + 1 < len(self.entries) else self.bytes

    def to_dict(self) -> dict[str, Any]:
        return {
            "every_lines": self.every_lines,
            "lines": self.lines,
            "bytes": self.bytes,
            "dialect": self.dialect,
            "entries": [[e.line, e.offset, e.digest, e.state.to_dict()] for e in self.entries],
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> ProgramIndex:
        entries = (IndexEntry(a, b, c, ModalState.from_dict(state)) for a, b, c, state in data["entries"])
        return ProgramIndex(**{**data, "entries": tuple(entries)})


class ProgramReader:
    """The blocks of one program file. Each call of `lines` reads independently, so several may run at the same time."""

    def __init__(self, path: Path, index: ProgramIndex) -> None:
        self.path = path
        self.index = index

    def lines(self, from_line: int = 1) -> Iterator[ProgramLine]:
        """Yield blocks from line `from_line` on: no comment, no blank, upper case. ProgramChangedError at a changed
        piece.
        """
        first = self.index.before(from_line)
        with self._open() as file:
            for number in range(first, len(self.index.entries)):
                entry = self.index.entries[number]
                data = self._piece(file, number)
                for line in _blocks(data, entry.line, entry.offset, self.index.dialect):
                    if line.number >= from_line:
                        yield line

    def state_before(self, line: int) -> ModalState:
        """Return the modal state when every line before `line` has been executed."""
        number = self.index.before(line)
        entry = self.index.entries[number]
        if line <= entry.line:
            return entry.state
        with self._open() as file:
            data = self._piece(file, number)
        if self.index.dialect == RML:
            return entry.state  # its modal state is not known
        interpreter = Interpreter(entry.state, dialect=self.index.dialect)
        for block in _blocks(data, entry.line, entry.offset, self.index.dialect):
            if block.number >= line:
                break
            interpreter.take(block.text)
        return interpreter.state

    def _open(self) -> BinaryIO:
        try:
            return self.path.open("rb")
        except OSError as error:
            raise ProgramChangedError(
                Phrase("{path}: can no longer be read ({reason})", path=self.path, reason=error.strerror)
            ) from None

    def _piece(self, file: BinaryIO, number: int) -> bytes:
        entry, end = self.index.entries[number], self.index.end_of(number)
        data = os.pread(file.fileno(), end - entry.offset, entry.offset)
        if len(data) != end - entry.offset or piece_digest(data) != entry.digest:
            raise ProgramChangedError(
                Phrase(
                    "{path}: changed on disk since pre-flight (in the {count} bytes from line {line} on); nothing "
                    "of that piece was sent; run pre-flight again",
                    path=self.path,
                    count=len(data),
                    line=entry.line,
                )
            )
        return data


def _blocks(data: bytes, line: int, offset: int, dialect: str) -> Iterator[ProgramLine]:
    """Yield the blocks of one piece. A piece without comments, blanks or lower case needs no work on its lines."""
    strip: Callable[[bytes], bytes] = strip_block
    plain, keeps_percent = False, True
    if dialect == RML:  # its own language: unchanged, and ; ends a command
        strip = strip_ends
    else:
        keeps_percent = not DIALECTS[dialect].is_grbl
        plain = data.translate(None, b"ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.-+\n") == b""
    for text in data.split(b"\n"):
        block = text if plain else strip(text)
        if block and (plain or keeps_percent or block != b"%"):
            yield ProgramLine(line, offset, block)
        line += 1
        offset += len(text) + 1


class TextIndex:
    """Index of a program in a language other than G-code.

    Fed by `cut_into_pieces`, which hands the chunks on; complete when they have ended.
    """

    def __init__(self, dialect: str, *, piece_bytes: int = _TEXT_BYTES) -> None:
        self.blocks = 0
        self._piece_bytes = piece_bytes
        self._dialect = dialect
        self._entries: list[IndexEntry] = []
        self._lines = 0
        self._bytes = 0

    @property
    def index(self) -> ProgramIndex:
        return ProgramIndex(
            every_lines=_TEXT_LINES,
            entries=tuple(self._entries),
            lines=self._lines,
            bytes=self._bytes,
            dialect=self._dialect,
        )

    def cut_into_pieces(self, chunks: Iterable[bytes]) -> Iterator[bytes]:
        """Yield the chunks unchanged, and index their pieces meanwhile. ProgramRefusedError for a line that is too
        long.
        """
        rest = b""
        for chunk in chunks:
            yield chunk
            rest = self._take(rest + chunk)
        if rest or not self._entries:
            self._close(rest)

    def _take(self, data: bytes) -> bytes:
        """Close all complete pieces of the data; return the rest."""
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
        reason = Phrase(
            "a line of more than {most} bytes; put a line end after each command (sed 's/;/;\\n/g')", most=LONGEST_LINE
        )
        raise ProgramRefusedError(number, show_line(text[:60]), reason)
