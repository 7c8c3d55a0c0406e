"""Points to text, in integer arithmetic straight into a byte buffer: tens of millions of lines a minute."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

MOST_BYTES_PER_LINE = 96
UNKNOWN = np.iinfo(np.int64).min


@njit(cache=True, nogil=True)
def write_number(value, decimals, least_decimals, out, at):  # type: ignore[no-untyped-def]
    """Write value / 10^decimals, without zeros after the least decimals, to out[at:]; return the place after it."""
    if value < 0:
        out[at] = 45  # -
        at += 1
        value = -value
    scale = 1
    for _ in range(decimals):
        scale *= 10
    whole, part = value // scale, value % scale
    tens = 1
    while tens * 10 <= whole:
        tens *= 10
    while tens > 0:
        out[at] = 48 + whole // tens % 10
        at += 1
        tens //= 10
    if part == 0 and least_decimals == 0:
        return at
    out[at] = 46  # .
    at += 1
    while part > 0 or least_decimals > 0:
        scale //= 10
        out[at] = 48 + part // scale
        at += 1
        part %= scale
        least_decimals -= 1
    return at


@njit(cache=True, nogil=True)
def write_lines(  # type: ignore[no-untyped-def]
    points, state, decimals, letters, gap, line_end, opening, closing, least_decimals, number_every, out
):
    """Write points (n, 3) as blocks into out; state (4,) int64: the last position and the lines written, updated.

    Axis words are written only if they have changed, and no block if none has; `opening` and `closing` (a motion word,
    a feed word) only go on the first block. Return the bytes and lines written.
    """
    at = 0
    lines = 0
    first = True
    for k in range(points.shape[0]):
        begin = at
        if number_every > 0 and (state[3] + lines + 1) % number_every == 0:
            out[at] = 78  # N
            at = write_number(state[3] + lines + 1, 0, 0, out, at + 1)
        if first:
            if at > begin and opening.size:
                for c in gap:
                    out[at] = c
                    at += 1
            for c in opening:
                out[at] = c
                at += 1
        moved = False
        for a in range(3):
            scale = 1.0
            for _ in range(decimals[a]):
                scale *= 10.0
            value = np.int64(math.floor(points[k, a] * scale + 0.5))
            if value != state[a]:
                if at > begin:
                    for c in gap:
                        out[at] = c
                        at += 1
                out[at] = letters[a]
                at = write_number(value, decimals[a], least_decimals, out, at + 1)
                state[a] = value
                moved = True
        if not moved:
            at = begin
            continue
        if first:
            if closing.size:
                for c in gap:
                    out[at] = c
                    at += 1
            for c in closing:
                out[at] = c
                at += 1
            first = False
        for c in line_end:
            out[at] = c
            at += 1
        lines += 1
    state[3] += lines
    return at, lines
