"""The compiled part of `track_gaps`: paints tiles of pixels by tracks, and computes exact distances where paint is
missing.

One bit is one pixel; a track paints, row by row, the run of pixels whose centres lie within half a pitch of it. Lengths
inside a tile are in pixels, its lower left corner is the origin, pixel (i, j) has its centre at (i + 0.5, j + 0.5).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

MICRO = 1e-6  # tracks are stored in whole millionths of a millimetre
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_MOST_TRIED = 512  # bare pixels of a tile whose distance is computed
_SAMPLES = 48  # places tried in every tile, painted or not
_MOST_CLIMBS = 12  # of a tile with bare pixels; 2 of a painted one
_GOLDEN = 2.399963229728653


@njit(cache=True, nogil=True, inline="always")
def _between(table, start, step, at):  # type: ignore[no-untyped-def]
    """Interpolate linearly in a table with even steps; constant beyond its ends."""
    u = (at - start) / step
    last = table.size - 1
    if u <= 0.0:
        return table[0]
    if u >= last:
        return table[last]
    k = int(u)
    return table[k] + (u - k) * (table[k + 1] - table[k])


@njit(cache=True, nogil=True)
def is_inside(rim, x, y):  # type: ignore[no-untyped-def]
    """Return whether (x, y) [mm] lies within rim: (left, right, bottom, top, start, step) of a TipRegion."""
    left, right, bottom, top, start, step = rim
    if x < _between(left, start, step, y) or x > _between(right, start, step, y):
        return False
    return _between(bottom, start, step, x) <= y <= _between(top, start, step, x)


@njit(cache=True, nogil=True, inline="always")
def _fill(bits, j, i0, i1):  # type: ignore[no-untyped-def]
    w0 = i0 >> 6
    w1 = i1 >> 6
    first = _ALL << np.uint64(i0 & 63)
    last = _ALL >> np.uint64(63 - (i1 & 63))
    if w0 == w1:
        bits[j, w0] |= first & last
        return
    bits[j, w0] |= first
    for w in range(w0 + 1, w1):
        bits[j, w] = _ALL
    bits[j, w1] |= last


@njit(cache=True, nogil=True)
def _paint_disc(bits, columns, rows, x, y, radius):  # type: ignore[no-untyped-def]
    """Set the pixels whose centres lie within radius of a point."""
    j0 = max(0, int(math.ceil(y - radius - 0.5)))
    j1 = min(rows - 1, int(math.floor(y + radius - 0.5)))
    for j in range(j0, j1 + 1):
        half = math.sqrt(max(0.0, radius * radius - (j + 0.5 - y) ** 2))
        i0 = int(math.ceil(max(x - half - 0.5, 0.0)))
        i1 = int(math.floor(min(x + half - 0.5, columns - 1.0)))
        if i0 <= i1:
            _fill(bits, j, i0, i1)


@njit(cache=True, nogil=True)
def _paint_strip(bits, columns, rows, ax, ay, ex, ey, first, last, radius):  # type: ignore[no-untyped-def]
    """Set the pixels at first <= u <= last along the unit vector e from a, and |w| <= radius across it.

    All four bounds move evenly from row to row.
    """
    y0 = ay + min(first * ey, last * ey) - radius * abs(ex)
    y1 = ay + max(first * ey, last * ey) + radius * abs(ex)
    j0 = max(0, int(math.ceil(y0 - 0.5)))
    j1 = min(rows - 1, int(math.floor(y1 - 0.5)))
    v = j0 + 0.5 - ay
    low_u = low_w = -1e30
    high_u = high_w = 1e30
    step_u = step_w = 0.0
    if abs(ex) > 1e-9:
        p = ax + (first - v * ey) / ex - 0.5
        q = ax + (last - v * ey) / ex - 0.5
        low_u, high_u, step_u = min(p, q), max(p, q), -ey / ex
    if abs(ey) > 1e-9:
        p = ax + (v * ex - radius) / ey - 0.5
        q = ax + (v * ex + radius) / ey - 0.5
        low_w, high_w, step_w = min(p, q), max(p, q), ex / ey
    most = columns - 1.0
    for j in range(j0, j1 + 1):
        low = max(low_u, low_w, 0.0)
        high = min(high_u, high_w, most)
        if low <= high:
            i0 = int(math.ceil(low))
            i1 = int(high)
            if i0 <= i1:
                _fill(bits, j, i0, i1)
        low_u += step_u
        high_u += step_u
        low_w += step_w
        high_w += step_w


@njit(cache=True, nogil=True)
def _overhang(ex, ey, fx, fy, radius):  # type: ignore[no-untyped-def]
    """Return how far both strips must reach beyond a joint from direction e to f to close its outer wedge; -1: paint a
    disc instead.

    It adds overhang^2 / 2 radius to the radius there, 0.1 % of it at most.
    """
    cos = ex * fx + ey * fy
    if cos < 0.996:
        return -1.0
    return radius * math.sqrt(max(0.0, (1.0 - cos) / (1.0 + cos)))


@njit(cache=True, nogil=True)
def _paint_tracks(bits, columns, rows, tracks, chosen, radius):  # type: ignore[no-untyped-def]
    """Set the pixels whose centres lie within radius of the tracks (n, 4); chosen: their numbers along the path."""
    fx = fy = 1.0
    behind = -1.0
    for n in range(chosen.size):
        ax, ay, bx, by = tracks[n, 0], tracks[n, 1], tracks[n, 2], tracks[n, 3]
        length = math.hypot(bx - ax, by - ay)
        joined = n > 0 and chosen[n] == chosen[n - 1] + 1 and behind >= 0.0
        if not joined:
            _paint_disc(bits, columns, rows, ax, ay, radius)
        if length == 0.0:
            behind = -1.0
            continue
        ex, ey = (bx - ax) / length, (by - ay) / length
        ahead = -1.0
        if n + 1 < chosen.size and chosen[n + 1] == chosen[n] + 1:
            gx, gy = tracks[n + 1, 2] - bx, tracks[n + 1, 3] - by
            size = math.hypot(gx, gy)
            if size > 0.0:
                fx, fy = gx / size, gy / size
                ahead = _overhang(ex, ey, fx, fy, radius)
        if ahead < 0.0:
            _paint_disc(bits, columns, rows, bx, by, radius)
        if min(ax, bx) - radius < columns and max(ax, bx) + radius > 0.0:
            first = -behind if joined else 0.0
            _paint_strip(bits, columns, rows, ax, ay, ex, ey, first, length + max(ahead, 0.0), radius)
        behind = ahead


@njit(cache=True, nogil=True)
def _paint_outside(bits, columns, rows, tile_x, tile_y, pixel, rim):  # type: ignore[no-untyped-def]
    """Set the pixels that do not lie in the region."""
    left, right, bottom, top, start, step = rim
    x_last = tile_x + columns * pixel
    y_last = tile_y + rows * pixel
    for j in range(rows):
        y = tile_y + (j + 0.5) * pixel
        i = int(math.ceil((_between(left, start, step, y) - tile_x) / pixel - 0.5))
        if i > 0:
            _fill(bits, j, 0, min(i, columns) - 1)
        i = int(math.floor((_between(right, start, step, y) - tile_x) / pixel - 0.5)) + 1
        if i < columns:
            _fill(bits, j, max(i, 0), columns - 1)
    if tile_y < bottom.max() or y_last > top.min():
        for i in range(columns):
            x = tile_x + (i + 0.5) * pixel
            if x > x_last:
                break
            bit = np.uint64(1) << np.uint64(i & 63)
            below = int(math.ceil((_between(bottom, start, step, x) - tile_y) / pixel - 0.5))
            for j in range(min(below, rows)):
                bits[j, i >> 6] |= bit
            above = int(math.floor((_between(top, start, step, x) - tile_y) / pixel - 0.5)) + 1
            for j in range(max(above, 0), rows):
                bits[j, i >> 6] |= bit


@njit(cache=True, nogil=True, inline="always")
def _apart(tracks, k, x, y):  # type: ignore[no-untyped-def]
    """Return (dx, dy) from the nearest point of track k to (x, y)."""
    ax = tracks[k, 0]
    ay = tracks[k, 1]
    ex = tracks[k, 2] - ax
    ey = tracks[k, 3] - ay
    length2 = ex * ex + ey * ey
    dx = x - ax
    dy = y - ay
    if length2 > 0.0:
        t = min(max((dx * ex + dy * ey) / length2, 0.0), 1.0)
        dx -= t * ex
        dy -= t * ey
    return dx, dy


@njit(cache=True, nogil=True, inline="always")
def _distance2(tracks, k, x, y):  # type: ignore[no-untyped-def]
    dx, dy = _apart(tracks, k, x, y)
    return dx * dx + dy * dy


@njit(cache=True, nogil=True)
def nearest(tracks, count, x, y):  # type: ignore[no-untyped-def]
    """Return the distance to the nearest of the first `count` tracks (n, 4); inf without any."""
    best = math.inf
    for k in range(count):
        best = min(best, _distance2(tracks, k, x, y))
    return math.sqrt(best)


@njit(cache=True, nogil=True)
def distance_to(points, counts, x, y):  # type: ignore[no-untyped-def]
    """Return the distance [mm] from (x, y) to the nearest of all tracks; points as in `scan_tiles`."""
    track = np.empty((1, 4))
    best = math.inf
    for k in range(counts.size):
        if counts[k]:
            for c in range(2):
                track[0, c] = points[k, c] * MICRO
                track[0, c + 2] = points[k + 1, c] * MICRO
            best = min(best, _distance2(track, 0, x, y))
    return math.sqrt(best)


@njit(cache=True, nogil=True)
def _away(tracks, k, x, y):  # type: ignore[no-untyped-def]
    """Return the unit vector from the nearest point of track k to (x, y)."""
    dx, dy = _apart(tracks, k, x, y)
    size = math.hypot(dx, dy)
    return (dx / size, dy / size) if size > 0.0 else (0.0, 0.0)


@njit(cache=True, nogil=True)
def _ridge(tracks, count, x, y):  # type: ignore[no-untyped-def]
    """Return the direction that keeps the distances to the nearest track and the opposite one equal; (0, 0) if there is
    none.
    """
    first = 0
    for k in range(1, count):
        if _distance2(tracks, k, x, y) < _distance2(tracks, first, x, y):
            first = k
    px, py = _away(tracks, first, x, y)
    second = math.inf
    rx = ry = 0.0
    for k in range(count):
        d2 = _distance2(tracks, k, x, y)
        if d2 < second:
            qx, qy = _away(tracks, k, x, y)
            if px * qx + py * qy < 0.5:
                second = d2
                rx, ry = -(py - qy), px - qx
    size = math.hypot(rx, ry)
    return (rx / size, ry / size) if size > 0.0 else (0.0, 0.0)


@njit(cache=True, nogil=True)
def climb(tracks, count, near, x, y, pitch, tile_x, tile_y, pixel, rim):  # type: ignore[no-untyped-def]
    """Climb from (x, y) to the place farthest from all tracks, half a pitch away at most: (distance, x, y).

    Steps in turning directions and along the ridge between two tracks, halved when none of them leads farther away.
    """
    start_x, start_y = x, y
    best = nearest(tracks, count, x, y)
    reach2 = (best + 1.1 * pitch) ** 2
    kept = 0
    for k in range(count):
        if _distance2(tracks, k, x, y) <= reach2:
            for c in range(4):
                near[kept, c] = tracks[k, c]
            kept += 1
    step = 0.05 * pitch
    turn = 0
    while step > 1e-5 * pitch:
        moved = False
        rx, ry = _ridge(near, kept, x, y)
        for m in range(14):
            if m < 2:
                ux, uy = (rx, ry) if m == 0 else (-rx, -ry)
            else:
                turn += 1
                ux, uy = math.cos(turn * _GOLDEN), math.sin(turn * _GOLDEN)
            px = x + step * ux
            py = y + step * uy
            if math.hypot(px - start_x, py - start_y) > 0.5 * pitch:
                continue
            d = nearest(near, kept, px, py)
            if d > best + 1e-12 and is_inside(rim, tile_x + px * pixel, tile_y + py * pixel):
                best, x, y = d, px, py
                moved = True
                break
        if not moved:
            step *= 0.5
    return best, x, y


@njit(cache=True, nogil=True, inline="always")
def _ones(word):  # type: ignore[no-untyped-def]
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True, nogil=True)
def _list_bare(bits, columns, rows, places):  # type: ignore[no-untyped-def]
    """Return centres of pixels not painted into places (n, 2), evenly thinned out to fit: (pixels, places)."""
    words = (columns + 63) >> 6
    tail = _ALL >> np.uint64(words * 64 - columns)
    total = 0
    for j in range(rows):
        for w in range(words):
            miss = ~bits[j, w]
            if miss:
                total += _ones(miss & tail if w == words - 1 else miss)
    if total == 0:
        return 0, 0
    stride = -(-total // places.shape[0])
    seen = count = 0
    for j in range(rows):
        for w in range(words):
            miss = ~bits[j, w]
            if w == words - 1:
                miss &= tail
            while miss:
                low = miss & (~miss + np.uint64(1))
                miss ^= low
                if seen % stride == 0:
                    places[count, 0] = w * 64 + _ones(low - np.uint64(1)) + 0.5
                    places[count, 1] = j + 0.5
                    count += 1
                seen += 1
    return total, count


@njit(cache=True, nogil=True)
def _farthest(distances, count):  # type: ignore[no-untyped-def]
    best = 0
    for k in range(1, count):
        if distances[k] > distances[best]:
            best = k
    return best


@njit(cache=True, nogil=True)
def _convert_to_tile(points, chosen, tile_x, tile_y, pixel, tracks):  # type: ignore[no-untyped-def]
    """Convert the chosen tracks to pixels of the tile."""
    for n in range(chosen.size):
        k = chosen[n]
        tracks[n, 0] = (points[k, 0] * MICRO - tile_x) / pixel
        tracks[n, 1] = (points[k, 1] * MICRO - tile_y) / pixel
        tracks[n, 2] = (points[k + 1, 0] * MICRO - tile_x) / pixel
        tracks[n, 3] = (points[k + 1, 1] * MICRO - tile_y) / pixel


@njit(cache=True, nogil=True)
def scan_tiles(tiles, starts, order, points, x0, y0, pixel, per_pitch, side, shape, rim, found):  # type: ignore[no-untyped-def]
    """Fill found (tiles, 3): distance [mm], x, y of the farthest place of each tile.

    tiles       : numbers of the tiles to scan, row by row from (x0, y0); the tracks near tile t are
                  order[starts[t] : starts[t + 1]], track k from points[k] to points[k + 1] (whole millionths of 1 mm)
    pixel       : [mm]; per_pitch of them make a pitch, side x side a tile; shape: pixels of the whole (rows, columns)
    """
    across = -(-shape[1] // side)
    bits = np.empty((side, (side + 63) >> 6), dtype=np.uint64)
    places = np.empty((_MOST_TRIED + _SAMPLES, 2))
    distances = np.empty(places.shape[0])
    for n in range(tiles.size):
        tile = tiles[n]
        chosen = order[starts[tile] : starts[tile + 1]]
        row, column = tile // across, tile % across
        tile_x = x0 + column * side * pixel
        tile_y = y0 + row * side * pixel
        rows = min(side, shape[0] - row * side)
        columns = min(side, shape[1] - column * side)
        tracks = np.empty((chosen.size, 4))
        near = np.empty((chosen.size, 4))
        _convert_to_tile(points, chosen, tile_x, tile_y, pixel, tracks)
        bits[:] = 0
        _paint_outside(bits, columns, rows, tile_x, tile_y, pixel, rim)
        _paint_tracks(bits, columns, rows, tracks, chosen, 0.5 * per_pitch)
        bare, count = _list_bare(bits, columns, rows, places[:_MOST_TRIED])
        for k in range(_SAMPLES):  # evenly scattered, differently in each tile
            places[count, 0] = columns * ((tile * 0.618034 + k * 0.754877666) % 1.0)
            places[count, 1] = rows * ((tile * 0.414214 + k * 0.569840291) % 1.0)
            x, y = tile_x + places[count, 0] * pixel, tile_y + places[count, 1] * pixel
            count += 1 if is_inside(rim, x, y) else 0
        found[n, 0] = 0.0
        for k in range(count):
            distances[k] = nearest(tracks, chosen.size, places[k, 0], places[k, 1])
        for _ in range(min(count, _MOST_CLIMBS if bare else 2)):
            k = _farthest(distances, count)
            d, x, y = distances[k], places[k, 0], places[k, 1]
            distances[k] = -1.0
            if 0.0 <= d <= 1.4 * per_pitch:
                d, x, y = climb(tracks, chosen.size, near, x, y, float(per_pitch), tile_x, tile_y, pixel, rim)
                for m in range(count):  # others that would climb to the same place
                    if math.hypot(places[m, 0] - x, places[m, 1] - y) < 0.25 * per_pitch:
                        distances[m] = -1.0
            if d * pixel > found[n, 0]:
                found[n, 0] = d * pixel
                found[n, 1] = tile_x + x * pixel
                found[n, 2] = tile_y + y * pixel


@njit(cache=True, nogil=True)
def _tiles_of(a, b, reach, origin, extent, count):  # type: ignore[no-untyped-def]
    """Return the first and last tile along one axis that a track from a to b comes near."""
    first = int(math.floor((min(a, b) - reach - origin) / extent))
    last = int(math.floor((max(a, b) + reach - origin) / extent))
    return max(first, 0), min(last, count - 1)


@njit(cache=True, nogil=True)
def sort_by_tile(points, counts, x0, y0, extent, across, down, reach):  # type: ignore[no-untyped-def]
    """Sort tracks by the tiles within reach: (starts (tiles + 1,), order), a counting sort."""
    starts = np.zeros(across * down + 1, dtype=np.int64)
    for turn in range(2):
        if turn == 1:
            for t in range(across * down):
                starts[t + 1] += starts[t]
            order = np.empty(starts[-1], dtype=np.int32)
            filled = starts[:-1].copy()
        for k in range(counts.size):
            if not counts[k]:
                continue
            i0, i1 = _tiles_of(points[k, 0] * MICRO, points[k + 1, 0] * MICRO, reach, x0, extent, across)
            j0, j1 = _tiles_of(points[k, 1] * MICRO, points[k + 1, 1] * MICRO, reach, y0, extent, down)
            for j in range(j0, j1 + 1):
                for i in range(i0, i1 + 1):
                    t = j * across + i
                    if turn == 0:
                        starts[t + 1] += 1
                    else:
                        order[filled[t]] = k
                        filled[t] += 1
    return starts, order


@njit(cache=True, nogil=True)
def occupy(points, counts, x0, y0, cell, taken):  # type: ignore[no-untyped-def]
    """Mark the cells (ny, nx) that tracks pass through, sampled at most half a cell apart."""
    ny, nx = taken.shape
    for k in range(counts.size):
        if not counts[k]:
            continue
        ax, ay = points[k, 0] * MICRO, points[k, 1] * MICRO
        dx, dy = points[k + 1, 0] * MICRO - ax, points[k + 1, 1] * MICRO - ay
        parts = int(2.0 * math.hypot(dx, dy) / cell) + 1
        for m in range(parts + 1):
            i = int(math.floor((ax + dx * m / parts - x0) / cell))
            j = int(math.floor((ay + dy * m / parts - y0) / cell))
            if 0 <= i < nx and 0 <= j < ny:
                taken[j, i] = True
