"""Strips of the surface, between the two ends of what a ball shows while it moves, cut into facets.

Each part of a strip is asked at three places: where it shows at all of them it is one facet, else each third is by
itself. Where tracks come and go with steps and noise, every end of one is up to a sixth of a part off, to either side:
light on a screen is the sum of so many that it does not show (a part cut until it is 7 um long gives the same picture
to 58 dB, at 100 mm, R 0.5, pitch 0.02 and steps of 2.5 um, and takes twice as long).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numba import njit

from cam.as_milled.neighbours import WIDEST, shown

MOST_PARTS = 81  # of a strip
STEEPEST = 0.6  # rad: no ball shows more of itself along its track


class Strip(NamedTuple):
    """What a chord, or the ball at its end, may show: u from 0 to 1 along it.

    length                : of it on the surface
    whole                 : length of the chord
    start, run            : way along the chord, start + u run
    rise                  : of the chord, out of the surface
    first, span, up, left : of a corner's ball, which shows rise + (first + u span) (up - left x across) ahead
    before, after         : of a chord, the bends at its ends, see `bend`
    skip                  : the rival that does not count
    """

    is_corner: bool
    length: float
    whole: float
    start: float
    run: float
    rise: float
    first: float
    span: float
    up: float
    left: float
    before: Any
    after: Any
    skip: int


@njit(cache=True, nogil=True)
def bend(tips, k, frame, rise, sign):  # type: ignore[no-untyped-def]
    """Return (up, left) of chord k's direction from that of its neighbour with `rise`, times sign, and its length."""
    tx, ty, tz = tips[k, 0] - tips[k - 1, 0], tips[k, 1] - tips[k - 1, 1], tips[k, 2] - tips[k - 1, 2]
    ahead = frame[0, 0] * tx + frame[0, 1] * ty + frame[0, 2] * tz
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    ahead = max(ahead, 0.3 * length)
    left = frame[1, 0] * tx + frame[1, 1] * ty + frame[1, 2] * tz
    up = frame[2, 0] * tx + frame[2, 1] * ty + frame[2, 2] * tz
    size = math.hypot(ahead, up)
    return sign * (up / size - rise), sign * left / size, length


@njit(cache=True, nogil=True)
def _lost(radius, bend, across):  # type: ignore[no-untyped-def]
    """Return what a chord loses to the next one beyond a hill; 0 where that is too short to matter."""
    loss = -0.5 * radius * min(bend[0] - bend[1] * across, 0.0)
    return loss if loss < bend[2] else 0.0


@njit(cache=True, nogil=True)
def strip_of_chord(length, rise, radius, before, after):  # type: ignore[no-untyped-def]
    start, end = _lost(radius, before, 0.0), length - _lost(radius, after, 0.0)
    return Strip(False, end - start, length, start, end - start, rise, 0.0, 0.0, 0.0, 0.0, before, after, -1)


@njit(cache=True, nogil=True)
def strip_of_corner(k, length, rise, radius, bend, most):  # type: ignore[no-untyped-def]
    """Return the ball at the end of chord k; most: the tilt along the track up to which it may show, to either side."""
    up, first, last = bend[0], 0.0, 1.0
    if up > 0.0:
        first, last = min(max((-most - rise) / up, 0.0), 1.0), min(max((most - rise) / up, 0.0), 1.0)
    size = radius * (last - first) * max(up, 0.0)
    return Strip(True, size, length, length, 0.0, rise, first, last - first, up, bend[1], bend, bend, k + 1)


@njit(cache=True, nogil=True)
def _shown_at(strip, u, count, rivals, radius, slack):  # type: ignore[no-untyped-def]
    share = strip.first + u * strip.span
    tilt = strip.rise + share * max(strip.up, 0.0)
    low = strip.up / strip.left if strip.left < 0.0 else -WIDEST
    high = strip.up / strip.left if strip.left > 0.0 else WIDEST
    if abs(tilt) > STEEPEST or low >= WIDEST or high <= -WIDEST:
        return 0.0, -1.0, tilt
    s = strip.start + u * strip.run
    ball = (s * math.sqrt(1.0 - strip.rise * strip.rise), s * strip.rise)
    shear = share * strip.left
    return shown(count, rivals, strip.skip, ball, tilt, shear, radius, max(low, -WIDEST), min(high, WIDEST), slack)


@njit(cache=True, nogil=True)
def _fill_corner(tips, k, frame, radius, share, along, across, out):  # type: ignore[no-untyped-def]
    """Compute out (5,): x, y, z and slopes where the ball at that share of chord k shows `along` and `across`."""
    down = math.sqrt(1.0 - along * along - across * across)
    vx = along * frame[0, 0] + across * frame[1, 0] - down * frame[2, 0]
    vy = along * frame[0, 1] + across * frame[1, 1] - down * frame[2, 1]
    vz = along * frame[0, 2] + across * frame[1, 2] - down * frame[2, 2]
    out[0] = tips[k - 1, 0] + share * (tips[k, 0] - tips[k - 1, 0]) + radius * vx
    out[1] = tips[k - 1, 1] + share * (tips[k, 1] - tips[k - 1, 1]) + radius * vy
    out[2] = tips[k - 1, 2] + share * (tips[k, 2] - tips[k - 1, 2]) + radius * (1.0 + vz)
    out[3] = -vx / vz
    out[4] = -vy / vz


@njit(cache=True, nogil=True)
def _fill_facet_end(tips, k, frame, radius, strip, u, across, out):  # type: ignore[no-untyped-def]
    """Compute out (5,): a facet's corner at u along the strip."""
    along = strip.rise * math.sqrt(1.0 - across * across)
    if strip.is_corner:
        along += (strip.first + u * strip.span) * max(strip.up - strip.left * across, 0.0)
        along = min(max(along, -STEEPEST), STEEPEST)
        _fill_corner(tips, k, frame, radius, 1.0, along, across, out)
        return
    s = strip.start + u * strip.run
    if u == 0.0:
        s = min(_lost(radius, strip.before, across), strip.start + strip.run)
    elif u == 1.0:
        s = max(strip.whole - _lost(radius, strip.after, across), strip.start)
    _fill_corner(tips, k, frame, radius, s / strip.whole, along, across, out)


@njit(cache=True, nogil=True)
def _fill_facet(tips, k, frame, radius, strip, u0, u1, low, high, out):  # type: ignore[no-untyped-def]
    """Compute out (4, 5): the strip from u0 to u1; low, high: its ends at both, (there, there)."""
    low0, low1, high0, high1 = low[0], low[1], high[0], high[1]
    if low0 > high0:
        low0 = high0 = 0.5 * (low0 + high0)
    if low1 > high1:
        low1 = high1 = 0.5 * (low1 + high1)
    _fill_facet_end(tips, k, frame, radius, strip, u0, low0, out[0])
    _fill_facet_end(tips, k, frame, radius, strip, u1, low1, out[1])
    _fill_facet_end(tips, k, frame, radius, strip, u1, high1, out[2])
    _fill_facet_end(tips, k, frame, radius, strip, u0, high0, out[3])


@njit(cache=True, nogil=True)
def _straight(a, b, c):  # type: ignore[no-untyped-def]
    """Return the ends of the line nearest to a parabola of values a, b, c in the middles of thirds; the same mean."""
    mean, half = (3.0 * a + 2.0 * b + 3.0 * c) / 8.0, 0.75 * (c - a)
    return mean - half, mean + half


@njit(cache=True, nogil=True)
def _parts_shown(strip, parts, count, rivals, radius, slack):  # type: ignore[no-untyped-def]
    """Return (first, last): the parts, last not among them, in which a ball at a corner shows something.

    What a ball shows is convex, so that no place beyond one that is hidden from there shows anything.
    """
    cells = 3 * parts
    low, high, seen = 0, cells - 1, -1
    while low <= high and seen < 0:
        middle = (low + high) // 2
        shown = _shown_at(strip, (middle + 0.5) / cells, count, rivals, radius, slack)
        if shown[0] < shown[1]:
            seen = middle
        elif shown[2] > 0.0:
            high = middle - 1
        else:
            low = middle + 1
    if seen < 0:
        return 0, 0
    left, right = seen, seen  # the outermost that are known to show something
    while low < left:
        middle = (low + left) // 2
        shown = _shown_at(strip, (middle + 0.5) / cells, count, rivals, radius, slack)
        if shown[0] < shown[1]:
            left = middle
        else:
            low = middle + 1
    while right < high:
        middle = (right + high + 1) // 2
        shown = _shown_at(strip, (middle + 0.5) / cells, count, rivals, radius, slack)
        if shown[0] < shown[1]:
            right = middle
        else:
            high = middle - 1
    return left // 3, right // 3 + 1


@njit(cache=True, nogil=True)
def facets_of_strip(tips, k, frame, radius, strip, longest, count, rivals, farthest, out, filled):  # type: ignore[no-untyped-def]
    """Write facets of a strip into out from `filled` on; return its new value. farthest: of the rivals."""
    parts = min(max(1, int(math.ceil(strip.length / longest - 1e-9))), MOST_PARTS)
    slack = WIDEST * abs(strip.left) * (farthest + strip.whole)
    first, last = 0, parts
    if strip.is_corner and parts > 1:
        first, last = _parts_shown(strip, parts, count, rivals, radius, slack)
    for part in range(first, last):
        u0, u1 = part / parts, (part + 1) / parts
        third = (u1 - u0) / 3.0
        middle = _shown_at(strip, 0.5 * (u0 + u1), count, rivals, radius, slack)
        before = _shown_at(strip, u0 + 0.5 * third, count, rivals, radius, slack)
        after = _shown_at(strip, u1 - 0.5 * third, count, rivals, radius, slack)
        if before[0] < before[1] and middle[0] < middle[1] and after[0] < after[1]:
            lows, highs = _straight(before[0], middle[0], after[0]), _straight(before[1], middle[1], after[1])
            _fill_facet(tips, k, frame, radius, strip, u0, u1, lows, highs, out[filled])
            filled += 1
            continue
        for m in range(3):
            low, high, _ = before if m == 0 else middle if m == 1 else after
            if low < high:
                v0, v1 = u0 + m * third, u0 + (m + 1) * third
                _fill_facet(tips, k, frame, radius, strip, v0, v1, (low, low), (high, high), out[filled])
                filled += 1
    return filled
