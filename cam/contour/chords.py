"""Heights by exact contact along a path drawn in the plane, its chords cut until slope and sag keep the rule.

A chord is judged by what the surface does at its ends and its middle, and cut in as many parts as a constant curvature
would ask for. Curvature is not constant, so every part is judged again: where the surface bulges over a chord the tool
would cut into it. The surface of tips bulges no more than the ball itself, so parts of some micrometres always do; for
slope alone, or where a chord runs too high, parts on which a mill slows down are not worth it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cam.moves import Array
from cam.rows.vertices import TICKS_PER_MM, VertexRule
from cam.surface.contact import Ball, touch
from optics.heightfield import spline_jet

SHORTEST_MM = 0.014
"""No parts shorter than this for slope, nor where a chord runs too high: turns are drawn in such."""

SHORTEST_LOW_MM = 0.003
"""No parts shorter than this where a chord cuts too low: under a ball of 0.1 mm it is 11 nm."""

MOST_PARTS, WAITING = 64, 512
"""Parts cut at once; parts that wait to be judged, several times cut."""


def tips_along(ball: Ball, rule: VertexRule, xy: Array) -> Array:
    """Return (m, 3) tips over the vertices (n, 2) of a path, which lie on the writing raster, and where its chords are
    cut.
    """
    chords = np.hypot(*np.diff(xy, axis=0).T)
    out = np.empty((len(xy) + int(np.sum(chords // SHORTEST_LOW_MM)), 3))
    return out[: _cut_chords(ball, rule, xy, out)].copy()


@njit(cache=True, nogil=True)
def _lie(b, x, y, px, py, tip):  # type: ignore[no-untyped-def]
    """Compute tip (7,): x, y, z, contact, gradient: the tips' surface has at (x, y) that of the lens at the contact."""
    px, py, z = touch(b, x, y, px, py)[:3]
    jet = spline_jet(b.coefs, b.x0, b.y0, b.inv_dx, b.inv_dy, px, py)
    tip[0], tip[1], tip[2], tip[3], tip[4], tip[5], tip[6] = x, y, z, px, py, jet[1], jet[2]


@njit(cache=True, nogil=True, inline="always")
def _share(error, allowed, power, length, shortest):  # type: ignore[no-untyped-def]
    """Return the parts that an error falling with that power of their number needs, none shorter than the shortest."""
    if error <= allowed:
        return 1
    return min(math.ceil((error / allowed) ** power), math.floor(length / shortest))


@njit(cache=True, nogil=True)
def _parts(rule, a, m, b):  # type: ignore[no-untyped-def]
    """Return how many parts the chord from tip a to tip b, with tip m over its middle, needs."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.hypot(dx, dy)
    chord = (b[2] - a[2]) / length
    off_a = (a[5] * dx + a[6] * dy) / length - chord
    off_b = (b[5] * dx + b[6] * dy) / length - chord
    off_m = (m[5] * dx + m[6] * dy) / length - chord
    bulge = m[2] - 0.5 * (a[2] + b[2])
    low = max(bulge, 0.25 * length * max(off_a, -off_b))
    high = max(-bulge, 0.25 * length * max(-off_a, off_b))
    steep = max(abs(off_a), abs(off_b), abs(off_m))
    return max(
        _share(steep, rule.slope_rad, 1.0, length, SHORTEST_MM),
        _share(high, rule.sag_mm, 0.5, length, SHORTEST_MM),
        _share(low, rule.sag_mm, 0.5, length, SHORTEST_LOW_MM),
        1,
    )


@njit(cache=True, nogil=True)
def _cut_chords(b, rule, xy, out):  # type: ignore[no-untyped-def]
    """Write vertices with heights into out (n, 3); return n. Ends of chords wait on a stack, the nearest on top."""
    ends = np.empty((WAITING, 7))
    here, middle = np.empty(7), np.empty(7)
    _lie(b, xy[0, 0], xy[0, 1], xy[0, 0], xy[0, 1], here)
    out[0] = here[:3]
    count = 1
    for k in range(1, xy.shape[0]):
        _lie(b, xy[k, 0], xy[k, 1], here[3] + xy[k, 0] - here[0], here[4] + xy[k, 1] - here[1], ends[0])
        top = 0
        while top >= 0:
            end = ends[top]
            mid = 0.5 * (here + end)
            _lie(b, mid[0], mid[1], mid[3], mid[4], middle)
            parts = min(_parts(rule, here, middle, end), MOST_PARTS, WAITING - top)
            for part in range(parts - 1, 0, -1):
                t = part / parts
                x = math.floor((here[0] + t * (end[0] - here[0])) * TICKS_PER_MM + 0.5) / TICKS_PER_MM
                y = math.floor((here[1] + t * (end[1] - here[1])) * TICKS_PER_MM + 0.5) / TICKS_PER_MM
                px, py = here[3] + t * (end[3] - here[3]), here[4] + t * (end[4] - here[4])
                _lie(b, x, y, px, py, ends[top + parts - part])
            if parts > 1:
                top += parts - 1
                continue
            here[:] = end
            out[count] = here[:3]
            count += 1
            top -= 1
    return count
