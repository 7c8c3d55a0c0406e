"""Level lines of f, traced through triangles: every grid cell is cut along its diagonal, so no case is ambiguous.

A line is the zero of f less its own level, linear in a triangle. Several lines cross one cell: the grid need not
resolve the pitch. Triangles are listed per line; a walk from any of them goes both ways until the line closes or ends.
Raw points lie where edges are crossed; of these the farthest is kept whose chord passes all between within the sag.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cam.contour.field import REACH_PITCHES, ContourField
from cam.contour.levels import level_at, level_tree
from cam.moves import Array
from cam.raster import THREAD_NAME, THREADS
from cam.vertices import TICKS_PER_MM

CHUNKS = 16
SAG_PITCHES = 0.015
SHORTEST_CHORD_PITCHES = 1.5
SHARP = math.cos(math.radians(50.0))
"""Tracks that turn more at a vertex, as level lines do at saddles, are parted there; the tour joins the parts."""

LONGEST_CHORD_PITCHES = 25.0
SHORTEST_PITCHES = 6.0
"""Shorter tracks are dropped: strokes do better."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """Polylines one after the other: track k is xy_mm[start[k] : start[k + 1]]; a closed one ends where it began."""

    xy_mm: Array
    start: NDArray[np.int64]

    @property
    def count(self) -> int:
        return self.start.size - 1

    @classmethod
    def joined(cls, parts: list[Tracks]) -> Tracks:
        starts = [part.start[:-1] + before for part, before in zip(parts, _before(parts), strict=True)]
        xy = np.concatenate([part.xy_mm for part in parts])
        return cls(xy_mm=xy, start=np.concatenate([*starts, [len(xy)]]).astype(np.int64))


def _before(parts: list[Tracks]) -> list[int]:
    return [0, *np.cumsum([len(part.xy_mm) for part in parts])[:-1].tolist()]


def trace(field: ContourField, *, pitch_mm: float) -> Tracks:
    """All level lines, as far as places are wanted beside them."""
    classes = int(np.ceil(field.density.max())) + 2
    levels = level_tree(float(field.f.min()), float(field.f.max()), field.level_mm, classes)
    grid = field.f, field.density, field.traced, levels
    counts = np.zeros(levels.birth.size + 1, np.int64)
    _bucket(*grid, counts, np.empty(0, np.int32), True)
    offset = np.concatenate([[0], np.cumsum(counts)])
    triangles = np.empty(offset[-1], np.int32)
    _bucket(*grid, offset[:-1].copy(), triangles, False)
    shares = np.searchsorted(offset, np.linspace(0, offset[-1], CHUNKS + 1))
    shares[-1] = levels.birth.size

    def chunk(first: int, last: int) -> Tracks:
        room = int(offset[last] - offset[first])
        xy, start = np.empty((2 * room + 4, 2)), np.empty(room + 4, np.int64)
        origin = field.x0_mm, field.y0_mm, field.step_mm
        count = _walk(*grid, *origin, field.wanted, offset, triangles, first, last, pitch_mm, xy, start)
        return Tracks(xy_mm=xy[: start[count]].copy(), start=start[: count + 1].copy())

    with ThreadPoolExecutor(THREADS, thread_name_prefix=THREAD_NAME) as pool:
        return Tracks.joined(list(pool.map(chunk, shares[:-1].tolist(), shares[1:].tolist())))


@njit(cache=True, nogil=True)
def _crossing_lines(f, c, levels, out):  # type: ignore[no-untyped-def]
    """Lines that cross a triangle with corner values f (3,), c (3,), into out; returns how many."""
    c_max, c_min = max(c[0], c[1], c[2]), min(c[0], c[1], c[2])
    j = int(math.ceil(c_max))
    slack = int(math.ceil(0.55 * (j - math.floor(c_min)))) + 1
    s = levels.spacing[j]
    m_from = int(math.floor(min(f[0], f[1], f[2]) / s)) - slack - levels.first[j]
    m_to = int(math.ceil(max(f[0], f[1], f[2]) / s)) + slack - levels.first[j]
    total = levels.offset[j + 1] - levels.offset[j]
    count = 0
    for m in range(max(m_from, 0), min(m_to + 1, total)):
        line = levels.line_of[levels.offset[j] + m]
        if levels.birth[line] - 1 >= c_max:
            continue
        a = f[0] >= level_at(levels, line, c[0])
        b = f[1] >= level_at(levels, line, c[1])
        d = f[2] >= level_at(levels, line, c[2])
        if (a != b or b != d) and count < out.size:
            out[count] = line
            count += 1
    return count


@njit(cache=True, nogil=True)
def _corners(f, density, t, fs, cs, nodes):  # type: ignore[no-untyped-def]
    """Values and node indices (j, i) of triangle t; corner 0 is the cell's lower left, 1 -> 2 counter-clockwise."""
    nx = f.shape[1] - 1
    cell = t >> 1
    j, i = cell // nx, cell % nx
    nodes[0, 0], nodes[0, 1] = j, i
    if t & 1:
        nodes[1, 0], nodes[1, 1] = j + 1, i + 1
        nodes[2, 0], nodes[2, 1] = j + 1, i
    else:
        nodes[1, 0], nodes[1, 1] = j, i + 1
        nodes[2, 0], nodes[2, 1] = j + 1, i + 1
    for k in range(3):
        fs[k] = f[nodes[k, 0], nodes[k, 1]]
        cs[k] = density[nodes[k, 0], nodes[k, 1]]


@njit(cache=True, nogil=True)
def _bucket(f, density, cells, levels, at, triangles, counting):  # type: ignore[no-untyped-def]
    """Count the triangles of every line in at (nl + 1,), or list them from at[line] on."""
    ny, nx = cells.shape
    fs, cs, nodes = np.empty(3), np.empty(3), np.empty((3, 2), np.int64)
    lines = np.empty(4096, np.int64)
    for j in range(ny):
        for i in range(nx):
            if not cells[j, i]:
                continue
            for half in range(2):
                t = 2 * (j * nx + i) + half
                _corners(f, density, t, fs, cs, nodes)
                for k in range(_crossing_lines(fs, cs, levels, lines)):
                    if not counting:
                        triangles[at[lines[k]]] = t
                    at[lines[k]] += 1


@njit(cache=True, nogil=True)
def _beyond(t, edge, nx, ny):  # type: ignore[no-untyped-def]
    """(triangle, its edge) on the other side of an edge, -1 outside the grid. Edge k is opposite to corner k."""
    cell = t >> 1
    j, i = cell // nx, cell % nx
    if t & 1:  # corners: lower left, upper right, upper left
        if edge == 2:
            return t - 1, 1
        if edge == 0:
            return (t + 2 * nx - 1, 2) if j + 1 < ny else (-1, 0)
        return (t - 3, 0) if i > 0 else (-1, 0)
    if edge == 1:  # corners: lower left, lower right, upper right
        return t + 1, 2
    if edge == 2:
        return (t - 2 * nx + 1, 0) if j > 0 else (-1, 0)
    return (t + 3, 1) if i + 1 < nx else (-1, 0)


@njit(cache=True, nogil=True)
def _follow(f, density, cells, levels, line, t, edge, stamp, raw, count, way):  # type: ignore[no-untyped-def]
    """Points on the edges crossed from triangle t on, out by the edge, into raw[count], raw[count + way], ...

    returns (count, whether the line closed); raw is in steps of the grid.
    """
    ny, nx = cells.shape
    begin = t
    fs, cs, nodes = np.empty(3), np.empty(3), np.empty((3, 2), np.int64)
    while True:
        _corners(f, density, t, fs, cs, nodes)
        a, b = (edge + 1) % 3, (edge + 2) % 3
        u, v = fs[a] - level_at(levels, line, cs[a]), fs[b] - level_at(levels, line, cs[b])
        # from the same end of the edge on both of its sides
        if nodes[a, 0] > nodes[b, 0] or (nodes[a, 0] == nodes[b, 0] and nodes[a, 1] > nodes[b, 1]):
            a, b, u, v = b, a, v, u
        part = u / (u - v)
        raw[count, 0] = nodes[a, 1] + part * (nodes[b, 1] - nodes[a, 1])
        raw[count, 1] = nodes[a, 0] + part * (nodes[b, 0] - nodes[a, 0])
        count += way
        t, edge = _beyond(t, edge, nx, ny)
        if t < 0 or not cells[(t >> 1) // nx, (t >> 1) % nx]:
            return count, False
        if t == begin:
            return count, True
        _corners(f, density, t, fs, cs, nodes)
        if levels.birth[line] - 1 >= max(cs[0], cs[1], cs[2]):
            return count, False
        stamp[t] = line
        edge = _other_edge(levels, line, fs, cs, edge)


@njit(cache=True, nogil=True)
def _other_edge(levels, line, fs, cs, edge):  # type: ignore[no-untyped-def]
    """The edge by which the line leaves a triangle that it entered by another; edge -1: any of the two."""
    up = [fs[k] >= level_at(levels, line, cs[k]) for k in range(3)]
    for k in range(3):
        if k != edge and up[(k + 1) % 3] != up[(k + 2) % 3]:
            return k
    return -1


@njit(cache=True, nogil=True)
def _walk(f, density, cells, levels, x0, y0, step, wanted, offset, triangles, first, last, pitch, xy, start):  # type: ignore[no-untyped-def]
    """Tracks of the lines first..last - 1, thinned, into xy and start; returns how many."""
    stamp = np.full(2 * cells.size, -1, np.int32)
    longest = 0
    for line in range(first, last):
        longest = max(longest, offset[line + 1] - offset[line])
    raw = np.empty((2 * longest + 8, 2))
    middle = longest + 4
    fs, cs, nodes = np.empty(3), np.empty(3), np.empty((3, 2), np.int64)
    tracks, reach = 0, REACH_PITCHES * pitch
    start[0] = 0
    for line in range(first, last):
        for k in range(offset[line], offset[line + 1]):
            t = triangles[k]
            if stamp[t] == line:
                continue
            stamp[t] = line
            _corners(f, density, t, fs, cs, nodes)
            edge = _other_edge(levels, line, fs, cs, -1)
            end, closed = _follow(f, density, cells, levels, line, t, edge, stamp, raw, middle, 1)
            begin = middle
            if closed:
                raw[end] = raw[middle]
                end += 1
            else:
                edge = _other_edge(levels, line, fs, cs, edge)
                begin, _ = _follow(f, density, cells, levels, line, t, edge, stamp, raw, middle - 1, -1)
                begin += 1
                begin, end = _needed(raw, begin, end, wanted, reach / step)
            if _placed(raw[begin:end], x0, y0, step) >= SHORTEST_PITCHES * pitch:
                tracks = _thinned(raw[begin:end], pitch, xy, start, tracks)
    return tracks


@njit(cache=True, nogil=True)
def _needed(raw, begin, end, wanted, reach):  # type: ignore[no-untyped-def]
    """(begin, end) of an open line's part beside which places are wanted, with a point more on either side."""
    first = begin
    while first + 2 < end and not _beside(raw[first + 1], raw[first + 2], wanted, reach):
        first += 1
    last = end
    while last - 2 > first and not _beside(raw[last - 2], raw[last - 3], wanted, reach):
        last -= 1
    return first, last


@njit(cache=True, nogil=True)
def _beside(a, b, wanted, reach):  # type: ignore[no-untyped-def]
    """Whether a place is wanted across from a, where the line goes on to b, within the reach."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.hypot(dx, dy) + 1e-12
    for k in range(-4, 5):
        i = int(math.floor(a[0] - 0.25 * k * reach * dy / length))
        j = int(math.floor(a[1] + 0.25 * k * reach * dx / length))
        if 0 <= j < wanted.shape[0] and 0 <= i < wanted.shape[1] and wanted[j, i]:
            return True
    return False


@njit(cache=True, nogil=True)
def _placed(points, x0, y0, step):  # type: ignore[no-untyped-def]
    """Steps of the grid to mm, in place; returns the length."""
    length = 0.0
    for n in range(points.shape[0]):
        points[n, 0] = x0 + step * points[n, 0]
        points[n, 1] = y0 + step * points[n, 1]
        if n:
            length += math.hypot(points[n, 0] - points[n - 1, 0], points[n, 1] - points[n - 1, 1])
    return length


@njit(cache=True, nogil=True)
def _thinned(points, pitch, xy, start, tracks):  # type: ignore[no-untyped-def]
    """Points kept, on the writing raster, into xy[start[tracks]:]; returns the new number of tracks.

    All points since the anchor lie within the sag of a chord whose direction is in a cone; it narrows with each.
    """
    sag, shortest = SAG_PITCHES * pitch, SHORTEST_CHORD_PITCHES * pitch
    ax, ay = points[0, 0], points[0, 1]
    count = start[tracks]
    tracks, count = _put(ax, ay, xy, start, tracks, count)
    low, high, ahead = -math.pi, math.pi, 0.0
    far = 0.0  # of the candidate, from the anchor
    n = points.shape[0]
    i = 1
    while i < n:
        dx, dy = points[i, 0] - ax, points[i, 1] - ay
        away = math.hypot(dx, dy)
        if away > sag:
            if low == -math.pi:
                ahead = math.atan2(dy, dx)
            turn = math.atan2(dy, dx) - ahead
            turn -= 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5)
            if far >= shortest and (not low <= turn <= high or away > LONGEST_CHORD_PITCHES * pitch):
                ax, ay = points[i - 1, 0], points[i - 1, 1]
                tracks, count = _put(ax, ay, xy, start, tracks, count)
                low, high, far = -math.pi, math.pi, 0.0
                continue
            wide = math.asin(sag / away)
            low, high = max(low, turn - wide), min(high, turn + wide)
        far = away
        i += 1
    if far < shortest and count > start[tracks] + 1:  # no crumb at the end
        count -= 1
    tracks, count = _put(points[n - 1, 0], points[n - 1, 1], xy, start, tracks, count)
    start[tracks + 1] = count
    return tracks + 1


@njit(cache=True, nogil=True)
def _put(x, y, xy, start, tracks, count):  # type: ignore[no-untyped-def]
    """One more vertex; where the track turns sharply at the last one, a new track begins there. (tracks, vertices)"""
    x, y = math.floor(x * TICKS_PER_MM + 0.5) / TICKS_PER_MM, math.floor(y * TICKS_PER_MM + 0.5) / TICKS_PER_MM
    if count > start[tracks] + 1:
        ax, ay = xy[count - 1, 0] - xy[count - 2, 0], xy[count - 1, 1] - xy[count - 2, 1]
        bx, by = x - xy[count - 1, 0], y - xy[count - 1, 1]
        if ax * bx + ay * by < SHARP * math.hypot(ax, ay) * math.hypot(bx, by):
            tracks += 1
            start[tracks] = count
            xy[count] = xy[count - 1]
            count += 1
    xy[count, 0], xy[count, 1] = x, y
    return tracks, count + 1
