"""The compiled part of the scanner that records moves: entries of the batch, totals, bounds, events.

state (18,) is language's modal state; place (3,) where the last entry ended; totals, events and bounds are tally's;
rates (3,) the greatest of each axis; moves the arrays of the batch.
"""

from __future__ import annotations

import math

from numba import njit

from machines.gcode import language, refusals, tally

MOST_CHORDS = 50_000
ARC_TOLERANCE_MM = 0.002  # $12 as GRBL ships it
_OVER = 1.05  # times an axis's rate: moves that are slowed down by less are not reported


@njit(cache=True, nogil=True, inline="always")
def note_event(events, which, line):  # type: ignore[no-untyped-def]
    if events[which, 1] == 0:
        events[which, 0] = line
    events[which, 1] += 1


@njit(cache=True, nogil=True, inline="always")
def is_plain(state):  # type: ignore[no-untyped-def]
    """Return whether blocks are absolute, in mm, with feeds per minute, and the program has not ended: then straight
    moves may take the fast path.
    """
    metric = state[language.MM] == 1.0 and state[language.FEED_MODE] == 94.0
    return metric and state[language.ABSOLUTE] == 1.0 and state[language.ENDED] == 0.0


@njit(cache=True, nogil=True, inline="always")
def is_spindle_off(state):  # type: ignore[no-untyped-def]
    return state[language.SPINDLE] == 5.0 or state[language.SPEED] == 0.0


@njit(cache=True, nogil=True, inline="always")
def row_of(bounds, state):  # type: ignore[no-untyped-def]
    """Return the bounds of the frame that moves are in."""
    shifted = state[language.SHIFTED] == language.MOVED
    return bounds[tally.SHIFTED_ROW if shifted else min(int(state[language.WCS]) - 54, tally.SHIFTED_ROW)]


@njit(cache=True, nogil=True, inline="always")
def widen(row, d, value):  # type: ignore[no-untyped-def]
    if value < row[d]:
        row[d] = value
    if value > row[3 + d]:
        row[3 + d] = value


@njit(cache=True, nogil=True)
def add_entry(n, place, rapid_, feed_, line_, spindle_, pause_, sent_, moves):  # type: ignore[no-untyped-def]
    """Write entry n of the batch, which ends at `place`; returns n + 1."""
    points, rapid, feed, line, spindle, pause, sent = moves
    for d in range(3):
        points[n + 1, d] = place[d]
    rapid[n] = rapid_
    feed[n] = feed_
    line[n] = line_
    spindle[n] = spindle_
    pause[n] = pause_
    sent[n] = sent_
    return n + 1


@njit(cache=True, nogil=True)
def add_straight(n, start, end, cut, feed, line, state, place, totals, events, bounds, rates, moves):  # type: ignore[no-untyped-def]
    """Add one straight move: entry, totals, bounds. `place` follows with unknown axes left where they were."""
    blind = False
    jumps = False
    moved = False
    placed = False
    length2 = 0.0
    row = bounds[
        tally.SHIFTED_ROW
        if state[language.SHIFTED] == language.MOVED
        else min(int(state[language.WCS]) - 54, tally.SHIFTED_ROW)
    ]
    for d in range(3):
        value = end[d]
        if start[d] != start[d]:
            blind = True
            if value == value:
                placed = True
                if value != place[d]:
                    place[d] = value
                    jumps = True
        else:
            if start[d] != place[d]:  # the frame has moved
                place[d] = start[d]
                jumps = True
            if value == value and value != start[d]:
                moved = True
                length2 += (value - start[d]) * (value - start[d])
        if value < row[d]:
            row[d] = value
        if value > row[3 + d]:
            row[3 + d] = value
    if jumps:  # from an unknown position, or one in a frame that has moved: counts no time here
        n = add_entry(n, place, False, 0.0, line, False, 0.0, totals[tally.SENT_BYTES], moves)
    length = math.sqrt(length2)
    totals[tally.PATH_MM] += length
    totals[tally.LAST_Z] = end[2]
    if moved or placed:
        totals[tally.MOTIONS] += 1.0
    if cut:
        if blind:
            note_event(events, tally.BLIND_CUT, line)
        # A level move over the work zero, at the greatest height so far, is a way in the air: a trace, no cut.
        aloft = start[2] == row[5] and end[2] == row[5] and end[2] > 0.0
        if (state[language.SPINDLE] == 5.0 and not aloft) or (
            state[language.SPINDLE] != 5.0 and state[language.SPEED] == 0.0
        ):
            note_event(events, tally.SPINDLE_OFF, line)
        totals[tally.CUT_MM] += length
        if feed < totals[tally.LEAST_FEED]:
            totals[tally.LEAST_FEED] = feed
        if feed > totals[tally.MOST_FEED]:
            totals[tally.MOST_FEED] = feed
        over = False
        for d in range(3):
            if abs(end[d] - start[d]) * feed > _OVER * rates[d] * length:
                over = True
        if over and length > 0.0:
            note_event(events, tally.OVER_RATE, line)
    if moved:
        for d in range(3):
            if start[d] == start[d] and end[d] == end[d]:
                place[d] = end[d]
        spindle = state[language.SPINDLE] != 5.0
        n = add_entry(n, place, not cut, feed if cut else 0.0, line, spindle, -1.0, totals[tally.SENT_BYTES], moves)
    return n


@njit(cache=True, nogil=True)
def add_arc(n, out, line, start, end, state, place, totals, events, bounds, rates, moves):  # type: ignore[no-untyped-def]
    """Add an arc as chords, cut as GRBL's mc_arc cuts it. Returns n, or -1 when it has too many."""
    plane = state[language.PLANE]
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
        feed = out[language.BLOCK_FEED]
        n = add_straight(n, start, end, True, feed, line, state, place, totals, events, bounds, rates, moves)
        for d in range(3):
            start[d] = end[d]
    return n


@njit(cache=True, nogil=True)
def add_jump(n, out, kind, line, state, place, totals, events, bounds, moves):  # type: ignore[no-untyped-def]
    """Add a move to a position that only the controller knows (G28, G30), or in machine coordinates (G53)."""
    row = bounds[tally.MACHINE_ROW]
    if kind == language.JUMP:
        row = row_of(bounds, state)
    note_event(events, tally.PLACE_UNKNOWN if kind == language.JUMP else tally.MACHINE_MOVES, line)
    for d in range(3):
        widen(row, d, out[language.END + d])
    if kind == language.JUMP and state[language.Z] != state[language.Z]:
        totals[tally.LAST_Z], totals[tally.LAST_MACHINE_Z] = math.nan, math.inf
    elif kind == language.MACHINE and out[language.END + 2] == out[language.END + 2]:
        totals[tally.LAST_Z], totals[tally.LAST_MACHINE_Z] = math.nan, out[language.END + 2]
    spindle = state[language.SPINDLE] != 5.0
    return add_entry(n, place, False, 0.0, line, spindle, 0.0, totals[tally.SENT_BYTES], moves)


@njit(cache=True, nogil=True)
def note_assumed(state, g, n_g, events, line):  # type: ignore[no-untyped-def]
    """Note coordinates that come before the program has stated their unit or their reference."""
    stated = int(state[language.STATED])
    for k in range(n_g):
        if g[k] == 200 or g[k] == 210:
            stated |= language.STATED_UNITS
        elif g[k] == 900 or g[k] == 910:
            stated |= language.STATED_DISTANCE
    if not stated & language.STATED_UNITS:
        note_event(events, tally.UNITS_ASSUMED, line)
    if not stated & language.STATED_DISTANCE:
        note_event(events, tally.DISTANCE_ASSUMED, line)


@njit(cache=True, nogil=True)
def note_block(seen, m, n_m, out, line, state, totals, events):  # type: ignore[no-untyped-def]
    """Note events and spindle speeds of a block that the general interpreter has executed."""
    flags = int(out[language.FLAGS])
    if seen & 1 << 13:
        note_event(events, tally.NUMBERED, line)
    if flags & language.WITHHOLDS:
        note_event(events, tally.STOPS, line)
    if flags & language.WRITES:
        note_event(events, tally.SETTINGS_WRITTEN, line)
    if state[language.SHIFTED] == language.MOVED and events[tally.FRAME_MOVED, 1] == 0:
        note_event(events, tally.FRAME_MOVED, line)
    for k in range(n_m):
        if m[k] == 70:
            note_event(events, tally.MIST, line)
    totals[tally.LONGEST_PAUSE_S] = max(totals[tally.LONGEST_PAUSE_S], out[language.PAUSE])
    if state[language.SPINDLE] != 5.0:
        totals[tally.LEAST_RPM] = min(totals[tally.LEAST_RPM], state[language.SPEED])
        totals[tally.MOST_RPM] = max(totals[tally.MOST_RPM], state[language.SPEED])


@njit(cache=True, nogil=True)
def check_motion(seen, out, rules, line, state, events, start, end):  # type: ignore[no-untyped-def]
    """Record the motion, from `start` to `end`, of a block that the general interpreter has executed; return a refusal
    code or 0.
    """
    kind = int(out[language.KIND])
    if kind == language.MACHINE and rules[tally.RULE_G53] != 0 and state[language.ABSOLUTE] == 0.0:
        return refusals.G53_RELATIVE
    if kind == language.NONE or kind == language.DWELL or kind == language.JUMP or kind == language.MACHINE:
        return 0
    cuts = (kind == language.CUT or kind == language.ARC) and state[language.ENDED] == 0.0
    if cuts and rules[tally.RULE_SPINDLE] != 0 and is_spindle_off(state):
        return refusals.SPINDLE_FIRST
    blind = False
    for d in range(3):
        start[d] = out[language.START + d]
        end[d] = out[language.END + d]
        if (seen >> (23 + d)) & 1 and end[d] != end[d]:
            blind = True
    if blind:
        note_event(events, tally.BLIND_RELATIVE, line)
    if kind == language.ARC and seen & 1 << 17 and rules[tally.RULE_NO_R] != 0:
        return refusals.ARC_BY_R
    if kind == language.PROBE:
        note_event(events, tally.PLACE_UNKNOWN, line)
    return 0
