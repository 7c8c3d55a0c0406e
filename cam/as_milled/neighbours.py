"""What a ball shows of itself between its rivals, the neighbouring chords: one interval of angles across its track.

A point of the ball with centre c and radius R is c + R v, v a unit vector. It lies outside another ball of the path, d
away, where 2 R v . d < |d|^2 (for equal radii): a half-space in v, so what a ball shows of itself is cut out by
half-spaces on any path: neighbours, crossings, deeper tracks that hide it altogether. While the tool
moves along t only points with v . t = 0 stay: v = f b - n, one angle f across the track, with the frame t, b, n turned
so that n is about the surface's normal. Each other chord bounds f from one side, or hides the place, in closed form:
f < min X / D over its balls, X = d_n + |d|^2 / 2R and D = d_b (squares of f, some 1e-4, are left out).

Balls of different radii are compared by their lowest points towards n: exact where they touch the same surface, off by
d^2 / 2 (1/R1 - 1/R2) at a border between two programs.
"""

from __future__ import annotations

import math

from numba import njit

FACTS = 11  # of one rival, see `turn_to_frame`
WIDEST = 0.3  # rad: what a ball without a neighbour shows, to either side
_CROSSING = 0.3  # tangent of the angle at which tracks cross
_POINT = 1e-18  # mm: half the square of a chord that is none in its frame, over the radius
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
def are_crossed(count, rivals):  # type: ignore[no-untyped-def]
    """Return whether another track runs across this one: then what it shows changes from place to place."""
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
def shown(count, rivals, skip, ball, tilt, shear, radius, low, high, slack):  # type: ignore[no-untyped-def]
    """Return (low, high, ahead): the angles across that a ball shows within those; low >= high: none, and what hides
    the ball hides even more of it with a larger tilt where `ahead` is positive, with a smaller one else. Rival `skip`
    does not count.

    ball        : its centre (t, n) in the frame
    tilt, shear : where it is asked: tilt - shear f ahead of n
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
