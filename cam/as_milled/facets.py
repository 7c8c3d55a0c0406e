"""What each chord of the path leaves of itself on the surface: the part where its ball was lowest, as small facets.

Theory of operation. A point of the ball with centre c and radius R is c + R v, v a unit vector. It lies outside another
ball of the path, d away, where 2 R v . d < |d|^2 (for equal radii): a half-space in v, so what a ball shows of itself
is cut out by half-spaces, whatever the path is like: neighbours, crossings, deeper tracks that hide it altogether.
While the tool moves along t only points with v . t = 0 stay: v = f b - n, one angle f across the track, with the frame
t, b, n turned so that n is about the surface's normal. Each other chord bounds f from one side, or hides the place, in
closed form: f < min X / D over its balls, X = d_n + |d|^2 / 2R and D = d_b (squares of f, some 1e-4, are left out). So
a short piece of a chord shows one interval of f, and slopes and places at its ends follow.

Between two chords: where the path bends down (a hill) both lose R / 2 times the bend to one another; where it bends up
the ball at the corner shows itself between the two, in slices that are treated like pieces.

Balls of different radii are compared by their lowest points towards n: exact where they touch the same surface, off by
d^2 / 2 (1/R1 - 1/R2) at a border between two programs.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cam.as_milled.chords import gather
from optics.heightfield import spline_jet

ROOM = 1024  # neighbours of one chord
SLICES = 32  # of a corner's ball, at most
_WIDEST = 0.3  # rad: what a ball without a neighbour shows, to either side
_TURNED = 0.03  # rad: a frame farther from the surface's normal than this is set up anew
_CROSSING = 0.3  # tangent of the angle at which tracks cross
_SPARE = 0.01  # rad: added to the tilts at which a ball may show at all
_TIE_MM = 1e-9  # of two equal balls the earlier one counts as lower


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
def _set_frame(tips, k, nx, ny, nz, frame):  # type: ignore[no-untyped-def]
    """frame (3, 3): t along chord k, b to its left, n as near to the given normal as may be; returns the length."""
    tx, ty, tz = tips[k, 0] - tips[k - 1, 0], tips[k, 1] - tips[k - 1, 1], tips[k, 2] - tips[k - 1, 2]
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx / length, ty / length, tz / length
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    size = math.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx / size, by / size, bz / size
    frame[0, 0], frame[0, 1], frame[0, 2] = tx, ty, tz
    frame[1, 0], frame[1, 1], frame[1, 2] = bx, by, bz
    frame[2, 0], frame[2, 1], frame[2, 2] = ty * bz - tz * by, tz * bx - tx * bz, tx * by - ty * bx
    return length


@njit(cache=True, nogil=True)
def _are_crossed(count, rivals):  # type: ignore[no-untyped-def]
    """Whether another track runs across this one: then what it shows changes from place to place."""
    crossed = False
    for m in range(count):
        crossed = crossed or abs(rivals[m, 4]) > _CROSSING * abs(rivals[m, 3])
    return crossed


@njit(cache=True, nogil=True)
def _in_frame(c, k, frame, radius, near, count, rivals):  # type: ignore[no-untyped-def]
    """rivals (count, 8): the neighbours' beginnings (t, b, n) from that of chord k, ways, who wins a tie, names."""
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


@njit(cache=True, nogil=True)
def _first(rivals, m):  # type: ignore[no-untyped-def]
    """Whoever hides one piece will hide the next: it is asked first from now on."""
    for d in range(rivals.shape[1]):
        rivals[0, d], rivals[m, d] = rivals[m, d], rivals[0, d]


@njit(cache=True, nogil=True, error_model="numpy")
def _shown(count, rivals, skip, s, offset, radius):  # type: ignore[no-untyped-def]
    """(low, high): the angles across that the ball at s shows; low >= high: nothing. Chord `skip` does not count."""
    low, high = -_WIDEST, _WIDEST
    half = 0.5 / radius
    for m in range(count):
        if rivals[m, 7] == skip:
            continue
        t, b, dt, db = rivals[m, 0] - s, rivals[m, 1], rivals[m, 3], rivals[m, 4]
        alpha = half * (dt * dt + db * db)
        beta = rivals[m, 5] + 2.0 * half * (t * dt + b * db)
        gamma = rivals[m, 2] + half * (t * t + b * b) - offset - rivals[m, 6]
        near = min(max(-0.5 * beta / alpha, 0.0), 1.0)
        least = gamma + near * (beta + alpha * near)
        end = b + db
        most = max(abs(b), abs(end))
        if least > most * max(high, -low):
            continue
        if b * end > 0.0 and abs(db) < 1e-3 * most:  # as good as parallel
            bound = least / (b + near * db)
            if b > 0.0:
                high = min(high, bound)
            else:
                low = max(low, bound)
        elif abs(db) < 1e-12:  # straight ahead or behind
            if least < 0.0:
                _first(rivals, m)
                return 0.0, -1.0
        else:
            curve = alpha / (db * db)
            at = -b / db
            level = gamma + at * (beta + alpha * at)  # X where D is 0; X / D is least at the root
            first, last = min(b, end), max(b, end)
            if first <= 0.0 <= last and level < 0.0:
                _first(rivals, m)
                return 0.0, -1.0
            root = math.sqrt(max(level, 0.0) / curve)
            if last > 0.0:
                d = min(max(root, first), last)
                if d > 0.0:
                    way = (d - b) / db
                    high = min(high, (gamma + way * (beta + alpha * way)) / d)
            if first < 0.0:
                d = max(min(-root, last), first)
                if d < 0.0:
                    way = (d - b) / db
                    low = max(low, (gamma + way * (beta + alpha * way)) / d)
        if low >= high:
            _first(rivals, m)
            break
    return low, high


@njit(cache=True, nogil=True)
def _bend(tips, k, frame, sign):  # type: ignore[no-untyped-def]
    """(up, left) of chord k's direction in the frame of its neighbour, times sign, and its length; per way ahead."""
    tx, ty, tz = tips[k, 0] - tips[k - 1, 0], tips[k, 1] - tips[k - 1, 1], tips[k, 2] - tips[k - 1, 2]
    ahead = frame[0, 0] * tx + frame[0, 1] * ty + frame[0, 2] * tz
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    ahead = max(ahead, 0.3 * length)
    left = frame[1, 0] * tx + frame[1, 1] * ty + frame[1, 2] * tz
    up = frame[2, 0] * tx + frame[2, 1] * ty + frame[2, 2] * tz
    return sign * up / ahead, sign * left / ahead, length


@njit(cache=True, nogil=True)
def _corner(tips, k, frame, radius, s, along, across, out):  # type: ignore[no-untyped-def]
    """out (5,): x, y, z and slopes where the ball at s along chord k shows `along` and `across`."""
    down = math.sqrt(1.0 - along * along - across * across)
    vx = along * frame[0, 0] + across * frame[1, 0] - down * frame[2, 0]
    vy = along * frame[0, 1] + across * frame[1, 1] - down * frame[2, 1]
    vz = along * frame[0, 2] + across * frame[1, 2] - down * frame[2, 2]
    out[0] = tips[k - 1, 0] + s * frame[0, 0] + radius * vx
    out[1] = tips[k - 1, 1] + s * frame[0, 1] + radius * vy
    out[2] = tips[k - 1, 2] + s * frame[0, 2] + radius * (1.0 + vz)
    out[3] = -vx / vz
    out[4] = -vy / vz


@njit(cache=True, nogil=True)
def _lost(radius, bend, across):  # type: ignore[no-untyped-def]
    """What a chord loses to the next one beyond a hill; 0 where that is too short: then its neighbours tell."""
    loss = -0.5 * radius * min(bend[0] - bend[1] * across, 0.0)
    return loss if loss < bend[2] else 0.0


@njit(cache=True, nogil=True)
def _pieces(tips, k, frame, radius, length, piece, before, after, count, rivals, out, filled):  # type: ignore[no-untyped-def]
    """Facets of chord k itself; before, after: bends at its ends, see `_bend`."""
    most = max(1, int(math.ceil(length / piece - 1e-9)))
    start, end = _lost(radius, before, 0.0), length - _lost(radius, after, 0.0)
    if start >= end:
        return filled
    parts = max(1, int(math.ceil((end - start) / length * most - 1e-9)))
    for m in range(parts):
        s0, s1 = start + (end - start) * m / parts, start + (end - start) * (m + 1) / parts
        low, high = _shown(count, rivals, -1, 0.5 * (s0 + s1), 0.0, radius)
        if low >= high:
            continue
        for corner in range(4):
            across = low if corner == 0 or corner == 1 else high
            s = s0 if corner == 0 or corner == 3 else s1
            if m == 0 and (corner == 0 or corner == 3):
                s = min(_lost(radius, before, across), s1)
            elif m == parts - 1 and (corner == 1 or corner == 2):
                s = max(length - _lost(radius, after, across), s0)
            _corner(tips, k, frame, radius, s, 0.0, across, out[filled, corner])
        filled += 1
    return filled


@njit(cache=True, nogil=True)
def _slices(tips, k, frame, radius, length, piece, turn, count, rivals, out, filled):  # type: ignore[no-untyped-def]
    """Facets of the ball at the end of chord k; turn: the bend there (up, left), and the tilts where it shows."""
    up, left, least, most = turn
    first, last = 0.0, 1.0
    if up > 0.0:
        first, last = min(max(least / up, 0.0), 1.0), min(max(most / up, 0.0), 1.0)
    parts = min(max(1, int(math.ceil(radius * (last - first) * max(up, 0.0) / piece))), SLICES)
    step = (last - first) / parts
    for m in range(parts):
        along = (first + (m + 0.5) * step) * max(up, 0.0)
        low, high = _shown(count, rivals, k + 1, length + radius * along, 0.5 * radius * along * along, radius)
        if left > 0.0:
            high = min(high, up / left)
        elif left < 0.0:
            low = max(low, up / left)
        if low >= high:
            continue
        for corner in range(4):
            across = low if corner == 0 or corner == 1 else high
            share = first + (m if corner == 0 or corner == 3 else m + 1) * step
            along = share * max(up - left * across, 0.0)
            _corner(tips, k, frame, radius, length, along, across, out[filled, corner])
        filled += 1
    return filled


@njit(cache=True, nogil=True)
def _rise(c, k, frame, reach):  # type: ignore[no-untyped-def]
    """How far the path rises out of chord k's direction, per way ahead, from `reach` before it to as far behind it."""
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
    return (frame[2, 0] * wx + frame[2, 1] * wy + frame[2, 2] * wz) / max(ahead, 1e-6)


@njit(cache=True, nogil=True)
def facets_of(c, first, last, surface, reach, longest_piece, shortest_piece, out):  # type: ignore[no-untyped-def]
    """Facets of chords first .. last - 1 into out (room, 4, 5): corners with x, y, z, slope in x, slope in y.

    surface : (coefs, x0, y0, 1 / dx, 1 / dy) of the lens, which only says where the normal is, about
    reach   : how far a ball can be that hides something
    longest_piece, shortest_piece : of chords; the shortest where tracks cross
    returns (facets, chords with more neighbours than there was room for)
    """
    near, rivals = np.empty(ROOM, np.int32), np.empty((ROOM, 8))
    frame = np.empty((3, 3))
    filled = crowded = 0
    px, py, steps = 0.0, 0.0, 8
    for k in range(max(first, 1), last):
        if not c.joined[k]:
            steps = 8
            continue
        radius = c.radii[c.group[k]]
        x, y = 0.5 * (c.tips[k, 0] + c.tips[k - 1, 0]), 0.5 * (c.tips[k, 1] + c.tips[k - 1, 1])
        if steps == 8:
            px, py = x, y
        else:
            px, py = px + c.tips[k, 0] - c.tips[k - 1, 0], py + c.tips[k, 1] - c.tips[k - 1, 1]
        px, py, zx, zy = _slopes_at_contact(surface, x, y, radius, px, py, steps)
        steps = 2
        length = _set_frame(c.tips, k, -zx, -zy, 1.0, frame)
        way, most = _rise(c, k, frame, reach), 1.2 * reach / radius + _SPARE
        count = gather(c, k, reach, ROOM, near)
        crowded += count == ROOM
        _in_frame(c, k, frame, radius, near, count, rivals)
        low, high = _shown(count, rivals, -1, 0.5 * length, 0.0, radius)
        middle = 0.5 * (low + high)
        if low < high and abs(middle) > _TURNED and high < _WIDEST and low > -_WIDEST:
            nx = frame[2, 0] - middle * frame[1, 0]
            ny = frame[2, 1] - middle * frame[1, 1]
            nz = frame[2, 2] - middle * frame[1, 2]
            _set_frame(c.tips, k, nx, ny, nz, frame)
            _in_frame(c, k, frame, radius, near, count, rivals)
        piece = min(longest_piece, shortest_piece) if _are_crossed(count, rivals) else longest_piece
        before = after = (0.0, 0.0, 0.0)
        if c.joined[k - 1]:
            before = _bend(c.tips, k - 1, frame, -1.0)
        goes_on = k + 1 < c.joined.size and c.joined[k + 1]
        if goes_on:
            after = _bend(c.tips, k + 1, frame, 1.0)
        if abs(way) < most:
            filled = _pieces(c.tips, k, frame, radius, length, piece, before, after, count, rivals, out, filled)
        if goes_on and (after[0] > 1e-9 or abs(after[1]) > 1e-9):
            turn = (*after[:2], way - most, way + most)
            filled = _slices(c.tips, k, frame, radius, length, piece, turn, count, rivals, out, filled)
    return filled, crowded
