"""The kernels of `cam.checking.removal`: one ball along one batch of moves, cell by cell. See there for the theory."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_SMOOTH_COS = 0.9  # corners sharper than this (26 degrees) get their whole disc
_SLACK = 1e-9
_RIM = 1e-12  # of the squared radius: a cell closer to the rim of the disc than rounding errors is touched, not cut
_NO_WEDGE = 2.0  # a value that no sine of a slope has
_TIMES, _PARALLEL = 3, 1e-3  # turns of narrowing a strip down; one does where the way is parallel to an axis
TILE = 8  # cells a side, whose highest one is known
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
    """Cut with the ball standing still, its tip at (cx, cy, cz).

    Returns (greatest drop, flat cell index, height above the tip at which stock was cut).
    """
    deep = reach_up = 0.0
    place = -1
    rise = high - cz
    if rise <= 0.0:
        return deep, place, reach_up
    reach2 = radius * radius if rise >= radius else rise * (2.0 * radius - rise)
    reach, rim2 = math.sqrt(reach2), _RIM * radius * radius
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
            if r2 > rim2:
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
def find_highest_near(ceiling, tile, x0, y0, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Return an upper bound of the stock within the ball's radius of the segment; see RemovalGrid._ceiling."""
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
def find_way(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    """Return whether a move advances in plan, its length and direction there, and its slope; 0 if it does not."""
    length = math.hypot(bx - ax, by - ay)
    if length <= _STILL_MM:
        return False, length, 0.0, 0.0, 0.0
    return True, length, (bx - ax) / length, (by - ay) / length, (bz - az) / length


@njit(cache=True, nogil=True)
def find_strike(top, x0, y0, cell, a, b, reach, flutes, first_row, row_step):  # type: ignore[no-untyped-def]
    """Return how far stock stands above the flutes within `reach` of the axis on its way from a to b: (height, flat
    cell).
    """
    ny, nx = top.shape
    worst = 0.0
    place = -1
    along, length, ex, ey, slope = find_way(a[0], a[1], a[2], b[0], b[1], b[2])
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
def crown(top, tile_row, tile_column, first_row, row_step):  # type: ignore[no-untyped-def]
    """Return the highest stock in one tile, in rows first_row, first_row + row_step, ... only."""
    ny, nx = top.shape
    high = -math.inf
    j0 = tile_row * TILE
    for j in range(j0 + (first_row - j0) % row_step, min(j0 + TILE, ny), row_step):
        for i in range(tile_column * TILE, min(tile_column * TILE + TILE, nx)):
            high = max(high, top[j, i])
    return high


@njit(cache=True, nogil=True)
def crowns_of(top, first_row, row_step):  # type: ignore[no-untyped-def]
    """Return the highest stock in each tile."""
    ny, nx = top.shape
    crowns = np.empty((-(-ny // TILE), -(-nx // TILE)))
    for j in range(crowns.shape[0]):
        for i in range(crowns.shape[1]):
            crowns[j, i] = crown(top, j, i, first_row, row_step)
    return crowns


@njit(cache=True, nogil=True)
def _highest_crown(crowns, tiles, across):  # type: ignore[no-untyped-def]
    """Return the highest crown. tiles: (row or column of tiles, from, to in it)."""
    block, first, last = tiles
    high = -math.inf
    for t in range(first, last + 1):
        high = max(high, crowns[t, block] if across else crowns[block, t])
    return high


@njit(cache=True, nogil=True)
def _lower(crowns, tiles, across, top, first_row, row_step):  # type: ignore[no-untyped-def]
    block, first, last = tiles
    for t in range(first, last + 1):
        j, i = (t, block) if across else (block, t)
        crowns[j, i] = crown(top, j, i, first_row, row_step)


@njit(cache=True, nogil=True)
def _between(w_lo, w_hi, strip):  # type: ignore[no-untyped-def]
    """Return the range of u of the points with w_lo <= |w| <= w_hi that this move, or the wedge before it, cuts lowest.

    wedge : cosine and sine of the turn, tilt of the move before; _NO_WEDGE where none opens
    """
    radius, wide, tilt, length, (turn_cos, turn_sin, before) = strip
    rho_lo = math.sqrt(max(0.0, radius * radius - w_hi * w_hi))
    rho_hi = math.sqrt(max(0.0, radius * radius - w_lo * w_lo))
    low = min(tilt * rho_lo, tilt * rho_hi)
    high = length + max(tilt * rho_lo, tilt * rho_hi)
    if before != _NO_WEDGE:  # there u' >= before rho' along the move before, and |w'| is |w| but for R sin at most
        shift = radius * turn_sin
        far_w, near_w = min(wide, w_hi + shift), max(0.0, w_lo * turn_cos - shift)
        back_lo = before * math.sqrt(max(0.0, radius * radius - far_w * far_w))
        back_hi = before * math.sqrt(max(0.0, radius * radius - near_w * near_w))
        back = min(back_lo, back_hi) - turn_sin * w_hi
        low = min(low, back / turn_cos, back)
    return low - _SLACK, high + _SLACK


@njit(cache=True, nogil=True)
def _bent(d_lo, d_hi, e_in, e_out, low, high, strip):  # type: ignore[no-untyped-def]
    """Return (from, to) in u of the strip where it meets cell lines d_lo to d_hi beside the start, and the least |w|.

    The strip of a steep move is bent like the ball: with |w| nearly known, u is as well. w = (d - u e_out) / e_in.
    """
    wide = strip[1]
    for _ in range(_TIMES):
        p, r = d_lo - low * e_out, d_lo - high * e_out
        w_lo, w_hi = min(p, r), max(p, r) + d_hi - d_lo
        if e_in < 0.0:
            w_lo, w_hi = -w_hi, -w_lo
        stretch = abs(e_in)
        w_lo, w_hi = w_lo / stretch, w_hi / stretch
        near_w = 0.0 if w_lo * w_hi <= 0.0 else min(abs(w_lo), abs(w_hi))
        if near_w > wide + _SLACK:
            break
        from_u, to_u = _between(near_w, min(wide, max(abs(w_lo), abs(w_hi))), strip)
        low, high = max(low, from_u), min(high, to_u)
        if low > high or abs(e_out) < _PARALLEL:
            break
    return low, high, near_w


@njit(cache=True, nogil=True)
def sweep(  # type: ignore[no-untyped-def]
    top,
    by_line,
    x0,
    y0,
    cell,
    ceiling,
    tile,
    crowns,
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

    crowns   : highest stock in each TILE x TILE cells, of these rows; kept up to date
    shank    : (reach, flutes, ceiling): nothing within reach of the axis may stand higher than that above the tip;
               reach 0: not asked
    keep_off : at the end of a rapid along Z the ball counts as lower by this, so that a rapid too near the stock shows
               as a drop

    drops, places (n + 1) : greatest drop and its cell; slot k + 1 is move k, slot 0 the last move before these
    tally (n + 1, 5)      : see LEFT ... STRIKE_CELL
    corner                : carried between calls; owner_line is the line of that last move
    returns               : index of the last move that moved, or -1
    """
    ny, nx = top.shape
    x1 = x0 + nx * cell
    y1 = y0 + ny * cell
    area, rim2 = cell * cell, _RIM * radius * radius
    reach, flutes, shank_ceiling = shank
    owner = -1
    for k in range(line.size):
        ax, ay, az = points[k, 0], points[k, 1], points[k, 2]
        bx, by, bz = points[k + 1, 0], points[k + 1, 1], points[k + 1, 2]
        if ax == bx and ay == by and az == bz:
            continue
        along, length, ex, ey, slope = find_way(ax, ay, az, bx, by, bz)
        is_rapid = 1.0 if rapid[k] else 0.0
        kind = _ALONG if along else _VERTICAL
        q = math.sqrt(1.0 + slope * slope)
        tilt = slope / q
        turn_cos = ex * corner[_EX] + ey * corner[_EY]
        smooth = kind == _ALONG and corner[_KIND] == _ALONG and is_rapid == corner[_WAS_RAPID]
        smooth = smooth and turn_cos > _SMOOTH_COS
        if reach > 0.0 and find_highest_near(shank_ceiling, tile, x0, y0, ax, ay, bx, by) > min(az, bz) + flutes:
            over, place = find_strike(top, x0, y0, cell, points[k], points[k + 1], reach, flutes, first_row, row_step)
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
            peak = find_highest_near(ceiling, tile, x0, y0, ax, ay, bx, by)
            if not smooth:
                mine = k if corner[_KIND] == _NONE else owner
                number = line[mine] if mine >= 0 else owner_line
                standing_z = az - keep_off if corner[_KIND] == _VERTICAL and corner[_WAS_RAPID] == 1.0 else az
                deep, place, up = cap(
                    top, by_line, x0, y0, cell, peak, ax, ay, standing_z, radius, first_row, row_step, number
                )
                tally[mine + 1, REACH] = max(tally[mine + 1, REACH], up)
                if deep > drops[mine + 1]:
                    drops[mine + 1] = deep
                    places[mine + 1] = place
            lowest = min(az, bz)
            rise = peak - lowest
            if kind == _ALONG and rise > 0.0:
                wide = radius if rise >= radius else math.sqrt(rise * (2.0 * radius - rise))
                turn_sin = abs(ex * corner[_EY] - ey * corner[_EX])
                wedge = (turn_cos, turn_sin, corner[_TILT] if smooth else _NO_WEDGE)
                strip = (radius, wide, tilt, length, wedge)
                u_lo, u_hi = _between(0.0, wide, strip)
                across = abs(ex) < abs(ey)  # lines of cells run along the axis closer to the direction of the move
                e_in, e_out = (ey, ex) if across else (ex, ey)
                a_in, a_out = (ay - y0, ax - x0) if across else (ax - x0, ay - y0)
                n_in, n_out = (ny, nx) if across else (nx, ny)
                first_in, step_in = (first_row, row_step) if across else (0, 1)
                first_out, step_out = (0, 1) if across else (first_row, row_step)
                edge = wide + _SLACK
                side = edge * abs(e_in)
                o0 = max(0, int(math.ceil((a_out + min(u_lo * e_out, u_hi * e_out) - side) / cell - 0.5)))
                o1 = min(n_out - 1, int(math.floor((a_out + max(u_lo * e_out, u_hi * e_out) + side) / cell - 0.5)))
                for block in range(o0 // TILE, o1 // TILE + 1):
                    o_lo, o_hi = max(o0, block * TILE), min(o1, block * TILE + TILE - 1)
                    d_lo, d_hi = (o_lo + 0.5) * cell - a_out, (o_hi + 0.5) * cell - a_out
                    from_u, to_u, near_w = _bent(d_lo, d_hi, e_in, e_out, u_lo, u_hi, strip)
                    if from_u > to_u or near_w > edge:
                        continue
                    lines = (from_u / e_in, to_u / e_in) if e_in > 0.0 else (to_u / e_in, from_u / e_in)
                    lean = e_out / e_in
                    i0 = int(math.ceil((a_in + lines[0] - max(d_lo * lean, d_hi * lean)) / cell - 0.5))
                    i1 = int(math.floor((a_in + lines[1] - min(d_lo * lean, d_hi * lean)) / cell - 0.5))
                    tiles = (block, max(i0, 0) // TILE, min(i1, n_in - 1) // TILE)
                    free = max(0.0, from_u) if tilt >= 0.0 else max(0.0, length - to_u)
                    rho2 = radius * radius - near_w * near_w
                    lowest_cut = lowest + radius - math.sqrt(max(0.0, rho2 / (q * q), rho2 - free * free))
                    if _highest_crown(crowns, tiles, across) <= lowest_cut:
                        continue
                    cut = False
                    for o in range(o_lo + (first_out - o_lo) % step_out, o_hi + 1, step_out):
                        d_out = (o + 0.5) * cell - a_out
                        i0 = max(0, int(math.ceil((a_in + lines[0] - d_out * lean) / cell - 0.5)))
                        i1 = min(n_in - 1, int(math.floor((a_in + lines[1] - d_out * lean) / cell - 0.5)))
                        for i in range(i0 + (first_in - i0) % step_in, i1 + 1, step_in):
                            row, column = (i, o) if across else (o, i)
                            d_in = (i + 0.5) * cell - a_in
                            u = d_in * e_in + d_out * e_out
                            w = d_in * e_out - d_out * e_in if across else d_out * e_in - d_in * e_out
                            height = top[row, column]
                            rho2 = radius * radius - w * w
                            over = lowest + radius - height  # the ball is nowhere lower than this minus rho
                            if rho2 <= rim2 or (over > 0.0 and rho2 <= over * over):
                                continue
                            rho = math.sqrt(rho2)
                            s = u - rho * tilt
                            tip = az
                            if s <= 0.0:
                                r2 = rho2 - u * u
                                if r2 <= rim2:
                                    continue
                                f = az + radius - math.sqrt(r2)
                            elif s >= length:
                                r2 = rho2 - (u - length) * (u - length)
                                if r2 <= rim2:
                                    continue
                                f = bz + radius - math.sqrt(r2)
                                tip = bz
                            else:
                                f = az + radius + slope * u - q * rho
                                tip = az + slope * s
                            drop = height - f
                            if drop > 0.0:
                                cut = True
                                tally[k + 1, LEFT if w > 0.0 else RIGHT] += drop * area
                                tally[k + 1, REACH] = max(tally[k + 1, REACH], height - tip)
                                top[row, column] = f
                                by_line[row, column] = line[k]
                                if drop > drops[k + 1]:
                                    drops[k + 1] = drop
                                    places[k + 1] = row * nx + column
                    if cut:
                        _lower(crowns, tiles, across, top, first_row, row_step)
        owner = k
        corner[_EX] = ex
        corner[_EY] = ey
        corner[_TILT] = tilt
        corner[_KIND] = kind
        corner[_WAS_RAPID] = is_rapid
    return owner
