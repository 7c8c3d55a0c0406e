"""Triangle meshes in the plane: areas, median dual faces, P1 gradients and the largest step without a flip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.spline import Array

Triangles = NDArray[np.int32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriangleMesh:
    """points_mm (n, 2), triangles (m, 3) int32, counter-clockwise. The arrays are not copied: do not write to them."""

    points_mm: Array
    triangles: Triangles

    @classmethod
    def build_regular(cls, x_mm: Array, y_mm: Array) -> TriangleMesh:
        """Build right triangles over the grid of x_mm (nx,) and y_mm (ny,), both ascending; vertex (j, i) is j nx + i.

        Every cell is cut along the diagonal from its lower left to its upper right corner.
        """
        points = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2).astype(np.float64)
        index = np.arange(points.shape[0], dtype=np.int32).reshape(y_mm.size, x_mm.size)
        lower_left, lower_right = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
        upper_left, upper_right = index[1:, :-1].ravel(), index[1:, 1:].ravel()
        triangles = np.stack([lower_left, lower_right, upper_right, lower_left, upper_right, upper_left], axis=1)
        return cls(points_mm=points, triangles=np.ascontiguousarray(triangles.reshape(-1, 3)))

    def move_to(self, points_mm: Array) -> TriangleMesh:
        """Return the same triangles on other points (n, 2)."""
        return TriangleMesh(points_mm=np.ascontiguousarray(points_mm), triangles=self.triangles)

    def areas(self) -> Array:
        """Return (m,) signed triangle areas [mm^2], positive where counter-clockwise."""
        return _areas(self.points_mm, self.triangles)

    def dual_areas(self) -> Array:
        """Return (n,) areas of the median dual faces [mm^2].

        The face of a vertex is bounded by the midpoints of its edges and the centroids of its triangles; medians cut a
        triangle into six equal parts, so each corner owns exactly a third of it. The faces tile the mesh.
        """
        return _dual_areas(self.points_mm, self.triangles)

    def triangle_gradients(self, values: Array) -> Array:
        """Return (m, 2) gradient of the P1 field `values` (n,) in each triangle."""
        corners, f = self.points_mm[self.triangles], values[self.triangles]
        opposite = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]  # edge opposite to each corner, counter-clockwise
        turned = np.stack([-opposite[..., 1], opposite[..., 0]], axis=-1)
        return np.asarray((f[..., None] * turned).sum(axis=1) / (2.0 * self.areas())[:, None])

    def vertex_gradients(self, values: Array, weights: Array) -> Array:
        """Return (n, 2) gradient of the P1 field `values` (n,): per vertex the mean over its triangles, weighted
        (m,).
        """
        return _vertex_gradients(self.points_mm, self.triangles, np.ascontiguousarray(values), weights)

    def largest_step(self, velocity: Array) -> float:
        """Return the smallest positive time at which points moving with `velocity` (n, 2) give some triangle zero area.

        The area of a moving triangle is A0 + A1 t + A2 t^2, exactly (paper, 3.1); infinity if none ever vanishes.
        """
        return _largest_step(self.points_mm, self.triangles, np.ascontiguousarray(velocity))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshPair:
    """One mesh in two planes, a one-to-one map from screen to lens; the triangles are the same array in both."""

    screen: TriangleMesh
    lens: TriangleMesh

    @property
    def triangles(self) -> Triangles:
        return self.lens.triangles


@njit(cache=True, nogil=True)
def _areas(points: Array, triangles: Triangles) -> Array:
    areas = np.empty(triangles.shape[0])
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t]
        areas[t] = 0.5 * (
            (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1])
            - (points[c, 0] - points[a, 0]) * (points[b, 1] - points[a, 1])
        )
    return areas


@njit(cache=True, nogil=True)
def _dual_areas(points: Array, triangles: Triangles) -> Array:
    thirds = _areas(points, triangles) / 3.0
    dual = np.zeros(points.shape[0])
    for t in range(triangles.shape[0]):
        for k in range(3):
            dual[triangles[t, k]] += thirds[t]
    return dual


@njit(cache=True, nogil=True)
def _vertex_gradients(points: Array, triangles: Triangles, values: Array, weights: Array) -> Array:
    """Return the gradients by 2 area grad(f) = sum_k f_k rot90(edge opposite to k) per triangle."""
    sums = np.zeros((points.shape[0], 2))
    totals = np.zeros(points.shape[0])
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t]
        gx = (
            values[a] * (points[b, 1] - points[c, 1])
            + values[b] * (points[c, 1] - points[a, 1])
            + values[c] * (points[a, 1] - points[b, 1])
        )
        gy = (
            values[a] * (points[c, 0] - points[b, 0])
            + values[b] * (points[a, 0] - points[c, 0])
            + values[c] * (points[b, 0] - points[a, 0])
        )
        twice_area = (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1]) - (points[c, 0] - points[a, 0]) * (
            points[b, 1] - points[a, 1]
        )
        for k in range(3):
            v = triangles[t, k]
            sums[v, 0] += weights[t] * gx / twice_area
            sums[v, 1] += weights[t] * gy / twice_area
            totals[v] += weights[t]
    for v in range(points.shape[0]):
        sums[v, 0] /= totals[v]
        sums[v, 1] /= totals[v]
    return sums


@njit(cache=True, nogil=True)
def smallest_positive_root(a0: float, a1: float, a2: float) -> float:
    """Return smallest t > 0 with a0 + a1 t + a2 t^2 = 0 for a0 > 0, else infinity; the form without cancellation."""
    discriminant = a1 * a1 - 4.0 * a0 * a2
    if discriminant < 0.0 or (a1 >= 0.0 and a2 >= 0.0):
        return np.inf
    # 2 a0 / (-a1 + sqrt(disc)) is the smaller positive root if a1 < 0; with a1 >= 0 (then a2 < 0) it is the only one.
    if a1 < 0.0:
        return 2.0 * a0 / (-a1 + np.sqrt(discriminant))
    return (a1 + np.sqrt(discriminant)) / (-2.0 * a2)


@njit(cache=True, nogil=True)
def _largest_step(points: Array, triangles: Triangles, velocity: Array) -> float:
    smallest = np.inf
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t]
        ex, ey = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        fx, fy = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1]
        ux, uy = velocity[b, 0] - velocity[a, 0], velocity[b, 1] - velocity[a, 1]
        wx, wy = velocity[c, 0] - velocity[a, 0], velocity[c, 1] - velocity[a, 1]
        a0 = ex * fy - fx * ey
        a1 = ex * wy - fx * uy + ux * fy - wx * ey
        a2 = ux * wy - wx * uy
        smallest = min(smallest, smallest_positive_root(a0, a1, a2))
    return smallest
