"""Joins the programs of a job into one, for controls that change their tools themselves (T, M6), and proves that it
makes the same moves. It streams; nothing here opens a file.

Each program sets everything that it depends on: modes, tool, length, spindle; and it ends with the head at its top and
the spindle off. So the texts can follow one another unchanged. Only the first keeps its tape marks and its name, only
the last keeps its end, and N words count on.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator

import numpy as np

from cam.posts.post import Post
from cam.reading.gcode import MoveBatch

_NUMBER = re.compile(rb"^N(\d+)", re.MULTILINE)
_CHANGE = re.compile(rb"(?:N\d+)?T(\d+)M6\b")


def join_programs(programs: Iterable[Iterable[bytes]], post: Post) -> Iterator[bytes]:
    """Yield the text of one program that runs the given ones, each in pieces of its text. ValueError if one does not
    end as the dialect's programs do.
    """
    end = b"".join(post.block(block) for block in post.end if block != "M5")
    numbered, held_end = 0, b""
    for at, chunks in enumerate(programs):
        held, to_drop, base = b"", len(post.tape) if at else 0, numbered
        for chunk in chunks:
            held += chunk
            whole = held.rfind(b"\n", 0, max(0, len(held) - len(end))) + 1
            text, held = held[:whole], held[whole:]
            while to_drop and text:
                text, to_drop = text.partition(b"\n")[2], to_drop - 1
            if numbers := _NUMBER.findall(text):
                numbered = base + int(numbers[-1])
            yield _number_onward(text, base)
        if held != end:
            raise ValueError(f"program {at + 1} ends with {held[-80:]!r}")
        held_end = held
    yield held_end


def _number_onward(text: bytes, base: int) -> bytes:
    """Add base to each N word of the text."""
    return _NUMBER.sub(lambda found: b"N%d" % (base + int(found[1])), text) if base else text


def find_tool_changes(lines: Iterable[bytes]) -> list[tuple[int, int]]:
    """Return (line, from 1, and number of the tool) of each tool change of a program, given by its lines."""
    return [(number, int(found[1])) for number, line in enumerate(lines, 1) if (found := _CHANGE.match(line))]


def hash_moves(batches: Iterable[MoveBatch]) -> str:
    """Return a digest of all moves: their ends, feeds and spindle speeds, and the pauses between them. Stopping a
    spindle that is already off does not count: each program ends with such a stop.
    """
    digests = [hashlib.blake2b() for _ in range(5)]
    for batch in batches:
        counts = (batch.pause_s != 0.0) | batch.spindle_on
        feed = np.where(batch.is_rapid | (batch.pause_s >= 0.0), 0.0, batch.feed_mm_per_min)
        figures = (batch.end_mm, batch.is_rapid, feed, batch.spindle_rpm, batch.pause_s)
        for figure, digest in zip(figures, digests, strict=True):
            digest.update(figure[counts].tobytes())
    return " ".join(digest.hexdigest() for digest in digests)
