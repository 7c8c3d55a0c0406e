"""The joints of a tour: the shortest curve from one place and heading to another, and 2-opt moves against long ones.

A joint is the shortest curve of bounded curvature (Dubins 1957): three pieces out of left arcs, right arcs and
straights, one of the six words LSL, RSR, LSR, RSL, RLR, LRL. Formulas after Shkel and Lumelsky (2001), lengths in
radii.

A tour that always takes the nearest track leaves some behind and crosses the lens for them at the end. Its long joints
are shortened by 2-opt and Or-opt moves (Croes 1958, Or 1976). Only joints longer than an ordinary turn are tried, each
against all others. A joint has the same length backwards, so parts of a tour may be reversed.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

TURN = 2.0 * math.pi
LEFT, STRAIGHT, RIGHT = 1, 0, -1
WORDS = (
    (LEFT, STRAIGHT, LEFT),
    (RIGHT, STRAIGHT, RIGHT),
    (LEFT, STRAIGHT, RIGHT),
    (RIGHT, STRAIGHT, LEFT),
    (RIGHT, LEFT, RIGHT),
    (LEFT, RIGHT, LEFT),
)
ARC_STEP = math.radians(7.5)
"""Greatest distance between points of an arc."""
LONG_TURNS = 3.0
"""A joint is long from this multiple of a half circle on."""

LONGEST_PART = 4
"""Most stops that are moved elsewhere together."""

ROUNDS = 3
LEAST_GAIN = 0.02
"""Share of a half circle: a move that gains less is not made."""


@njit(cache=True, nogil=True, inline="always")
def _positive(angle):  # type: ignore[no-untyped-def]
    angle -= TURN * math.floor(angle / TURN)
    return 0.0 if angle > TURN - 1e-9 else angle


@njit(cache=True, nogil=True)
def shortest(x0, y0, h0, x1, y1, h1, radius):  # type: ignore[no-untyped-def]
    """Return (length, word, a, b, c): the three pieces in radii, in words of WORDS."""
    dx, dy = (x1 - x0) / radius, (y1 - y0) / radius
    d = math.hypot(dx, dy)
    theta = math.atan2(dy, dx) if d > 0.0 else 0.0
    al, be = h0 - theta, h1 - theta
    sa, sb, ca, cb = math.sin(al), math.sin(be), math.cos(al), math.cos(be)
    cab = math.cos(al - be)
    best, word, ba, bb, bc = np.inf, -1, 0.0, 0.0, 0.0
    for w in range(6):
        if w == 0:
            p2 = 2.0 + d * d - 2.0 * cab + 2.0 * d * (sa - sb)
            p = math.sqrt(max(p2, 0.0))
            t = math.atan2(cb - ca, d + sa - sb)
            a, b, c = _positive(t - al), p, _positive(be - t)
        elif w == 1:
            p2 = 2.0 + d * d - 2.0 * cab + 2.0 * d * (sb - sa)
            p = math.sqrt(max(p2, 0.0))
            t = math.atan2(ca - cb, d - sa + sb)
            a, b, c = _positive(al - t), p, _positive(t - be)
        elif w == 2:
            p2 = -2.0 + d * d + 2.0 * cab + 2.0 * d * (sa + sb)
            if p2 < 0.0:
                continue
            p = math.sqrt(p2)
            t = math.atan2(-ca - cb, d + sa + sb) - math.atan2(-2.0, p)
            a, b, c = _positive(t - al), p, _positive(t - be)
        elif w == 3:
            p2 = -2.0 + d * d + 2.0 * cab - 2.0 * d * (sa + sb)
            if p2 < 0.0:
                continue
            p = math.sqrt(p2)
            t = math.atan2(ca + cb, d - sa - sb) - math.atan2(2.0, p)
            a, b, c = _positive(al - t), p, _positive(be - t)
        elif w == 4:
            q = (6.0 - d * d + 2.0 * cab + 2.0 * d * (sa - sb)) / 8.0
            if abs(q) > 1.0:
                continue
            b = TURN - math.acos(q)
            a = _positive(al - math.atan2(ca - cb, d - sa + sb) + b / 2.0)
            c = _positive(al - be - a + b)
        else:
            q = (6.0 - d * d + 2.0 * cab + 2.0 * d * (sb - sa)) / 8.0
            if abs(q) > 1.0:
                continue
            b = TURN - math.acos(q)
            a = _positive(-al - math.atan2(ca - cb, d + sa - sb) + b / 2.0)
            c = _positive(be - al - a + b)
        if a + b + c < best:
            best, word, ba, bb, bc = a + b + c, w, a, b, c
    return best * radius, word, ba, bb, bc


@njit(cache=True, nogil=True)
def draw(x, y, h, radius, word, a, b, c, out, count):  # type: ignore[no-untyped-def]
    """Write the points of a curve, except its start, to out[count:]; return the new count."""
    pieces = (a, b, c)
    for k in range(3):
        length = pieces[k]
        way = WORDS[word][k]
        if length < 1e-9:
            continue
        if way == STRAIGHT:
            x += radius * length * math.cos(h)
            y += radius * length * math.sin(h)
            out[count, 0], out[count, 1] = x, y
            count += 1
            continue
        steps = int(math.ceil(length / ARC_STEP))
        for _ in range(steps):
            turn = way * length / steps
            x += way * radius * (math.sin(h + turn) - math.sin(h))
            y += way * radius * (math.cos(h) - math.cos(h + turn))
            h += turn
            out[count, 0], out[count, 1] = x, y
            count += 1
    return count


@njit(cache=True, nogil=True)
def shorten(into, out, radius, order, turned):  # type: ignore[no-untyped-def]
    """Change order (n + 1,), turned (n + 1,) so that the joints between the stops are shorter; the first stop stays.

    Stop k is entered by the pose into[k] and left by out[k], or the other way round if it is reversed.
    """
    n = order.size - 1
    half = math.pi * radius
    joint = np.zeros(n + 1)  # from stop i to the next; none after the last
    for i in range(n):
        joint[i] = _between(into, out, radius, order, turned, i, i + 1, False, False)
    for _ in range(ROUNDS):
        improved = False
        for i in range(n):
            while joint[i] > LONG_TURNS * half:
                if not (
                    _turn_part(into, out, radius, order, turned, joint, i, LEAST_GAIN * half)
                    or _move_part(into, out, radius, order, turned, joint, i, LEAST_GAIN * half)
                ):
                    break
                improved = True
        if not improved:
            return


@njit(cache=True, nogil=True, inline="always")
def _pose(into, out, order, turned, i, leaving, again):  # type: ignore[no-untyped-def]
    """Return the pose by which the i-th stop is entered or left, as it is or reversed."""
    k = order[i]
    back = turned[i] != again
    pose = out[k] if leaving != back else into[k]
    return pose[0], pose[1], pose[2] + math.pi if back else pose[2]


@njit(cache=True, nogil=True)
def _apart(into, out, order, turned, i, j, i_again, j_again):  # type: ignore[no-untyped-def]
    """Return the distance from the i-th stop to the j-th, the least length of a joint; none leads on from the last."""
    if j >= order.size:
        return 0.0
    x, y, _ = _pose(into, out, order, turned, i, True, i_again)
    px, py, _ = _pose(into, out, order, turned, j, False, j_again)
    return math.hypot(px - x, py - y)


@njit(cache=True, nogil=True)
def _between(into, out, radius, order, turned, i, j, i_again, j_again):  # type: ignore[no-untyped-def]
    """Return the length of the joint from the i-th stop to the j-th; there is none after the last."""
    if j >= order.size:
        return 0.0
    x, y, h = _pose(into, out, order, turned, i, True, i_again)
    px, py, ph = _pose(into, out, order, turned, j, False, j_again)
    return shortest(x, y, h, px, py, ph, radius)[0]


@njit(cache=True, nogil=True)
def _reverse(into, out, radius, order, turned, joint, a, b):  # type: ignore[no-untyped-def]
    """Reverse the part from the a-th stop to the b-th."""
    order[a : b + 1] = order[a : b + 1][::-1].copy()
    turned[a : b + 1] = ~turned[a : b + 1][::-1]
    joint[a:b] = joint[a:b][::-1].copy()
    for i in (a - 1, b):
        joint[i] = _between(into, out, radius, order, turned, i, i + 1, False, False)


@njit(cache=True, nogil=True)
def _turn_part(into, out, radius, order, turned, joint, i, least):  # type: ignore[no-untyped-def]
    """Reverse the part between joint i and another joint if that gains; return whether it did."""
    best, choice = least, -1
    for j in range(order.size):
        a, b = min(i, j), max(i, j)
        if a == b:
            continue
        now = joint[a] + joint[b]
        first = _apart(into, out, order, turned, a, b, False, True)
        if now - first - _apart(into, out, order, turned, a + 1, b + 1, True, False) <= best:
            continue
        gain = now - _between(into, out, radius, order, turned, a, b, False, True)
        gain -= _between(into, out, radius, order, turned, a + 1, b + 1, True, False)
        if gain > best:
            best, choice = gain, j
    if choice >= 0:
        _reverse(into, out, radius, order, turned, joint, min(i, choice) + 1, max(i, choice))
    return choice >= 0


@njit(cache=True, nogil=True)
def _move_part(into, out, radius, order, turned, joint, i, least):  # type: ignore[no-untyped-def]
    """Move some stops after joint i, or before it, into another joint if that gains; return whether it did."""
    n = order.size - 1
    best, first, last, place, again = least, -1, -1, -1, False
    for part in range(2 * LONGEST_PART):
        a = i + 1 if part < LONGEST_PART else i + LONGEST_PART - part
        b = i + 1 + part if part < LONGEST_PART else i
        if a < 1 or b > n:
            continue
        saved = joint[a - 1] + joint[b] - _between(into, out, radius, order, turned, a - 1, b + 1, False, False)
        if saved <= best:
            continue
        for j in range(n + 1):
            if a - 1 <= j <= b:
                continue
            room = saved + joint[j]
            for back in (False, True):
                head, tail = (b, a) if back else (a, b)
                near = _apart(into, out, order, turned, j, head, False, back)
                if room - near - _apart(into, out, order, turned, tail, j + 1, back, False) <= best:
                    continue
                gain = room - _between(into, out, radius, order, turned, j, head, False, back)
                gain -= _between(into, out, radius, order, turned, tail, j + 1, back, False)
                if gain > best:
                    best, first, last, place, again = gain, a, b, j, back
    if place < 0:
        return False
    # the part and the stops between it and its new place change places
    begin, end = (first, place) if place > last else (place + 1, last)
    long = last - first + 1
    _reverse(into, out, radius, order, turned, joint, begin, end)
    if place > last:
        _reverse(into, out, radius, order, turned, joint, begin, end - long)
        if not again:
            _reverse(into, out, radius, order, turned, joint, end - long + 1, end)
    else:
        _reverse(into, out, radius, order, turned, joint, begin + long, end)
        if not again:
            _reverse(into, out, radius, order, turned, joint, begin, begin + long - 1)
    return True
