"""The meaning of one block: the modal groups, the axis commands and the arcs of GRBL 1.1, once for all readers.

Plain functions on vectors of floats, without calls between them, so that the same source runs unchanged in the
streaming process (lists, no numpy) and compiled over whole programs in scan.py. Order and refusals follow gc.c.
"""

from __future__ import annotations

import math
from typing import Any

from machines.gcode import refusals

# Slots of the modal state. Positions in mm, nan where unknown; motion as 10 x G number; coolant: 1 mist + 2 flood.
(
    X, Y, Z, FEED, SPEED, MM, ABSOLUTE, MOTION, PLANE, FEED_MODE, WCS, SPINDLE, COOLANT, TOOL, TLO, SHIFTED, ENDED,
    STATED,
) = range(18)  # fmt: skip
STATE_SIZE = 18
# Slots of the effects of one block. START is in the frame the motion runs in; END is the programmed end (for G28 and
# G30 the point on the way, for G53 in machine coordinates); CENTRE_U .. SWEEP describe an arc in its plane; BLOCK_FEED
# is in mm/min (nan for rapids).
(
    KIND, PAUSE, FLAGS, END, CENTRE_U, CENTRE_V, RADIUS, ANGLE, SWEEP, BLOCK_FEED, LENGTH, START,
) = (0, 1, 2, 3, 6, 7, 8, 9, 10, 11, 12, 13)  # fmt: skip
OUT_SIZE = 16
NONE, RAPID, CUT, ARC, DWELL, JUMP, MACHINE, PROBE = range(8)  # JUMP: G28, G30. MACHINE: G53
WAITS, WITHHOLDS, ENDS, WRITES = 1, 2, 4, 8
STATED_UNITS, STATED_DISTANCE = 1, 2
# Effects of a dialect's own word.
# MACHINE_BY_H: H0 means G53. LENGTH_BY_H, CHANGE: a length from the control's table, and a tool.
ACCEPT, MOVES_FRAME, DWELL_MS, DWELL_BY_F, OFFSET_BY_H, MACHINE_BY_H, LENGTH_BY_H, CHANGE = range(1, 9)
# Values of SHIFTED: the program has moved its frame; or it has only taken its tool, and the tool's length, before its
# first Z, so that Z0 is still that of the work offset.
MOVED, TOOL_TAKEN = 1.0, 2.0
M2_READ, TAPE_ENDED = 1, 2  # bits of ENDED

_F, _H, _I, _J, _K, _L, _N, _O, _P, _R, _S, _T = (1 << (ord(letter) - 65) for letter in "FHIJKLNOPRST")
_X = 1 << 23
_AXES = 7 << 23
_FAR_MM = 100_000.0


def execute_block(
    state: Any, values: Any, seen: int, g: Any, n_g: int, m: Any, n_m: int, own: Any, n_limit: float, out: Any
) -> int:
    """Carry out one block on `state` and write what it does into `out`. Returns 0, or the refusal's code.

    values (26,) : numbers by letter, where `seen` has the letter's bit; G and M words apart as 10 x their number
    own (k, 4)   : words of the dialect: 10 x number (M: + 100 000), its effect or -refusal, letters it uses, whether
                   any may follow; it may refuse or extend any word but G0 to G3
    If a block is refused, state may be partly changed; nothing after it is read.
    """
    nan = math.nan
    for k in range(OUT_SIZE):
        out[k] = 0.0
    out[BLOCK_FEED] = nan
    for d in range(3):
        out[END + d] = state[d]
    if seen & ~_N == 0 and n_g == 0 and n_m == 0:
        if seen & _N and not (0.0 <= values[13] <= n_limit and values[13] == math.floor(values[13])):
            return refusals.BAD_N
        return 0
    if state[ENDED] > 0.0:
        return refusals.AFTER_END

    # Words to groups.
    groups = 0
    used = _F | _S | _T | _N | _O
    motion = -1
    single = -1  # of the group that holds for one block: G4, G10, G28, G30, G53, G92
    length_word = -1
    wcs = state[WCS]
    moves_frame = False
    takes_tool = False
    dwell = 0
    for k in range(n_g):
        code = g[k]
        bit = 0
        action = 0
        if code > 30:
            for j in range(len(own)):
                if own[j][0] == code:
                    action = own[j][1]
                    used |= own[j][2]
            if action < 0:
                return -action
            if action == MACHINE_BY_H and seen & _H and values[7] == 0.0:
                bit = 2
                single = 530
            elif action in (MOVES_FRAME, MACHINE_BY_H) or (action == LENGTH_BY_H and state[2] == state[2]):
                moves_frame = True
            elif action == LENGTH_BY_H:
                takes_tool = True
            elif action == OFFSET_BY_H:  # 1 to 6 are G54 to G59 elsewhere
                h = values[7] if seen & _H else 0.0
                if 1.0 <= h <= 6.0 and h == math.floor(h) and state[SHIFTED] != MOVED:
                    wcs = 53.0 + h
                else:
                    moves_frame = True
            elif action in (DWELL_MS, DWELL_BY_F):
                dwell = action
        if code == 0 or code == 10 or code == 20 or code == 30 or 382 <= code <= 385 or code == 800:
            bit = 1
            motion = code
        elif code in (40, 100, 280, 281, 300, 301, 530, 920, 921):
            bit = 2
            single = code
        elif code == 170 or code == 180 or code == 190:
            bit = 4
            state[PLANE] = code / 10
        elif code == 200 or code == 210:
            bit = 8
            state[MM] = 25.4 if code == 200 else 1.0
            state[STATED] = float(int(state[STATED]) | STATED_UNITS)
        elif code == 900 or code == 910:
            bit = 16
            state[ABSOLUTE] = 1.0 if code == 900 else 0.0
            state[STATED] = float(int(state[STATED]) | STATED_DISTANCE)
        elif code == 930 or code == 940:
            bit = 32
            if state[FEED_MODE] != code / 10:
                state[FEED] = nan
            state[FEED_MODE] = code / 10
        elif code == 431 or code == 490:
            bit = 64
            length_word = code
        elif 540 <= code <= 590 and code % 10 == 0:
            bit = 128
            if action == 0:  # G56 is a tool's length on an OSP control
                wcs = code / 10.0
        elif code == 911:
            bit = 256
        elif code == 400:
            bit = 512
        elif code == 610:
            bit = 1024
        elif action == 0:
            return refusals.WRONG_G
        if groups & bit:
            return refusals.GROUP_TWICE
        groups |= bit
    flags = 0
    spindle = state[SPINDLE]
    for k in range(n_m):
        code = m[k]
        bit = 0
        action = 0
        for j in range(len(own)):
            if own[j][0] == code + 100000:
                action = own[j][1]
                used |= own[j][2]
        if action < 0:
            return -action
        if action == MOVES_FRAME or (action == CHANGE and state[2] == state[2]):
            moves_frame = True
        elif action == CHANGE:
            takes_tool = True
        if code == 0 or code == 10:
            bit = 4096
            flags |= WITHHOLDS | WAITS
        elif code == 20 or code == 300:
            bit = 4096
            flags |= ENDS | WAITS
        elif code == 30 or code == 40 or code == 50:
            bit = 8192
            spindle = code / 10
            flags |= WAITS
        elif code == 70 or code == 80 or code == 90:
            bit = 16384
            flags |= WAITS
            state[COOLANT] = 0.0 if code == 90 else float(int(state[COOLANT]) | (1 if code == 70 else 2))
        elif action == 0:
            return refusals.WRONG_M
        if groups & bit:
            return refusals.GROUP_TWICE
        groups |= bit

    # A dwell by another letter than P: X in seconds or P in milliseconds, or F in seconds.
    pause = values[15] if seen & _P else -1.0
    if single == 40 and dwell == DWELL_MS:
        pause = values[15] / 1000.0 if seen & _P else values[23] if seen & _X else -1.0
        seen &= ~_X
    elif single == 40 and dwell == DWELL_BY_F:
        pause = values[5] if seen & _F else -1.0
        seen &= ~_F

    # Which command owns the coordinates.
    axes = (seen >> 23) & 7
    claimed = single == 100 or single == 280 or single == 300 or single == 920
    if length_word >= 0:
        if claimed:
            return refusals.TWO_AXIS_COMMANDS
        claimed = True
    if motion >= 0 and motion != 800:
        if claimed:
            return refusals.TWO_AXIS_COMMANDS
        if single == 40:
            return refusals.DWELL_MOVES
    if motion >= 0:
        state[MOTION] = motion
    if single == 40 and axes:
        return refusals.DWELL_MOVES

    # Numbers that stand for themselves.
    mm = state[MM]
    if seen & _N and not (0.0 <= values[13] <= n_limit and values[13] == math.floor(values[13])):
        return refusals.BAD_N
    if seen & _F:
        if not values[5] > 0.0:
            return refusals.BAD_FEED
        if state[FEED_MODE] == 94.0:
            state[FEED] = values[5] * mm
    if seen & _S:
        if values[18] < 0.0:
            return refusals.BAD_SPEED
        if values[18] != state[SPEED]:
            if state[SPINDLE] != 5.0 or spindle != 5.0:
                flags |= WAITS
            state[SPEED] = values[18]
    if seen & _T:
        if not (0.0 <= values[19] <= 255.0 and values[19] == math.floor(values[19])):
            return refusals.BAD_TOOL
        state[TOOL] = values[19]
    state[SPINDLE] = spindle
    if wcs != state[WCS]:
        state[WCS] = wcs
        for d in range(3):
            state[d] = nan
    if takes_tool and state[SHIFTED] == 0.0:
        state[SHIFTED] = TOOL_TAKEN
    if moves_frame:
        state[SHIFTED] = MOVED
        for d in range(3):
            state[d] = nan

    if single == 40:
        if pause < 0.0:
            return refusals.BAD_DWELL
        used |= _P
        flags |= WAITS
        out[KIND] = float(DWELL)
        out[PAUSE] = pause

    # Length offset and the frame.
    if length_word == 431:
        if not axes:
            return refusals.NO_AXES
        if axes != 4:
            return refusals.G43_AXES
        state[Z] += state[TLO] - values[25] * mm
        state[TLO] = values[25] * mm
        state[SHIFTED] = MOVED
        used |= _AXES
    elif length_word == 490:
        if state[TLO] != 0.0:
            state[SHIFTED] = MOVED
        state[Z] += state[TLO]
        state[TLO] = 0.0
    if single == 100:
        used |= _L | _P | _AXES
        if not axes:
            return refusals.NO_AXES
        if not seen & _L or not seen & _P or seen & _R or not 0.0 <= values[15] <= 6.0:
            return refusals.G10_WORDS
        if (values[11] != 2.0 and values[11] != 20.0) or values[15] != math.floor(values[15]):
            return refusals.G10_WORDS
        if values[15] == 0.0 or values[15] + 53.0 == state[WCS]:
            for d in range(3):
                if (axes >> d) & 1:
                    state[d] = values[23 + d] * mm if values[11] == 20.0 else nan
        state[SHIFTED] = MOVED
        flags |= WRITES | WAITS
    elif single == 920:
        used |= _AXES
        if not axes:
            return refusals.NO_AXES
        for d in range(3):
            if (axes >> d) & 1:
                state[d] = values[23 + d] * mm
        state[SHIFTED] = MOVED
    elif single == 921:
        for d in range(3):
            state[d] = nan
    elif single == 281 or single == 301:
        flags |= WRITES | WAITS

    # Motion.
    for d in range(3):
        out[START + d] = state[d]
        out[END + d] = state[d]
    if single == 280 or single == 300:
        used |= _AXES
        out[KIND] = float(JUMP)
        for d in range(3):
            if (axes >> d) & 1:
                value = values[23 + d] * mm
                out[END + d] = value if state[ABSOLUTE] > 0.0 else state[d] + value
            if axes == 0 or (axes >> d) & 1:
                state[d] = nan
    elif single == 530 and state[MOTION] != 0.0 and state[MOTION] != 10.0:
        return refusals.G53_MOTION
    if (axes and not used & _AXES) or (motion > 0 and motion != 800 and not claimed):
        mode = int(state[MOTION])
        if mode == 800:
            return refusals.NO_MOTION
        used |= _AXES
        feed = nan
        if mode != 0:
            if state[FEED_MODE] == 94.0:
                feed = state[FEED]
            elif seen & _F:
                feed = values[5]  # 1/min; becomes mm/min when the length is known
            if not feed > 0.0:
                return refusals.NO_FEED
        if mode >= 20 and not axes:
            return refusals.NO_AXES
        length2 = 0.0
        for d in range(3):
            target = state[d]
            if (axes >> d) & 1:
                target = values[23 + d] * mm
                if state[ABSOLUTE] == 0.0 and single != 530:
                    target += state[d]
                if abs(target) > _FAR_MM:
                    return refusals.OUT_OF_RANGE
            out[END + d] = target
            if target == target and state[d] == state[d]:
                length2 += (target - state[d]) ** 2
        out[LENGTH] = math.sqrt(length2)
        if mode == 20 or mode == 30:
            # Arc in the plane (u, v) with the helix axis w: gc.c, G2/G3; mc_arc for the angles.
            u = 0
            v = 1
            if state[PLANE] == 18.0:
                u = 2
                v = 0
            elif state[PLANE] == 19.0:
                u = 1
                v = 2
            w = 3 - u - v
            if not (axes >> u) & 1 and not (axes >> v) & 1:
                return refusals.ARC_NO_PLANE_AXIS
            du = out[END + u] - state[u]
            dv = out[END + v] - state[v]
            if not (du == du and dv == dv):
                return refusals.ARC_BLIND
            if (axes >> w) & 1 and state[w] != state[w]:
                return refusals.ARC_BLIND
            offsets = seen & (_I | _J | _K)
            cu = 0.0
            cv = 0.0
            if seen & _R:
                if offsets:
                    return refusals.ARC_R_WITH_CENTRE
                used |= _R
                if du == 0.0 and dv == 0.0:
                    return refusals.ARC_SAME_POINT
                radius = values[17] * mm
                rest = 4.0 * radius * radius - du * du - dv * dv
                if rest < 0.0:
                    return refusals.ARC_TOO_FAR
                h = -math.sqrt(rest) / math.hypot(du, dv)
                if mode == 30:
                    h = -h
                if radius < 0.0:
                    h = -h
                    radius = -radius
                cu = 0.5 * (du - dv * h)
                cv = 0.5 * (dv + du * h)
            else:
                if not offsets & ((_I << u) | (_I << v)):
                    return refusals.ARC_NO_CENTRE
                used |= _I | _J | _K
                if seen & (_I << u):
                    cu = values[8 + u] * mm
                if seen & (_I << v):
                    cv = values[8 + v] * mm
                radius = math.hypot(cu, cv)
                differ = abs(math.hypot(du - cu, dv - cv) - radius)
                if differ > 0.005 and (differ > 0.5 or differ > 0.001 * radius):
                    return refusals.ARC_RADII_DIFFER
            angle = math.atan2(-cv, -cu)
            sweep = math.atan2(-cu * (dv - cv) + cv * (du - cu), -cu * (du - cu) - cv * (dv - cv))
            if mode == 20:
                if sweep >= -5e-7:
                    sweep -= 2.0 * math.pi
            elif sweep <= 5e-7:
                sweep += 2.0 * math.pi
            out[CENTRE_U] = state[u] + cu
            out[CENTRE_V] = state[v] + cv
            out[RADIUS] = radius
            out[ANGLE] = angle
            out[SWEEP] = sweep
            rise = out[END + w] - state[w]
            if rise != rise:
                rise = 0.0
            out[LENGTH] = math.hypot(radius * sweep, rise)
            out[KIND] = float(ARC)
        elif axes:
            out[KIND] = float(RAPID if mode == 0 else CUT)
            if mode >= 382:
                out[KIND] = float(PROBE)
                flags |= WAITS
            if single == 530:
                out[KIND] = float(MACHINE)
        if state[FEED_MODE] == 93.0 and mode != 0:
            feed *= out[LENGTH]
        out[BLOCK_FEED] = feed
        if out[KIND] == MACHINE or out[KIND] == PROBE:
            out[LENGTH] = 0.0 if out[KIND] == MACHINE else out[LENGTH]
            for d in range(3):
                if out[KIND] == MACHINE and not (axes >> d) & 1:
                    out[END + d] = nan
                if (axes >> d) & 1:
                    state[d] = nan
        else:
            for d in range(3):
                state[d] = out[END + d]
    if seen & ~used:
        return refusals.UNUSED_WORD
    if flags & ENDS:
        state[MOTION], state[PLANE], state[ABSOLUTE], state[FEED_MODE] = 10.0, 17.0, 1.0, 94.0
        state[SPINDLE], state[COOLANT], state[ENDED] = 5.0, 0.0, float(M2_READ)
        if state[WCS] != 54.0:
            state[WCS] = 54.0
            for d in range(3):
                state[d] = nan
    out[FLAGS] = float(flags)
    return 0
