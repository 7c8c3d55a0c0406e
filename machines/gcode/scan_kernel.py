"""The compiled part of the scanner: bytes to moves, statistics and modal state in one pass.

Never imported by the streaming process. What a block means is language.block, compiled here from the same source that
the interpreter runs; only straight moves in plain modes take a short way of their own, as they do there.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from machines.gcode import language
from machines.gcode.language import (
    ABSOLUTE,
    ANGLE,
    ARC,
    BLOCK_FEED,
    CENTRE_U,
    CENTRE_V,
    CUT,
    DWELL,
    END,
    ENDED,
    FEED,
    FEED_MODE,
    FLAGS,
    JUMP,
    KIND,
    MACHINE,
    MM,
    MOTION,
    PAUSE,
    PLANE,
    PROBE,
    RADIUS,
    RAPID,
    SHIFTED,
    SPEED,
    SPINDLE,
    START,
    STATED,
    STATED_DISTANCE,
    STATED_UNITS,
    SWEEP,
    TAPE_ENDED,
    WAITS,
    WCS,
    WITHHOLDS,
    WRITES,
)
from machines.gcode.refusals import (
    ARC_BY_R,
    ARC_HUGE,
    BAD_FEED,
    BAD_NAME,
    BLOCK_DELETE,
    DECIMALS,
    DOLLAR,
    G53_RELATIVE,
    LONG,
    MISPLACED_PERCENT,
    NEEDS_POINT,
    NO_FEED,
    NO_LETTER,
    NO_NUMBER,
    OPEN_COMMENT,
    OUT_OF_RANGE,
    PERCENT,
    REPEATED,
    SPINDLE_FIRST,
    TWO_DIGITS,
    WRONG_G,
    WRONG_LETTER,
    WRONG_M,
)
from machines.gcode.tally import (
    BLIND_CUT,
    BLIND_RELATIVE,
    BLOCKS,
    CUT_MM,
    DISTANCE_ASSUMED,
    FRAME_MOVED,
    LEAST_FEED,
    LEAST_RPM,
    LINES,
    MACHINE_MOVES,
    MACHINE_ROW,
    MIST,
    MOST_FEED,
    MOST_RPM,
    NUMBERED,
    OTHER_OFFSET,
    OVER_RATE,
    PATH_MM,
    PLACE_UNKNOWN,
    RULE_BARE_ZERO,
    RULE_DECIMALS,
    RULE_G53,
    RULE_LENGTH,
    RULE_LETTERS,
    RULE_N,
    RULE_NAME_LEAST,
    RULE_NAME_MOST,
    RULE_NAMED,
    RULE_NO_R,
    RULE_PERCENT,
    RULE_POINT,
    RULE_SPINDLE,
    RULE_TWO_DIGITS,
    SENT_BYTES,
    SETTINGS_WRITTEN,
    SHIFTED_ROW,
    SPINDLE_OFF,
    STOPS,
    UNITS_ASSUMED,
)

POWERS = 10.0 ** np.arange(19)
MOST_CHORDS = 50_000
MOST_CODE = 1024  # characters of code in a line, before any dialect's own limit
ARC_TOLERANCE_MM = 0.002  # $12 as GRBL ships it

_STRAIGHT = sum(1 << (ord(letter) - 65) for letter in "XYZF")

_block = njit(cache=True, nogil=True)(language.block)


@njit(cache=True, nogil=True, inline="always")
def _event(events, which, line):  # type: ignore[no-untyped-def]
    if events[which, 1] == 0:
        events[which, 0] = line
    events[which, 1] += 1


@njit(cache=True, nogil=True)
def _entry(n, place, rapid_, feed_, line_, spindle_, pause_, sent_, moves):  # type: ignore[no-untyped-def]
    """Write entry n of the batch; returns n + 1."""
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
def _straight(n, start, end, cut, feed, line, state, place, totals, events, bounds, rates, moves):  # type: ignore[no-untyped-def]
    """One straight move: entry, totals, bounds. `place` follows with unknown axes left where they were."""
    blind = False
    jumps = False
    moved = False
    length2 = 0.0
    row = bounds[SHIFTED_ROW if state[SHIFTED] > 0.0 else min(int(state[WCS]) - 54, SHIFTED_ROW)]
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
        if value < row[d]:
            row[d] = value
        if value > row[3 + d]:
            row[3 + d] = value
    if jumps:  # from a place nobody knows, or that has a new name: takes no time here
        n = _entry(n, place, False, 0.0, line, False, 0.0, totals[SENT_BYTES], moves)
    length = math.sqrt(length2)
    totals[PATH_MM] += length
    if cut:
        totals[CUT_MM] += length
        if feed < totals[LEAST_FEED]:
            totals[LEAST_FEED] = feed
        if feed > totals[MOST_FEED]:
            totals[MOST_FEED] = feed
        if blind:
            _event(events, BLIND_CUT, line)
        # A level move over the work zero, at the greatest height so far, is a way in the air: a trace, no cut.
        aloft = start[2] == row[5] and end[2] == row[5] and end[2] > 0.0
        if (state[SPINDLE] == 5.0 or state[SPEED] == 0.0) and not aloft:
            _event(events, SPINDLE_OFF, line)
        over = False
        for d in range(3):
            if abs(end[d] - start[d]) * feed > rates[d] * length:
                over = True
        if over and length > 0.0:
            _event(events, OVER_RATE, line)
    if moved:
        for d in range(3):
            if start[d] == start[d] and end[d] == end[d]:
                place[d] = end[d]
        n = _entry(
            n, place, not cut, feed if cut else 0.0, line, state[SPINDLE] != 5.0, -1.0, totals[SENT_BYTES], moves
        )
    return n


@njit(cache=True, nogil=True)
def _arc(n, out, line, state, place, totals, events, bounds, rates, moves, end):  # type: ignore[no-untyped-def]
    """An arc as chords, cut as GRBL's mc_arc cuts it. Returns n, or -1 when it has too many."""
    u = 0
    v = 1
    if state[PLANE] == 18.0:
        u = 2
        v = 0
    elif state[PLANE] == 19.0:
        u = 1
        v = 2
    w = 3 - u - v
    radius = out[RADIUS]
    sweep = out[SWEEP]
    chords = 1
    if radius > ARC_TOLERANCE_MM:
        count = 0.5 * abs(sweep) * radius / math.sqrt(ARC_TOLERANCE_MM * (2.0 * radius - ARC_TOLERANCE_MM))
        if count > MOST_CHORDS:
            return -1
        chords = max(1, int(count))
    start = np.empty(3)
    for d in range(3):
        start[d] = out[START + d]
    low = out[START + w]
    rise = out[END + w] - low
    for k in range(1, chords + 1):
        if k == chords:
            for d in range(3):
                end[d] = out[END + d]
        else:
            angle = out[ANGLE] + sweep * k / chords
            end[u] = out[CENTRE_U] + radius * math.cos(angle)
            end[v] = out[CENTRE_V] + radius * math.sin(angle)
            end[w] = low + rise * k / chords
        n = _straight(n, start, end, True, out[BLOCK_FEED], line, state, place, totals, events, bounds, rates, moves)
        for d in range(3):
            start[d] = end[d]
    return n


@njit(cache=True, nogil=True)
def scan(raw, most_lines, rules, own, rates, powers, state, place, totals, events, bounds, moves):  # type: ignore[no-untyped-def]
    """Read whole lines of raw, at most `most_lines`. Returns (bytes used, entries, refusal code, start of that line).

    state (18,)       : language's modal state          place (3,)       : where the last entry ended
    totals, events, bounds : see above                   moves            : arrays of the batch, written from entry 0
    """
    n = 0
    at = 0
    size = raw.size
    room = moves[1].size - MOST_CHORDS - 8
    done_lines = 0
    values = np.zeros(26)
    g = np.empty(16, dtype=np.int64)
    m = np.empty(16, dtype=np.int64)
    out = np.zeros(language.OUT_SIZE)
    code = np.empty(MOST_CODE + 1, dtype=np.uint8)
    start = np.empty(3)
    end = np.empty(3)
    letters = rules[RULE_LETTERS]
    strict = rules[RULE_TWO_DIGITS] != 0 or rules[RULE_POINT] != 0 or rules[RULE_DECIMALS] < 17
    tapes = rules[RULE_NAMED] + rules[RULE_NAME_MOST] > 0
    points = moves[0]
    for d in range(3):
        points[0, d] = place[d]
    plain = state[MM] == 1.0 and state[ABSOLUTE] == 1.0 and state[FEED_MODE] == 94.0 and state[ENDED] == 0.0
    while n < room and done_lines < most_lines:
        begin = at
        p = at
        size_of_code = 0
        # The line without comments and blanks, in upper case.
        closed = False
        while p < size:
            c = raw[p]
            if c > 59:
                if 97 <= c <= 122:
                    c -= 32
            elif c == 10:
                closed = True
                break
            elif c == 32 or c == 13 or (9 <= c <= 12):
                p += 1
                continue
            elif c == 59:
                while p < size and raw[p] != 10:
                    p += 1
                continue
            elif c == 40:
                while p < size and raw[p] != 10 and raw[p] != 41:
                    p += 1
                if p < size and raw[p] == 10:
                    return begin, n, OPEN_COMMENT, begin
                p += 1
                continue
            if size_of_code >= MOST_CODE:
                return begin, n, LONG, begin
            code[size_of_code] = c
            size_of_code += 1
            p += 1
        if not closed:
            break
        at = p + 1
        done_lines += 1
        if size_of_code == 0:
            totals[LINES] += 1.0
            continue
        if size_of_code > rules[RULE_LENGTH]:
            return begin, n, LONG, begin
        line = int(totals[LINES]) + 1
        if size_of_code == 1 and code[0] == 37:
            if rules[RULE_PERCENT] == 0:
                return begin, n, PERCENT, begin
            if int(state[ENDED]) & TAPE_ENDED:
                return begin, n, MISPLACED_PERCENT, begin
            if totals[BLOCKS] > 0.0 and tapes:
                state[ENDED] = float(int(state[ENDED]) | TAPE_ENDED)
                plain = False
            totals[LINES] += 1.0
            totals[BLOCKS] += 1.0
            totals[SENT_BYTES] += 2.0
            continue
        # Words.
        seen = 0
        n_g = n_m = int(np.int64(0))  # a plain 0 is a type of its own to numba: the language would be compiled twice
        q = 0
        while q < size_of_code:
            c = code[q]
            letter = int(c) - 65
            if letter < 0 or letter > 25:
                if c == 37:
                    return begin, n, MISPLACED_PERCENT if rules[RULE_PERCENT] else PERCENT, begin
                if c == 36:
                    return begin, n, DOLLAR, begin
                if c == 47:
                    return begin, n, BLOCK_DELETE, begin
                return begin, n, NO_LETTER, begin
            q += 1
            if letter == 14 and tapes:
                if q > 1:
                    return begin, n, BAD_NAME, begin
                least = rules[RULE_NAME_LEAST]
                most = rules[RULE_NAME_MOST]
                if rules[RULE_NAMED] != 0:
                    least = 1
                    most = 16
                if not least <= size_of_code - 1 <= most:
                    return begin, n, BAD_NAME, begin
                for k in range(1, size_of_code):
                    if not (48 <= code[k] <= 57 or (rules[RULE_NAMED] != 0 and 65 <= code[k] <= 90)):
                        return begin, n, BAD_NAME, begin
                seen = 1 << 14
                break
            negative = False
            if q < size_of_code and (code[q] == 45 or code[q] == 43):
                negative = code[q] == 45
                q += 1
            mantissa = 0
            digits = 0
            decimals = -1
            while q < size_of_code:
                c = code[q]
                if 48 <= c <= 57:
                    mantissa = mantissa * 10 + (int(c) - 48)
                    digits += 1
                    if decimals >= 0:
                        decimals += 1
                elif c == 46 and decimals < 0:
                    decimals = 0
                else:
                    break
                q += 1
            if digits == 0 or digits > 17:
                return begin, n, NO_NUMBER, begin
            value = mantissa / powers[decimals] if decimals > 0 else float(mantissa)
            if negative:
                value = -value
            if letter == 6 or letter == 12:
                tenths = value * 10.0
                number = int(np.rint(tenths))
                wrong = WRONG_G if letter == 6 else WRONG_M
                if abs(tenths - number) > 1e-6 or number < 0 or n_g == 16 or n_m == 16:
                    return begin, n, wrong, begin
                if strict and rules[RULE_TWO_DIGITS] != 0 and (digits if decimals < 0 else digits - decimals) < 2:
                    return begin, n, TWO_DIGITS, begin
                if letter == 6:
                    g[n_g] = number
                    n_g += 1
                else:
                    m[n_m] = number
                    n_m += 1
                continue
            if not (letters >> letter) & 1:
                return begin, n, WRONG_LETTER, begin
            if (seen >> letter) & 1:
                return begin, n, REPEATED, begin
            if strict:
                if decimals < 0 and (rules[RULE_POINT] >> letter) & 1 and (value != 0.0 or rules[RULE_BARE_ZERO] == 0):
                    return begin, n, NEEDS_POINT, begin
                if decimals > rules[RULE_DECIMALS]:
                    return begin, n, DECIMALS, begin
            seen |= 1 << letter
            values[letter] = value
        totals[BLOCKS] += 1.0
        totals[SENT_BYTES] += size_of_code + 1.0
        axes = (seen >> 23) & 7
        if axes and (int(state[STATED]) & 3) != 3:
            stated = int(state[STATED])
            for k in range(n_g):
                if g[k] == 200 or g[k] == 210:
                    stated |= STATED_UNITS
                elif g[k] == 900 or g[k] == 910:
                    stated |= STATED_DISTANCE
            if not stated & STATED_UNITS:
                _event(events, UNITS_ASSUMED, line)
            if not stated & STATED_DISTANCE:
                _event(events, DISTANCE_ASSUMED, line)
        mode = state[MOTION]
        if n_g == 1 and (g[0] == 0 or g[0] == 10):
            mode = float(g[0])
        if (
            plain
            and axes
            and seen & ~_STRAIGHT == 0
            and n_m == 0
            and mode <= 10.0
            and (n_g == 0 or (n_g == 1 and g[0] <= 10))
        ):
            # The short way: a straight move, absolute, in mm.
            if seen & 32:
                if not values[5] > 0.0:
                    return begin, n, BAD_FEED, begin
                state[FEED] = values[5]
            cut = mode > 0.0
            if cut and not state[FEED] > 0.0:
                return begin, n, NO_FEED, begin
            state[MOTION] = mode
            for d in range(3):
                start[d] = state[d]
                if (axes >> d) & 1:
                    if abs(values[23 + d]) > 100000.0:
                        return begin, n, OUT_OF_RANGE, begin
                    state[d] = values[23 + d]
                end[d] = state[d]
            if cut and rules[RULE_SPINDLE] != 0 and (state[SPINDLE] == 5.0 or state[SPEED] == 0.0):
                return begin, n, SPINDLE_FIRST, begin
            feed = state[FEED] if cut else 0.0
            n = _straight(n, start, end, cut, feed, line, state, place, totals, events, bounds, rates, moves)
            totals[LINES] += 1.0
            continue
        refusal = _block(state, values, seen, g, n_g, m, n_m, own, rules[RULE_N], out)
        if refusal:
            return begin, n, refusal, begin
        plain = state[MM] == 1.0 and state[ABSOLUTE] == 1.0 and state[FEED_MODE] == 94.0 and state[ENDED] == 0.0
        flags = int(out[FLAGS])
        kind = int(out[KIND])
        if flags & WAITS or kind == DWELL:
            n = _entry(n, place, False, 0.0, line, state[SPINDLE] != 5.0, out[PAUSE], totals[SENT_BYTES], moves)
        if seen & 1 << 13:
            _event(events, NUMBERED, line)
        if flags & WITHHOLDS:
            _event(events, STOPS, line)
        if flags & WRITES:
            _event(events, SETTINGS_WRITTEN, line)
        if state[SHIFTED] > 0.0 and events[FRAME_MOVED, 1] == 0:
            _event(events, FRAME_MOVED, line)
        if state[WCS] != 54.0 and axes:
            _event(events, OTHER_OFFSET, line)
        for k in range(n_m):
            if m[k] == 70:
                _event(events, MIST, line)
        if state[SPINDLE] != 5.0:
            totals[LEAST_RPM] = min(totals[LEAST_RPM], state[SPEED])
            totals[MOST_RPM] = max(totals[MOST_RPM], state[SPEED])
        if kind in (RAPID, CUT, PROBE, ARC):
            cut = kind != RAPID
            still = state[SPINDLE] == 5.0 or state[SPEED] == 0.0
            if cut and rules[RULE_SPINDLE] != 0 and kind != PROBE and still and state[ENDED] == 0.0:
                return begin, n, SPINDLE_FIRST, begin
            blind = False
            for d in range(3):
                start[d] = out[START + d]
                end[d] = out[END + d]
                if (axes >> d) & 1 and end[d] != end[d]:
                    blind = True
            if blind:
                _event(events, BLIND_RELATIVE, line)
            if kind == ARC:
                if seen & 1 << 17 and rules[RULE_NO_R] != 0:
                    return begin, n, ARC_BY_R, begin
                n = _arc(n, out, line, state, place, totals, events, bounds, rates, moves, end)
                if n < 0:
                    return begin, 0, ARC_HUGE, begin
            else:
                feed = out[BLOCK_FEED] if cut else 0.0
                if kind == PROBE:
                    _event(events, PLACE_UNKNOWN, line)
                n = _straight(n, start, end, cut, feed, line, state, place, totals, events, bounds, rates, moves)
        elif kind in (JUMP, MACHINE):
            if kind == MACHINE and rules[RULE_G53] != 0 and state[ABSOLUTE] == 0.0:
                return begin, n, G53_RELATIVE, begin
            row = bounds[MACHINE_ROW]
            if kind == JUMP:
                row = bounds[SHIFTED_ROW if state[SHIFTED] > 0.0 else min(int(state[WCS]) - 54, SHIFTED_ROW)]
                _event(events, PLACE_UNKNOWN, line)
            else:
                _event(events, MACHINE_MOVES, line)
            for d in range(3):
                value = out[END + d]
                if value < row[d]:
                    row[d] = value
                if value > row[3 + d]:
                    row[3 + d] = value
            n = _entry(n, place, False, 0.0, line, state[SPINDLE] != 5.0, 0.0, totals[SENT_BYTES], moves)
        totals[LINES] += 1.0
    return at, n, 0, 0
