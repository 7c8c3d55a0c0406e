"""The compiled part of the scanner that takes down what moves: entries of the batch, totals, bounds, events.

`tables` is (state, place, totals, events, bounds, rates, moves): language's modal state (18,), where the last entry
ended (3,), the vectors of tally.py, the greatest rates (3,), and the arrays of the batch.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from machines.gcode import language, tally

MOST_CHORDS = 50_000
ARC_TOLERANCE_MM = 0.002  # $12 as GRBL ships it


@njit(cache=True, nogil=True, inline="always")
def note_event(events, which, line):  # type: ignore[no-untyped-def]
    if events[which, 1] == 0:
        events[which, 0] = line
    events[which, 1] += 1


@njit(cache=True, nogil=True, inline="always")
def is_plain(state):  # type: ignore[no-untyped-def]
    """Absolute, in mm, feeds per minute, not ended: straight moves may take the short way."""
    metric = state[language.MM] == 1.0 and state[language.FEED_MODE] == 94.0
    return metric and state[language.ABSOLUTE] == 1.0 and state[language.ENDED] == 0.0


@njit(cache=True, nogil=True, inline="always")
def is_spindle_off(state):  # type: ignore[no-untyped-def]
    return state[language.SPINDLE] == 5.0 or state[language.SPEED] == 0.0


@njit(cache=True, nogil=True, inline="always")
def row_of(bounds, state):  # type: ignore[no-untyped-def]
    """The bounds of the frame that moves are in."""
    shifted = state[language.SHIFTED] > 0.0
    return bounds[tally.SHIFTED_ROW if shifted else min(int(state[language.WCS]) - 54, tally.SHIFTED_ROW)]


@njit(cache=True, nogil=True, inline="always")
def widen(row, d, value):  # type: ignore[no-untyped-def]
    if value < row[d]:
        row[d] = value
    if value > row[3 + d]:
        row[3 + d] = value


@njit(cache=True, nogil=True)
def add_entry(n, rapid_, feed_, line_, spindle_, pause_, tables):  # type: ignore[no-untyped-def]
    """Write entry n of the batch, which ends at `place`; returns n + 1."""
    _, place, totals, _, _, _, (points, rapid, feed, line, spindle, pause, sent) = tables
    for d in range(3):
        points[n + 1, d] = place[d]
    rapid[n] = rapid_
    feed[n] = feed_
    line[n] = line_
    spindle[n] = spindle_
    pause[n] = pause_
    sent[n] = totals[tally.SENT_BYTES]
    return n + 1


@njit(cache=True, nogil=True)
def add_straight(n, start, end, cut, feed, line, tables):  # type: ignore[no-untyped-def]
    """One straight move: entry, totals, bounds. `place` follows with unknown axes left where they were."""
    state, place, totals, events, bounds, _, _ = tables
    blind = False
    jumps = False
    moved = False
    length2 = 0.0
    row = row_of(bounds, state)
    for d in range(3):
        value = end[d]
        if start[d] != start[d]:
            blind = True
            if value == value and value != place[d]:
                place[d] = value
                jumps = True
        else:
            if start[d] != place[d]:  # the frame has moved
                place[d] = start[d]
                jumps = True
            if value == value and value != start[d]:
                moved = True
                length2 += (value - start[d]) * (value - start[d])
        widen(row, d, value)
    if jumps:  # from a place nobody knows, or that has a new name: takes no time here
        n = add_entry(n, False, 0.0, line, False, 0.0, tables)
    length = math.sqrt(length2)
    totals[tally.PATH_MM] += length
    if cut:
        if blind:
            note_event(events, tally.BLIND_CUT, line)
        # A level move over the work zero, at the greatest height so far, is a way in the air: a trace, no cut.
        aloft = start[2] == row[5] and end[2] == row[5] and end[2] > 0.0
        if is_spindle_off(state) and not aloft:
            note_event(events, tally.SPINDLE_OFF, line)
        _count_cut(start, end, feed, length, line, tables)
    if moved:
        for d in range(3):
            if start[d] == start[d] and end[d] == end[d]:
                place[d] = end[d]
        n = add_entry(n, not cut, feed if cut else 0.0, line, state[language.SPINDLE] != 5.0, -1.0, tables)
    return n


@njit(cache=True, nogil=True)
def _count_cut(start, end, feed, length, line, tables):  # type: ignore[no-untyped-def]
    _, _, totals, events, _, rates, _ = tables
    totals[tally.CUT_MM] += length
    if feed < totals[tally.LEAST_FEED]:
        totals[tally.LEAST_FEED] = feed
    if feed > totals[tally.MOST_FEED]:
        totals[tally.MOST_FEED] = feed
    over = False
    for d in range(3):
        if abs(end[d] - start[d]) * feed > rates[d] * length:
            over = True
    if over and length > 0.0:
        note_event(events, tally.OVER_RATE, line)


@njit(cache=True, nogil=True)
def add_arc(n, out, line, end, tables):  # type: ignore[no-untyped-def]
    """An arc as chords, cut as GRBL's mc_arc cuts it. Returns n, or -1 when it has too many."""
    plane = tables[0][language.PLANE]
    u = 2 if plane == 18.0 else 1 if plane == 19.0 else 0
    v = (u + 1) % 3
    w = 3 - u - v
    radius = out[language.RADIUS]
    sweep = out[language.SWEEP]
    chords = 1
    if radius > ARC_TOLERANCE_MM:
        count = 0.5 * abs(sweep) * radius / math.sqrt(ARC_TOLERANCE_MM * (2.0 * radius - ARC_TOLERANCE_MM))
        if count > MOST_CHORDS:
            return -1
        chords = max(1, int(count))
    start = np.empty(3)
    for d in range(3):
        start[d] = out[language.START + d]
    low = out[language.START + w]
    rise = out[language.END + w] - low
    for k in range(1, chords + 1):
        if k == chords:
            for d in range(3):
                end[d] = out[language.END + d]
        else:
            angle = out[language.ANGLE] + sweep * k / chords
            end[u] = out[language.CENTRE_U] + radius * math.cos(angle)
            end[v] = out[language.CENTRE_V] + radius * math.sin(angle)
            end[w] = low + rise * k / chords
        n = add_straight(n, start, end, True, out[language.BLOCK_FEED], line, tables)
        for d in range(3):
            start[d] = end[d]
    return n


@njit(cache=True, nogil=True)
def add_jump(n, out, kind, line, tables):  # type: ignore[no-untyped-def]
    """A move to a place only the controller knows, or in machine coordinates (G28, G30; G53)."""
    state, _, _, events, bounds, _, _ = tables
    row = bounds[tally.MACHINE_ROW]
    if kind == language.JUMP:
        row = row_of(bounds, state)
    note_event(events, tally.PLACE_UNKNOWN if kind == language.JUMP else tally.MACHINE_MOVES, line)
    for d in range(3):
        widen(row, d, out[language.END + d])
    return add_entry(n, False, 0.0, line, state[language.SPINDLE] != 5.0, 0.0, tables)
