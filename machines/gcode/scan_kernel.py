"""The compiled part of the scanner: bytes to moves, statistics and modal state in one pass.

Never imported by the streaming process. What a block means is language.block, compiled here from the same source that
the interpreter runs; only straight moves in plain modes take a short way of their own, as they do there.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from machines.gcode import language, refusals, tally
from machines.gcode.scan_moves import (
    MOST_CHORDS,
    add_arc,
    add_entry,
    add_jump,
    add_straight,
    is_plain,
    is_spindle_off,
    note_event,
)
from machines.gcode.scan_text import MOST_CODE, read_code, read_words

POWERS = 10.0 ** np.arange(19)

_STRAIGHT = sum(1 << (ord(letter) - 65) for letter in "XYZF")

_block = njit(cache=True, nogil=True)(language.block)


@njit(cache=True, nogil=True)
def scan(raw, most_lines, rules, own, rates, powers, state, place, totals, events, bounds, moves):  # type: ignore[no-untyped-def]
    """Read whole lines of raw, at most `most_lines`. Returns (bytes used, entries, refusal code, start of that line).

    moves : arrays of the batch, written from entry 0; state .. bounds : see scan_moves
    """
    tables = (state, place, totals, events, bounds, rates, moves)
    n = 0
    at = 0
    room = moves[1].size - MOST_CHORDS - 8
    done_lines = 0
    values = np.zeros(26)
    g = np.empty(16, dtype=np.int64)
    m = np.empty(16, dtype=np.int64)
    out = np.zeros(language.OUT_SIZE)
    code = np.empty(MOST_CODE + 1, dtype=np.uint8)
    start = np.empty(3)
    end = np.empty(3)
    for d in range(3):
        moves[0][0, d] = place[d]
    plain = is_plain(state)
    while n < room and done_lines < most_lines:
        begin = at
        line_end, size, refusal = read_code(raw, begin, code)
        if refusal:
            return begin, n, refusal, begin
        if line_end < 0:
            break
        at = line_end + 1
        done_lines += 1
        if size == 0:
            totals[tally.LINES] += 1.0
            continue
        if size > rules[tally.RULE_LENGTH]:
            return begin, n, refusals.LONG, begin
        if size == 1 and code[0] == 37:
            refusal = _take_tape_mark(rules, state, totals)
            if refusal:
                return begin, n, refusal, begin
            plain = is_plain(state)
            continue
        line = int(totals[tally.LINES]) + 1
        seen, n_g, n_m, refusal = read_words(code, size, rules, powers, values, g, m)
        if refusal:
            return begin, n, refusal, begin
        totals[tally.BLOCKS] += 1.0
        totals[tally.SENT_BYTES] += size + 1.0
        axes = (seen >> 23) & 7
        if axes and (int(state[language.STATED]) & 3) != 3:
            _note_assumed(state, g, n_g, events, line)
        mode = state[language.MOTION]
        if n_g == 1 and (g[0] == 0 or g[0] == 10):
            mode = float(g[0])
        alone = n_m == 0 and (n_g == 0 or (n_g == 1 and g[0] <= 10))
        if plain and axes and seen & ~_STRAIGHT == 0 and alone and mode <= 10.0:
            refusal = _take_straight(values, seen, mode, rules, state, start, end)
            if refusal:
                return begin, n, refusal, begin
            n = add_straight(n, start, end, mode > 0.0, state[language.FEED] if mode > 0.0 else 0.0, line, tables)
        else:
            refusal = _block(state, values, seen, g, n_g, m, n_m, own, rules[tally.RULE_N], out)
            if refusal:
                return begin, n, refusal, begin
            plain = is_plain(state)
            if int(out[language.FLAGS]) & language.WAITS or out[language.KIND] == language.DWELL:
                n = add_entry(n, False, 0.0, line, state[language.SPINDLE] != 5.0, out[language.PAUSE], tables)
            _note_block(seen, m, n_m, out, line, tables)
            n, refusal = _add_motion(n, seen, out, rules, line, start, end, tables)
            if refusal:
                return begin, n, refusal, begin
        totals[tally.LINES] += 1.0
    return at, n, 0, 0


@njit(cache=True, nogil=True)
def _take_tape_mark(rules, state, totals):  # type: ignore[no-untyped-def]
    """A line that is only %. Returns a refusal code, or 0."""
    if rules[tally.RULE_PERCENT] == 0:
        return refusals.PERCENT
    if int(state[language.ENDED]) & language.TAPE_ENDED:
        return refusals.MISPLACED_PERCENT
    if totals[tally.BLOCKS] > 0.0 and rules[tally.RULE_NAMED] + rules[tally.RULE_NAME_MOST] > 0:
        state[language.ENDED] = float(int(state[language.ENDED]) | language.TAPE_ENDED)
    totals[tally.LINES] += 1.0
    totals[tally.BLOCKS] += 1.0
    totals[tally.SENT_BYTES] += 2.0
    return 0


@njit(cache=True, nogil=True)
def _note_assumed(state, g, n_g, events, line):  # type: ignore[no-untyped-def]
    """Coordinates before the program has said their unit, or from where they count."""
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
def _take_straight(values, seen, mode, rules, state, start, end):  # type: ignore[no-untyped-def]
    """The short way: a straight move, absolute, in mm. Returns a refusal code, or 0."""
    if seen & 32:
        if not values[5] > 0.0:
            return refusals.BAD_FEED
        state[language.FEED] = values[5]
    if mode > 0.0 and not state[language.FEED] > 0.0:
        return refusals.NO_FEED
    state[language.MOTION] = mode
    for d in range(3):
        start[d] = state[d]
        if (seen >> (23 + d)) & 1:
            if abs(values[23 + d]) > 100000.0:
                return refusals.OUT_OF_RANGE
            state[d] = values[23 + d]
        end[d] = state[d]
    if mode > 0.0 and rules[tally.RULE_SPINDLE] != 0 and is_spindle_off(state):
        return refusals.SPINDLE_FIRST
    return 0


@njit(cache=True, nogil=True)
def _note_block(seen, m, n_m, out, line, tables):  # type: ignore[no-untyped-def]
    """Events and spindle speeds of a block that has taken the general way."""
    state, _, totals, events, _, _, _ = tables
    flags = int(out[language.FLAGS])
    if seen & 1 << 13:
        note_event(events, tally.NUMBERED, line)
    if flags & language.WITHHOLDS:
        note_event(events, tally.STOPS, line)
    if flags & language.WRITES:
        note_event(events, tally.SETTINGS_WRITTEN, line)
    if state[language.SHIFTED] > 0.0 and events[tally.FRAME_MOVED, 1] == 0:
        note_event(events, tally.FRAME_MOVED, line)
    if state[language.WCS] != 54.0 and (seen >> 23) & 7:
        note_event(events, tally.OTHER_OFFSET, line)
    for k in range(n_m):
        if m[k] == 70:
            note_event(events, tally.MIST, line)
    if state[language.SPINDLE] != 5.0:
        totals[tally.LEAST_RPM] = min(totals[tally.LEAST_RPM], state[language.SPEED])
        totals[tally.MOST_RPM] = max(totals[tally.MOST_RPM], state[language.SPEED])


@njit(cache=True, nogil=True)
def _add_motion(n, seen, out, rules, line, start, end, tables):  # type: ignore[no-untyped-def]
    """What a block that has taken the general way moves. Returns (entries, refusal code)."""
    state, _, _, events, _, _, _ = tables
    kind = int(out[language.KIND])
    if kind == language.JUMP or kind == language.MACHINE:
        if kind == language.MACHINE and rules[tally.RULE_G53] != 0 and state[language.ABSOLUTE] == 0.0:
            return n, refusals.G53_RELATIVE
        return add_jump(n, out, kind, line, tables), 0
    if kind not in (language.RAPID, language.CUT, language.PROBE, language.ARC):
        return n, 0
    cuts = (kind == language.CUT or kind == language.ARC) and state[language.ENDED] == 0.0
    if cuts and rules[tally.RULE_SPINDLE] != 0 and is_spindle_off(state):
        return n, refusals.SPINDLE_FIRST
    blind = False
    for d in range(3):
        start[d] = out[language.START + d]
        end[d] = out[language.END + d]
        if (seen >> (23 + d)) & 1 and end[d] != end[d]:
            blind = True
    if blind:
        note_event(events, tally.BLIND_RELATIVE, line)
    if kind == language.ARC:
        if seen & 1 << 17 and rules[tally.RULE_NO_R] != 0:
            return n, refusals.ARC_BY_R
        n = add_arc(n, out, line, end, tables)
        return (n, 0) if n >= 0 else (0, refusals.ARC_HUGE)
    if kind == language.PROBE:
        note_event(events, tally.PLACE_UNKNOWN, line)
    cut = kind != language.RAPID
    return add_straight(n, start, end, cut, out[language.BLOCK_FEED] if cut else 0.0, line, tables), 0
