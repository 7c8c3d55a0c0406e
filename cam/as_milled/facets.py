"""What each chord of the path leaves of itself on the surface: the part where its ball was lowest, as small facets.

Theory of operation. What the ball shows across its track is an interval of angles, see `rivals`; along a chord its two
ends move, and a *strip* between them is what the chord leaves. A strip is asked at three places: where its ends run
straight enough it is one facet, elsewhere it is cut in three and each third asked again. So where tracks lie even a
facet is as long as its chord, and where they cross, or come and go with steps and noise, it is as short as need be.

Between two chords: where the path bends down (a hill) both lose R / 2 times the bend to one another; where it bends up
the ball at the corner shows itself between the two, in a strip that is treated like that of a chord.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from cam.as_milled.chords import gather
from cam.as_milled.rivals import FACTS, WIDEST, are_crossed, set_frame, shown, to_frame
from optics.heightfield import spline_jet

_ROOM = 4096  # neighbours of one chord
_MOST = 81  # parts of a strip before any is cut
_FINEST = 243  # of a strip's length to its shortest part
_PER_CHORD = 20 * _FINEST  # facets, more than there can be
_TURNED = 0.03  # rad: a frame farther from the surface's normal than this is set up anew
_STEEPEST = 0.6  # rad: no ball shows more of itself along its track
_CORNERS = 0.25  # of a chord's length: parts of the balls at its end, of which short chords show narrow slivers
_WITHIN = 0.75  # of the reach: farther from its middle a ball shows nothing, as what hides it may be out of reach
_SPARE = 0.01  # rad: added to the tilts at which a ball may show at all


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
    before, after         : of a chord, the bends at its ends, see `_bend`
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
def _slopes_at_contact(surface, x, y, radius, px, py, steps):  # type: ignore[no-untyped-def]
    """(px, py, zx, zy): where a ball with its centre above (x, y) touches the lens, about, from the guess p."""
    zx = zy = 0.0
    for _ in range(steps):
        _, zx, zy, _, _, _ = spline_jet(surface[0], surface[1], surface[2], surface[3], surface[4], px, py)
        w = radius / math.sqrt(1.0 + zx * zx + zy * zy)
        px, py = x + w * zx, y + w * zy
    return px, py, zx, zy


@njit(cache=True, nogil=True)
def _bend(tips, k, frame, rise, sign):  # type: ignore[no-untyped-def]
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
def _lost(radius, bend, across):  # type: ignore[no-untyped-def]
    """What a chord loses to the next one beyond a hill; 0 where that is too short: then its neighbours tell."""
    loss = -0.5 * radius * min(bend[0] - bend[1] * across, 0.0)
    return loss if loss < bend[2] else 0.0


@njit(cache=True, nogil=True)
def _strip_of_chord(length, rise, radius, before, after):  # type: ignore[no-untyped-def]
    start, end = _lost(radius, before, 0.0), length - _lost(radius, after, 0.0)
    return Strip(False, end - start, length, start, end - start, rise, 0.0, 0.0, 0.0, 0.0, before, after, -1)


@njit(cache=True, nogil=True)
def _strip_of_corner(k, length, rise, radius, bend, most):  # type: ignore[no-untyped-def]
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
    if abs(tilt) > _STEEPEST:
        return 0.0, -1.0
    s = strip.start + u * strip.run
    ball = (s * math.sqrt(1.0 - strip.rise * strip.rise), s * strip.rise)
    shear = share * strip.left
    return shown(count, rivals, strip.skip, ball, tilt, shear, radius, max(low, -WIDEST), min(high, WIDEST))


@njit(cache=True, nogil=True)
def _end_of_facet(tips, k, frame, radius, strip, u, across, out):  # type: ignore[no-untyped-def]
    """out (5,): a facet's corner at u along the strip."""
    along = strip.rise * math.sqrt(1.0 - across * across)
    if strip.is_corner:
        along += (strip.first + u * strip.span) * max(strip.up - strip.left * across, 0.0)
        along = min(max(along, -_STEEPEST), _STEEPEST)
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
def _facets_of_strip(tips, k, frame, radius, strip, longest, fine, count, rivals, todo, out, filled):  # type: ignore[no-untyped-def]
    """Facets of a strip into out from `filled` on, whose new value is returned; todo (rows, 4): room for its parts."""
    parts = min(max(1, int(math.ceil(strip.length / longest - 1e-9))), _MOST)
    shortest = min(fine.shortest, fine.share * strip.whole)
    shortest = max(shortest, strip.length / _FINEST) / max(strip.length, 1e-9)
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


@njit(cache=True, nogil=True)
def _rise(c, k, frame, reach):  # type: ignore[no-untyped-def]
    """How far the path rises out of the frame, per way ahead, from `reach` before chord k to as far behind it."""
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
    more[:filled] = out[:filled]
    return more


@njit(cache=True, nogil=True)
def facets_of(c, first, last, surface, reach, fine):  # type: ignore[no-untyped-def]
    """(n, 4, 5) facets of chords first .. last - 1: corners with x, y, z, slope in x, slope in y.

    surface : (coefs, x0, y0, 1 / dx, 1 / dy) of the lens, which only says where the normal is, about
    reach   : how far a ball can be that hides something
    """
    near, rivals, todo = np.empty(_ROOM, np.int32), np.empty((_ROOM, FACTS)), np.empty((16, 4))
    frame, out = np.empty((3, 3)), np.empty((2 * (last - first) + _PER_CHORD, 4, 5))
    filled = 0
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
        px, py, zx, zy = _slopes_at_contact(surface, x, y, radius, px, py, steps)
        steps = 2
        set_frame(c.tips, k, -zx, -zy, 1.0, frame)
        way = _rise(c, k, frame, reach)
        nx, ny, nz = frame[2, 0] - way * frame[0, 0], frame[2, 1] - way * frame[0, 1], frame[2, 2] - way * frame[0, 2]
        length, rise = set_frame(c.tips, k, nx, ny, nz, frame)
        count = gather(c, k, reach, _ROOM, near)
        to_frame(c, k, frame, radius, near, count, rivals)
        most = min(_WITHIN * reach / radius + _SPARE, _STEEPEST)
        low, high = 0.0, 0.0
        if abs(rise) < most:
            ball = (0.5 * length * math.sqrt(1.0 - rise * rise), 0.5 * length * rise)
            low, high = shown(count, rivals, -1, ball, rise, 0.0, radius, -WIDEST, WIDEST)
        middle = 0.5 * (low + high)
        if low < high and abs(middle) > _TURNED and high < WIDEST and low > -WIDEST:
            nx = frame[2, 0] - middle * frame[1, 0]
            ny = frame[2, 1] - middle * frame[1, 1]
            nz = frame[2, 2] - middle * frame[1, 2]
            length, rise = set_frame(c.tips, k, nx, ny, nz, frame)
            to_frame(c, k, frame, radius, near, count, rivals)
        longest = min(fine.longest, fine.crossed) if are_crossed(count, rivals) else fine.longest
        goes_on = k + 1 < c.joined.size and c.joined[k + 1]
        before = _bend(c.tips, k - 1, frame, rise, -1.0) if c.joined[k - 1] else straight
        after = _bend(c.tips, k + 1, frame, rise, 1.0) if goes_on else straight
        if abs(rise) < most:
            strip = _strip_of_chord(length, rise, radius, before, after)
            if strip.length > 0.0:
                filled = _facets_of_strip(
                    c.tips, k, frame, radius, strip, longest, fine, count, rivals, todo, out, filled
                )
        if goes_on and (after[0] > 1e-9 or abs(after[1]) > 1e-9):
            strip = _strip_of_corner(k, length, rise, radius, after, most)
            longest = min(longest, _CORNERS * min(length, after[2]))
            filled = _facets_of_strip(c.tips, k, frame, radius, strip, longest, fine, count, rivals, todo, out, filled)
    return out[:filled]
