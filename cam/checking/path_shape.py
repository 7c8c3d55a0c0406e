"""The compiled part of `path_quality`: how a path runs along the contour lines, and how sharply it turns."""

from __future__ import annotations

import math

from numba import njit

from optics.heightfield import spline_jet

SLOPE_THAT_COUNTS = 0.01
ALIGNED_RAD = math.radians(15.0)
SHARP_RAD = math.radians(60.0)
TIGHT_PITCHES = 5.0
_CLOSE_MM = 1e-3  # of the contact: the gradient there changes by that times the curvature


@njit(cache=True, nogil=True)
def add_lengths(coefs, x0, y0, inv_dx, inv_dy, width, height, points, on, ball, offset, sums):  # type: ignore[no-untyped-def]
    """Add to sums: length on the surface; of it, where the slope counts in the aperture; of that, along the contour.

    offset (2,): from tip to contact, kept between calls. The contact p solves p = tip + ball grad h / q.
    """
    for k in range(on.size):
        if not on[k]:
            continue
        dx = points[k + 1, 0] - points[k, 0]
        dy = points[k + 1, 1] - points[k, 1]
        dz = points[k + 1, 2] - points[k, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        sums[0] += length
        plan = math.hypot(dx, dy)
        if plan == 0.0:
            continue
        x = 0.5 * (points[k, 0] + points[k + 1, 0])
        y = 0.5 * (points[k, 1] + points[k + 1, 1])
        hx = hy = 0.0
        for _ in range(12):
            _h, hx, hy, _xx, _xy, _yy = spline_jet(coefs, x0, y0, inv_dx, inv_dy, x + offset[0], y + offset[1])
            lean = ball / math.sqrt(1.0 + hx * hx + hy * hy)
            change = math.hypot(lean * hx - offset[0], lean * hy - offset[1])
            offset[0] = lean * hx
            offset[1] = lean * hy
            if change < _CLOSE_MM:
                break
        if not (0.0 <= x + offset[0] <= width and 0.0 <= y + offset[1] <= height):
            continue  # the run-out has no contour lines that mean anything
        slope = math.hypot(hx, hy)
        if slope > SLOPE_THAT_COUNTS:
            sums[1] += length
            if abs(dx * hx + dy * hy) <= math.sin(ALIGNED_RAD) * slope * plan:
                sums[2] += length


@njit(cache=True, nogil=True)
def _chords(points, on, k, least):  # type: ignore[no-untyped-def]
    """Return the angle between the chords before and after vertex k, of the first vertices at least that far away, and
    half the length of path they span.
    """
    i = k
    way = 0.0
    while i > 0 and on[i - 1] and way < least:
        i -= 1
        way += math.hypot(points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1])
    before = way
    j = k
    way = 0.0
    while j < on.size and on[j] and way < least:
        j += 1
        way += math.hypot(points[j, 0] - points[j - 1, 0], points[j, 1] - points[j - 1, 1])
    ux, uy = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1]
    vx, vy = points[j, 0] - points[k, 0], points[j, 1] - points[k, 1]
    return abs(math.atan2(ux * vy - uy * vx, ux * vx + uy * vy)), 0.5 * (before + way)


@njit(cache=True, nogil=True)
def add_turns(points, on, first, last, pitch, sums):  # type: ignore[no-untyped-def]
    """Add to sums, for the vertices first..last - 1: turns over 60 degrees, and length that turns tightly.

    points (n + 1, 2) without repeated ones, on (n,). A vertex stands for half of either move beside it.
    """
    for k in range(max(first, 1), min(last, on.size)):
        if not (on[k - 1] and on[k]):
            continue
        if _chords(points, on, k, 0.1 * pitch)[0] > SHARP_RAD:
            sums[3] += 1.0
        angle, length = _chords(points, on, k, 0.5 * pitch)
        if angle * TIGHT_PITCHES * pitch > length:
            before = math.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
            after = math.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
            sums[4] += 0.5 * (before + after)
