"""First-order Galerkin finite elements on triangles: P1 matrices and Poisson's equation with a natural boundary.

The sparsity pattern depends only on the triangles, so it is built once and filled again whenever the points move. The
Neumann problem fixes the unknown up to a constant: the mean is removed from load and solution, and conjugate gradients
solve the rest, preconditioned by one classical (Ruge-Stueben) multigrid V-cycle built for the matrix at hand. On
stretched meshes a fresh hierarchy needs 5-20 cycles and costs less to build (0.3 s at 512 x 512) than an old one would
lose. Nothing in it is random: the same mesh and load give the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
import pyamg
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

from optics.paper.mesh import TriangleMesh, Triangles
from optics.spline import Array

_MOST_ITERATIONS = 300


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoissonSolution:
    """values (n,) of mean 0 over the vertices; `residual` is relative to the load, in the Euclidean norm."""

    values: Array
    iterations: int
    residual: float


class NeumannPoisson:
    """Solves  int grad(phi) . grad(v) = load(v)  for every P1 test function v, on meshes that share their triangles."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._pattern, self._slots = _pattern(mesh.triangles, mesh.points_mm.shape[0])

    def stiffness(self, mesh: TriangleMesh) -> sparse.csr_matrix:
        """Return (n, n) integrals of grad(v_i) . grad(v_j) over the mesh [1]."""
        data = _stiffness(mesh.points_mm, mesh.triangles, self._slots, self._pattern.nnz)
        return sparse.csr_matrix((data, self._pattern.indices, self._pattern.indptr), shape=self._pattern.shape)

    def factor(self, mesh: TriangleMesh) -> FactoredPoisson:
        """Return the problem on `mesh`, ready for one or more loads."""
        return FactoredPoisson(self.stiffness(mesh))

    def solve(self, mesh: TriangleMesh, load: Array, *, tolerance: float = 1e-6) -> PoissonSolution:
        return self.factor(mesh).solve(load, tolerance=tolerance)


class FactoredPoisson:
    """One stiffness matrix with its multigrid hierarchy."""

    def __init__(self, stiffness: sparse.csr_matrix) -> None:
        self._stiffness = stiffness
        # "min": only negative entries count as couplings. A fifth of them are positive on a sheared mesh, and taking
        # their size for strength makes the cycle count grow from 14 to 79.
        strength = ("classical", {"theta": 0.25, "norm": "min"})
        self._hierarchy = pyamg.ruge_stuben_solver(stiffness, strength=strength, max_coarse=50)

    def solve(self, load: Array, *, guess: Array | None = None, tolerance: float = 1e-6) -> PoissonSolution:
        """load (n,): its mean is removed (the solvability condition), and the mean of the solution too.

        Conjugate gradients until |residual| <= tolerance |load|, or 300 iterations: see the solution's residual.
        """
        balanced = load - load.mean()
        target = tolerance * sqrt(_dot(balanced, balanced))
        values = np.zeros_like(load) if guess is None else guess.copy()
        residual = balanced - self._stiffness @ values
        size, iterations = sqrt(_dot(residual, residual)), 0
        if target <= tolerance * 1e-14 * float(np.abs(load).sum()):  # a constant load: only rounding is left
            return PoissonSolution(values=np.zeros_like(load), iterations=0, residual=0.0)
        direction, old_product = np.zeros_like(load), 1.0
        while size > target and iterations < _MOST_ITERATIONS:
            smoothed = self._v_cycle(0, residual)
            product = _dot(residual, smoothed)
            direction = smoothed + (product / old_product) * direction
            image = self._stiffness @ direction
            length = product / _dot(direction, image)
            values += length * direction
            residual -= length * image
            old_product = product
            size, iterations = sqrt(_dot(residual, residual)), iterations + 1
        return PoissonSolution(values=values - values.mean(), iterations=iterations, residual=size * tolerance / target)

    def _v_cycle(self, depth: int, load: Array) -> Array:
        """Return an approximate solution of the problem at this depth; symmetric, as conjugate gradients need."""
        level = self._hierarchy.levels[depth]
        if depth == len(self._hierarchy.levels) - 1:
            return np.asarray(self._hierarchy.coarse_solver(level.A, load))
        values = np.zeros_like(load)
        level.presmoother(level.A, values, load)
        values += level.P @ self._v_cycle(depth + 1, level.R @ (load - level.A @ values))
        level.postsmoother(level.A, values, load)
        return values


def _dot(a: Array, b: Array) -> float:
    """Return the dot product by einsum, which stays on this thread: BLAS wakes others that spin after little work."""
    return float(np.einsum("i,i", a, b))


def divergence_load(mesh: TriangleMesh, field: Array) -> Array:
    """Return (n,) integrals of field . grad(v_i): the weak form of -div(field), natural condition d(phi)/dn = field .
    n.

    field (n, 2) is P1, so the midpoint of each triangle integrates the product exactly.
    """
    return _divergence_load(mesh.points_mm, mesh.triangles, np.ascontiguousarray(field))


def _pattern(triangles: Triangles, vertices: int) -> tuple[sparse.csr_matrix, NDArray[np.int32]]:
    """Return the sparsity pattern, and for each entry of the triangles' 3 x 3 matrices its place in the CSR data (m, 3,
    3).
    """
    rows = np.repeat(triangles[:, :, None], 3, axis=2)
    columns = np.repeat(triangles[:, None, :], 3, axis=1)
    keys, slots = np.unique(rows.astype(np.int64) * vertices + columns, return_inverse=True)
    starts = np.searchsorted(keys, np.arange(vertices + 1, dtype=np.int64) * vertices).astype(np.int32)
    indices = (keys % vertices).astype(np.int32)
    pattern = sparse.csr_matrix((np.ones(keys.size), indices, starts), shape=(vertices, vertices))
    return pattern, slots.reshape(rows.shape).astype(np.int32)


@njit(cache=True, nogil=True)
def _stiffness(points: Array, triangles: Triangles, slots: NDArray[np.int32], nnz: int) -> Array:
    """Return e_a . e_b / (4 area) per triangle, e_k the edge opposite to corner k."""
    data = np.zeros(nnz)
    ex, ey = np.empty(3), np.empty(3)
    for t in range(triangles.shape[0]):
        for k in range(3):
            b, c = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
            ex[k] = points[c, 0] - points[b, 0]
            ey[k] = points[c, 1] - points[b, 1]
        scale = 0.5 / (ex[0] * ey[1] - ex[1] * ey[0])
        for p in range(3):
            for q in range(3):
                data[slots[t, p, q]] += scale * (ex[p] * ex[q] + ey[p] * ey[q])
    return data


@njit(cache=True, nogil=True)
def _divergence_load(points: Array, triangles: Triangles, field: Array) -> Array:
    """Return the load by area grad(v_k) = 1/2 rot90(opposite edge); a P1 field's mean is that of its corners."""
    load = np.zeros(points.shape[0])
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t]
        fx = (field[a, 0] + field[b, 0] + field[c, 0]) / 3.0
        fy = (field[a, 1] + field[b, 1] + field[c, 1]) / 3.0
        for k in range(3):
            b, c = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
            load[triangles[t, k]] += 0.5 * (fx * (points[b, 1] - points[c, 1]) + fy * (points[c, 0] - points[b, 0]))
    return load
