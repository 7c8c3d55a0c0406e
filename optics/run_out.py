"""The surface around the aperture on which all passes run out, as coefficients of the lens's own spline.

The slope across the rim continues and decays as exp(-d / fade), instead of rising or falling without bound. The
contribution of the rim's curvature decays within a few cells; otherwise a crease that reaches the rim would continue as
a ridge. Within 1 mm, from `rim_mm` on, the run-out also turns down by the droop, so that it does not lift a ball that
touches the rim: a dark frame makes half a valley of the rim.
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

    rim_mm : width in which the surface continues without the droop
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
        (ny, nx), (after_y, after_x) = coefs.shape, (coefs.shape[0] - pad_y, coefs.shape[1] - pad_x)
        for rows, j in (slice(0, pad_y), pad_y), (slice(after_y, ny), after_y - 1):
            for columns, i in (slice(0, pad_x), pad_x), (slice(after_x, nx), after_x - 1):
                # The sum of the two strips that meet at the corner: continuing them once more would multiply the twist
                # at the rim's corners into towers of millimetres.
                coefs[rows, columns] = coefs[rows, i][:, None] + coefs[j, columns][None, :] - coefs[j, i]
        return coefs


def _continue_rows(coefs: Array, rows: int, spacing: float, rim_mm: float) -> Array:
    """Return coefficients with `rows` more rows before the first and after the last; always C2.

    The k-th new difference is s exp(-k spacing / fade) + (e - s) / 3^k, less the droop: e the outermost difference,
    which belongs to half a cell beyond the rim, and s the slope at the rim itself, per cell.
    """
    k = np.arange(1, rows + 1)[:, None]
    slow, quick = np.cumsum(np.exp(-k * spacing / _FADE_MM), axis=0), np.cumsum((1 / 3) ** k, axis=0)
    sag = np.cumsum(_DROOP * spacing * np.clip(k * spacing - rim_mm, 0.0, 1.0), axis=0)

    def beyond(outer: Array, at_rim: Array, inner: Array) -> Array:
        slope = (outer - inner) / 2
        return np.asarray(outer + slow * slope + quick * (outer - at_rim - slope) - sag)

    before = beyond(coefs[0], coefs[1], coefs[2])[::-1]
    return np.concatenate([before, coefs, beyond(coefs[-1], coefs[-2], coefs[-3])])
