"""Tracks of few vertices from raw points: the farthest is kept whose chord passes all between within the sag."""

from __future__ import annotations

import math

from numba import njit

from cam.rows.vertices import TICKS_PER_MM

SAG_PITCHES = 0.015
SHORTEST_CHORD_PITCHES = 1.5
LONGEST_CHORD_PITCHES = 25.0
SHARP = math.cos(math.radians(50.0))
"""Tracks that turn more at a vertex, as level lines do at saddles, are parted there; the tour joins the parts."""


@njit(cache=True, nogil=True)
def thin_line(points, pitch, xy, start, tracks):  # type: ignore[no-untyped-def]
    """Write the points kept, on the raster, into xy[start[tracks]:]; return the new number of tracks.

    All points since the anchor lie within the sag of a chord whose direction is in a cone; it narrows with each.
    """
    sag, shortest = SAG_PITCHES * pitch, SHORTEST_CHORD_PITCHES * pitch
    ax, ay = points[0, 0], points[0, 1]
    first, count = tracks, start[tracks]
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
    if tracks == first and _closes_sharply(xy, start[tracks], count):
        middle = (start[tracks] + count) // 2
        for k in range(count, middle, -1):
            xy[k] = xy[k - 1]
        tracks, count = tracks + 1, count + 1
        start[tracks] = middle + 1
    start[tracks + 1] = count
    return tracks + 1


@njit(cache=True, nogil=True)
def _sharp(a, b, c):  # type: ignore[no-untyped-def]
    """Return whether a path from a by b to c turns too much at b."""
    ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1]
    return ux * vx + uy * vy < SHARP * math.hypot(ux, uy) * math.hypot(vx, vy)


@njit(cache=True, nogil=True)
def _closes_sharply(xy, begin, end):  # type: ignore[no-untyped-def]
    """Return whether a track is closed and turns too much where it does: there no vertex has been looked at."""
    last = end - 1
    closed = begin + 2 < last and xy[begin, 0] == xy[last, 0] and xy[begin, 1] == xy[last, 1]
    return closed and _sharp(xy[last - 1], xy[last], xy[begin + 1])


@njit(cache=True, nogil=True)
def _put(x, y, xy, start, tracks, count):  # type: ignore[no-untyped-def]
    """Add a vertex; a new track begins where it turns sharply at the last one. Returns (tracks, vertices)."""
    x, y = math.floor(x * TICKS_PER_MM + 0.5) / TICKS_PER_MM, math.floor(y * TICKS_PER_MM + 0.5) / TICKS_PER_MM
    if count > start[tracks] + 1 and _sharp(xy[count - 2], xy[count - 1], (x, y)):
        tracks += 1
        start[tracks] = count
        xy[count] = xy[count - 1]
        count += 1
    xy[count, 0], xy[count, 1] = x, y
    return tracks, count + 1
