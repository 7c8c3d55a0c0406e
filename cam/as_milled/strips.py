"""Strips of the surface, between the two ends of what a ball shows while it moves, cut into facets.

A strip is asked at three places: where its ends run straight enough it is one facet, elsewhere it is cut in three and
each third asked again. So where tracks lie even a facet is as long as its chord, and where they cross, or come and go
with steps and noise, it is as short as need be.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numba import njit

from cam.as_milled.rivals import WIDEST, shown

_MOST = 81  # parts of a strip before any is cut
FINEST = 243  # of a strip's length to its shortest part
STEEPEST = 0.6  # rad: no ball shows more of itself along its track


class Fineness(NamedTuple):
    """How small facets have to be.

    longest, crossed : parts of a strip, before any is cut; of one that other tracks cross
    shortest, share  : parts no longer than the lesser of this and this share of their chord are not cut
    bend             : a strip's ends may miss a straight line by about this [rad x radius]
    """

    longest: float
    crossed: float
    shortest: float
    share: float
    bend: float


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
    """(up, left) of chord k's direction from that of its neighbour with `rise`, times sign, and its length."""
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
    """What a chord loses to the next one beyond a hill; 0 where that is too short: then its neighbours tell."""
    loss = -0.5 * radius * min(bend[0] - bend[1] * across, 0.0)
    return loss if loss < bend[2] else 0.0


@njit(cache=True, nogil=True)
def strip_of_chord(length, rise, radius, before, after):  # type: ignore[no-untyped-def]
    start, end = _lost(radius, before, 0.0), length - _lost(radius, after, 0.0)
    return Strip(False, end - start, length, start, end - start, rise, 0.0, 0.0, 0.0, 0.0, before, after, -1)


@njit(cache=True, nogil=True)
def strip_of_corner(k, length, rise, radius, bend, most):  # type: ignore[no-untyped-def]
    """The ball at the end of chord k; most: the tilt along the track up to which it may show, to either side."""
    up, first, last = bend[0], 0.0, 1.0
    if up > 0.0:
        first, last = min(max((-most - rise) / up, 0.0), 1.0), min(max((most - rise) / up, 0.0), 1.0)
    size = radius * (last - first) * max(up, 0.0)
    return Strip(True, size, length, length, 0.0, rise, first, last - first, up, bend[1], bend, bend, k + 1)


@njit(cache=True, nogil=True)
def _shown_at(strip, u, count, rivals, radius):  # type: ignore[no-untyped-def]
    share = strip.first + u * strip.span
    tilt = strip.rise + share * max(strip.up, 0.0)
    low = strip.up / strip.left if strip.left < 0.0 else -WIDEST
    high = strip.up / strip.left if strip.left > 0.0 else WIDEST
    if abs(tilt) > STEEPEST:
        return 0.0, -1.0
    s = strip.start + u * strip.run
    ball = (s * math.sqrt(1.0 - strip.rise * strip.rise), s * strip.rise)
    shear = share * strip.left
    return shown(count, rivals, strip.skip, ball, tilt, shear, radius, max(low, -WIDEST), min(high, WIDEST))


@njit(cache=True, nogil=True)
def _corner(tips, k, frame, radius, share, along, across, out):  # type: ignore[no-untyped-def]
    """out (5,): x, y, z and slopes where the ball at that share of chord k shows `along` and `across`."""
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
def _end_of_facet(tips, k, frame, radius, strip, u, across, out):  # type: ignore[no-untyped-def]
    """out (5,): a facet's corner at u along the strip."""
    along = strip.rise * math.sqrt(1.0 - across * across)
    if strip.is_corner:
        along += (strip.first + u * strip.span) * max(strip.up - strip.left * across, 0.0)
        along = min(max(along, -STEEPEST), STEEPEST)
        _corner(tips, k, frame, radius, 1.0, along, across, out)
        return
    s = strip.start + u * strip.run
    if u == 0.0:
        s = min(_lost(radius, strip.before, across), strip.start + strip.run)
    elif u == 1.0:
        s = max(strip.whole - _lost(radius, strip.after, across), strip.start)
    _corner(tips, k, frame, radius, s / strip.whole, along, across, out)


@njit(cache=True, nogil=True)
def _facet(tips, k, frame, radius, strip, u0, u1, low, high, out):  # type: ignore[no-untyped-def]
    """out (4, 5): the strip from u0 to u1; low, high: its ends at both, (there, there)."""
    low0, low1, high0, high1 = low[0], low[1], high[0], high[1]
    if low0 > high0:
        low0 = high0 = 0.5 * (low0 + high0)
    if low1 > high1:
        low1 = high1 = 0.5 * (low1 + high1)
    _end_of_facet(tips, k, frame, radius, strip, u0, low0, out[0])
    _end_of_facet(tips, k, frame, radius, strip, u1, low1, out[1])
    _end_of_facet(tips, k, frame, radius, strip, u1, high1, out[2])
    _end_of_facet(tips, k, frame, radius, strip, u0, high0, out[3])


@njit(cache=True, nogil=True)
def _straight(a, b, c):  # type: ignore[no-untyped-def]
    """Ends of the line that is nearest to a parabola with values a, b, c in the middles of thirds; the same mean."""
    mean, half = (3.0 * a + 2.0 * b + 3.0 * c) / 8.0, 0.75 * (c - a)
    return mean - half, mean + half


@njit(cache=True, nogil=True)
def facets_of_strip(tips, k, frame, radius, strip, longest, fine, count, rivals, todo, out, filled):  # type: ignore[no-untyped-def]
    """Facets of a strip into out from `filled` on, whose new value is returned; todo (rows, 4): room for its parts."""
    parts = min(max(1, int(math.ceil(strip.length / longest - 1e-9))), _MOST)
    shortest = min(fine.shortest, fine.share * strip.whole)
    shortest = max(shortest, strip.length / FINEST) / max(strip.length, 1e-9)
    for part in range(parts):
        todo[0, 0], todo[0, 1] = part / parts, (part + 1) / parts
        todo[0, 2], todo[0, 3] = _shown_at(strip, (part + 0.5) / parts, count, rivals, radius)
        left = 1
        while left > 0:
            left -= 1
            u0, u1, middle = todo[left, 0], todo[left, 1], (todo[left, 2], todo[left, 3])
            third = (u1 - u0) / 3.0
            before = _shown_at(strip, u0 + 0.5 * third, count, rivals, radius)
            after = _shown_at(strip, u1 - 0.5 * third, count, rivals, radius)
            seen = (before[0] < before[1]) + (middle[0] < middle[1]) + (after[0] < after[1])
            if seen == 0:
                continue
            bend = radius * max(
                abs(before[0] - 2.0 * middle[0] + after[0]), abs(before[1] - 2.0 * middle[1] + after[1])
            )
            small = u1 - u0 <= shortest
            if seen == 3 and (small or bend <= fine.bend):
                lows, highs = _straight(before[0], middle[0], after[0]), _straight(before[1], middle[1], after[1])
                _facet(tips, k, frame, radius, strip, u0, u1, lows, highs, out[filled])
                filled += 1
                continue
            for m in range(3):
                low, high = before if m == 0 else middle if m == 1 else after
                if not small:
                    todo[left, 0], todo[left, 1], todo[left, 2], todo[left, 3] = (
                        u0 + m * third,
                        u0 + (m + 1) * third,
                        low,
                        high,
                    )
                    left += 1
                elif low < high:
                    _facet(
                        tips,
                        k,
                        frame,
                        radius,
                        strip,
                        u0 + m * third,
                        u0 + (m + 1) * third,
                        (low, low),
                        (high, high),
                        out[filled],
                    )
                    filled += 1
    return filled
