"""The transport map with exact near-field refraction: one fixed-point iteration on the optical path.

Solves det Dp(q) = g(q) for the optical path c(q) (optical_path.py), g = target / mean, light uniform on the aperture.
    step      r = det+ - g,  r -= mean r,  c += scale * InvLaplace(r)   (cosine transform, Neumann)
    det+      max(a,0) max(b,0) - x + min(a,0) + min(b,0) with a, b the diagonal and x the mixed products: equal to
              det on the elliptic branch and monotone off it, so the iteration finds its way back from folds
    piston    c += (n - 1) (-skim - top): the highest point stays skim_mm under Z0
    Anderson  depth 16, least squares on r and the piston together (by r alone, the piston never comes to rest where
              screen and aperture differ); beyond twice the best residual: back to the best with half the step
    levels    32, 64 .. N pixels, cubic prolongation of c
No Jacobian, no line search, no floor under the target: black pixels converge like others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy import fft
from scipy.ndimage import map_coordinates

from optics.bench import Bench
from optics.errors import TotalReflectionError
from optics.optical_path import preimage_areas, preimages_of_corners, rim_slopes
from optics.spline import Array
from optics.threads import over_rows, thread_count
from optics.transport_map import TransportMap

TOLERANCE = 1e-3  # rms of det - g at which a level is done
_COARSEST = 32
_ANDERSON_DEPTH = 16  # on hard logos 8 takes three times the steps, 24 no fewer
_PISTON_WEIGHT = 3.0  # of the highest point's distance from the skim, in throws, beside the rms of det - g
_MOST_COARSE = 100
_STALE = 60  # iterations without 2 % of progress: stopped
_BLOW_UP = 2.0  # a residual this many times the best: restart


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelRecord:
    """How one grid level went: pixels across, iterations, and the last root mean square of det - g."""

    pixels: int
    iterations: int
    rms: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpticalPath:
    """The solution on the screen's pixels; what a warm start needs, and what lens heights are made of."""

    bench: Bench
    path_mm: Array  # (ny, nx)
    levels: tuple[LevelRecord, ...]
    converged: bool

    def transport_map(self) -> TransportMap:
        """Pixel corners and the lens points that light them."""
        ny, nx = self.path_mm.shape
        px, py = np.empty((ny + 1, nx + 1)), np.empty((ny + 1, nx + 1))
        rims = rim_slopes(self.path_mm, self.bench)
        over_rows(
            preimages_of_corners, ny + 1,
            self.path_mm, *rims, *self.bench.kernel_arguments(nx, ny), px, py,
        )  # fmt: skip
        s = self.bench.screen
        qx, qy = np.meshgrid(
            s.left_mm + np.arange(nx + 1) * s.width_mm / nx, s.bottom_mm + np.arange(ny + 1) * s.height_mm / ny
        )
        return TransportMap(screen_mm=np.stack([qx, qy], axis=-1), lens_mm=np.stack([px, py], axis=-1))


@njit(cache=True, nogil=True)
def _monotone_residual(
    row_lo: int, row_hi: int, across: Array, along: Array, mixed: Array, g: Array, residual: Array
) -> None:
    for r in range(row_lo, row_hi):
        for k in range(g.shape[1]):
            a, b = across[r, k], along[r, k]
            det = max(a, 0.0) * max(b, 0.0) - mixed[r, k] + min(a, 0.0) + min(b, 0.0)
            residual[r, k] = det - g[r, k]


class _Level:
    """One grid level: evaluates residuals and inverts the Laplacian."""

    def __init__(self, target: Array, bench: Bench) -> None:
        ny, nx = target.shape
        self.target, self.bench = target, bench
        self.arguments = bench.kernel_arguments(nx, ny)
        dx, dy = self.arguments[4], self.arguments[5]
        # paraxial change of the area by a change of c: -throw * (screen / aperture) * Laplacian
        sx, sy = bench.screen.width_mm / bench.width_mm, bench.screen.height_mm / bench.height_mm
        symbol = (2 - 2 * np.cos(np.pi * np.arange(nx) / nx))[None, :] * sx / dx**2 + (
            2 - 2 * np.cos(np.pi * np.arange(ny) / ny)
        )[:, None] * sy / dy**2
        symbol[0, 0] = np.inf
        self.inverse = -1.0 / (symbol * bench.throw_mm)
        self.across, self.along, self.mixed, self.residual = (np.empty((ny, nx)) for _ in range(4))
        self.top = np.empty(ny)

    def evaluate(self, c: Array) -> tuple[Array, float, float]:
        """(residual with its mean removed, its rms, greatest height met)."""
        rows = c.shape[0]
        rim_x, rim_y = rim_slopes(c, self.bench)
        over_rows(preimage_areas, rows, c, rim_x, rim_y, *self.arguments, self.across, self.along, self.mixed, self.top)
        over_rows(_monotone_residual, rows, self.across, self.along, self.mixed, self.target, self.residual)
        r = self.residual - self.residual.mean()
        return r, math.sqrt(float(np.mean(r * r))), float(self.top.max())

    def preconditioned(self, r: Array) -> Array:
        spectrum = fft.dctn(r, type=2, workers=thread_count())
        spectrum *= self.inverse
        return np.asarray(fft.idctn(spectrum, type=2, workers=thread_count(), overwrite_x=True))


class _Anderson:
    """Mixing memory: the last steps of iterate and residual, least squares on the residual.

    The iterate is c; the residual is r of every pixel and, last, the piston's share of the merit.
    """

    def __init__(self, size: int) -> None:
        self.moves = np.empty((_ANDERSON_DEPTH, size))  # differences of x + f
        self.changes = np.empty((_ANDERSON_DEPTH, size + 1))  # and of the residual
        self.gram = np.empty((_ANDERSON_DEPTH, _ANDERSON_DEPTH))
        self.last: tuple[Array, Array] | None = None
        self.count = 0

    def forget(self) -> None:
        self.last, self.count = None, 0

    def next_iterate(self, moved: Array, r: Array, piston: float) -> Array:
        flat_moved, flat = moved.ravel(), np.append(r.ravel(), piston)
        if self.last is None:
            self.last = (flat_moved, flat)
            return moved
        slot = self.count % _ANDERSON_DEPTH
        self.count += 1
        np.subtract(flat_moved, self.last[0], out=self.moves[slot])
        np.subtract(flat, self.last[1], out=self.changes[slot])
        self.last = (flat_moved, flat)
        n = min(self.count, _ANDERSON_DEPTH)
        self.gram[slot, :n] = self.gram[:n, slot] = self.changes[:n] @ self.changes[slot]
        weights, *_ = np.linalg.lstsq(self.gram[:n, :n], self.changes[:n] @ flat, rcond=1e-12)
        return np.asarray(flat_moved - weights @ self.moves[:n]).reshape(moved.shape)


def solve_transport(
    target: Array,
    bench: Bench,
    *,
    skim_mm: float,
    start: OpticalPath | None = None,
    tolerance: float = TOLERANCE,
    most_iterations: int = 300,
    on_progress: Callable[[float], None] | None = None,
) -> OpticalPath:
    """Optical path whose refraction gives each pixel its share of the light.

    target      : (ny, nx) irradiance in the work frame, mean 1 (any mean is scaled)
    skim_mm     : depth of the lens's highest point under Z0
    start       : an earlier solution on the same grid, for a warm start without the coarse levels
    tolerance   : rms of det - g, with the skim's share, at which a level is done
    returns converged = False, with its history, where the finest level stopped early
    raises TotalReflectionError where the throw is too short for the way the light must go
    """
    g = target / target.mean()
    records: list[LevelRecord] = []
    if start is not None:
        c = start.path_mm
        shapes = [g.shape]
    else:
        shapes = level_shapes(g.shape)
        c = _flat_start(shapes[0], bench, skim_mm)
    converged = reflected = False
    for number, shape in enumerate(shapes):
        if c.shape != shape:
            c = _prolonged(c, shape, bench)
        finest = number == len(shapes) - 1
        most = most_iterations if finest else _MOST_COARSE
        c, record, met_reflection = _solve_level(box_averaged(g, shape), c, bench, skim_mm, tolerance, most)
        records.append(record)
        converged = record.rms <= tolerance
        reflected |= met_reflection
        if on_progress is not None:
            on_progress(4.0 ** (number + 1 - len(shapes)))
    if reflected and not converged:
        _refuse_too_short_throw(g, bench)
    return OpticalPath(bench=bench, path_mm=c, levels=tuple(records), converged=converged)


def _solve_level(
    g: Array, c: Array, bench: Bench, skim_mm: float, tolerance: float, most: int
) -> tuple[Array, LevelRecord, bool]:
    """Iterate one level; the last value says whether an iterate sent light beyond the critical angle."""
    level, memory, step = _Level(g, bench), _Anderson(g.size), 1.0
    reflected = False
    best, best_rms, best_merit = c, math.inf, math.inf
    stale, iteration = 0, 0
    for iteration in range(most + 1):
        r, rms, top = level.evaluate(c)
        piston = _PISTON_WEIGHT * (top + skim_mm) / bench.throw_mm
        merit = math.hypot(rms, piston)
        if not math.isfinite(merit):
            reflected, merit = True, math.inf
            if best_merit == math.inf:
                break
        stale = 0 if merit < 0.98 * best_merit else stale + 1
        if merit < best_merit:
            best, best_rms, best_merit = c, rms, merit
        if merit <= tolerance or iteration == most or stale > _STALE:
            break
        if merit > _BLOW_UP * best_merit:
            step *= 0.5
            memory.forget()
            c = best
            r, rms, top = level.evaluate(c)
            piston = _PISTON_WEIGHT * (top + skim_mm) / bench.throw_mm
        moved = c + step * level.preconditioned(r) - (bench.refractive_index - 1) * (top + skim_mm)
        c = memory.next_iterate(moved, r, piston * math.sqrt(r.size))
    record = LevelRecord(pixels=g.shape[1], iterations=iteration, rms=best_rms)
    return best, record, reflected


def level_shapes(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Grid shapes from about 32 pixels along the longer side to the full one, doubling."""
    ny, nx = shape
    shapes = [(ny, nx)]
    while max(shapes[0]) > 1.5 * _COARSEST and min(shapes[0]) >= 8:
        shapes.insert(0, (-(-shapes[0][0] // 2), -(-shapes[0][1] // 2)))
    return shapes


def box_averaged(values: Array, shape: tuple[int, int]) -> Array:
    """Exact means of a piecewise constant grid over a coarser one's cells (any ratio)."""
    for axis, n in enumerate(shape):
        if values.shape[axis] == n:
            continue
        total = np.insert(np.cumsum(values, axis=axis), 0, 0.0, axis=axis)
        edges = np.linspace(0, values.shape[axis], n + 1)
        low = np.minimum(edges.astype(int), values.shape[axis] - 1)
        part = np.expand_dims(edges - low, tuple(a for a in range(values.ndim) if a != axis))
        at = np.take(total, low, axis=axis) * (1 - part) + np.take(total, low + 1, axis=axis) * part
        values = np.diff(at, axis=axis) * (n / values.shape[axis])
    return values


def _flat_start(shape: tuple[int, int], bench: Bench, skim_mm: float) -> Array:
    qx, qy = bench.pixel_centres_mm(shape[1], shape[0])
    flat = bench.throw_mm - (bench.refractive_index - 1) * skim_mm
    return flat + bench.base_path_mm(qx[None, :], qy[:, None])


def _prolonged(c: Array, shape: tuple[int, int], bench: Bench) -> Array:
    """c on a finer grid: base exactly, the rest by cubic interpolation with mirror images beyond the frame."""
    qx, qy = bench.pixel_centres_mm(c.shape[1], c.shape[0])
    delta = c - bench.base_path_mm(qx[None, :], qy[:, None])
    rows = (np.arange(shape[0]) + 0.5) * c.shape[0] / shape[0] - 0.5
    columns = (np.arange(shape[1]) + 0.5) * c.shape[1] / shape[1] - 0.5
    fine = map_coordinates(delta, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="reflect")
    qx, qy = bench.pixel_centres_mm(shape[1], shape[0])
    return np.asarray(fine + bench.base_path_mm(qx[None, :], qy[:, None]))


def _refuse_too_short_throw(g: Array, bench: Bench) -> None:
    """Raise TotalReflectionError if the way the light must go sideways is what stopped the solution.

    How far it must go hardly depends on the throw, so a coarse solution for a far screen tells it.
    """
    s = bench.screen
    far = replace(bench, throw_mm=20 * max(bench.width_mm, bench.height_mm, s.width_mm, s.height_mm, bench.throw_mm))
    coarse = box_averaged(g, level_shapes(g.shape)[0])
    solution = solve_transport(coarse, far, skim_mm=0.0, tolerance=1e-2)
    moved = solution.transport_map()
    shift_mm = float(np.linalg.norm(moved.screen_mm - moved.lens_mm, axis=-1).max())
    steepest = math.sqrt(bench.refractive_index**2 - 1)  # tangent of the exit angle where cos = 1 / n
    if shift_mm > 0.6 * steepest * bench.throw_mm:
        raise TotalReflectionError(
            throw_mm=bench.throw_mm, shift_mm=shift_mm, shortest_throw_mm=shift_mm / (0.6 * steepest)
        )
