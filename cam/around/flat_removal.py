"""What a flat end mill takes off: all stock above its end, cell by cell, exactly along straight moves."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cam.moves import Array
from cam.surface.stock_grid import StockGrid

_STILL_MM = 1e-9


@njit(cache=True, nogil=True)
def carve(top, x0, y0, cell, points, radius, rim, drops, places):  # type: ignore[no-untyped-def]
    """Move a flat end of this radius along points (n + 1, 3) through the stock's heights top (ny, nx), lowering them.

    drops, places (n,) : greatest drop of each move and its flat cell, -1 where there is none; cells nearer to the rim
                         of the end than `rim` are cut, but do not count
    At a cell the end leaves the lowest height that it has while its centre is within the radius.
    """
    ny, nx = top.shape
    for k in range(drops.size):
        ax, ay, az = points[k, 0], points[k, 1], points[k, 2]
        bx, by, bz = points[k + 1, 0], points[k + 1, 1], points[k + 1, 2]
        length = math.hypot(bx - ax, by - ay)
        along = length > _STILL_MM
        ex = (bx - ax) / length if along else 0.0
        ey = (by - ay) / length if along else 0.0
        slope = (bz - az) / length if along else 0.0
        i0 = max(0, int(math.ceil((min(ax, bx) - radius - x0) / cell - 0.5)))
        i1 = min(nx - 1, int(math.floor((max(ax, bx) + radius - x0) / cell - 0.5)))
        j0 = max(0, int(math.ceil((min(ay, by) - radius - y0) / cell - 0.5)))
        j1 = min(ny - 1, int(math.floor((max(ay, by) + radius - y0) / cell - 0.5)))
        lowest = min(az, bz)
        for j in range(j0, j1 + 1):
            dy = y0 + (j + 0.5) * cell - ay
            for i in range(i0, i1 + 1):
                if top[j, i] <= lowest:
                    continue
                dx = x0 + (i + 0.5) * cell - ax
                u = dx * ex + dy * ey
                half2 = radius * radius - (dx * dx + dy * dy - u * u)
                if half2 < 0.0:
                    continue
                height = lowest
                if along:
                    half = math.sqrt(half2)
                    first, last = max(0.0, u - half), min(length, u + half)
                    if first > last:
                        continue
                    height = az + slope * (first if slope > 0.0 else last)
                drop = top[j, i] - height
                if drop > 0.0:
                    top[j, i] = height
                    if drop > drops[k] and half2 > rim * (2.0 * radius - rim):
                        drops[k] = drop
                        places[k] = j * nx + i


class FlatRemoval:
    """The stock that is left under one flat end mill. Not a value: it changes with every batch of moves."""

    def __init__(self, stock: StockGrid, *, radius_mm: float, rim_mm: float = 0.0) -> None:
        """Make it of stock. rim_mm: how far a repeated way may lie beside itself, by its digits."""
        self._stock, self._radius_mm, self._rim_mm = stock, radius_mm, rim_mm
        self.top_mm = stock.top_mm.copy()

    def cut(self, points_mm: Array) -> tuple[Array, np.ndarray]:
        """Cut along points (n + 1, 3). Returns the greatest drop of each move (n,), and its flat cell, -1 for none."""
        drops, places = np.zeros(len(points_mm) - 1), np.full(len(points_mm) - 1, -1, dtype=np.int64)
        grid = self._stock
        carve(
            *(self.top_mm, grid.x0_mm, grid.y0_mm, grid.cell_mm),
            *(np.ascontiguousarray(points_mm), self._radius_mm, self._rim_mm, drops, places),
        )
        return drops, places
