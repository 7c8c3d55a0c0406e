"""The paper's simple remeshing (section 5): cut out triangles that would flip soon, and throw darts into the holes.

"... first detecting triangles which admit small dt, then removing the vertices of the triangles, and inserting random
vertices using dart throwing." A vertex is removed by merging it into the neighbour that lets the triangles around live
longest. Edges between short-lived triangles are flipped if that is enough. A dart falls anywhere in the remeshed
triangles, evenly over the lens, and stays if it is not too near the corners of its triangle in either plane. It takes
screen point and velocity from the flat triangle in which it falls, so the map stays one-to-one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.paper.mesh import MeshPair, TriangleMesh, Triangles
from optics.paper.mesh_surgery import (
    MOST_AROUND,
    Neighbours,
    draw_onto,
    find_around,
    flip_short_lived,
    life,
    life_without,
    neighbours_of,
    place_in,
    split,
)
from optics.spline import Array

_ROUNDS = 6
_LEAST_ON_SCREEN = 0.02  # twice the area of a triangle there, in pixels
_DARTS_PER_HOLE = 4  # thrown for each vertex removed, of which at most one stays
_LEAST_SPACING = 0.5  # of a dart from the corners: times the side of a square as large as a mean lens face, or a pixel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Remeshed:
    """The mesh after remeshing, and a record of it. velocity_mm (n, 2) belongs to the new vertices."""

    pair: MeshPair
    velocity_mm: Array
    removed: int
    inserted: int


def without_short_lived(
    pair: MeshPair, velocity_mm: Array, *, wanted: float, pixel_mm: tuple[float, float], rng: np.random.Generator
) -> Remeshed:
    """Remesh until triangles live `wanted`, as far as possible; the frame's vertices stay on the frame."""
    rule = _Rule(
        wanted=wanted,
        least=_LEAST_ON_SCREEN * pixel_mm[0] * pixel_mm[1],
        size_x=float(pair.screen.points_mm[:, 0].max()),
        size_y=float(pair.screen.points_mm[:, 1].max()),
    )
    columns = np.concatenate([pair.lens.points_mm, pair.screen.points_mm, velocity_mm], axis=1)
    columns, triangles, removed, touched = _cut_out(columns, pair.triangles, rule)
    inserted = 0
    if removed:
        before = columns.shape[0]
        columns, triangles = _with_darts(columns, triangles, touched, removed, pixel_mm, rng)
        inserted = columns.shape[0] - before
        columns, triangles, again, _ = _cut_out(columns, triangles, rule)
        removed += again
    lens, screen, velocity = (np.ascontiguousarray(columns[:, k : k + 2]) for k in (0, 2, 4))
    return Remeshed(
        pair=MeshPair(
            screen=TriangleMesh(points_mm=screen, triangles=triangles),
            lens=TriangleMesh(points_mm=lens, triangles=triangles),
        ),
        velocity_mm=velocity,
        removed=removed,
        inserted=inserted,
    )


class _Rule(NamedTuple):
    """Lives wanted, least (doubled) area of a triangle on the screen, and the frame, where vertices only slide."""

    wanted: float
    least: float
    size_x: float
    size_y: float


def _cut_out(columns: Array, triangles: Triangles, rule: _Rule) -> tuple[Array, Triangles, int, NDArray[np.intp]]:
    """Flip edges and remove vertices; return new columns and triangles, removed vertices, indices of changed
    triangles.
    """
    lens, screen, velocity = (np.ascontiguousarray(columns[:, k : k + 2]) for k in (0, 2, 4))
    triangles = triangles.copy()
    across = neighbours_of(triangles)
    gone = np.zeros(lens.shape[0], dtype=np.bool_)
    touched = np.zeros(triangles.shape[0], dtype=np.bool_)
    for _ in range(_ROUNDS):
        turned = flip_short_lived(lens, screen, velocity, triangles, across, 2.0 * rule.wanted, rule.least)
        drawn = _draw_away(lens, screen, velocity, triangles, across, rule, gone, touched)
        if turned + drawn == 0:
            break
    number, kept = np.cumsum(~gone) - 1, triangles[:, 0] >= 0
    renumbered = np.ascontiguousarray(number[triangles[kept]].astype(np.int32))
    return columns[~gone], renumbered, int(gone.sum()), np.flatnonzero(touched[kept])


@njit(cache=True, nogil=True)
def _draw_away(
    lens: Array,
    screen: Array,
    velocity: Array,
    triangles: Triangles,
    across: Neighbours,
    rule: _Rule,
    gone: NDArray[np.bool_],
    touched: NDArray[np.bool_],
) -> int:
    """For each triangle that lives shorter than wanted, remove the corner whose removal lengthens lives most."""
    ring = np.empty(MOST_AROUND, dtype=np.int32)
    count = 0
    for t in range(triangles.shape[0]):
        if triangles[t, 0] < 0:
            continue
        now = life(lens, velocity, triangles[t, 0], triangles[t, 1], triangles[t, 2])
        if now >= rule.wanted:
            continue
        best, from_v, onto_w = 2.0 * now, -1, -1
        for k in range(3):
            v = triangles[t, k]
            on_x = screen[v, 0] == 0.0 or screen[v, 0] == rule.size_x
            on_y = screen[v, 1] == 0.0 or screen[v, 1] == rule.size_y
            if on_x and on_y:
                continue
            n = find_around(triangles, across, v, t, ring)
            for i in range(n):
                w = triangles[ring[i], (place_in(triangles[ring[i]], v) + 1) % 3]
                if (on_x and screen[w, 0] != screen[v, 0]) or (on_y and screen[w, 1] != screen[v, 1]):
                    continue
                lives = life_without(lens, screen, velocity, triangles, ring[:n], v, w, rule.least)
                if lives > best:
                    best, from_v, onto_w = lives, v, w
        if from_v >= 0:
            n = find_around(triangles, across, from_v, t, ring)
            draw_onto(triangles, across, ring[:n], from_v, onto_w)
            gone[from_v] = True
            for i in range(n):
                touched[ring[i]] = True
            count += 1
    return count


def _with_darts(
    columns: Array,
    triangles: Triangles,
    holes: NDArray[np.intp],
    removed: int,
    pixel_mm: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[Array, Triangles]:
    """Throw darts into the triangles `holes`, at most one for each vertex removed."""
    throws = _DARTS_PER_HOLE * removed
    vertices, rows = columns.shape[0], triangles.shape[0]
    corners = columns[triangles[holes], :2]
    edges = corners[:, 1:] - corners[:, :1]
    areas = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    into = holes[np.searchsorted(np.cumsum(areas), rng.random(throws) * areas.sum()).clip(max=holes.size - 1)]
    root, share = np.sqrt(rng.random(throws)), rng.random(throws)
    weights = np.stack([1.0 - root, root * (1.0 - share), root * share], axis=1)
    columns = np.concatenate([columns, np.zeros((removed, 6))])
    grown = np.concatenate([triangles, np.zeros((2 * removed, 3), dtype=np.int32)])
    across = np.concatenate([neighbours_of(triangles), np.zeros((2 * removed, 3), dtype=np.int32)])
    spacing = _LEAST_SPACING * np.array([np.sqrt(areas.mean()), np.sqrt(pixel_mm[0] * pixel_mm[1])])
    stay = _throw(columns, grown, across, into.astype(np.int64), weights, spacing, vertices, rows)
    return columns[: vertices + stay], np.ascontiguousarray(grown[: rows + 2 * stay])


@njit(cache=True, nogil=True)
def _throw(
    columns: Array,
    triangles: Triangles,
    across: Neighbours,
    into: NDArray[np.int64],
    weights: Array,
    spacing: Array,
    vertices: int,
    rows: int,
) -> int:
    """Return the number of darts that stay. columns (n, 6): lens, screen, velocity, room for the darts at the end."""
    stay, most = 0, columns.shape[0] - vertices
    for d in range(into.size):
        if stay == most:
            break
        t, v = into[d], vertices + stay
        for c in range(6):
            columns[v, c] = 0.0
            for k in range(3):
                columns[v, c] += weights[d, k] * columns[triangles[t, k], c]
        free = True
        for k in range(3):
            corner = columns[triangles[t, k]]
            free &= np.hypot(corner[0] - columns[v, 0], corner[1] - columns[v, 1]) >= spacing[0]
            free &= np.hypot(corner[2] - columns[v, 2], corner[3] - columns[v, 3]) >= spacing[1]
        if free:
            split(triangles, across, t, v, rows + 2 * stay)
            stay += 1
    return stay
