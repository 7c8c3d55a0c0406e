"""Reads G-code text back to moves, as a stream. It does not trust the writer of the program.

It reads the subset of each control's language that a finishing program needs: straight moves, dwell, spindle, comments.
Everything else is refused with its line, because a word that is skipped here but obeyed by the mill breaks a cutter.
One compiled pass over the bytes keeps the whole modal state; a chunk boundary may fall anywhere.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from cam.reading import gcode_parse, rml_parse
from cam.reading.gcode_languages import (
    ALLOWED,
    CHANGES_IN_MIDDLE,
    GRBL,
    LANGUAGES,
    LONG,
    REFUSALS,
    TOOLS,
    WRONG_WORD,
    Language,
    ProgramError,
)
from optics.heightfield import Array
from phrases.phrase import Phrase

__all__ = [
    "ALLOWED",
    "GRBL",
    "LANGUAGES",
    "LINE_LIMIT",
    "Language",
    "MoveBatch",
    "ProgramError",
    "read_parts",
]

LINE_LIMIT = 79  # bytes before the line end that GRBL 1.1 holds; more than any control needs
BATCH_BYTES = 4 << 20
_WORD = re.compile(r"[A-Za-z]\s*[-+]?\s*[\d.]*")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MoveBatch:
    """Consecutive moves of one program; batches follow each other without a gap.

    points_mm (n + 1, 3)     : move k runs from points_mm[k] to points_mm[k + 1]; tool tip, work frame
    is_rapid (n,)            : bool, G0
    feed_mm_per_min (n,)     : feed in force (0 until one is given; only rapids may have that)
    line (n,)                : int64, line of the program, from 1
    spindle_rpm (n,)         : 0 while the spindle is off
    pause_s (n,)             : -1 for a motion; otherwise the mill stops here for that long (G4, or 0 at M3, M5, M2)
    lines_read, bytes_read   : of the program, up to the end of this batch
    ended                    : M2 or M30 has been read

    The approach, up to the line on which all three coordinates have been given, is not a move, because its start is not
    known. Its dwell is the pause of the first entry, at its end.
    """

    points_mm: Array
    is_rapid: np.ndarray
    feed_mm_per_min: Array
    line: np.ndarray
    spindle_rpm: Array
    pause_s: Array
    lines_read: int
    bytes_read: int
    ended: bool

    def __len__(self) -> int:
        return len(self.line)

    @property
    def spindle_on(self) -> np.ndarray:
        return self.spindle_rpm > 0.0

    @property
    def start_mm(self) -> Array:
        return self.points_mm[:-1]

    @property
    def end_mm(self) -> Array:
        return self.points_mm[1:]


def read_parts(
    parts: Iterable[Iterable[bytes]], language: Language = GRBL, *, changes_tools: bool = False
) -> Iterator[MoveBatch]:
    """Yield moves of a pass that is written as several programs, run one after the other, each given in pieces of its
    text.

    At the start of each, only the tool's position after the one before is known, in its work offset; lines and bytes
    are counted through.

    changes_tools : each may change its tool in the middle, where the head is at its top and the spindle off
    """
    rules = language.rules()
    if changes_tools:
        rules[TOOLS] *= CHANGES_IN_MIDDLE
    state = np.zeros(gcode_parse.LINE + 1)
    state[:3] = np.nan
    bytes_read = lines_read = 0
    for chunks in parts:
        state[3 : gcode_parse.OFFSET] = state[gcode_parse.LINE] = 0.0
        state[gcode_parse.TOOL], state[gcode_parse.LOWERED], state[gcode_parse.GONE] = -1.0, 0.0, 0.0
        state[gcode_parse.UNIT], state[gcode_parse.ABSOLUTE], state[gcode_parse.MOTION] = 1.0, 1.0, -1.0
        for batch in _batches(chunks, language, rules, state):
            yield replace(batch, line=batch.line + lines_read, lines_read=batch.lines_read + lines_read,
                          bytes_read=batch.bytes_read + bytes_read) if lines_read else batch  # fmt: skip
        lines_read, bytes_read = batch.lines_read + lines_read, batch.bytes_read + bytes_read


def _batches(chunks: Iterable[bytes], language: Language, rules: np.ndarray, state: Array) -> Iterator[MoveBatch]:
    parse = rml_parse.parse if language.kind == "rml" else gcode_parse.parse
    rest = b""
    bytes_read = 0
    for text, is_last in _large_pieces(chunks):
        bytes_read += len(text)
        buffer = rest + text
        if is_last and buffer and not buffer.endswith(b"\n"):
            buffer += b"\n"
        done = 0
        while done < len(buffer):
            batch, used = _read_batch(parse, buffer, done, state, rules, bytes_read)
            done += used
            if len(batch) or (is_last and done == len(buffer)):
                yield batch
            if used == 0:
                break
        rest = buffer[done:]
        if len(rest) > LINE_LIMIT + 1:
            raise ProgramError(int(state[gcode_parse.LINE]) + 1, rest, REFUSALS[LONG])


def _large_pieces(chunks: Iterable[bytes]) -> Iterator[tuple[bytes, bool]]:
    """Yield chunks gathered to BATCH_BYTES or more, each with "is the last one" (possibly empty)."""
    held: list[bytes] = []
    size = 0
    for chunk in chunks:
        held.append(chunk)
        size += len(chunk)
        while size > BATCH_BYTES:
            joined = b"".join(held)
            yield joined[:BATCH_BYTES], False
            held, size = [joined[BATCH_BYTES:]], size - BATCH_BYTES
    yield b"".join(held), True


def _read_batch(
    parse: Callable[..., tuple[int, int, int, int]],
    buffer: bytes,
    start: int,
    state: Array,
    rules: np.ndarray,
    bytes_read: int,
) -> tuple[MoveBatch, int]:
    raw = np.frombuffer(buffer, dtype=np.uint8)[start:]
    room = buffer.count(b"\n", start) + 64 + gcode_parse.MOST_CHORDS
    points = np.empty((room + 1, 3))
    rapid, spindle = np.zeros(room, dtype=np.bool_), np.zeros(room)
    feed, pause, line = np.empty(room), np.empty(room), np.empty(room, dtype=np.int64)
    used, n, code, bad = parse(raw, state, rules, gcode_parse.POWERS, points, rapid, feed, line, spindle, pause)
    end = buffer.find(b"\n", start + bad)
    if code and end >= 0:  # a line without its end is judged when the rest of it has come
        line_text, reason = buffer[start + used : end], REFUSALS[code]
        if code == WRONG_WORD:
            word = _WORD.findall(buffer[start + used : start + bad].decode("ascii", "replace"))[-1]
            reason = Phrase("{word} is not allowed here; allowed: {words}", word=word, words=ALLOWED)
        raise ProgramError(int(state[gcode_parse.LINE]) + 1, line_text, reason)
    batch = MoveBatch(
        points_mm=points[: n + 1],
        is_rapid=rapid[:n],
        feed_mm_per_min=feed[:n],
        line=line[:n],
        spindle_rpm=spindle[:n],
        pause_s=pause[:n],
        lines_read=int(state[gcode_parse.LINE]),
        bytes_read=bytes_read,
        ended=bool(state[gcode_parse.ENDED]),
    )
    return batch, used
