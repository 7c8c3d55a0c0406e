"""The shortest curve of bounded curvature from one place and heading to another (Dubins 1957).

Three pieces out of left arcs, right arcs and straights: one of the six words LSL, RSR, LSR, RSL, RLR, LRL. Formulas
after Shkel and Lumelsky (2001), lengths in radii.
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
"""At most, from point to point of an arc."""


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
    """Draw points of a curve, its begin left out, into out[count:]; return the new count."""
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
