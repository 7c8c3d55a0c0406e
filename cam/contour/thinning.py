"""Tracks of few vertices from raw points: the farthest is kept whose chord passes all between within the sag."""

from __future__ import annotations

import math

from numba import njit

from cam.vertices import TICKS_PER_MM

SAG_PITCHES = 0.015
SHORTEST_CHORD_PITCHES = 1.5
LONGEST_CHORD_PITCHES = 25.0
SHARP = math.cos(math.radians(50.0))
"""Tracks that turn more at a vertex, as level lines do at saddles, are parted there; the tour joins the parts."""


@njit(cache=True, nogil=True)
def thinned(points, pitch, xy, start, tracks):  # type: ignore[no-untyped-def]
    """Points kept, on the writing raster, into xy[start[tracks]:]; returns the new number of tracks.

    All points since the anchor lie within the sag of a chord whose direction is in a cone; it narrows with each.
    """
    sag, shortest = SAG_PITCHES * pitch, SHORTEST_CHORD_PITCHES * pitch
    ax, ay = points[0, 0], points[0, 1]
    count = start[tracks]
    tracks, count = _put(ax, ay, xy, start, tracks, count)
    low, high, ahead = -math.pi, math.pi, 0.0
    far = 0.0  # of the candidate, from the anchor
    n = points.shape[0]
    i = 1
    while i < n:
        dx, dy = points[i, 0] - ax, points[i, 1] - ay
        away = math.hypot(dx, dy)
        if away > sag:
            if low == -math.pi:
                ahead = math.atan2(dy, dx)
            turn = math.atan2(dy, dx) - ahead
            turn -= 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5)
            if far >= shortest and (not low <= turn <= high or away > LONGEST_CHORD_PITCHES * pitch):
                ax, ay = points[i - 1, 0], points[i - 1, 1]
                tracks, count = _put(ax, ay, xy, start, tracks, count)
                low, high, far = -math.pi, math.pi, 0.0
                continue
            wide = math.asin(sag / away)
            low, high = max(low, turn - wide), min(high, turn + wide)
        far = away
        i += 1
    if far < shortest and count > start[tracks] + 1:  # no crumb at the end
        count -= 1
    tracks, count = _put(points[n - 1, 0], points[n - 1, 1], xy, start, tracks, count)
    start[tracks + 1] = count
    return tracks + 1


@njit(cache=True, nogil=True)
def _put(x, y, xy, start, tracks, count):  # type: ignore[no-untyped-def]
    """One more vertex; where the track turns sharply at the last one, a new track begins there. (tracks, vertices)"""
    x, y = math.floor(x * TICKS_PER_MM + 0.5) / TICKS_PER_MM, math.floor(y * TICKS_PER_MM + 0.5) / TICKS_PER_MM
    if count > start[tracks] + 1:
        ax, ay = xy[count - 1, 0] - xy[count - 2, 0], xy[count - 1, 1] - xy[count - 2, 1]
        bx, by = x - xy[count - 1, 0], y - xy[count - 1, 1]
        if ax * bx + ay * by < SHARP * math.hypot(ax, ay) * math.hypot(bx, by):
            tracks += 1
            start[tracks] = count
            xy[count] = xy[count - 1]
            count += 1
    xy[count, 0], xy[count, 1] = x, y
    return tracks, count + 1
