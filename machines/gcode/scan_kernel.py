"""The compiled part of the scanner: bytes to moves, statistics and modal state in one pass.

Never imported by the streaming process. language.execute_block, compiled here from the same source that the interpreter
runs, interprets the blocks; only straight moves in plain modes take a fast path, as they do there. The code for nearly
every line is in one function, because calls that pass arrays halve the speed.
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
    check_motion,
    is_plain,
    is_spindle_off,
    note_assumed,
    note_block,
)

POWERS = 10.0 ** np.arange(19)
MOST_CODE = 1024  # characters of code in a line, before any dialect's own limit

_STRAIGHT = sum(1 << (ord(letter) - 65) for letter in "XYZF")

_block = njit(cache=True, nogil=True)(language.execute_block)


@njit(cache=True, nogil=True)
def _refuse_sign(c, rules):  # type: ignore[no-untyped-def]
    if c == 37:
        return refusals.MISPLACED_PERCENT if rules[tally.RULE_PERCENT] else refusals.PERCENT
    if c == 36:
        return refusals.DOLLAR
    return refusals.BLOCK_DELETE if c == 47 else refusals.NO_LETTER


@njit(cache=True, nogil=True)
def _is_name(code, size, rules):  # type: ignore[no-untyped-def]
    """Return whether the whole line is a program's name in this dialect: O and digits, or O and letters and digits."""
    named = rules[tally.RULE_NAMED] != 0
    least = 1 if named else rules[tally.RULE_NAME_LEAST]
    most = 16 if named else rules[tally.RULE_NAME_MOST]
    for k in range(1, size):
        if not (48 <= code[k] <= 57 or (named and 65 <= code[k] <= 90)):
            return False
    return least <= size - 1 <= most


@njit(cache=True, nogil=True)
def scan(raw, most_lines, rules, own, rates, powers, state, place, totals, events, bounds, moves):  # type: ignore[no-untyped-def]
    """Read whole lines of raw, at most `most_lines`. Returns (bytes used, entries, refusal code, start of that line).

    state .. moves : see scan_moves; the batch is written from entry 0
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
    letters = rules[tally.RULE_LETTERS]
    strict = rules[tally.RULE_TWO_DIGITS] != 0 or rules[tally.RULE_POINT] != 0 or rules[tally.RULE_DECIMALS] < 17
    tapes = rules[tally.RULE_NAMED] + rules[tally.RULE_NAME_MOST] > 0
    points = moves[0]
    for d in range(3):
        points[0, d] = place[d]
    plain = is_plain(state)
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
                    return begin, n, refusals.OPEN_COMMENT, begin
                p += 1
                continue
            if size_of_code >= MOST_CODE:
                return begin, n, refusals.LONG, begin
            code[size_of_code] = c
            size_of_code += 1
            p += 1
        if not closed:
            break
        at = p + 1
        done_lines += 1
        if size_of_code == 0:
            totals[tally.LINES] += 1.0
            continue
        if size_of_code > rules[tally.RULE_LENGTH]:
            return begin, n, refusals.LONG, begin
        line = int(totals[tally.LINES]) + 1
        if size_of_code == 1 and code[0] == 37:
            if rules[tally.RULE_PERCENT] == 0:
                return begin, n, refusals.PERCENT, begin
            if int(state[language.ENDED]) & language.TAPE_ENDED:
                return begin, n, refusals.MISPLACED_PERCENT, begin
            if totals[tally.BLOCKS] > 0.0 and tapes:
                state[language.ENDED] = float(int(state[language.ENDED]) | language.TAPE_ENDED)
                plain = False
            totals[tally.LINES] += 1.0
            totals[tally.BLOCKS] += 1.0
            totals[tally.SENT_BYTES] += 2.0
            continue
        # Words.
        seen = 0
        n_g = n_m = int(np.int64(0))  # a plain 0 is another type for numba: the language would be compiled twice
        q = 0
        while q < size_of_code:
            c = code[q]
            letter = int(c) - 65
            if letter < 0 or letter > 25:
                return begin, n, _refuse_sign(c, rules), begin
            q += 1
            if letter == 14 and tapes:
                if q > 1 or not _is_name(code, size_of_code, rules):
                    return begin, n, refusals.BAD_NAME, begin
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
                return begin, n, refusals.NO_NUMBER, begin
            value = mantissa / powers[decimals] if decimals > 0 else float(mantissa)
            if negative:
                value = -value
            if letter == 6 or letter == 12:
                tenths = value * 10.0
                number = int(np.rint(tenths))
                wrong = refusals.WRONG_G if letter == 6 else refusals.WRONG_M
                if abs(tenths - number) > 1e-6 or number < 0 or n_g == 16 or n_m == 16:
                    return begin, n, wrong, begin
                if strict and rules[tally.RULE_TWO_DIGITS] != 0 and (digits if decimals < 0 else digits - decimals) < 2:
                    return begin, n, refusals.TWO_DIGITS, begin
                if letter == 6:
                    g[n_g] = number
                    n_g += 1
                else:
                    m[n_m] = number
                    n_m += 1
                continue
            if not (letters >> letter) & 1:
                return begin, n, refusals.WRONG_LETTER, begin
            if (seen >> letter) & 1:
                return begin, n, refusals.REPEATED, begin
            if strict:
                bare = value != 0.0 or rules[tally.RULE_BARE_ZERO] == 0
                if decimals < 0 and (rules[tally.RULE_POINT] >> letter) & 1 and bare:
                    return begin, n, refusals.NEEDS_POINT, begin
                if decimals > rules[tally.RULE_DECIMALS]:
                    return begin, n, refusals.DECIMALS, begin
            seen |= 1 << letter
            values[letter] = value
        totals[tally.BLOCKS] += 1.0
        totals[tally.SENT_BYTES] += size_of_code + 1.0
        axes = (seen >> 23) & 7
        if axes and (int(state[language.STATED]) & 3) != 3:
            note_assumed(state, g, n_g, events, line)
        mode = state[language.MOTION]
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
            # The fast path: a straight move, absolute, in mm.
            if seen & 32:
                if not values[5] > 0.0:
                    return begin, n, refusals.BAD_FEED, begin
                state[language.FEED] = values[5]
            cut = mode > 0.0
            if cut and not state[language.FEED] > 0.0:
                return begin, n, refusals.NO_FEED, begin
            state[language.MOTION] = mode
            for d in range(3):
                start[d] = state[d]
                if (axes >> d) & 1:
                    if abs(values[23 + d]) > 100000.0:
                        return begin, n, refusals.OUT_OF_RANGE, begin
                    state[d] = values[23 + d]
                end[d] = state[d]
            if cut and rules[tally.RULE_SPINDLE] != 0 and is_spindle_off(state):
                return begin, n, refusals.SPINDLE_FIRST, begin
            feed = state[language.FEED] if cut else 0.0
            n = add_straight(n, start, end, cut, feed, line, state, place, totals, events, bounds, rates, moves)
            totals[tally.LINES] += 1.0
            continue
        refusal = _block(state, values, seen, g, n_g, m, n_m, own, rules[tally.RULE_N], out)
        if refusal:
            return begin, n, refusal, begin
        plain = is_plain(state)
        if int(out[language.FLAGS]) & language.WAITS or out[language.KIND] == language.DWELL:
            spindle, pause_s, sent = state[language.SPINDLE] != 5.0, out[language.PAUSE], totals[tally.SENT_BYTES]
            n = add_entry(n, place, False, 0.0, line, spindle, pause_s, sent, moves)
        note_block(seen, m, n_m, out, line, state, totals, events)
        refusal = check_motion(seen, out, rules, line, state, events, start, end)
        if refusal:
            return begin, n, refusal, begin
        kind = int(out[language.KIND])
        if kind == language.RAPID or kind == language.CUT or kind == language.PROBE:
            cut = kind != language.RAPID
            feed = out[language.BLOCK_FEED] if cut else 0.0
            n = add_straight(n, start, end, cut, feed, line, state, place, totals, events, bounds, rates, moves)
        elif kind == language.ARC:
            n = add_arc(n, out, line, start, end, state, place, totals, events, bounds, rates, moves)
            if n < 0:
                return begin, 0, refusals.ARC_HUGE, begin
        elif kind == language.JUMP or kind == language.MACHINE:
            n = add_jump(n, out, kind, line, state, place, totals, events, bounds, moves)
        totals[tally.LINES] += 1.0
    return at, n, 0, 0
