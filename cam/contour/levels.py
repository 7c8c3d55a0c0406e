"""Level lines over the field's grid: which levels of f are tracks at which density, and how a line crosses triangles.

Lines in the plane of class and level are born in gaps and never cross. At a whole class j the tracks are the levels
m S_j, S_j = S_0 / RATIO^j, m any whole number. From class to class every line glides to the nearest level of the denser
one; levels that no line takes are born at the start of the glide, in between. Neighbours are thus nowhere farther apart
than S_j, the spacing that the class stands for, and the next line born at the same place is more than ten pitches away:
room for a turn.

Every cell of the grid is cut along its diagonal, so no case is ambiguous. A line is the zero of f less its own level,
linear in a triangle. Triangle t is half t & 1 of cell t >> 1.
"""

from __future__ import annotations

import math
from math import ceil, floor
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from cam.contour.field import RATIO


class Levels(NamedTuple):
    """The levels in the form of the kernels.

    spacing (nc,)     : S_j
    first (nc,)       : m of the first level of class j
    offset (nc + 1,)  : where class j begins in line_of
    line_of (n,)      : the line at a level of a class
    birth (nl,)       : class at which a line is first whole; it exists from one class before
    level (nl, nc)    : of each line at each class; before its birth, that of its birth
    """

    spacing: Any
    first: Any
    offset: Any
    line_of: Any
    birth: Any
    level: Any


def level_tree(lowest: float, highest: float, level_mm: float, classes: int) -> Levels:
    """Build lines over levels from lowest to highest and classes 0..classes - 1."""
    spacing = level_mm / RATIO ** np.arange(classes)
    first = np.array([floor(lowest / s) - 2 for s in spacing])
    counts = np.array([ceil(highest / s) + 3 for s in spacing]) - first
    offset = np.concatenate([[0], np.cumsum(counts)])
    line_of = np.empty(offset[-1], np.int64)
    line_of[: counts[0]] = np.arange(counts[0])
    births = [np.zeros(counts[0], np.int64)]
    total = int(counts[0])
    for j in range(1, classes):
        here = np.full(counts[j], -1)
        before = line_of[offset[j - 1] : offset[j]]
        m = np.rint((first[j - 1] + np.arange(before.size)) * RATIO).astype(np.int64) - first[j]
        kept = (m >= 0) & (m < counts[j])
        here[m[kept]] = before[kept]
        fresh = np.flatnonzero(here < 0)
        here[fresh] = total + np.arange(fresh.size)
        births.append(np.full(fresh.size, j))
        total += fresh.size
        line_of[offset[j] : offset[j + 1]] = here
    birth = np.concatenate(births)
    level = np.full((total, classes), np.nan)
    for j in range(classes):
        level[line_of[offset[j] : offset[j + 1]], j] = (first[j] + np.arange(counts[j])) * spacing[j]
    for j in range(classes - 2, -1, -1):  # before birth; lines that have left the range stay outside it
        level[:, j] = np.where(np.isnan(level[:, j]), level[:, j + 1], level[:, j])
    for j in range(1, classes):
        level[:, j] = np.where(np.isnan(level[:, j]), level[:, j - 1], level[:, j])
    return Levels(spacing=spacing, first=first, offset=offset, line_of=line_of, birth=birth, level=level)


@njit(cache=True, nogil=True, inline="always")
def level_at(levels, line, density):  # type: ignore[no-untyped-def]
    """Return the level of a line at a class, which may be fractional."""
    last = levels.spacing.size - 1
    j = min(int(density), last - 1)
    t = density - j
    return levels.level[line, j] * (1.0 - t) + levels.level[line, j + 1] * t


@njit(cache=True, nogil=True)
def _cross_triangle(f, c, levels, out):  # type: ignore[no-untyped-def]
    """Write lines that cross a triangle with corner values f (3,), c (3,) into out; return how many."""
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
def fill_corners(f, density, t, fs, cs, nodes):  # type: ignore[no-untyped-def]
    """Compute values and node indices (j, i) of triangle t; corner 0 is the cell's lower left, 1 -> 2
    counter-clockwise.
    """
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
def sort_by_line(f, density, cells, levels, at, triangles, counting):  # type: ignore[no-untyped-def]
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
                fill_corners(f, density, t, fs, cs, nodes)
                for k in range(_cross_triangle(fs, cs, levels, lines)):
                    if not counting:
                        triangles[at[lines[k]]] = t
                    at[lines[k]] += 1


@njit(cache=True, nogil=True)
def _beyond(t, edge, nx, ny):  # type: ignore[no-untyped-def]
    """Return (triangle, its edge) on the other side of an edge, -1 outside the grid. Edge k is opposite to corner k."""
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
def other_edge(levels, line, fs, cs, edge):  # type: ignore[no-untyped-def]
    """Return the edge by which the line leaves a triangle that it entered by another; edge -1: any of the two."""
    up = [fs[k] >= level_at(levels, line, cs[k]) for k in range(3)]
    for k in range(3):
        if k != edge and up[(k + 1) % 3] != up[(k + 2) % 3]:
            return k
    return -1


@njit(cache=True, nogil=True)
def follow(f, density, cells, levels, line, t, edge, stamp, raw, count, way):  # type: ignore[no-untyped-def]
    """Write points on the edges crossed from triangle t on, out by the edge, into raw[count], raw[count + way], ...

    returns (count, whether the line closed); raw is in steps of the grid.
    """
    ny, nx = cells.shape
    begin = t
    fs, cs, nodes = np.empty(3), np.empty(3), np.empty((3, 2), np.int64)
    while True:
        fill_corners(f, density, t, fs, cs, nodes)
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
        fill_corners(f, density, t, fs, cs, nodes)
        if levels.birth[line] - 1 >= max(cs[0], cs[1], cs[2]):
            return count, False
        stamp[t] = line
        edge = other_edge(levels, line, fs, cs, edge)
