"""Simulates the removal by an end mill that is flat or has rounded corners: all stock above its end, cell by cell,
exactly along straight moves.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cam.checking.removal import Drops, RemovalGrid
from cam.checking.sweep import (
    LEFT,
    REACH,
    RIGHT,
    STRIKE,
    STRIKE_CELL,
    TALLIES,
    find_highest_near,
    find_strike,
    find_way,
)
from cam.cutters import BALL, CutterShape
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid

_SEARCHED = 1e-5  # of the radius: precision of the lowest place along the path; the height is off by its square
_SLIVER_MM = 1e-7  # left by rounding where an end passes twice
_RIM_MM = 1e-3  # inside the rim of an end: nearer than this, rounding decides whether a wall is touched
_VISIT_RADII = 2.5  # a cell that was last cut within this length of path is still being cut


@njit(cache=True, nogil=True)
def carve(top, by_line, x0, y0, cell, points, rapid, line, cutter, stock, visit, first_row, row_step, found):  # type: ignore[no-untyped-def] # fmt: skip
    """Move an end mill along points (n + 1, 3) through the stock's heights top (ny, nx), lowering them; in rows
    first_row, first_row + row_step, ... only.

    cutter             : radius, radius of the corner (0 of a flat end), rim: cells nearer to the rim of the end than
                         that, beside the way or around its ends, are cut but do not count, unless a later move goes
                         farther over them; how much lower a rapid straight down counts
    stock              : (ceiling, tile, shank reach, flutes, shank ceiling), see `cam.checking.sweep`
    visit              : path length so far (1,); for each cell the length at its last cut, and its height when that cut
                         began
    found              : of each move (n,) the greatest drop, its flat cell (-1: none), and the tally (n, 5) of
                         `cam.checking.sweep`
    The height left at a cell is the lowest height of the end while its centre is within the radius of the cell.
    """
    ny, nx = top.shape
    drops, places, tally = found
    radius, corner, rim, keep_off = cutter
    ceiling, tile, shank_reach, flutes, shank_ceiling = stock
    way, seen, begun = visit
    for k in range(drops.size):
        ax, ay, az = points[k, 0], points[k, 1], points[k, 2]
        bx, by, bz = points[k + 1, 0], points[k + 1, 1], points[k + 1, 2]
        if ax == bx and ay == by and az == bz:
            continue
        along, length, ex, ey, slope = find_way(ax, ay, az, bx, by, bz)
        way[0] += math.hypot(length, bz - az)
        lowest = min(az, bz)
        if rapid[k] and not along and bz < az:
            lowest -= keep_off
        if shank_reach > 0.0 and find_highest_near(shank_ceiling, tile, x0, y0, ax, ay, bx, by) > lowest + flutes:
            over, place = find_strike(
                top, x0, y0, cell, points[k], points[k + 1], shank_reach, flutes, first_row, row_step
            )
            if over > tally[k, STRIKE]:
                tally[k, STRIKE], tally[k, STRIKE_CELL] = over, place
        if find_highest_near(ceiling, tile, x0, y0, ax, ay, bx, by) <= lowest:
            continue
        i0 = max(0, int(math.ceil((min(ax, bx) - radius - x0) / cell - 0.5)))
        i1 = min(nx - 1, int(math.floor((max(ax, bx) + radius - x0) / cell - 0.5)))
        j0 = max(0, int(math.ceil((min(ay, by) - radius - y0) / cell - 0.5)))
        j1 = min(ny - 1, int(math.floor((max(ay, by) + radius - y0) / cell - 0.5)))
        for j in range(j0 + (first_row - j0) % row_step, j1 + 1, row_step):
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
                if first > last or top[j, i] <= lowest + _measure_rise(beside2, radius, corner):
                    continue
                at = first if slope > 0.0 else last
                if corner > 0.0:
                    at = _find_lowest(u, beside2, first, last, slope, radius, corner)
                height = az + slope * at if along else lowest
                if corner > 0.0:
                    height += _measure_rise(beside2 + (u - at) ** 2, radius, corner)
                off = top[j, i] - height
                if off <= _SLIVER_MM:
                    continue
                if way[0] - seen[j, i] > _VISIT_RADII * radius + length:
                    begun[j, i] = top[j, i]
                seen[j, i] = way[0]
                tally[k, REACH] = max(tally[k, REACH], top[j, i] - az - slope * at)
                tally[k, LEFT if dy * ex > dx * ey else RIGHT] += off * cell * cell
                by_line[j, i] = line[k]
                past = u - min(max(u, 0.0), length)
                if half2 - past * past <= rim * (2.0 * radius - rim):
                    top[j, i] = height + 2.0 * _SLIVER_MM  # a move that goes farther over the cell finds it again
                    continue
                top[j, i] = height
                if begun[j, i] - height > drops[k]:
                    drops[k] = begun[j, i] - height
                    places[k] = j * nx + i


@njit(cache=True, nogil=True)
def _find_lowest(u, w2, first, last, slope, radius, corner):  # type: ignore[no-untyped-def]
    """Find the position between `first` and `last` on the way at which the end cuts lowest at a place u along the way,
    w2 being the square of its distance beside the way. The height is convex along a move.
    """
    if slope == 0.0:
        return min(max(u, first), last)
    if _climb(u, w2, first, slope, radius, corner) >= 0.0:
        return first
    if _climb(u, w2, last, slope, radius, corner) <= 0.0:
        return last
    while last - first > _SEARCHED * radius:
        middle = 0.5 * (first + last)
        if _climb(u, w2, middle, slope, radius, corner) < 0.0:
            first = middle
        else:
            last = middle
    return 0.5 * (first + last)


@njit(cache=True, nogil=True)
def _climb(u, w2, at, slope, radius, corner):  # type: ignore[no-untyped-def]
    """Return how fast the height that the end leaves there rises along its way."""
    away = math.sqrt(w2 + (u - at) ** 2)
    beyond = away - (radius - corner)
    if beyond <= 0.0:
        return slope
    return slope + (at - u) / away * beyond / math.sqrt(max(1e-300, corner * corner - beyond * beyond))


@njit(cache=True, nogil=True)
def _measure_rise(square, radius, corner):  # type: ignore[no-untyped-def]
    """Return the height of the underside over the tip, at a distance of that square from the axis."""
    beyond = math.sqrt(max(0.0, square)) - (radius - corner)
    return 0.0 if beyond <= 0.0 else corner - math.sqrt(max(0.0, corner * corner - beyond * beyond))


class FlatRemoval(RemovalGrid):
    """The stock left under one end mill that is flat or has a rounded corner."""

    def __init__(
        self,
        stock: StockGrid,
        *,
        radius_mm: float,
        corner_mm: float = 0.0,
        rim_mm: float = _RIM_MM,
        rapid_clearance_mm: float = 0.0,
        shares: int = 1,
        shank: tuple[float, float] | None = None,
    ) -> None:
        """Begin as RemovalGrid does. rim_mm: how far two runs of the same way may lie apart, by its digits."""
        super().__init__(stock, radius_mm=radius_mm, rapid_clearance_mm=rapid_clearance_mm, shares=shares, shank=shank)
        self._corner_mm, self._rim_mm = float(corner_mm), float(rim_mm)
        self._ways = np.zeros((shares, 1))
        self._seen, self._begun = np.full(self.top_mm.shape, -np.inf), self.top_mm.copy()

    def sweep(self, batch: MoveBatch, share: int) -> Drops:
        drops, cells = np.zeros(len(batch) + 1), np.full(len(batch) + 1, -1, dtype=np.int64)
        tally = np.zeros((len(batch) + 1, TALLIES))
        carve(
            *(self.top_mm, self.cut_by_line, self.x0_mm, self.y0_mm, self.cell_mm),
            *(batch.points_mm, batch.is_rapid, batch.line),
            (self.radius_mm, self._corner_mm, self._rim_mm, self._keep_off_mm),
            (self._ceiling, self._tile_mm, self._shank_reach_mm, self._flutes_mm, self._shank_ceiling),
            (self._ways[share], self._seen, self._begun),
            *(share, self.shares, (drops[1:], cells[1:], tally[1:])),
        )
        return Drops(depth_mm=drops, cell=cells, tally=tally)

    def cut_at_rest(self) -> tuple[float, int]:
        """Do nothing: the removal where an end stops counts for the move that ends there."""
        return 0.0, -1


def removal_of(
    shape: CutterShape,
    stock: StockGrid,
    *,
    radius_mm: float,
    rim_mm: float = _RIM_MM,
    rapid_clearance_mm: float = 0.0,
    shares: int = 1,
    shank: tuple[float, float] | None = None,
) -> RemovalGrid:
    """Return the stock under a cutter of that shape."""
    if shape == BALL:
        return RemovalGrid(
            stock, radius_mm=radius_mm, rapid_clearance_mm=rapid_clearance_mm, shares=shares, shank=shank
        )
    return FlatRemoval(
        stock,
        radius_mm=radius_mm,
        corner_mm=shape.corner_mm(radius_mm),
        rim_mm=rim_mm,
        rapid_clearance_mm=rapid_clearance_mm,
        shares=shares,
        shank=shank,
    )
