"""The compiled reader of RML-1: commands to moves, in the form and with the modal state of the G-code reader.

The subset a finishing program needs: ^DF, ^PA, !MC, !RC, V, W, absolute Z with three whole numbers, and ^PR;Z0,0,n;
which lifts the tool to the top of the mill. That lift is not a move here, because the height of the top is not known.
The next move therefore starts higher than it seems, which is the safe side. A move to a height above every mill's
travel runs along its top and changes only X and Y. At V50, the highest speed, a move counts as a rapid. ^DF with the
spindle off after the last move ends the program.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from cam.reading.gcode_languages import (
    AFTER_END,
    BAD_NUMBERS,
    BLIND,
    LONG,
    NO_COMMAND,
    NO_SEMICOLON,
    NO_SPEED,
    NO_VELOCITY,
    RELATIVE,
)
from cam.reading.gcode_parse import ABSOLUTE, DWELT, ENDED, FEED, LINE, MOTION, RAISED, SPEED, SPINDLE, X, Y, Z, record

UNITS_PER_MM = 100.0
_NO_HEIGHT = 10_500.0  # and above: the mill stops at its top
_FASTEST_MM_PER_S = 50.0
_DEFAULTS, _ABSOLUTE, _RELATIVE, _MOTOR, _RPM, _SPEED, _WAIT, _MOVE = range(1, 9)


@njit(cache=True, nogil=True)
def _command(raw, p, size):  # type: ignore[no-untyped-def]
    """Return (the command that begins at p, or 0 if none does; the place after its name)."""
    c = raw[p]
    if c == 86:  # V
        return _SPEED, p + 1
    if c == 87:  # W
        return _WAIT, p + 1
    if c == 90:  # Z
        return _MOVE, p + 1
    if p + 2 < size:
        a, b = raw[p + 1], raw[p + 2]
        if c == 94:  # ^
            if a == 68 and b == 70:
                return _DEFAULTS, p + 3
            if a == 80 and b == 65:
                return _ABSOLUTE, p + 3
            if a == 80 and b == 82:
                return _RELATIVE, p + 3
        elif c == 33:  # !
            if a == 77 and b == 67:
                return _MOTOR, p + 3
            if a == 82 and b == 67:
                return _RPM, p + 3
    return 0, p


@njit(cache=True, nogil=True)
def _parse_numbers(raw, p, size, found):  # type: ignore[no-untyped-def]
    """Parse numbers between commas into found; return (how many or -1, whether all are whole, place after them)."""
    count = 0
    whole = True
    while True:
        negative = p < size and raw[p] == 45
        if negative:
            p += 1
        value, scale, digits = 0.0, 1.0, 0
        while p < size and (48 <= raw[p] <= 57 or (raw[p] == 46 and scale == 1.0)):
            if raw[p] == 46:
                scale = 0.1
                whole = False
            else:
                digits += 1
                if scale < 1.0:
                    value += scale * (raw[p] - 48)
                    scale *= 0.1
                else:
                    value = 10.0 * value + (raw[p] - 48)
            p += 1
        if digits == 0 or digits > 9 or count == 3:
            return -1, whole, p
        found[count] = -value if negative else value
        count += 1
        if p >= size or raw[p] != 44:
            return count, whole, p
        p += 1


@njit(cache=True, nogil=True)
def parse(raw, state, rules, powers, points, rapid, feed, line, spindle, pause):  # type: ignore[no-untyped-def]
    """Parse all whole lines of raw into moves. Returns (bytes used, moves, refusal code, start of the refused line)."""
    n = 0
    at = 0
    size = raw.size
    room = feed.size - 2
    found = np.zeros(3)
    for d in range(3):
        points[0, d] = state[d]
    while n < room:
        stop = at
        while stop < size and raw[stop] != 10:
            stop += 1
        if stop == size:
            break
        if stop - at > 80:
            return at, n, LONG, at
        p = at
        while p < stop:
            if n >= feed.size:
                return at, n, LONG, at
            c = raw[p]
            if c == 32 or c == 13 or c == 59:
                p += 1
                continue
            if state[ENDED]:
                return at, n, AFTER_END, at
            what, p = _command(raw, p, stop)
            if what == 0:
                return at, n, NO_COMMAND, at
            count, whole = 0, True
            if what >= _MOTOR:
                count, whole, p = _parse_numbers(raw, p, stop, found)
            if p >= stop or raw[p] != 59:
                return at, n, NO_SEMICOLON, at
            wanted = 3 if what == _MOVE else 1 if what >= _MOTOR else 0
            if count != wanted or (not whole and what != _SPEED):
                return at, n, BAD_NUMBERS, at
            known = not np.isnan(state[X] + state[Y] + state[Z])
            if what == _DEFAULTS:
                state[ABSOLUTE] = 1.0
                if state[MOTION] >= 0.0 and state[SPINDLE] == 0.0:
                    state[ENDED] = 1.0
            elif what == _ABSOLUTE:
                state[ABSOLUTE] = 1.0
            elif what == _RELATIVE:
                state[ABSOLUTE] = 0.0
            elif what == _SPEED:
                if not 0.1 <= found[0] <= _FASTEST_MM_PER_S:
                    return at, n, NO_VELOCITY, at
                state[FEED] = 60.0 * found[0]
            elif what == _RPM:
                state[SPEED] = found[0]
            elif what in (_MOTOR, _WAIT):
                seconds = 0.0
                if what == _WAIT:
                    seconds = found[0] / 1000.0
                elif found[0] == 1.0 and not state[SPEED] > 0.0:
                    return at, n, NO_SPEED, at
                if found[0] < 0.0 or (what == _MOTOR and found[0] > 1.0) or (what == _WAIT and found[0] < 1.0):
                    return at, n, BAD_NUMBERS, at
                if what == _MOTOR:
                    state[SPINDLE] = found[0]
                if known:
                    n = record(n, state, False, seconds, points, rapid, feed, line, spindle, pause)
                else:
                    state[DWELT] += seconds
            elif state[ABSOLUTE] == 0.0:
                if found[0] != 0.0 or found[1] != 0.0 or not found[2] > 0.0:
                    return at, n, RELATIVE, at
                state[RAISED] = found[2] >= _NO_HEIGHT
            else:
                if not state[FEED] > 0.0:
                    return at, n, NO_VELOCITY, at
                is_rapid = state[FEED] >= 60.0 * _FASTEST_MM_PER_S
                along_top = found[2] >= _NO_HEIGHT
                if (not known or along_top) and not is_rapid:
                    return at, n, BLIND, at
                if along_top and not state[RAISED]:
                    return at, n, RELATIVE, at
                state[RAISED] = along_top
                moved = False
                for d in range(2 if along_top else 3):
                    target = found[d] / UNITS_PER_MM
                    if target != state[d]:
                        moved = True
                    state[d] = target
                state[MOTION] = 0.0
                if np.isnan(state[Z]):
                    pass  # above its place, at an unknown height
                elif not known:
                    for d in range(3):
                        points[n, d] = state[d]
                    if state[DWELT] > 0.0:
                        n = record(n, state, False, state[DWELT], points, rapid, feed, line, spindle, pause)
                        state[DWELT] = 0.0
                elif moved:
                    n = record(n, state, is_rapid, -1.0, points, rapid, feed, line, spindle, pause)
        state[LINE] += 1
        at = stop + 1
    return at, n, 0, 0
