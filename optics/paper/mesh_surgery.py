"""Local changes to a mesh that lies in two planes at once: flips edges, removes and inserts vertices.

The mesh stands for a one-to-one map: vertex i lies at lens[i] and at screen[i], triangles are counter-clockwise in both
planes, and an operation is done only if that remains true. A triangle's *life* is the time until the vertices'
velocities make it flip (the paper's dt_i). A vertex is removed by merging it into one of its neighbours.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.paper.mesh import Triangles, smallest_positive_root
from optics.spline import Array

Neighbours = NDArray[np.int32]

MOST_AROUND = 64  # triangles round one vertex
_BETTER = 1.5  # a flip must lengthen the shorter life of the pair by this factor; merging a vertex away, by 2
_SWEEPS = 20


def neighbours_of(triangles: Triangles) -> Neighbours:
    """Return (m, 3) int32: the triangle across the edge opposite to each corner, -1 where that edge is on the rim."""
    m, n = triangles.shape[0], int(triangles.max()) + 1
    a, b = triangles[:, [1, 2, 0]].astype(np.int64).ravel(), triangles[:, [2, 0, 1]].astype(np.int64).ravel()
    keys = np.minimum(a, b) * n + np.maximum(a, b)
    order = np.argsort(keys, kind="stable")
    twins = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    across = np.full(3 * m, -1, dtype=np.int32)
    across[order[twins]] = order[twins + 1] // 3
    across[order[twins + 1]] = order[twins] // 3
    return across.reshape(m, 3)


@njit(cache=True, nogil=True, inline="always")
def twice_area(points: Array, a: int, b: int, c: int) -> float:
    return (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1]) - (points[c, 0] - points[a, 0]) * (
        points[b, 1] - points[a, 1]
    )


@njit(cache=True, nogil=True, inline="always")
def life(points: Array, velocity: Array, a: int, b: int, c: int) -> float:
    """Time until the moving triangle has no area; 0 where it has none already."""
    ex, ey = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
    fx, fy = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1]
    ux, uy = velocity[b, 0] - velocity[a, 0], velocity[b, 1] - velocity[a, 1]
    wx, wy = velocity[c, 0] - velocity[a, 0], velocity[c, 1] - velocity[a, 1]
    area = ex * fy - fx * ey
    if area <= 0.0:
        return 0.0
    return smallest_positive_root(area, ex * wy - fx * uy + ux * fy - wx * ey, ux * wy - wx * uy)


@njit(cache=True, nogil=True)
def place_in(row: NDArray[np.int32], value: int) -> int:
    return 0 if row[0] == value else (1 if row[1] == value else 2)


@njit(cache=True, nogil=True)
def flip(triangles: Triangles, across: Neighbours, t: int, k: int) -> None:
    """Turn the edge opposite to corner k of t: (a, b, c) and (d, c, b) become (a, b, d) and (a, d, c)."""
    s, a, b, c = across[t, k], triangles[t, k], triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
    d = triangles[s, place_in(across[s], t)]
    beyond_ca, beyond_ab = across[t, (k + 1) % 3], across[t, (k + 2) % 3]
    beyond_bd, beyond_dc = across[s, place_in(triangles[s], c)], across[s, place_in(triangles[s], b)]
    triangles[t, 0], triangles[t, 1], triangles[t, 2] = a, b, d
    triangles[s, 0], triangles[s, 1], triangles[s, 2] = a, d, c
    across[t, 0], across[t, 1], across[t, 2] = beyond_bd, s, beyond_ab
    across[s, 0], across[s, 1], across[s, 2] = beyond_dc, beyond_ca, t
    if beyond_bd >= 0:
        across[beyond_bd, place_in(across[beyond_bd], s)] = t
    if beyond_ca >= 0:
        across[beyond_ca, place_in(across[beyond_ca], t)] = s


@njit(cache=True, nogil=True)
def flip_short_lived(
    lens: Array, screen: Array, velocity: Array, triangles: Triangles, across: Neighbours, wanted: float, least: float
) -> int:
    """Flip edges of triangles that live shorter than `wanted` where that helps; `least`: least (doubled) area on
    screen.
    """
    count = 0
    for _ in range(_SWEEPS):
        done = 0
        for t in range(triangles.shape[0]):
            if triangles[t, 0] < 0:
                continue
            now = life(lens, velocity, triangles[t, 0], triangles[t, 1], triangles[t, 2])
            if now >= wanted:
                continue
            best, which = _BETTER, -1
            for k in range(3):
                s = across[t, k]
                if s < 0:
                    continue
                a, b, c = triangles[t, k], triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
                d = triangles[s, place_in(across[s], t)]
                if twice_area(screen, a, b, d) < least or twice_area(screen, a, d, c) < least:
                    continue
                old = min(now, life(lens, velocity, triangles[s, 0], triangles[s, 1], triangles[s, 2]))
                new = min(life(lens, velocity, a, b, d), life(lens, velocity, a, d, c))
                if new > best * old:
                    best, which = new / max(old, 1e-300), k
            if which >= 0:
                flip(triangles, across, t, which)
                done += 1
        count += done
        if done == 0:
            break
    return count


@njit(cache=True, nogil=True)
def find_around(triangles: Triangles, across: Neighbours, v: int, t: int, ring: NDArray[np.int32]) -> int:
    """Fill `ring` with the triangles at vertex v, of which t is one; return their number, -1 if there are too many."""
    count, now = 0, t
    while True:
        ring[count] = now
        count += 1
        if count == ring.size:
            return -1
        now = across[now, (place_in(triangles[now], v) + 1) % 3]
        if now < 0 or now == t:
            break
    if now < 0:  # v is on the rim: the other way round, too
        now = across[t, (place_in(triangles[t], v) + 2) % 3]
        while now >= 0:
            ring[count] = now
            count += 1
            if count == ring.size:
                return -1
            now = across[now, (place_in(triangles[now], v) + 2) % 3]
    return count


@njit(cache=True, nogil=True)
def life_without(
    lens: Array, screen: Array, velocity: Array, triangles: Triangles, ring: Neighbours, v: int, w: int, least: float
) -> float:
    """Return the shortest life around v if v were merged into its neighbour w; 0 if a triangle would turn over."""
    shortest = np.inf
    for t in ring:
        row = triangles[t]
        if row[0] == w or row[1] == w or row[2] == w:
            continue
        k = place_in(row, v)
        b, c = row[(k + 1) % 3], row[(k + 2) % 3]
        if twice_area(screen, w, b, c) < least:
            return 0.0
        shortest = min(shortest, life(lens, velocity, w, b, c))
    return shortest


@njit(cache=True, nogil=True)
def draw_onto(triangles: Triangles, across: Neighbours, ring: Neighbours, v: int, w: int) -> None:
    """Merge vertex v into w; the triangles that contained both are marked as removed (first corner -1)."""
    for t in ring:
        k = place_in(triangles[t], v)
        if triangles[t, 0] == w or triangles[t, 1] == w or triangles[t, 2] == w:
            one, other = across[t, k], across[t, place_in(triangles[t], w)]
            if one >= 0:
                across[one, place_in(across[one], t)] = other
            if other >= 0:
                across[other, place_in(across[other], t)] = one
            triangles[t, 0] = -1
        else:
            triangles[t, k] = w


@njit(cache=True, nogil=True)
def split(triangles: Triangles, across: Neighbours, t: int, v: int, next_free: int) -> None:
    """Put vertex v into triangle t: t keeps the edge a b, rows next_free and next_free + 1 take b c and c a."""
    a, b, c = triangles[t]
    over_a, over_b = across[t, 0], across[t, 1]
    s, r = next_free, next_free + 1
    triangles[t, 2] = v
    triangles[s, 0], triangles[s, 1], triangles[s, 2] = v, b, c
    triangles[r, 0], triangles[r, 1], triangles[r, 2] = a, v, c
    across[s, 0], across[s, 1], across[s, 2] = over_a, r, t
    across[r, 0], across[r, 1], across[r, 2] = s, over_b, t
    if over_a >= 0:
        across[over_a, place_in(across[over_a], t)] = s
    if over_b >= 0:
        across[over_b, place_in(across[over_b], t)] = r
    across[t, 0], across[t, 1] = s, r
