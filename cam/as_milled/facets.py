"""Computes what each chord of the path leaves on the surface: the part where its ball was lowest, as small facets.

Theory of operation. Across its track the ball leaves an interval of angles, see `rivals`. Along a chord the two ends of
the interval move, and the chord leaves the strip between them, see `strips`. Between two chords: if the path bends down
(a hill), each loses R / 2 times the bend to the other; if it bends up, the ball at the corner leaves a strip between
the two, which is treated like that of a chord.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cam.as_milled.strips import (
    FACTS,
    MOST_PARTS,
    STEEPEST,
    WIDEST,
    bend,
    facets_of_strip,
    find_shown,
    has_crossing,
    set_frame,
    strip_of_chord,
    strip_of_corner,
    turn_to_frame,
)
from cam.as_milled.tracks import gather
from optics.heightfield import spline_jet

_ROOM = 4096  # neighbours of one chord
_PER_CHORD = 6 * MOST_PARTS  # facets, of itself and of the ball at its end
_TURNED = 0.03  # rad: a frame that deviates more from the surface's normal is set up again
_CORNERS = 0.5  # of a chord's length: parts of the balls at its end, of which short chords leave narrow slivers
_WITHIN = 0.75  # of the reach: farther out a ball is taken to leave nothing, as rivals may be out of reach there
_SPARE = 0.01  # rad: added to the tilts at which a ball can leave anything


@njit(cache=True, nogil=True)
def slopes_at_contact(surface, x, y, radius, px, py, steps):  # type: ignore[no-untyped-def]
    """Return (px, py, zx, zy): roughly where a ball with its centre above (x, y) touches the lens, from the guess p."""
    zx = zy = 0.0
    for _ in range(steps):
        _, zx, zy, _, _, _ = spline_jet(surface[0], surface[1], surface[2], surface[3], surface[4], px, py)
        w = radius / math.sqrt(1.0 + zx * zx + zy * zy)
        px, py = x + w * zx, y + w * zy
    return px, py, zx, zy


@njit(cache=True, nogil=True)
def _rise(c, k, frame, reach):  # type: ignore[no-untyped-def]
    """Return the rise of the path out of the frame, per distance, from `reach` before chord k to `reach` behind it."""
    first = k - 1
    while (
        c.joined[first]
        and first > k - 12
        and math.hypot(c.tips[k, 0] - c.tips[first, 0], c.tips[k, 1] - c.tips[first, 1]) < reach
    ):
        first -= 1
    last = k
    while last + 1 < c.joined.size and c.joined[last + 1] and last < k + 12:
        if math.hypot(c.tips[k, 0] - c.tips[last, 0], c.tips[k, 1] - c.tips[last, 1]) >= reach:
            break
        last += 1
    wx, wy = c.tips[last, 0] - c.tips[first, 0], c.tips[last, 1] - c.tips[first, 1]
    wz = c.tips[last, 2] - c.tips[first, 2]
    ahead = frame[0, 0] * wx + frame[0, 1] * wy + frame[0, 2] * wz
    up = frame[2, 0] * wx + frame[2, 1] * wy + frame[2, 2] * wz
    left = frame[1, 0] * wx + frame[1, 1] * wy + frame[1, 2] * wz
    return up / ahead if ahead > abs(left) else 0.0


@njit(cache=True, nogil=True)
def _with_more_room(out, filled):  # type: ignore[no-untyped-def]
    more = np.empty((2 * out.shape[0], 4, 5))
    for f in range(filled):
        for k in range(4):
            for d in range(5):
                more[f, k, d] = out[f, k, d]
    return more


@njit(cache=True, nogil=True)
def _spread_along(out, first, last, c, k, steps_within):  # type: ignore[no-untyped-def]
    """Spread the slopes of facets first .. last - 1, which chord k leaves, from one end of each to the other."""
    dx, dy = c.tips[k, 0] - c.tips[k - 1, 0], c.tips[k, 1] - c.tips[k - 1, 1]
    way, group = math.hypot(dx, dy), c.group[k]
    slopes, half_widths = steps_within
    half_width = np.interp(abs(c.tips[k, 2] - c.tips[k - 1, 2]) / way, slopes[group], half_widths[group]) / way
    for f in range(first, last):
        to_and_fro = half_width if (f // 2) % 2 else -half_width  # a ball at a corner has slopes that rise, themselves
        for corner in range(4):
            more = to_and_fro if corner == 1 or corner == 2 else -to_and_fro
            out[f, corner, 3] += more * dx
            out[f, corner, 4] += more * dy


@njit(cache=True, nogil=True)
def facets_of(c, first, last, surface, reach, longest, crossed, steps_within):  # type: ignore[no-untyped-def]
    """Return (n, 4, 5) facets of chords first .. last - 1: corners with x, y, z, slope in x, slope in y.

    surface : (coefs, x0, y0, 1 / dx, 1 / dy) of the lens; used only for the rough direction of the normal
    reach   : greatest distance of a ball that hides something
    longest, crossed : greatest length of the parts of a strip, and of one that other tracks cross
    steps_within     : (slopes, half width) of each ball's moves: the spread that steps within moves add
    """
    near, rivals = np.empty(_ROOM, np.int32), np.empty((_ROOM, FACTS))
    frame, out = np.empty((3, 3)), np.empty((2 * (last - first) + _PER_CHORD, 4, 5))
    filled, nobody = int(np.int64(0)), int(np.int64(-1))  # plain ones are types of their own: compiled twice
    px, py, steps = 0.0, 0.0, 8
    straight = (0.0, 0.0, 0.0)
    for k in range(max(first, 1), last):
        if not c.joined[k]:
            steps = 8
            continue
        if filled + _PER_CHORD > out.shape[0]:
            out = _with_more_room(out, filled)
        radius = c.radii[c.group[k]]
        x, y = 0.5 * (c.tips[k, 0] + c.tips[k - 1, 0]), 0.5 * (c.tips[k, 1] + c.tips[k - 1, 1])
        if steps == 8:
            px, py = x, y
        else:
            px, py = px + c.tips[k, 0] - c.tips[k - 1, 0], py + c.tips[k, 1] - c.tips[k - 1, 1]
        px, py, zx, zy = slopes_at_contact(surface, x, y, radius, px, py, steps)
        steps = 2
        set_frame(c.tips, k, -zx, -zy, 1.0, frame)
        way = _rise(c, k, frame, reach)
        nx, ny, nz = frame[2, 0] - way * frame[0, 0], frame[2, 1] - way * frame[0, 1], frame[2, 2] - way * frame[0, 2]
        length, rise = set_frame(c.tips, k, nx, ny, nz, frame)
        count = gather(c, k, frame[2, 0], frame[2, 1], reach, _ROOM, near)
        farthest = turn_to_frame(c, k, frame, radius, near, count, rivals)
        most = min(_WITHIN * reach / radius + _SPARE, STEEPEST)
        low, high = 0.0, 0.0
        if abs(rise) < most:
            ball = (0.5 * length * math.sqrt(1.0 - rise * rise), 0.5 * length * rise)
            low, high, _ = find_shown(count, rivals, nobody, ball, rise, 0.0, radius, -WIDEST, WIDEST, 0.0)
        middle = 0.5 * (low + high)
        if low < high and abs(middle) > _TURNED and high < WIDEST and low > -WIDEST:
            nx = frame[2, 0] - middle * frame[1, 0]
            ny = frame[2, 1] - middle * frame[1, 1]
            nz = frame[2, 2] - middle * frame[1, 2]
            length, rise = set_frame(c.tips, k, nx, ny, nz, frame)
            for m in range(count):  # the chord that bounded the middle stays first
                near[m] = int(rivals[m, 7])
            farthest = turn_to_frame(c, k, frame, radius, near, count, rivals)
        part = min(longest, crossed) if has_crossing(count, rivals) else longest
        goes_on = k + 1 < c.joined.size and c.joined[k + 1]
        before = bend(c.tips, k - 1, frame, rise, -1.0) if c.joined[k - 1] else straight
        after = bend(c.tips, k + 1, frame, rise, 1.0) if goes_on else straight
        begin = filled
        if abs(rise) < most:
            strip = strip_of_chord(length, rise, radius, before, after)
            if strip.length > 0.0:
                filled = facets_of_strip(c.tips, k, frame, radius, strip, part, count, rivals, farthest, out, filled)
        if goes_on and (after[0] > 1e-9 or abs(after[1]) > 1e-9):
            strip = strip_of_corner(k, length, rise, radius, after, most)
            part = min(part, _CORNERS * min(length, after[2]))
            filled = facets_of_strip(c.tips, k, frame, radius, strip, part, count, rivals, farthest, out, filled)
        _spread_along(out, begin, filled, c, k, steps_within)
    return out[:filled]
