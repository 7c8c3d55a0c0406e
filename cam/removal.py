"""What a ball end mill takes off: the exact lower envelope of the moving ball, cell by cell.

At a point (x, y) the ball along a straight move leaves min over s of z(s) + R - sqrt(rho^2 - (u - s)^2), where u and w
are the point's coordinates along and across the move and rho^2 = R^2 - w^2. That is convex in s with its minimum at
s* = u - rho m / q (m = dz/ds, q = sqrt(1 + m^2)): inside the move the swept cylinder a_z + R + m u - q rho, otherwise
the ball at the nearer end.

Theory of operation. Over a whole path a point gets its lowest cut at an s* inside some move, or at a corner that is a
local minimum from both sides. So a move visits only the cells whose s* lies in it (a strip as long as the move, not the
ball's whole disc), plus, before it, the wedge its corner with the move before opens; after a sharp turn, a stop or a
change between rapid and feed, the whole disc of the corner, on the account of the move that ends there. Nothing is
lost by this, and the drop found at a cell is the full depth of cut there, not the sliver that one short move adds.
Two threads share a grid by rows (even, odd): every cell is written by one thread, so the result does not depend on
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import maximum_filter1d

from cam.gcode import MoveBatch
from cam.stock_grid import StockGrid
from optics.heightfield import Array

_SMOOTH_COS = 0.9  # corners sharper than this (26 degrees) get their whole disc
_STILL_MM = 1e-9  # a move shorter than this in plan is vertical
# Slots of the carried corner: unit direction, slope/q, start flag, rapid flag.
_EX, _EY, _TILT, _KIND, _WAS_RAPID = range(5)
_NONE, _VERTICAL, _ALONG = 0.0, 1.0, 2.0


@njit(cache=True, nogil=True)
def _cap(top, by_line, x0, y0, cell, high, cx, cy, cz, radius, first_row, row_step, line):  # type: ignore[no-untyped-def]
    """The ball standing still with its tip at (cx, cy, cz). Returns (greatest drop, flat cell index)."""
    deep = 0.0
    place = -1
    rise = high - cz
    if rise <= 0.0:
        return deep, place
    reach2 = radius * radius if rise >= radius else rise * (2.0 * radius - rise)
    reach = math.sqrt(reach2)
    ny, nx = top.shape
    j0 = max(0, int(math.ceil((cy - reach - y0) / cell - 0.5)))
    j1 = min(ny - 1, int(math.floor((cy + reach - y0) / cell - 0.5)))
    j0 += (first_row - j0) % row_step
    for j in range(j0, j1 + 1, row_step):
        dy = y0 + (j + 0.5) * cell - cy
        half2 = reach2 - dy * dy
        if half2 < 0.0:
            continue
        half = math.sqrt(half2)
        i0 = max(0, int(math.ceil((cx - half - x0) / cell - 0.5)))
        i1 = min(nx - 1, int(math.floor((cx + half - x0) / cell - 0.5)))
        for i in range(i0, i1 + 1):
            dx = x0 + (i + 0.5) * cell - cx
            r2 = radius * radius - dx * dx - dy * dy
            if r2 > 0.0:
                f = cz + radius - math.sqrt(r2)
                drop = top[j, i] - f
                if drop > 0.0:
                    top[j, i] = f
                    by_line[j, i] = line
                    if drop > deep:
                        deep = drop
                        place = j * nx + i
    return deep, place


@njit(cache=True, nogil=True)
def _highest(ceiling, tile, x0, y0, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Upper bound of the stock within the ball's radius of the segment; see RemovalGrid._ceiling."""
    nty, ntx = ceiling.shape
    steps = int(math.hypot(bx - ax, by - ay) / tile) + 1
    high = -math.inf
    for k in range(steps):
        t = k / steps
        i = min(max(int((ax + t * (bx - ax) - x0) / tile), 0), ntx - 1)
        j = min(max(int((ay + t * (by - ay) - y0) / tile), 0), nty - 1)
        high = max(high, ceiling[j, i])
    return high


@njit(cache=True, nogil=True)
def _sweep(  # type: ignore[no-untyped-def]
    top,
    by_line,
    x0,
    y0,
    cell,
    ceiling,
    tile,
    points,
    rapid,
    line,
    owner_line,
    radius,
    keep_off,
    first_row,
    row_step,
    corner,
    drops,
    places,
):
    """Move the ball along points; cells of rows first_row, first_row + row_step, ... only.

    keep_off : where a rapid along Z ends the ball counts as this much lower, so that coming too near shows as a drop

    drops, places (n + 1) : greatest drop and its cell; slot k + 1 is move k, slot 0 the last move before these
    corner                : carried between calls; owner_line is the line of that last move
    returns               : index of the last move that moved, or -1
    """
    ny, nx = top.shape
    x1 = x0 + nx * cell
    y1 = y0 + ny * cell
    owner = -1
    for k in range(line.size):
        ax, ay, az = points[k, 0], points[k, 1], points[k, 2]
        bx, by, bz = points[k + 1, 0], points[k + 1, 1], points[k + 1, 2]
        if ax == bx and ay == by and az == bz:
            continue
        length = math.hypot(bx - ax, by - ay)
        is_rapid = 1.0 if rapid[k] else 0.0
        kind = _ALONG if length > _STILL_MM else _VERTICAL
        ex = ey = slope = tilt = 0.0
        q = 1.0
        if kind == _ALONG:
            ex = (bx - ax) / length
            ey = (by - ay) / length
            slope = (bz - az) / length
            q = math.sqrt(1.0 + slope * slope)
            tilt = slope / q
        turn_cos = ex * corner[_EX] + ey * corner[_EY]
        smooth = kind == _ALONG and corner[_KIND] == _ALONG and is_rapid == corner[_WAS_RAPID]
        smooth = smooth and turn_cos > _SMOOTH_COS
        near = (
            min(ax, bx) - radius < x1
            and max(ax, bx) + radius > x0
            and min(ay, by) - radius < y1
            and max(ay, by) + radius > y0
        )
        if near:
            high = _highest(ceiling, tile, x0, y0, ax, ay, bx, by)
            if not smooth:
                mine = k if corner[_KIND] == _NONE else owner
                number = line[mine] if mine >= 0 else owner_line
                foot = az - keep_off if corner[_KIND] == _VERTICAL and corner[_WAS_RAPID] == 1.0 else az
                deep, place = _cap(top, by_line, x0, y0, cell, high, ax, ay, foot, radius, first_row, row_step, number)
                if deep > drops[mine + 1]:
                    drops[mine + 1] = deep
                    places[mine + 1] = place
            lowest = min(az, bz)
            rise = high - lowest
            if kind == _ALONG and rise > 0.0:
                wide = radius if rise >= radius else math.sqrt(rise * (2.0 * radius - rise))
                thin = math.sqrt(max(0.0, radius * radius - wide * wide))  # least rho in the strip
                low = min(tilt * thin, tilt * radius)
                if smooth:  # reach back over the wedge at the corner
                    back = min(corner[_TILT] * thin, corner[_TILT] * radius)
                    turn_sin = abs(ex * corner[_EY] - ey * corner[_EX])
                    low = min(low, (back - turn_sin * wide) / turn_cos, back - turn_sin * wide)
                low -= 1e-9
                far = length + max(tilt * thin, tilt * radius) + 1e-9
                edge = wide + 1e-9
                reach_lo = min(low * ey, far * ey) - edge * abs(ex)
                reach_hi = max(low * ey, far * ey) + edge * abs(ex)
                j0 = max(0, int(math.ceil((ay + reach_lo - y0) / cell - 0.5)))
                j1 = min(ny - 1, int(math.floor((ay + reach_hi - y0) / cell - 0.5)))
                j0 += (first_row - j0) % row_step
                for j in range(j0, j1 + 1, row_step):
                    dy = y0 + (j + 0.5) * cell - ay
                    # dx with low <= dx ex + dy ey <= far and |dy ex - dx ey| <= edge
                    dx_lo = -1e30
                    dx_hi = 1e30
                    if abs(ex) > 1e-12:
                        p = (low - dy * ey) / ex
                        r = (far - dy * ey) / ex
                        dx_lo = min(p, r)
                        dx_hi = max(p, r)
                    if abs(ey) > 1e-12:
                        p = (dy * ex - edge) / ey
                        r = (dy * ex + edge) / ey
                        dx_lo = max(dx_lo, min(p, r))
                        dx_hi = min(dx_hi, max(p, r))
                    i0 = int(math.ceil(max((ax + dx_lo - x0) / cell - 0.5, 0.0)))
                    i1 = int(math.floor(min((ax + dx_hi - x0) / cell - 0.5, nx - 1.0)))
                    for i in range(i0, i1 + 1):
                        dx = x0 + (i + 0.5) * cell - ax
                        u = dx * ex + dy * ey
                        w = dy * ex - dx * ey
                        rho2 = radius * radius - w * w
                        over = lowest + radius - top[j, i]  # the ball is nowhere lower than this less rho
                        if rho2 <= 0.0 or (over > 0.0 and rho2 <= over * over):
                            continue
                        rho = math.sqrt(rho2)
                        s = u - rho * tilt
                        if s <= 0.0:
                            r2 = rho2 - u * u
                            if r2 <= 0.0:
                                continue
                            f = az + radius - math.sqrt(r2)
                        elif s >= length:
                            r2 = rho2 - (u - length) * (u - length)
                            if r2 <= 0.0:
                                continue
                            f = bz + radius - math.sqrt(r2)
                        else:
                            f = az + radius + slope * u - q * rho
                        drop = top[j, i] - f
                        if drop > 0.0:
                            top[j, i] = f
                            by_line[j, i] = line[k]
                            if drop > drops[k + 1]:
                                drops[k + 1] = drop
                                places[k + 1] = j * nx + i
        owner = k
        corner[_EX] = ex
        corner[_EY] = ey
        corner[_TILT] = tilt
        corner[_KIND] = kind
        corner[_WAS_RAPID] = is_rapid
    return owner


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drops:
    """Per move: greatest drop of the stock at one cell [mm], and that cell (flat index, -1 for none).

    Slot k + 1 is move k of the batch; slot 0 belongs to the last move of the batch before.
    """

    depth_mm: Array
    cell: np.ndarray


class RemovalGrid:
    """The stock that is left under one ball, cut down batch by batch. Not a value: it changes with every batch."""

    def __init__(self, stock: StockGrid, *, radius_mm: float, rapid_clearance_mm: float = 0.0, shares: int = 1) -> None:
        """rapid_clearance_mm: a rapid straight down that ends nearer to stock takes some off; shares: sets of rows into
        which the work may be split.
        """
        self.x0_mm, self.y0_mm, self.cell_mm = stock.x0_mm, stock.y0_mm, stock.cell_mm
        self.top_mm = stock.top_mm.copy()
        self.cut_by_line = np.zeros(self.top_mm.shape, dtype=np.int32)  # 0: not touched
        self.radius_mm = radius_mm
        self.shares = shares
        self._keep_off_mm = rapid_clearance_mm
        self._tile_cells = max(1, round(radius_mm / 2 / stock.cell_mm))
        self._corners = np.zeros((shares, 5))
        self._owner_line = 0
        self._last_point = np.full(3, np.nan)
        self._ceiling = self._bounds()

    def _bounds(self) -> Array:
        """Per tile the highest stock within radius + one tile of it: what the ball could meet on a short move."""
        n = self._tile_cells
        ny, nx = self.top_mm.shape
        rows = np.maximum.reduceat(self.top_mm, np.arange(0, ny, n), axis=0)
        tiles = np.maximum.reduceat(rows, np.arange(0, nx, n), axis=1)
        size = 2 * (math.ceil(self.radius_mm / (n * self.cell_mm)) + 1) + 1
        return maximum_filter1d(maximum_filter1d(tiles, size, axis=0), size, axis=1)

    def refresh(self) -> None:
        """Tighten the bounds that let moves pass over cut ground; call before the shares of a batch."""
        self._ceiling = self._bounds()

    def sweep(self, batch: MoveBatch, share: int) -> Drops:
        """Cut one batch in the rows of one share. Different shares may run at the same time."""
        drops = np.zeros(len(batch) + 1)
        cells = np.full(len(batch) + 1, -1, dtype=np.int64)
        _sweep(
            *(self.top_mm, self.cut_by_line, self.x0_mm, self.y0_mm, self.cell_mm),
            *(self._ceiling, self._tile_cells * self.cell_mm),
            *(batch.points_mm, batch.is_rapid, batch.line, self._owner_line, self.radius_mm, self._keep_off_mm),
            *(share, self.shares, self._corners[share], drops, cells),
        )
        return Drops(depth_mm=drops, cell=cells)

    def passed(self, batch: MoveBatch) -> None:
        """All shares of the batch are done."""
        moved = np.flatnonzero((batch.points_mm[1:] != batch.points_mm[:-1]).any(axis=1))
        if moved.size:
            self._owner_line = int(batch.line[moved[-1]])
            self._last_point = batch.points_mm[moved[-1] + 1].copy()

    def rest(self) -> tuple[float, int]:
        """The ball stops where the last move ended: (drop, cell) of that, on the last move's account."""
        if not np.isfinite(self._last_point).all():
            return 0.0, -1
        return _cap(
            *(self.top_mm, self.cut_by_line, self.x0_mm, self.y0_mm, self.cell_mm, float(self.top_mm.max())),
            *(*self._last_point, self.radius_mm, 0, 1, self._owner_line),
        )

    def cut(self, batch: MoveBatch) -> Drops:
        """All shares of one batch, one after the other."""
        self.refresh()
        parts = [self.sweep(batch, share) for share in range(self.shares)]
        self.passed(batch)
        return deepest(parts)

    def place_mm(self, cell: int) -> tuple[float, float]:
        """Centre of a cell given by its flat index."""
        j, i = divmod(int(cell), self.top_mm.shape[1])
        return self.x0_mm + (i + 0.5) * self.cell_mm, self.y0_mm + (j + 0.5) * self.cell_mm

    def places_mm(self, cells: np.ndarray) -> tuple[Array, Array]:
        """x and y of the centres of cells given by flat index."""
        rows, columns = np.divmod(cells, self.top_mm.shape[1])
        return self.x0_mm + (columns + 0.5) * self.cell_mm, self.y0_mm + (rows + 0.5) * self.cell_mm

    def stock(self) -> StockGrid:
        return StockGrid(x0_mm=self.x0_mm, y0_mm=self.y0_mm, cell_mm=self.cell_mm, top_mm=self.top_mm)


def deepest(parts: list[Drops]) -> Drops:
    """The greatest drop of each move over the shares."""
    depth, cell = parts[0].depth_mm, parts[0].cell
    for part in parts[1:]:
        cell = np.where(part.depth_mm > depth, part.cell, cell)
        depth = np.maximum(depth, part.depth_mm)
    return Drops(depth_mm=depth, cell=cell)
