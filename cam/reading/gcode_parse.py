"""The compiled part of the G-code reader: bytes to moves, one pass, all modal state in a vector."""

from __future__ import annotations

import numpy as np
from numba import njit

from cam.reading.gcode_languages import (
    AFTER_END,
    ALONE,
    ARC,
    BAD_ARC,
    BAD_DWELL,
    BAD_FEED,
    BAD_NAME,
    BAD_OFFSET,
    BLENDS,
    BLIND,
    BLIND_ARC,
    CHANGES_IN_MIDDLE,
    COOLANT,
    DECIMALS,
    DECIMALS_LEFT_OUT,
    DWELL,
    DWELL_F,
    DWELL_MOVES,
    DWELL_X,
    GROUP_TWICE,
    HOME_MIDDLE,
    HUGE_ARC,
    LETTERS,
    LONG,
    NEEDS_POINT,
    NO_FEED,
    NO_LETTER,
    NO_MOTION,
    NO_NUMBER,
    NO_SPEED,
    NO_TOOL,
    OFFSET_CHANGES,
    OFFSETS_BY_H,
    OPEN_COMMENT,
    PERCENT,
    PERCENT_PLACE,
    POINTED,
    PRECISE,
    RAISED_WRONG,
    REPEATED,
    TAPE,
    TOOL_LATE,
    TOOLS,
    TWO_DIGITS,
    TWO_DIGITS_ONLY,
    USELESS_P,
    USELESS_WORD,
    WRONG_WORD,
)

# Slots of the modal state: position [mm], feed [mm/min], speed [rpm], mm per unit, 1 for G90, 0 to 3 for G0 to G3 (-1:
# none yet), spindle on, end seen, seconds dwelt before the position was known, % marks, work offset from 1 (0: none),
# head raised, tool (-1: none), a Z of the work frame reached, then gone where only the control knows, lines read.
(
    X, Y, Z, FEED, SPEED, UNIT, ABSOLUTE, MOTION, SPINDLE, ENDED, DWELT, TAPED, OFFSET, RAISED, TOOL, LOWERED,
    GONE, LINE,
) = range(18)  # fmt: skip
ARC_TOLERANCE_MM = 0.0005
MOST_CHORDS = 20_000
_AXES = 7 << 23
_ARC_WORDS = 1 << 8 | 1 << 9 | 1 << 17  # I, J, R
_T, _H = 1 << 19, 1 << 7
POWERS = 10.0 ** np.arange(19)


@njit(cache=True, nogil=True)
def record(n, state, is_rapid, seconds, points, rapid, feed, line, spindle, pause):  # type: ignore[no-untyped-def]
    """Record entry n, a move to the state's position or a pause there (seconds >= 0); return n + 1."""
    for d in range(3):
        points[n + 1, d] = state[d]
    rapid[n] = is_rapid
    feed[n] = state[FEED]
    line[n] = int(state[LINE]) + 1
    spindle[n] = state[SPEED] if state[SPINDLE] > 0.0 else 0.0
    pause[n] = seconds
    return n + 1


@njit(cache=True, nogil=True)
def record_arc(n, state, target, i, j, r, clockwise, points, rapid, feed, line, spindle, pause):  # type: ignore[no-untyped-def]
    """Record an arc in X and Y, or a helix, as chords within ARC_TOLERANCE_MM; return n, or minus a refusal's code.

    i, j : centre from the start; r : radius, above 0 for the shorter way, below for the longer; 0 where i, j count
    """
    dx, dy = target[0] - state[X], target[1] - state[Y]
    if r != 0.0:
        rest = 4.0 * r * r - dx * dx - dy * dy
        way = np.hypot(dx, dy)
        if way == 0.0 or rest < -1e-6 * r * r:
            return -BAD_ARC
        h = np.sqrt(max(rest, 0.0)) / way
        if clockwise == (r > 0.0):
            h = -h
        i, j = 0.5 * (dx - dy * h), 0.5 * (dy + dx * h)
    radius = np.hypot(i, j)
    differ = abs(np.hypot(dx - i, dy - j) - radius)
    if radius == 0.0 or differ > max(0.005, 0.001 * radius):
        return -BAD_ARC
    centre_x, centre_y = state[X] + i, state[Y] + j
    angle = np.arctan2(-j, -i)
    sweep = np.arctan2(-i * (dy - j) + j * (dx - i), -i * (dx - i) - j * (dy - j))
    if clockwise and sweep > -5e-7:
        sweep -= 2.0 * np.pi
    if not clockwise and sweep < 5e-7:
        sweep += 2.0 * np.pi
    chords = int(np.ceil(abs(sweep) / (2.0 * np.sqrt(2.0 * min(ARC_TOLERANCE_MM / radius, 0.5)))))
    if chords > MOST_CHORDS:
        return -HUGE_ARC
    z = state[Z]
    for k in range(1, chords + 1):
        share = k / chords
        state[X] = centre_x + radius * np.cos(angle + share * sweep)
        state[Y] = centre_y + radius * np.sin(angle + share * sweep)
        state[Z] = z + share * (target[2] - z)
        if k == chords:
            state[:3] = target
        n = record(n, state, False, -1.0, points, rapid, feed, line, spindle, pause)
    return n


@njit(cache=True, nogil=True)
def parse(raw, state, rules, powers, points, rapid, feed, line, spindle, pause):  # type: ignore[no-untyped-def]
    """Parse all whole lines of raw into moves. Returns (bytes used, moves, refusal code, start of the refused line)."""
    letters, pointed_letters, most_decimals = rules[LETTERS], rules[POINTED], rules[DECIMALS]
    two_digits = rules[TWO_DIGITS] != 0
    n = 0
    at = 0
    size = raw.size
    room = feed.size - 2 - MOST_CHORDS
    values = np.zeros(26)
    arc_end = np.empty(3)
    for d in range(3):
        points[0, d] = state[d]
    while n < room:
        # One line: bytes at..end. Words go to `values` by letter, G and M words to their groups.
        begin = at
        p = at
        seen = 0
        g_motion = -1
        g_dwell = False
        g_unit = 0.0
        g_distance = -1.0
        g_blend = False
        g_contour = False  # G5.1 Q
        g_ahead = False  # G8 P
        g_offset = False
        offset = 0
        g_machine = False  # Z in machine coordinates, for this line
        g_home = False  # G28
        g_length = False  # G43, or G56 where offsets are by H
        m_change = False
        m_stop = False
        percent = False
        m_spindle = -1
        m_end = False
        groups = 0
        closed = False  # the line end was found
        while p < size:
            c = raw[p]
            if c == 10:
                closed = True
                break
            if c == 32 or c == 9 or c == 13:
                p += 1
                continue
            if c == 59:  # ; comment to the line end
                while p < size and raw[p] != 10:
                    p += 1
                continue
            if c == 40:  # ( comment )
                while p < size and raw[p] != 10 and raw[p] != 41:
                    p += 1
                if p < size and raw[p] == 10:
                    return begin, n, OPEN_COMMENT, begin
                p += 1
                continue
            letter = c - 65
            if letter >= 32:
                letter -= 32  # lower case
            if c < 65 or letter < 0 or letter > 25:
                if c != 37:
                    return begin, n, NO_LETTER, begin
                if rules[TAPE] == 0:
                    return begin, n, PERCENT, begin
                if percent:
                    return begin, n, PERCENT_PLACE, begin
                percent = True
                p += 1
                continue
            if letter == 14 and rules[TAPE]:  # O, the program's name: letters and digits
                p += 1
                length = 0
                while p < size and (48 <= raw[p] <= 57 or 65 <= raw[p] <= 90):
                    p += 1
                    length += 1
                if seen or length < 1 or length > 16:
                    return begin, n, BAD_NAME, begin
                seen |= 1 << 14
                continue
            # The number after the letter.
            p += 1
            while p < size and (raw[p] == 32 or raw[p] == 9):
                p += 1
            negative = False
            if p < size and (raw[p] == 45 or raw[p] == 43):
                negative = raw[p] == 45
                p += 1
            mantissa = 0
            digits = 0
            decimals = 0
            pointed = False
            while p < size:
                c = raw[p]
                if 48 <= c <= 57:
                    mantissa = mantissa * 10 + (c - 48)
                    digits += 1
                    if pointed:
                        decimals += 1
                elif c == 46 and not pointed:
                    pointed = True
                else:
                    break
                p += 1
            if digits == 0 or digits > 17:
                return begin, n, NO_NUMBER, begin
            if (pointed_letters >> letter) & 1 and not pointed:
                return begin, n, NEEDS_POINT, begin
            if decimals > most_decimals + (1 if g_unit > 1.0 or (g_unit == 0.0 and state[UNIT] > 1.0) else 0):
                return begin, n, DECIMALS_LEFT_OUT, begin
            value = mantissa / powers[decimals]
            if negative:
                value = -value
            if two_digits and (letter == 6 or letter == 12) and digits - decimals < 2:
                return begin, n, TWO_DIGITS_ONLY, begin
            if letter == 6:  # G
                code = int(np.rint(value * 10.0))
                if abs(value * 10.0 - code) > 1e-9:
                    return begin, n, WRONG_WORD, p
                group = 0
                if code == 0 or code == 10 or code == 20 or code == 30:
                    g_motion = code // 10
                    group = 1
                elif code == 40:
                    g_dwell = True
                    group = 2
                elif code == 200:
                    g_unit = 25.4
                    group = 4
                elif code == 210:
                    g_unit = 1.0
                    group = 4
                elif code == 900:
                    g_distance = 1.0
                    group = 8
                elif code == 910:
                    g_distance = 0.0
                    group = 8
                elif code == 170:
                    group = 16
                elif 540 <= code <= 590 and code % 10 == 0 and not rules[OFFSETS_BY_H]:
                    offset = (code - 530) // 10
                    group = 32
                elif code == 150 and rules[OFFSETS_BY_H]:
                    g_offset = True
                    group = 32
                elif code == (160 if rules[OFFSETS_BY_H] else 530):
                    g_machine = True
                    group = 2
                elif code == 280:
                    g_home = True
                    group = 2
                elif code == (560 if rules[OFFSETS_BY_H] else 430) and rules[TOOLS]:
                    g_length = True
                    group = 1024
                elif code == 640 and rules[BLENDS]:
                    g_blend = True
                    group = 512
                elif code == 611 and rules[BLENDS]:
                    group = 512
                elif code == 51 and rules[PRECISE]:
                    g_contour = True
                    group = 512
                elif code == 80 and rules[PRECISE]:
                    g_ahead = True
                    group = 512
                elif code == 940:
                    group = 64
                elif code == 400 or code == 490 or code == 800:
                    group = 0
                else:
                    return begin, n, WRONG_WORD, p
                if groups & group:
                    return begin, n, GROUP_TWICE, begin
                groups |= group
                seen |= 1 << 6
            elif letter == 12:  # M
                group = 128
                if value == 3.0:
                    m_spindle = 1
                elif value == 5.0:
                    m_spindle = 0
                elif value == 2.0 or value == 30.0:
                    m_end = True
                    group = 256
                elif (value == 7.0 or value == 8.0 or value == 9.0) and rules[COOLANT]:
                    group = 0
                elif value == 6.0 and rules[TOOLS]:
                    m_change = True
                    group = 2048
                elif value == 0.0 or value == 1.0:
                    m_stop = True
                    group = 256
                else:
                    return begin, n, WRONG_WORD, p
                if groups & group:
                    return begin, n, GROUP_TWICE, begin
                groups |= group
                seen |= 1 << 12
            elif (letters >> letter) & 1:
                if seen & (1 << letter):
                    return begin, n, REPEATED, begin
                seen |= 1 << letter
                values[letter] = value
            else:
                return begin, n, WRONG_WORD, p
        if not closed:
            break
        stop = p
        if stop > begin and raw[stop - 1] == 13:
            stop -= 1
        if stop - begin > 79:
            return begin, n, LONG, begin
        if percent:
            if seen or (state[TAPED] == 0.0 and state[LINE] > 0.0) or (state[TAPED] > 0.0 and not state[ENDED]):
                return begin, n, PERCENT_PLACE, begin
            if state[TAPED] > 1.0:
                return begin, n, PERCENT_PLACE, begin
            state[TAPED] += 1.0
        if seen & (1 << 14) and (seen != 1 << 14 or state[MOTION] >= 0.0):
            return begin, n, BAD_NAME, begin
        if seen & ~(1 << 13 | 1 << 14):  # anything but an N word and a name
            if state[ENDED]:
                return begin, n, AFTER_END, begin
            motion = g_motion if g_motion >= 0 else state[MOTION]
            if (
                (seen & _H and not (g_offset or g_machine or g_length))
                or (seen & (1 << 16) and not (g_blend or g_contour))  # Q
                or (seen & _ARC_WORDS and motion < 2)
            ):
                return begin, n, USELESS_WORD, begin
            if seen & _T:
                state[TOOL] = values[19]
            if m_change or g_length:
                if m_change and state[RAISED] > 0.0 and state[SPINDLE] == 0.0 and rules[TOOLS] == CHANGES_IN_MIDDLE:
                    state[LOWERED] = state[GONE] = 0.0
                if state[LOWERED]:
                    return begin, n, TOOL_LATE, begin
                if (m_change and state[TOOL] < 0.0) or (g_length and not seen & _H):
                    return begin, n, NO_TOOL, begin
            if (g_contour or g_ahead) and seen & ~(1 << 13) != (1 << 6 | 1 << (16 if g_contour else 15)):
                return begin, n, ALONE, begin
            if (g_contour or g_ahead) and not 0.0 <= values[16 if g_contour else 15] <= 1.0:
                return begin, n, ALONE, begin
            if g_offset:
                offset = int(values[7]) if seen & (1 << 7) else 0
                if not 1 <= offset <= 6 or values[7] != offset:
                    return begin, n, BAD_OFFSET, begin
            if offset:
                if state[OFFSET] != offset and (state[OFFSET] > 0.0 or not np.isnan(state[Z])):
                    return begin, n, OFFSET_CHANGES, begin
                state[OFFSET] = offset
            axes = seen & (7 << 23)
            halt = -1.0
            if g_machine:
                goes_up = g_motion == 0 or (g_motion < 0 and state[MOTION] == 0.0)
                absolute = g_distance > 0.0 or (g_distance < 0.0 and state[ABSOLUTE] > 0.0)
                of_machine = rules[OFFSETS_BY_H] == 0 or (seen & (1 << 7) != 0 and values[7] == 0.0)
                if axes != 1 << 25 or not (goes_up and absolute and of_machine):
                    return begin, n, RAISED_WRONG, begin
                axes = 0
                state[RAISED] = 1.0
            if g_home:  # over the point given, and on to a place that only the control knows
                state[GONE] = state[LOWERED]
                state[RAISED] = 1.0
                axes = 0
            if state[GONE] and (axes or g_motion >= 0):
                return begin, n, HOME_MIDDLE, begin
            if m_stop:
                halt = max(halt, 0.0)
            if g_dwell:  # the seconds of G4: without it the word means something else
                if rules[DWELL] == DWELL_X:
                    if axes != 1 << 23:
                        return begin, n, BAD_DWELL, begin
                    halt = values[23]
                    axes = 0
                elif rules[DWELL] == DWELL_F:
                    if not seen & (1 << 5):
                        return begin, n, BAD_DWELL, begin
                    halt = values[5]
                    seen &= ~(1 << 5)
                else:
                    if not seen & (1 << 15):
                        return begin, n, BAD_DWELL, begin
                    halt = values[15]
                if halt < 0.0:
                    return begin, n, BAD_DWELL, begin
            if g_unit:
                state[UNIT] = g_unit
            if g_distance >= 0.0:
                state[ABSOLUTE] = g_distance
            if seen & (1 << 5):  # F
                if not values[5] > 0.0:
                    return begin, n, BAD_FEED, begin
                state[FEED] = values[5] * state[UNIT]
            if seen & (1 << 18):  # S
                if values[18] < 0.0:
                    return begin, n, NO_SPEED, begin
                state[SPEED] = values[18]
            if m_spindle >= 0:
                if m_spindle == 1 and not state[SPEED] > 0.0:
                    return begin, n, NO_SPEED, begin
                state[SPINDLE] = m_spindle
                halt = max(halt, 0.0)
            if g_dwell and (axes or g_motion >= 0):
                return begin, n, DWELL_MOVES, begin
            if seen & (1 << 15) and not (g_blend or g_ahead) and not (g_dwell and rules[DWELL] == 0):
                return begin, n, USELESS_P, begin
            if m_end and not axes:
                halt = max(halt, 0.0)
            if g_motion >= 0:
                state[MOTION] = g_motion
            if halt >= 0.0 and np.isnan(state[X] + state[Y] + state[Z]):
                state[DWELT] += halt
            elif halt >= 0.0:
                n = record(n, state, False, halt, points, rapid, feed, line, spindle, pause)
            if axes:
                if state[MOTION] < 0.0:
                    return begin, n, NO_MOTION, begin
                if axes & (1 << 25):
                    state[LOWERED], state[RAISED] = 1.0, 0.0
                is_cut = state[MOTION] >= 1.0
                is_arc = state[MOTION] >= 2.0
                if is_cut and not state[FEED] > 0.0:
                    return begin, n, NO_FEED, begin
                known = not np.isnan(state[X] + state[Y] + state[Z])
                if is_arc:
                    if not known:
                        return begin, n, BLIND_ARC, begin
                    if not seen & _ARC_WORDS or (seen & (1 << 17) and seen & (1 << 8 | 1 << 9)):
                        return begin, n, ARC, begin
                    for d in range(3):
                        arc_end[d] = state[d]
                        if seen & (1 << (23 + d)):
                            arc_end[d] = values[23 + d] * state[UNIT] + (0.0 if state[ABSOLUTE] else state[d])
                    i = values[8] * state[UNIT] if seen & (1 << 8) else 0.0
                    j = values[9] * state[UNIT] if seen & (1 << 9) else 0.0
                    r = values[17] * state[UNIT] if seen & (1 << 17) else 0.0
                    n = record_arc(
                        n, state, arc_end, i, j, r, state[MOTION] == 2.0, points, rapid, feed, line, spindle, pause
                    )
                    if n < 0:
                        return begin, 0, -n, begin
                    axes = 0
                moved = False
                for d in range(3 if axes else 0):
                    if seen & (1 << (23 + d)):
                        target = values[23 + d] * state[UNIT]
                        if not state[ABSOLUTE]:
                            target += state[d]
                            if np.isnan(target):
                                return begin, n, BLIND, begin
                        if target != state[d]:
                            moved = True
                        state[d] = target
                if not known and (is_cut or (np.isnan(state[Z]) and not state[RAISED])):
                    return begin, n, BLIND, begin
                if not known:
                    for d in range(3):
                        points[n, d] = state[d]
                if is_arc:
                    pass
                elif moved and known:
                    n = record(n, state, not is_cut, -1.0, points, rapid, feed, line, spindle, pause)
                elif state[DWELT] > 0.0 and not np.isnan(state[X] + state[Y] + state[Z]):
                    n = record(n, state, False, state[DWELT], points, rapid, feed, line, spindle, pause)
                    state[DWELT] = 0.0
            if m_end:
                state[ENDED] = 1.0
                state[SPINDLE] = 0.0
        state[LINE] += 1
        at = p + 1
    return at, n, 0, 0
