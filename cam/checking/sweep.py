"""The kernels of `cam.checking.removal`: one ball along one batch of moves, cell by cell. Its theory stands there."""

from __future__ import annotations

import math

from numba import njit

_SMOOTH_COS = 0.9  # corners sharper than this (26 degrees) get their whole disc
_STILL_MM = 1e-9  # a move shorter than this in plan is vertical
# Columns of a tally, per move: volume taken off left and right of the travel, how high above the tip stock was cut, and
# how far stock stood above the flutes within the shank's reach, at which cell.
LEFT, RIGHT, REACH, STRIKE, STRIKE_CELL = range(5)
TALLIES = 5
# Slots of the carried corner: unit direction, slope/q, start flag, rapid flag.
_EX, _EY, _TILT, _KIND, _WAS_RAPID = range(5)
_NONE, _VERTICAL, _ALONG = 0.0, 1.0, 2.0


@njit(cache=True, nogil=True)
def cap(top, by_line, x0, y0, cell, high, cx, cy, cz, radius, first_row, row_step, line):  # type: ignore[no-untyped-def]
    """The ball standing still with its tip at (cx, cy, cz).

    Returns (greatest drop, flat cell index, height above the tip at which stock was cut).
    """
    deep = reach_up = 0.0
    place = -1
    rise = high - cz
    if rise <= 0.0:
        return deep, place, reach_up
    reach2 = radius * radius if rise >= radius else rise * (2.0 * radius - rise)
    reach = math.sqrt(reach2)
    ny, nx = top.shape
    j0 = max(0, int(math.ceil((cy - reach - y0) / cell - 0.5)))
    j1 = min(ny - 1, int(math.floor((cy + reach - y0) / cell - 0.5)))
    j0 += (first_row - j0) % row_step
    for j in range(j0, j1 + 1, row_step):
        dy = y0 + (j + 0.5) * cell - cy
        half2 = reach2 - dy * dy
        if half2 < 0.0:
            continue
        half = math.sqrt(half2)
        i0 = max(0, int(math.ceil((cx - half - x0) / cell - 0.5)))
        i1 = min(nx - 1, int(math.floor((cx + half - x0) / cell - 0.5)))
        for i in range(i0, i1 + 1):
            dx = x0 + (i + 0.5) * cell - cx
            r2 = radius * radius - dx * dx - dy * dy
            if r2 > 0.0:
                f = cz + radius - math.sqrt(r2)
                drop = top[j, i] - f
                if drop > 0.0:
                    reach_up = max(reach_up, top[j, i] - cz)
                    top[j, i] = f
                    by_line[j, i] = line
                    if drop > deep:
                        deep = drop
                        place = j * nx + i
    return deep, place, reach_up


@njit(cache=True, nogil=True)
def _highest(ceiling, tile, x0, y0, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Upper bound of the stock within the ball's radius of the segment; see RemovalGrid._ceiling."""
    nty, ntx = ceiling.shape
    steps = int(math.hypot(bx - ax, by - ay) / tile) + 1
    high = -math.inf
    for k in range(steps):
        t = k / steps
        i = min(max(int((ax + t * (bx - ax) - x0) / tile), 0), ntx - 1)
        j = min(max(int((ay + t * (by - ay) - y0) / tile), 0), nty - 1)
        high = max(high, ceiling[j, i])
    return high


@njit(cache=True, nogil=True)
def _strike(top, x0, y0, cell, a, b, reach, flutes, first_row, row_step):  # type: ignore[no-untyped-def]
    """How far stock stands above the flutes within `reach` of the axis on its way from a to b: (height, flat cell)."""
    ny, nx = top.shape
    worst = 0.0
    place = -1
    length = math.hypot(b[0] - a[0], b[1] - a[1])
    along = length > _STILL_MM
    ex = (b[0] - a[0]) / length if along else 0.0
    ey = (b[1] - a[1]) / length if along else 0.0
    slope = (b[2] - a[2]) / length if along else 0.0
    foot = a[2] if along else min(a[2], b[2])
    j0 = max(0, int(math.ceil((min(a[1], b[1]) - reach - y0) / cell - 0.5)))
    j1 = min(ny - 1, int(math.floor((max(a[1], b[1]) + reach - y0) / cell - 0.5)))
    i0 = max(0, int(math.ceil((min(a[0], b[0]) - reach - x0) / cell - 0.5)))
    i1 = min(nx - 1, int(math.floor((max(a[0], b[0]) + reach - x0) / cell - 0.5)))
    lowest = min(a[2], b[2]) + flutes
    j0 += (first_row - j0) % row_step
    for j in range(j0, j1 + 1, row_step):
        for i in range(i0, i1 + 1):
            if top[j, i] - lowest <= worst:
                continue
            dx = x0 + (i + 0.5) * cell - a[0]
            dy = y0 + (j + 0.5) * cell - a[1]
            u = dx * ex + dy * ey
            half2 = reach * reach - (dx * dx + dy * dy - u * u)
            if half2 <= 0.0:
                continue
            half = math.sqrt(half2)
            from_s = max(0.0, u - half)
            to_s = min(length, u + half) if along else 0.0
            if from_s > to_s:
                continue
            tip = foot + slope * (from_s if slope > 0.0 else to_s)
            over = top[j, i] - tip - flutes
            if over > worst:
                worst = over
                place = j * nx + i
    return worst, place


@njit(cache=True, nogil=True)
def sweep(  # type: ignore[no-untyped-def]
    top,
    by_line,
    x0,
    y0,
    cell,
    ceiling,
    tile,
    points,
    rapid,
    line,
    owner_line,
    radius,
    keep_off,
    shank,
    first_row,
    row_step,
    corner,
    drops,
    places,
    tally,
):
    """Move the ball along points; cells of rows first_row, first_row + row_step, ... only.

    shank    : (reach, flutes, ceiling): nothing within reach of the axis may stand higher than that above the tip;
               reach 0: not asked
    keep_off : where a rapid along Z ends the ball counts as this much lower, so that coming too near shows as a drop

    drops, places (n + 1) : greatest drop and its cell; slot k + 1 is move k, slot 0 the last move before these
    tally (n + 1, 5)      : see LEFT ... STRIKE_CELL
    corner                : carried between calls; owner_line is the line of that last move
    returns               : index of the last move that moved, or -1
    """
    ny, nx = top.shape
    x1 = x0 + nx * cell
    y1 = y0 + ny * cell
    area = cell * cell
    reach, flutes, shank_ceiling = shank
    owner = -1
    for k in range(line.size):
        ax, ay, az = points[k, 0], points[k, 1], points[k, 2]
        bx, by, bz = points[k + 1, 0], points[k + 1, 1], points[k + 1, 2]
        if ax == bx and ay == by and az == bz:
            continue
        length = math.hypot(bx - ax, by - ay)
        is_rapid = 1.0 if rapid[k] else 0.0
        kind = _ALONG if length > _STILL_MM else _VERTICAL
        ex = ey = slope = tilt = 0.0
        q = 1.0
        if kind == _ALONG:
            ex = (bx - ax) / length
            ey = (by - ay) / length
            slope = (bz - az) / length
            q = math.sqrt(1.0 + slope * slope)
            tilt = slope / q
        turn_cos = ex * corner[_EX] + ey * corner[_EY]
        smooth = kind == _ALONG and corner[_KIND] == _ALONG and is_rapid == corner[_WAS_RAPID]
        smooth = smooth and turn_cos > _SMOOTH_COS
        if reach > 0.0 and _highest(shank_ceiling, tile, x0, y0, ax, ay, bx, by) > min(az, bz) + flutes:
            over, place = _strike(top, x0, y0, cell, points[k], points[k + 1], reach, flutes, first_row, row_step)
            if over > tally[k + 1, STRIKE]:
                tally[k + 1, STRIKE] = over
                tally[k + 1, STRIKE_CELL] = place
        near = (
            min(ax, bx) - radius < x1
            and max(ax, bx) + radius > x0
            and min(ay, by) - radius < y1
            and max(ay, by) + radius > y0
        )
        if near:
            high = _highest(ceiling, tile, x0, y0, ax, ay, bx, by)
            if not smooth:
                mine = k if corner[_KIND] == _NONE else owner
                number = line[mine] if mine >= 0 else owner_line
                foot = az - keep_off if corner[_KIND] == _VERTICAL and corner[_WAS_RAPID] == 1.0 else az
                deep, place, up = cap(
                    top, by_line, x0, y0, cell, high, ax, ay, foot, radius, first_row, row_step, number
                )
                tally[mine + 1, REACH] = max(tally[mine + 1, REACH], up)
                if deep > drops[mine + 1]:
                    drops[mine + 1] = deep
                    places[mine + 1] = place
            lowest = min(az, bz)
            rise = high - lowest
            if kind == _ALONG and rise > 0.0:
                wide = radius if rise >= radius else math.sqrt(rise * (2.0 * radius - rise))
                thin = math.sqrt(max(0.0, radius * radius - wide * wide))  # least rho in the strip
                low = min(tilt * thin, tilt * radius)
                if smooth:  # reach back over the wedge at the corner
                    back = min(corner[_TILT] * thin, corner[_TILT] * radius)
                    turn_sin = abs(ex * corner[_EY] - ey * corner[_EX])
                    low = min(low, (back - turn_sin * wide) / turn_cos, back - turn_sin * wide)
                low -= 1e-9
                far = length + max(tilt * thin, tilt * radius) + 1e-9
                edge = wide + 1e-9
                reach_lo = min(low * ey, far * ey) - edge * abs(ex)
                reach_hi = max(low * ey, far * ey) + edge * abs(ex)
                j0 = max(0, int(math.ceil((ay + reach_lo - y0) / cell - 0.5)))
                j1 = min(ny - 1, int(math.floor((ay + reach_hi - y0) / cell - 0.5)))
                j0 += (first_row - j0) % row_step
                for j in range(j0, j1 + 1, row_step):
                    dy = y0 + (j + 0.5) * cell - ay
                    # dx with low <= dx ex + dy ey <= far and |dy ex - dx ey| <= edge
                    dx_lo = -1e30
                    dx_hi = 1e30
                    if abs(ex) > 1e-12:
                        p = (low - dy * ey) / ex
                        r = (far - dy * ey) / ex
                        dx_lo = min(p, r)
                        dx_hi = max(p, r)
                    if abs(ey) > 1e-12:
                        p = (dy * ex - edge) / ey
                        r = (dy * ex + edge) / ey
                        dx_lo = max(dx_lo, min(p, r))
                        dx_hi = min(dx_hi, max(p, r))
                    i0 = int(math.ceil(max((ax + dx_lo - x0) / cell - 0.5, 0.0)))
                    i1 = int(math.floor(min((ax + dx_hi - x0) / cell - 0.5, nx - 1.0)))
                    for i in range(i0, i1 + 1):
                        dx = x0 + (i + 0.5) * cell - ax
                        u = dx * ex + dy * ey
                        w = dy * ex - dx * ey
                        rho2 = radius * radius - w * w
                        over = lowest + radius - top[j, i]  # the ball is nowhere lower than this less rho
                        if rho2 <= 0.0 or (over > 0.0 and rho2 <= over * over):
                            continue
                        rho = math.sqrt(rho2)
                        s = u - rho * tilt
                        tip = az
                        if s <= 0.0:
                            r2 = rho2 - u * u
                            if r2 <= 0.0:
                                continue
                            f = az + radius - math.sqrt(r2)
                        elif s >= length:
                            r2 = rho2 - (u - length) * (u - length)
                            if r2 <= 0.0:
                                continue
                            f = bz + radius - math.sqrt(r2)
                            tip = bz
                        else:
                            f = az + radius + slope * u - q * rho
                            tip = az + slope * s
                        drop = top[j, i] - f
                        if drop > 0.0:
                            tally[k + 1, LEFT if w > 0.0 else RIGHT] += drop * area
                            if top[j, i] - tip > tally[k + 1, REACH]:
                                tally[k + 1, REACH] = top[j, i] - tip
                            top[j, i] = f
                            by_line[j, i] = line[k]
                            if drop > drops[k + 1]:
                                drops[k + 1] = drop
                                places[k + 1] = j * nx + i
        owner = k
        corner[_EX] = ex
        corner[_EY] = ey
        corner[_TILT] = tilt
        corner[_KIND] = kind
        corner[_WAS_RAPID] = is_rapid
    return owner
