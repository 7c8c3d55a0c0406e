"""The light of a picture on the dual faces of any triangle mesh: exact, by Green's formula along the faces' sides.

The integral of T over a polygon is the integral of F dy along its outline, F(x, y) = int_0^x T. Pixels are constant, so
on each piece of a side within one pixel the midpoint of F is exact. A side between two faces is walked once and counted
for one of them and against the other: the faces' light adds up to the picture's to rounding.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.paper.mesh import TriangleMesh, Triangles
from optics.spline import Array


def face_light(
    screen: TriangleMesh, neighbours: NDArray[np.int32], target: Array, size_mm: tuple[float, float]
) -> Array:
    """Return (n,) integrals of target (ny, nx) over the median dual faces of a mesh that covers [0, w] x [0, h] [mm^2].

    neighbours (m, 3) : the triangle across from each corner, -1 on the rim (optics.paper.mesh_surgery.neighbours_of)
    """
    ny, nx = target.shape
    left = np.zeros_like(target)
    np.cumsum(target[:, :-1], axis=1, out=left[:, 1:])
    scale_x, scale_y = nx / size_mm[0], ny / size_mm[1]
    points = screen.points_mm * np.array([scale_x, scale_y])
    light = _face_light(points, screen.triangles, neighbours, left, np.ascontiguousarray(target))
    return np.asarray(light / (scale_x * scale_y))


@njit(cache=True, nogil=True)
def _along(left: Array, target: Array, x0: float, y0: float, x1: float, y1: float) -> float:
    """Return the integral of F dy on the segment, in pixels, walked pixel by pixel; left[j, i] is F at the pixel's left
    side.
    """
    ny, nx = target.shape
    dx, dy = x1 - x0, y1 - y0
    if dy == 0.0:
        return 0.0
    i, j = min(max(int(np.floor(x0)), 0), nx - 1), min(max(int(np.floor(y0)), 0), ny - 1)
    if dx < 0.0 and x0 == i and i > 0:
        i -= 1
    if dy < 0.0 and y0 == j and j > 0:
        j -= 1
    total, start = 0.0, 0.0
    while True:
        to_x, to_y = np.inf, np.inf
        if (dx > 0.0 and i < nx - 1) or (dx < 0.0 and i > 0):
            to_x = (i + (1 if dx > 0.0 else 0) - x0) / dx
        if (dy > 0.0 and j < ny - 1) or (dy < 0.0 and j > 0):
            to_y = (j + (1 if dy > 0.0 else 0) - y0) / dy
        end = max(start, min(1.0, to_x, to_y))
        middle = x0 + dx * 0.5 * (start + end)
        total += (left[j, i] + target[j, i] * (middle - i)) * dy * (end - start)
        if end >= 1.0:
            return total
        start = end
        if to_x <= to_y:
            i += 1 if dx > 0.0 else -1
        else:
            j += 1 if dy > 0.0 else -1


@njit(cache=True, nogil=True)
def _face_light(
    points: Array, triangles: Triangles, neighbours: NDArray[np.int32], left: Array, target: Array
) -> Array:
    """Return the light per triangle: three sides from edge midpoint to centroid; on the rim, half edges as well."""
    light = np.zeros(points.shape[0])
    for t in range(triangles.shape[0]):
        p, q, r = triangles[t]
        gx = (points[p, 0] + points[q, 0] + points[r, 0]) / 3.0
        gy = (points[p, 1] + points[q, 1] + points[r, 1]) / 3.0
        for k in range(3):
            a, b = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
            mx, my = 0.5 * (points[a, 0] + points[b, 0]), 0.5 * (points[a, 1] + points[b, 1])
            inward = _along(left, target, mx, my, gx, gy)
            light[a] += inward
            light[b] -= inward
            if neighbours[t, k] < 0:
                light[a] += _along(left, target, points[a, 0], points[a, 1], mx, my)
                light[b] += _along(left, target, mx, my, points[b, 0], points[b, 1])
    return light
