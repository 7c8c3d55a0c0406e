"""How closely the tracks of a pass lie: the greatest gap between neighbours of any direction.

One sample point per cell of the stock grid, at a random place in it (fixed seed), so that a regular raster cannot
hide between regular samples. The distance in plan from each sample to the nearest track is exact; twice the greatest
of them is the width of the widest gap found. A gap of area A is missed with probability exp(-A / cell area).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt

from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Array


@njit(cache=True, nogil=True)
def _lower_distances(nearest2, jitter, x0, y0, cell, points, counts, reach):  # type: ignore[no-untyped-def]
    """Lower the squared distance of every sample within reach of a move that counts."""
    ny, nx = nearest2.shape
    for k in range(counts.size):
        if not counts[k]:
            continue
        ax, ay = points[k, 0], points[k, 1]
        bx, by = points[k + 1, 0], points[k + 1, 1]
        j0 = max(0, int(math.floor((min(ay, by) - reach - y0) / cell)))
        j1 = min(ny - 1, int(math.floor((max(ay, by) + reach - y0) / cell)))
        i0 = max(0, int(math.floor((min(ax, bx) - reach - x0) / cell)))
        i1 = min(nx - 1, int(math.floor((max(ax, bx) + reach - x0) / cell)))
        ex = bx - ax
        ey = by - ay
        length2 = max(ex * ex + ey * ey, 1e-30)
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                dx = x0 + (i + jitter[j, i, 0]) * cell - ax
                dy = y0 + (j + jitter[j, i, 1]) * cell - ay
                t = min(max((dx * ex + dy * ey) / length2, 0.0), 1.0)
                d2 = (dx - t * ex) ** 2 + (dy - t * ey) ** 2
                if d2 < nearest2[j, i]:
                    nearest2[j, i] = d2


class Coverage:
    """Distance from sample points to the tracks of a pass. Changes with every batch."""

    def __init__(self, grid: StockGrid, *, pitch_mm: float) -> None:
        shape = grid.top_mm.shape
        self._origin = grid.x0_mm, grid.y0_mm, grid.cell_mm
        self._reach_mm = 1.5 * pitch_mm
        self._jitter = np.random.default_rng(20140511).random((*shape, 2), dtype=np.float32)
        self._nearest2 = np.full(shape, np.inf, dtype=np.float32)

    def add(self, batch: MoveBatch, counts: np.ndarray) -> None:
        """Add moves. counts (n,) bool: those that are tracks, near enough to the surface to make it."""
        _lower_distances(self._nearest2, self._jitter, *self._origin, batch.points_mm, counts, self._reach_mm)

    def widest_gap_mm(self, wanted: np.ndarray) -> tuple[float, float, float]:
        """Return (gap, x, y) of the sample farthest from all tracks among the wanted cells (ny, nx) bool.

        Beyond three pitches the gap is read from the cells without a track near them: good to two cells.
        """
        if not wanted.any():
            return 0.0, math.nan, math.nan
        distance: Array = np.sqrt(np.where(wanted, self._nearest2, 0.0)).astype(np.float64)
        far = np.isinf(distance)
        if far.any():
            inside = distance_transform_edt(far) * self._origin[2]
            distance = np.where(far, self._reach_mm + inside, distance)
        j, i = divmod(int(distance.argmax()), distance.shape[1])
        x0, y0, cell = self._origin
        x, y = x0 + (i + self._jitter[j, i, 0]) * cell, y0 + (j + self._jitter[j, i, 1]) * cell
        return 2.0 * float(distance[j, i]), float(x), float(y)
