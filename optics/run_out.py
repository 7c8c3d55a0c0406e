"""The surface around the aperture on which all passes run out, by the coefficients of the lens's own spline.

The slope across the rim goes on and dies out as exp(-d / fade), instead of running up or down without bound; what the
rim's curvature adds to it dies out within a few cells, or a crease that runs out of the lens would go on as a ridge.
Within 1 mm, from `rim_mm` on, the run-out also turns down by the droop, so that it does not lift a ball that touches
the rim: a dark frame makes half a valley of the rim. All of it but the droop is linear in the lens's heights, so a
descent that looks beyond the rim has its transpose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_FADE_MM, _DROOP = 6.0, 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOut:
    """A run-out of that many cells (y, x) on each side of a spline's coefficients, on its own grid of dy_mm by dx_mm.

    rim_mm : so far the surface goes on without the droop
    """

    cells: tuple[int, int]
    dy_mm: float
    dx_mm: float
    rim_mm: float = 0.0

    def extend(self, coefs: Array) -> Array:
        """Return coefficients (ny + 2 cells, nx + 2 cells) of the lens, exactly, and of its run-out: C2."""
        pad_y, pad_x = self.cells
        coefs = _continue_rows(coefs, pad_y, self.dy_mm, self.rim_mm)
        coefs = np.ascontiguousarray(_continue_rows(coefs.T, pad_x, self.dx_mm, self.rim_mm).T)
        for rows, columns, j, i in self._corners(coefs.shape):
            coefs[rows, columns] = coefs[rows, i][:, None] + coefs[j, columns][None, :] - coefs[j, i]
        return coefs

    def transpose(self, gain: Array) -> Array:
        """Return the gradient by the lens's coefficients, from the gradient by all coefficients of `extend`, which is
        overwritten.
        """
        pad_y, pad_x = self.cells
        for rows, columns, j, i in self._corners(gain.shape):
            block = gain[rows, columns].copy()
            gain[rows, columns] = 0.0
            gain[rows, i] += block.sum(axis=1)
            gain[j, columns] += block.sum(axis=0)
            gain[j, i] -= block.sum()
        gain = _rows_transposed(gain.T, pad_x, self.dx_mm).T
        return _rows_transposed(gain, pad_y, self.dy_mm)

    def _corners(self, shape: tuple[int, ...]) -> list[tuple[slice, slice, int, int]]:
        """Return the corner blocks' rows and columns, and the row and column of the lens that each meets.

        They are the sum of the two strips that meet there: continuing the strips once more would multiply the twist at
        the rim's corners into towers of millimetres.
        """
        (pad_y, pad_x), (ny, nx) = self.cells, shape
        sides_y = (slice(0, pad_y), pad_y), (slice(ny - pad_y, ny), ny - pad_y - 1)
        sides_x = (slice(0, pad_x), pad_x), (slice(nx - pad_x, nx), nx - pad_x - 1)
        return [(rows, columns, j, i) for rows, j in sides_y for columns, i in sides_x]


def _weights(rows: int, spacing: float) -> tuple[Array, Array]:
    """Return (rows, 1) sums of the differences that fade slowly and quickly."""
    k = np.arange(1, rows + 1)
    return np.cumsum(np.exp(-k * spacing / _FADE_MM))[:, None], np.cumsum((1 / 3) ** k)[:, None]


def _continue_rows(coefs: Array, rows: int, spacing: float, rim_mm: float) -> Array:
    """Return coefficients with `rows` more rows before the first and after the last; always C2.

    The k-th new difference is s exp(-k spacing / fade) + (e - s) / 3^k, less the droop: e the outermost difference,
    which belongs to half a cell beyond the rim, and s the slope at the rim itself, per cell.
    """
    slow, quick = _weights(rows, spacing)
    sag = np.cumsum(_DROOP * spacing * np.clip(np.arange(1, rows + 1) * spacing - rim_mm, 0.0, 1.0))[:, None]

    def beyond(outer: Array, at_rim: Array, inner: Array) -> Array:
        slope = (outer - inner) / 2
        return np.asarray(outer + slow * slope + quick * (outer - at_rim - slope) - sag)

    before = beyond(coefs[0], coefs[1], coefs[2])[::-1]
    return np.concatenate([before, coefs, beyond(coefs[-1], coefs[-2], coefs[-3])])


def _rows_transposed(gain: Array, rows: int, spacing: float) -> Array:
    """Return the transpose of `_continue_rows`."""
    slow, quick = _weights(rows, spacing)
    inside = gain[rows : gain.shape[0] - rows].copy()
    for beyond, (outer, at_rim, inner) in (
        (gain[:rows][::-1], (0, 1, 2)),
        (gain[gain.shape[0] - rows :], (-1, -2, -3)),
    ):
        by_slope, by_bend = (slow * beyond).sum(axis=0), (quick * beyond).sum(axis=0)
        inside[outer] += beyond.sum(axis=0) + by_slope / 2 + by_bend / 2
        inside[at_rim] -= by_bend
        inside[inner] += by_bend / 2 - by_slope / 2
    return inside
