"""Grids of the transport solver, from coarse to fine, and the deviation of pixels' pre-images from their shares on
each.

    residual  r = light * det+ - g with a, b the diagonal and x the mixed products of Dp, ab = max(a,0) max(b,0) and
              det+ = ab - max(x, -ab) + min(a,0) + min(b,0): equal to det on the elliptic branch and monotone off it, so
              the iteration finds its way back from folds. Where a pixel has turned over, det+ < 0 <= g / light: no fold
              is a solution (with x unbounded, as the near field's curl makes it negative, some corners' folds are).
    step      InvLaplace(r / w): the linearised operator is div(cof(Dp) grad), about w = (|a| + |b|) / 2 times the
              Laplacian. The division makes the number of steps nearly independent of contrast and of grid; w is
              smoothed to (w + 1) / 2, because where it is nearly 0 (black) the cofactor is not a multiple of the
              identity.
The step is a cosine transform (Neumann), in single precision where that is enough: the step only guides the iteration,
r decides.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from scipy import fft
from scipy.ndimage import map_coordinates

from optics.bench import Bench
from optics.spline import Array
from optics.threads import run_on_rows, thread_count
from optics.transport.optical_path import Preimages

_SINGLE_UP_TO = 1024  # pixels a side: rounding of long waves reaches the residual N^2 times as strong
_EVENED = 1.0  # weight of 1 beside w; 0.3 and 3 take a few steps more, w alone (at least 0.1) three times as many
_COARSE_ENOUGH = 48


def level_shapes(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return grid shapes from about 32 pixels a side to the full one; a short side waits for the other to double."""
    shapes = [(shape[0], shape[1])]
    while max(shapes[0]) > _COARSE_ENOUGH:
        ny, nx = (-(-n // 2) if n > _COARSE_ENOUGH else n for n in shapes[0])
        shapes.insert(0, (ny, nx))
    return shapes


def average_boxes(values: Array, shape: tuple[int, int]) -> Array:
    """Return the exact means of a piecewise constant grid over a coarser one's cells (any ratio)."""
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


def prolong(c: Array, shape: tuple[int, int], bench: Bench) -> Array:
    """Return c on a finer grid: base exactly, the rest by cubic interpolation with mirror images beyond the frame."""
    qx, qy = bench.pixel_centres_mm(c.shape[1], c.shape[0])
    delta = c - bench.base_path_mm(qx[None, :], qy[:, None])
    rows = (np.arange(shape[0]) + 0.5) * c.shape[0] / shape[0] - 0.5
    columns = (np.arange(shape[1]) + 0.5) * c.shape[1] / shape[1] - 0.5
    fine = map_coordinates(delta, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="reflect")
    qx, qy = bench.pixel_centres_mm(shape[1], shape[0])
    return np.asarray(fine + bench.base_path_mm(qx[None, :], qy[:, None]))


@njit(cache=True, nogil=True)
def _fill_residual(
    row_lo: int, row_hi: int, across: Array, along: Array, mixed: Array, light: Array, g: Array,
    residual: Array, sums: Array,
) -> None:  # fmt: skip
    """Compute residual = light * det+ - g; sums[row] = its sum, that of its squares, and the light on turned pixels."""
    even = light.size == 1
    for r in range(row_lo, row_hi):
        total = squares = turned = 0.0
        for k in range(g.shape[1]):
            a, b = across[r, k], along[r, k]
            product = max(a, 0.0) * max(b, 0.0)
            det = product - max(mixed[r, k], -product) + min(a, 0.0) + min(b, 0.0)
            strength = 1.0 if even else light[r, k]
            area = a * b - mixed[r, k]
            if a < 0.0 or b < 0.0 or area < 0.0:
                turned += strength * abs(area)
            miss = strength * det - g[r, k]
            total += miss
            squares += miss * miss
            residual[r, k] = miss
        sums[r, 0], sums[r, 1], sums[r, 2] = total, squares, turned


@njit(cache=True, nogil=True)
def _level_out(
    row_lo: int, row_hi: int, across: Array, along: Array, light: Array, mean: float, residual: Array, even: Array
) -> None:
    """Compute residual -= mean, and even = residual / (w + 1) * 2."""
    is_even = light.size == 1
    for r in range(row_lo, row_hi):
        for k in range(residual.shape[1]):
            w = 0.5 * (abs(across[r, k]) + abs(along[r, k])) * (1.0 if is_even else light[r, k])
            miss = residual[r, k] - mean
            residual[r, k] = miss
            even[r, k] = miss * (1.0 + _EVENED) / (w + _EVENED)


class Misses(NamedTuple):
    """The deviation of an iterate from its aim; NaN beyond total reflection.

    residual (ny, nx) : r less its mean; the buffer is used again by the next evaluation
    rms               : of the residual
    turned            : share of the light that lands on pixels whose pre-image has turned over
    top_mm            : greatest height met
    """

    residual: Any
    rms: float
    turned: float
    top_mm: float


class TransportLevel:
    """Computes residual and step of each iterate, for one target grid (ny, nx) of mean 1."""

    def __init__(self, target: Array, bench: Bench) -> None:
        ny, nx = target.shape
        self.target, self.preimages = target, Preimages(bench, target.shape)
        # paraxial change of the area by a change of c: -reach * (screen / aperture) * Laplacian
        x, y = (
            reach * of_screen / of_aperture * (2 - 2 * np.cos(np.pi * np.arange(n) / n)) * (n / of_screen) ** 2
            for reach, of_screen, of_aperture, n in zip(
                self.preimages.reach_mm,
                (bench.screen.width_mm, bench.screen.height_mm),
                (bench.width_mm, bench.height_mm),
                (nx, ny),
                strict=True,
            )
        )
        symbol = x[None, :] + y[:, None]
        symbol[0, 0] = math.inf
        self.step_type = np.float32 if max(ny, nx) <= _SINGLE_UP_TO else np.float64
        self._inverse = (-self.preimages.sign / symbol).astype(self.step_type)
        self._residual, self._even = np.empty((ny, nx), np.float32), np.empty((ny, nx), self.step_type)
        self._sums = np.empty((ny, 3))

    def evaluate(self, c: Array) -> Misses:
        """Return the deviation of c from the aim; `step` then returns the correction."""
        p, rows = self.preimages, c.shape[0]
        top_mm = p.evaluate(c)
        run_on_rows(_fill_residual, rows, p.across, p.along, p.mixed, p.light, self.target, self._residual, self._sums)
        mean, square, turned = self._sums.sum(axis=0) / c.size
        run_on_rows(_level_out, rows, p.across, p.along, p.light, mean, self._residual, self._even)
        return Misses(self._residual, math.sqrt(max(square - mean * mean, 0.0)), float(turned), top_mm)

    def step(self) -> Array:
        """Return the change of c for the last residual."""
        spectrum = fft.dctn(self._even, type=2, workers=thread_count())
        spectrum *= self._inverse
        return np.asarray(fft.idctn(spectrum, type=2, workers=thread_count(), overwrite_x=True))
