"""What a flat end mill takes off, or one with a rounded corner: all stock above its end, cell by cell, exactly along
straight moves."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cam.moves import Array
from cam.surface.stock_grid import StockGrid

_STILL_MM = 1e-9
_SEARCHED_MM = 1e-8


@njit(cache=True, nogil=True)
def carve(top, x0, y0, cell, points, radius, corner, rim, drops, places):  # type: ignore[no-untyped-def]
    """Move an end mill along points (n + 1, 3) through the stock's heights top (ny, nx), lowering them.

    corner             : radius of its rounded corner, 0 of a flat end
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
                beside2 = dx * dx + dy * dy - u * u
                half2 = radius * radius - beside2
                if half2 < 0.0:
                    continue
                half = math.sqrt(half2)
                first, last = max(0.0, u - half), min(length, u + half)
                if first > last:
                    continue
                at = first if slope > 0.0 else last
                if corner > 0.0:
                    at = _find_lowest(u, beside2, first, last, slope, radius, corner)
                height = az + slope * at if along else lowest
                if corner > 0.0:
                    height += _measure_rise(beside2 + (u - at) ** 2, radius, corner)
                drop = top[j, i] - height
                if drop > 0.0:
                    top[j, i] = height
                    if drop > drops[k] and half2 > rim * (2.0 * radius - rim):
                        drops[k] = drop
                        places[k] = j * nx + i


@njit(cache=True, nogil=True)
def _find_lowest(u, w2, first, last, slope, radius, corner):  # type: ignore[no-untyped-def]
    """Find where from `first` to `last` on its way the end leaves least at a place lying at u along the way and at a
    distance of square w2 beside it. That is convex along a move: searched for by thirds where it climbs.
    """
    if slope == 0.0:
        return min(max(u, first), last)
    while last - first > _SEARCHED_MM:
        third = (last - first) / 3.0
        low = slope * (first + third) + _measure_rise(w2 + (u - first - third) ** 2, radius, corner)
        high = slope * (last - third) + _measure_rise(w2 + (u - last + third) ** 2, radius, corner)
        if low < high:
            last -= third
        else:
            first += third
    return first


@njit(cache=True, nogil=True)
def _measure_rise(square, radius, corner):  # type: ignore[no-untyped-def]
    """Return the height of the underside over the tip, at a distance of that square from the axis."""
    beyond = math.sqrt(max(0.0, square)) - (radius - corner)
    return 0.0 if beyond <= 0.0 else corner - math.sqrt(max(0.0, corner * corner - beyond * beyond))


class FlatRemoval:
    """The stock that is left under one end mill that is flat, or flat with a rounded corner. Not a value: it changes
    with every batch of moves."""

    def __init__(self, stock: StockGrid, *, radius_mm: float, corner_mm: float = 0.0, rim_mm: float = 0.0) -> None:
        """Begin with stock. rim_mm: how far a repeated way may lie beside itself, by its digits."""
        self._stock, self._radius_mm, self._corner_mm, self._rim_mm = stock, radius_mm, corner_mm, rim_mm
        self.top_mm = stock.top_mm.copy()

    def cut(self, points_mm: Array) -> tuple[Array, np.ndarray]:
        """Cut along points (n + 1, 3). Returns the greatest drop of each move (n,), and its flat cell, -1 for none."""
        drops, places = np.zeros(len(points_mm) - 1), np.full(len(points_mm) - 1, -1, dtype=np.int64)
        grid = self._stock
        cells = (self.top_mm, grid.x0_mm, grid.y0_mm, grid.cell_mm)
        cutter = (self._radius_mm, self._corner_mm, self._rim_mm)
        carve(*cells, np.ascontiguousarray(points_mm), *cutter, drops, places)
        return drops, places
