"""Strips of the surface that a moving ball leaves, between the two ends of its visible angles, cut into facets.

The visible part of a ball between its rivals, the neighbouring chords, is one interval of angles across its track. A
point of the ball with centre c and radius R is c + R v, v a unit vector. It lies outside another ball of the path, d
away, where 2 R v . d < |d|^2 (for equal radii): a half-space in v, so the visible part of a ball is an intersection of
half-spaces on any path: neighbours, crossings, deeper tracks that hide it altogether. While the tool moves along t only
points with v . t = 0 stay: v = f b - n, one angle f across the track, with the frame t, b, n turned so that n is about
the surface's normal. Each other chord bounds f from one side, or hides the place, in closed form: f < min X / D over
its balls, X = d_n + |d|^2 / 2R and D = d_b (squares of f, some 1e-4, are left out).

Balls of different radii are compared by their lowest points towards n: exact where they touch the same surface, off by
d^2 / 2 (1/R1 - 1/R2) at a border between two programs.

Each part of a strip is tested at three places: if it is visible at all of them it is one facet, otherwise each third is
tested alone. Where tracks come and go with steps and noise, every end of one is up to a sixth of a part off, to either
side: this does not show, because light on a screen is the sum of very many parts (a part cut until it is 7 um long
gives the same picture to 58 dB, at 100 mm, R 0.5, pitch 0.02 and steps of 2.5 um, and takes twice as long).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numba import njit

FACTS = 11  # of one rival, see `turn_to_frame`
WIDEST = 0.3  # rad: visible part of a ball without a neighbour, to either side
_CROSSING = 0.3  # tangent of the least angle at which tracks count as crossing
_POINT = 1e-18  # mm: half the square of a chord that counts as none in its frame, over the radius
_TIE_MM = 1e-9  # of two equal balls the earlier one counts as lower


@njit(cache=True, nogil=True)
def set_frame(tips, k, nx, ny, nz, frame):  # type: ignore[no-untyped-def]
    """Set frame (3, 3): n the given normal, b to the left of chord k, t ahead; return (length, rise of the chord).

    The chord's direction is (sqrt(1 - rise^2), 0, rise) in the frame.
    """
    dx, dy, dz = tips[k, 0] - tips[k - 1, 0], tips[k, 1] - tips[k - 1, 1], tips[k, 2] - tips[k - 1, 2]
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / size, ny / size, nz / size
    bx, by, bz = ny * dz - nz * dy, nz * dx - nx * dz, nx * dy - ny * dx
    size = math.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx / size, by / size, bz / size
    frame[0, 0], frame[0, 1], frame[0, 2] = by * nz - bz * ny, bz * nx - bx * nz, bx * ny - by * nx
    frame[1, 0], frame[1, 1], frame[1, 2] = bx, by, bz
    frame[2, 0], frame[2, 1], frame[2, 2] = nx, ny, nz
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    return length, (nx * dx + ny * dy + nz * dz) / length


@njit(cache=True, nogil=True)
def has_crossing(count, rivals):  # type: ignore[no-untyped-def]
    """Return whether another track runs across this one: then its visible part changes from place to place."""
    crossed = False
    for m in range(count):
        crossed = crossed or abs(rivals[m, 4]) > _CROSSING * abs(rivals[m, 3])
    return crossed


@njit(cache=True, nogil=True)
def turn_to_frame(c, k, frame, radius, near, count, rivals):  # type: ignore[no-untyped-def]
    """Fill rivals (count, FACTS): the neighbours' beginnings (t, b, n) from that of chord k, ways, who wins a tie,
    names, the square term of X along them, as it is and as what leads to where X is least, and its least part from b
    alone.

    The farthest of them ahead or behind is returned.
    """
    farthest = 0.0
    for m in range(count):
        j = near[m]
        more = c.radii[c.group[j]] - radius
        for d in range(3):
            ax, bx, cx = frame[d, 0], frame[d, 1], frame[d, 2]
            px, py = c.tips[j - 1, 0] - c.tips[k - 1, 0], c.tips[j - 1, 1] - c.tips[k - 1, 1]
            pz = c.tips[j - 1, 2] - c.tips[k - 1, 2] + more
            rivals[m, d] = ax * px + bx * py + cx * pz
            qx, qy = c.tips[j, 0] - c.tips[j - 1, 0], c.tips[j, 1] - c.tips[j - 1, 1]
            qz = c.tips[j, 2] - c.tips[j - 1, 2]
            rivals[m, 3 + d] = ax * qx + bx * qy + cx * qz
        rivals[m, 2] -= more
        rivals[m, 6] = _TIE_MM if j < k else -_TIE_MM
        rivals[m, 7] = j
        square = max(0.5 / radius * (rivals[m, 3] * rivals[m, 3] + rivals[m, 4] * rivals[m, 4]), _POINT)
        rivals[m, 8], rivals[m, 9] = square, -0.5 / square
        b, end = rivals[m, 1], rivals[m, 1] + rivals[m, 4]
        rivals[m, 10] = 0.0 if b * end < 0.0 else 0.5 * min(b * b, end * end) / radius
        farthest = max(farthest, abs(rivals[m, 0]), abs(rivals[m, 0] + rivals[m, 3]))
    return farthest


@njit(cache=True, nogil=True)
def _move_to_front(rivals, first, m):  # type: ignore[no-untyped-def]
    """Move the rival that bounds or hides one piece to the front: it will probably do so with the next piece, too."""
    for d in range(rivals.shape[1]):
        rivals[first, d], rivals[m, d] = rivals[m, d], rivals[first, d]


@njit(cache=True, nogil=True, error_model="numpy")
def find_shown(count, rivals, skip, ball, tilt, shear, radius, low, high, slack):  # type: ignore[no-untyped-def]
    """Return (low, high, ahead): the visible angles across of a ball within the given ones. low >= high: none; then a
    larger tilt hides even more of the ball where `ahead` is positive, a smaller one otherwise. Rival `skip` does not
    count.

    ball        : its centre (t, n) in the frame
    tilt, shear : place of the test: tilt - shear f ahead of n
    slack       : what shear may add to f D
    """
    down = math.sqrt(1.0 - tilt * tilt)
    here = down * ball[1] - tilt * ball[0] + slack + _TIE_MM
    by_low = by_high = 0
    low_ahead = high_ahead = 0.0  # by how much a larger tilt lowers either
    for m in range(count):
        b, dt, db = rivals[m, 1], rivals[m, 3], rivals[m, 4]
        lift, way = down * rivals[m, 2] - tilt * rivals[m, 0], down * rivals[m, 5] - tilt * dt
        reached = max(high, 0.0) * max(b, b + db, 0.0) - min(low, 0.0) * max(-b, -b - db, 0.0)
        if lift + min(way, 0.0) + rivals[m, 10] - here > reached:  # X > f D all along it
            continue
        t, alpha = rivals[m, 0] - ball[0], rivals[m, 8]
        beta = way + (t * dt + b * db) / radius
        gamma = down * (rivals[m, 2] - ball[1]) - tilt * t + 0.5 * (t * t + b * b) / radius - rivals[m, 6]
        b, db = b - shear * t, db - shear * dt
        near = min(max(beta * rivals[m, 9], 0.0), 1.0)
        least = gamma + near * (beta + alpha * near)
        end = b + db
        widest = max(high, 0.0) * max(b, end, 0.0) - min(low, 0.0) * max(-b, -end, 0.0)
        if least > widest or rivals[m, 7] == skip:
            continue
        if b * end > 0.0 and abs(db) < 1e-3 * abs(b):  # as good as parallel
            bound = least / (b + near * db)
            if b > 0.0 and bound < high:
                high, by_high, high_ahead = bound, m, (t + near * dt) / (b + near * db)
            elif b < 0.0 and bound > low:
                low, by_low, low_ahead = bound, m, (t + near * dt) / (b + near * db)
        elif abs(db) < 1e-12:  # straight ahead or behind
            if least < 0.0:
                _move_to_front(rivals, 0, m)
                return 0.0, -1.0, t + near * dt
        else:
            curve = alpha / (db * db)
            at = -b / db
            level = gamma + at * (beta + alpha * at)  # X where D is 0; X / D is least at the root
            first, last = min(b, end), max(b, end)
            if first <= 0.0 <= last and level < 0.0:
                _move_to_front(rivals, 0, m)
                return 0.0, -1.0, t + at * dt
            root = math.sqrt(max(level, 0.0) / curve)
            if last > 0.0:
                d = min(max(root, first), last)
                if d > 0.0:
                    way = (d - b) / db
                    bound = (gamma + way * (beta + alpha * way)) / d
                    if bound < high:
                        high, by_high, high_ahead = bound, m, (t + way * dt) / d
            if first < 0.0:
                d = max(min(-root, last), first)
                if d < 0.0:
                    way = (d - b) / db
                    bound = (gamma + way * (beta + alpha * way)) / d
                    if bound > low:
                        low, by_low, low_ahead = bound, m, (t + way * dt) / d
        if low >= high:
            _move_to_front(rivals, 0, m)
            return low, high, high_ahead - low_ahead
    _move_to_front(rivals, 0, by_high)
    if count > 1:
        _move_to_front(rivals, 1, by_high if by_low == 0 else by_low)
    return low, high, 0.0


MOST_PARTS = 81  # of a strip
STEEPEST = 0.6  # rad: no ball leaves a larger angle along its track


class Strip(NamedTuple):
    """The part of a chord, or of the ball at its end, that may be visible: u from 0 to 1 along it.

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
def _compute_loss(radius, bend, across):  # type: ignore[no-untyped-def]
    """Return the length that a chord loses to the next one beyond a hill; 0 if that is too short to matter."""
    loss = -0.5 * radius * min(bend[0] - bend[1] * across, 0.0)
    return loss if loss < bend[2] else 0.0


@njit(cache=True, nogil=True)
def strip_of_chord(length, rise, radius, before, after):  # type: ignore[no-untyped-def]
    start, end = _compute_loss(radius, before, 0.0), length - _compute_loss(radius, after, 0.0)
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
def _find_shown_at(strip, u, count, rivals, radius, slack):  # type: ignore[no-untyped-def]
    share = strip.first + u * strip.span
    tilt = strip.rise + share * max(strip.up, 0.0)
    low = strip.up / strip.left if strip.left < 0.0 else -WIDEST
    high = strip.up / strip.left if strip.left > 0.0 else WIDEST
    if abs(tilt) > STEEPEST or low >= WIDEST or high <= -WIDEST:
        return 0.0, -1.0, tilt
    s = strip.start + u * strip.run
    ball = (s * math.sqrt(1.0 - strip.rise * strip.rise), s * strip.rise)
    shear = share * strip.left
    return find_shown(count, rivals, strip.skip, ball, tilt, shear, radius, max(low, -WIDEST), min(high, WIDEST), slack)


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
        s = min(_compute_loss(radius, strip.before, across), strip.start + strip.run)
    elif u == 1.0:
        s = max(strip.whole - _compute_loss(radius, strip.after, across), strip.start)
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
    """Return the ends of the line nearest to a parabola with values a, b, c in the middles of thirds, with the same
    mean.
    """
    mean, half = (3.0 * a + 2.0 * b + 3.0 * c) / 8.0, 0.75 * (c - a)
    return mean - half, mean + half


@njit(cache=True, nogil=True)
def _parts_shown(strip, parts, count, rivals, radius, slack):  # type: ignore[no-untyped-def]
    """Return (first, last), last excluded: the parts in which a ball at a corner is visible. The visible part of a ball
    is convex, so nothing beyond a hidden place is visible.
    """
    cells = 3 * parts
    low, high, seen = 0, cells - 1, -1
    while low <= high and seen < 0:
        middle = (low + high) // 2
        shown = _find_shown_at(strip, (middle + 0.5) / cells, count, rivals, radius, slack)
        if shown[0] < shown[1]:
            seen = middle
        elif shown[2] > 0.0:
            high = middle - 1
        else:
            low = middle + 1
    if seen < 0:
        return 0, 0
    left, right = seen, seen  # the outermost parts that are known to be visible
    while low < left:
        middle = (low + left) // 2
        shown = _find_shown_at(strip, (middle + 0.5) / cells, count, rivals, radius, slack)
        if shown[0] < shown[1]:
            left = middle
        else:
            low = middle + 1
    while right < high:
        middle = (right + high + 1) // 2
        shown = _find_shown_at(strip, (middle + 0.5) / cells, count, rivals, radius, slack)
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
        middle = _find_shown_at(strip, 0.5 * (u0 + u1), count, rivals, radius, slack)
        before = _find_shown_at(strip, u0 + 0.5 * third, count, rivals, radius, slack)
        after = _find_shown_at(strip, u1 - 0.5 * third, count, rivals, radius, slack)
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
