"""Reads a whole program in one compiled pass: moves in batches, totals, and the index for entering it anywhere.

Imports numpy and numba: for a child process only. Memory does not grow with the program, except for the index (one
entry per piece of about 20 000 lines).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from machines.errors import ProgramRefusedError
from machines.gcode import refusals, scan_kernel, tally
from machines.gcode.dialects import DIALECTS, Dialect
from machines.gcode.modal import ModalState, state_of, vector_of
from machines.gcode.program import DIGEST_BYTES, IndexEntry, ProgramIndex
from machines.gcode.scan_moves import MOST_CHORDS
from machines.gcode.text import show_line

EVERY_LINES = 20_000
PIECE_BYTES = 1 << 19  # a piece ends here even if it has fewer lines, so that a reader's memory stays small
_ROOM = MOST_CHORDS + 2 * EVERY_LINES + 64
_LONGEST_LINE = 1 << 16  # comments included


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanBatch:
    """Consecutive entries of one program, laid out like cam.reading's; arcs come as chords (0.002 mm, GRBL's $12).

    sent_bytes (n,) : bytes on the wire up to and including the line of this entry (comments and blanks are not sent)
    A position that only the controller knows takes no time: the axis appears at its next given position, as a pause of
    0 s.
    """

    points_mm: np.ndarray
    is_rapid: np.ndarray
    feed_mm_per_min: np.ndarray
    line: np.ndarray
    spindle_on: np.ndarray
    pause_s: np.ndarray
    sent_bytes: np.ndarray

    def __len__(self) -> int:
        return len(self.line)

    @property
    def start_mm(self) -> np.ndarray:
        return self.points_mm[:-1]

    @property
    def end_mm(self) -> np.ndarray:
        return self.points_mm[1:]


class ProgramScan:
    """One pass over one program. `batches` does the work; everything else may be read when it has ended."""

    def __init__(
        self, dialect: str, max_rate_mm_per_min: tuple[float, float, float], *, every_lines: int = EVERY_LINES
    ) -> None:
        self._every_lines = every_lines
        self.dialect = DIALECTS[dialect]
        self.totals = np.zeros(tally.TOTALS)
        self.totals[[tally.LEAST_FEED, tally.LEAST_RPM]] = np.inf
        self.totals[tally.LAST_Z], self.totals[tally.LAST_MACHINE_Z] = np.nan, -np.inf
        self.events = np.zeros((tally.EVENTS, 2), dtype=np.int64)
        self.bounds = np.empty((tally.FRAMES, 6))
        self.bounds[:, :3], self.bounds[:, 3:] = np.inf, -np.inf
        self.bytes = 0
        self._rates = np.array(max_rate_mm_per_min) * (1 + 1e-9)
        self._rules = _rules(self.dialect)
        self._own = np.array(self.dialect.own, dtype=np.int64).reshape(-1, 4)
        self._state = np.array(vector_of(ModalState()))
        self._place = np.zeros(3)
        self._entries: list[IndexEntry] = []

    @property
    def state(self) -> ModalState:
        return state_of(self._state.tolist())

    @property
    def lines(self) -> int:
        return int(self.totals[tally.LINES])

    @property
    def index(self) -> ProgramIndex:
        return ProgramIndex(
            every_lines=self._every_lines,
            entries=tuple(self._entries),
            lines=self.lines,
            bytes=self.bytes,
            dialect=self.dialect.name,
        )

    def read_batches(self, chunks: Iterable[bytes]) -> Iterator[ScanBatch]:
        """Yield entries of the program; ProgramRefusedError at the first line that may not run."""
        rest = b""
        self._open_piece(0)
        for chunk, is_last in _with_last(chunks):
            buffer, real = rest + chunk, len(rest) + len(chunk)
            self.bytes += len(chunk)
            if is_last and buffer and not buffer.endswith(b"\n"):
                buffer += b"\n"  # as if the last line were terminated
            at, take = 0, PIECE_BYTES
            while at < len(buffer):
                used, batch = self._read(buffer, at, take)
                self._digest.update(memoryview(buffer)[at : min(at + used, real)])
                at += used
                if len(batch):
                    yield batch
                offset = self.bytes - real + min(at, real)
                if self._piece_lines >= self._every_lines or offset - self._piece_offset >= PIECE_BYTES // 2:
                    self._close_piece(offset)
                if used:
                    take = PIECE_BYTES
                elif at + take >= len(buffer):
                    break
                else:
                    take *= 2
            rest = buffer[at:]
            if len(rest) > _LONGEST_LINE:
                self._refuse(rest[:100], refusals.LONG)
        if self.bytes > self._piece_offset or not self._entries:
            self._close_piece(self.bytes)

    @property
    def _piece_lines(self) -> int:
        return self.lines + 1 - self._piece_line

    def _read(self, buffer: bytes, at: int, take: int) -> tuple[int, ScanBatch]:
        raw = np.frombuffer(buffer, dtype=np.uint8)[at : at + take]
        moves = (
            np.empty((_ROOM + 1, 3)),
            np.empty(_ROOM, dtype=np.bool_),
            np.empty(_ROOM),
            np.empty(_ROOM, dtype=np.int64),
            np.empty(_ROOM, dtype=np.bool_),
            np.empty(_ROOM),
            np.empty(_ROOM),
        )
        used, n, code, bad = scan_kernel.scan(
            *(raw, self._every_lines - self._piece_lines, self._rules, self._own, self._rates, scan_kernel.POWERS),
            *(self._state, self._place, self.totals, self.events, self.bounds, moves),
        )
        if code:
            end = buffer.find(b"\n", at + bad)
            self._refuse(buffer[at + bad : end if end >= 0 else len(buffer)], code)
        points, rapid, feed, line, spindle, pause, sent = moves
        return used, ScanBatch(
            points_mm=points[: n + 1],
            is_rapid=rapid[:n],
            feed_mm_per_min=feed[:n],
            line=line[:n],
            spindle_on=spindle[:n],
            pause_s=pause[:n],
            sent_bytes=sent[:n],
        )

    def _refuse(self, text: bytes, code: int) -> NoReturn:
        raise ProgramRefusedError(self.lines + 1, show_line(text), self.dialect.reason_for(code))

    def _open_piece(self, offset: int) -> None:
        self._piece_line, self._piece_offset, self._piece_state = self.lines + 1, offset, self.state
        self._digest = hashlib.blake2b(digest_size=DIGEST_BYTES)

    def _close_piece(self, offset: int) -> None:
        entry = IndexEntry(self._piece_line, self._piece_offset, self._digest.hexdigest(), self._piece_state)
        self._entries.append(entry)
        self._open_piece(offset)


def _rules(dialect: Dialect) -> np.ndarray:
    """Return the dialect as the numbers the kernel reads."""
    rules = {
        tally.RULE_LENGTH: dialect.line_limit,
        tally.RULE_N: dialect.n_limit,
        tally.RULE_PERCENT: dialect.percent,
        tally.RULE_LETTERS: dialect.letter_bits,
        tally.RULE_TWO_DIGITS: dialect.two_digits,
        tally.RULE_POINT: dialect.point_bits,
        tally.RULE_BARE_ZERO: dialect.bare_zero,
        tally.RULE_NAME_LEAST: dialect.name_digits[0],
        tally.RULE_NAME_MOST: dialect.name_digits[1],
        tally.RULE_NAMED: dialect.named,
        tally.RULE_NO_R: not dialect.arcs_by_r,
        tally.RULE_DECIMALS: dialect.decimals,
        tally.RULE_SPINDLE: dialect.spindle_first,
        tally.RULE_G53: dialect.g53_absolute,
    }
    return np.array([rules[slot] for slot in range(len(rules))], dtype=np.int64)


def _with_last(chunks: Iterable[bytes]) -> Iterator[tuple[bytes, bool]]:
    """Yield each chunk, and whether it is the last; at least one, possibly empty."""
    held = b""
    for chunk in chunks:
        if held:
            yield held, False
        held = chunk
    yield held, True
