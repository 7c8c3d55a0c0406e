"""Simulates the removal by a ball end mill: the exact lower envelope of the moving ball, cell by cell.

At a point (x, y) the ball along a straight move leaves min over s of z(s) + R - sqrt(rho^2 - (u - s)^2), where u and w
are the point's coordinates along and across the move and rho^2 = R^2 - w^2. That is convex in s with its minimum at
s* = u - rho m / q (m = dz/ds, q = sqrt(1 + m^2)): inside the move the swept cylinder a_z + R + m u - q rho, otherwise
the ball at the nearer end.

Theory of operation. Over a whole path a point gets its lowest cut at an s* inside some move, or at a corner that is a
local minimum from both sides. So a move visits only the cells whose s* lies in it (a strip as long as the move, bent
where the move is steep, as s* depends on rho; not the ball's whole disc), plus, before it, the wedge that its corner
with the previous move opens. After a sharp turn, a stop or a change between rapid and feed it is the whole disc of the
corner, counted for the move that ends there. This loses nothing, and the drop found at a cell is the full depth of cut
there, not the sliver that one short move adds. Tiles of cells whose highest stock, their crown, lies below the whole
ball are skipped. Windows are small squares of the part, simulated with fine cells, where a mistake would be largest.

Two threads share a grid by rows (even, odd): every cell is written by one thread, so the result does not depend on
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import maximum_filter, maximum_filter1d

from cam.checking.sweep import REACH, STRIKE, TALLIES, cap, crowns_of, sweep
from cam.passes import PassSpec
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Array, Heightfield


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drops:
    """Per move: greatest drop of the stock at one cell [mm], and that cell (flat index, -1 for none).

    Slot k + 1 is move k of the batch; slot 0 belongs to the last move of the batch before.
    tally (n + 1, 5) : other figures of each move, by the columns of `cam.checking.sweep`
    """

    depth_mm: Array
    cell: np.ndarray
    tally: Array = field(default_factory=lambda: np.zeros((1, TALLIES)))


class RemovalGrid:
    """The stock left under one ball, cut down batch by batch. It is mutable: it changes with every batch."""

    def __init__(
        self,
        stock: StockGrid,
        *,
        radius_mm: float,
        rapid_clearance_mm: float = 0.0,
        shares: int = 1,
        shank: tuple[float, float] | None = None,
    ) -> None:
        """Begin. rapid_clearance_mm: a rapid straight down that ends nearer to stock counts as cutting; shares: sets of
        rows into which the work may be split; shank: a distance from the axis, and the height above the tip that stock
        within it must not exceed.
        """
        self.x0_mm, self.y0_mm, self.cell_mm = stock.x0_mm, stock.y0_mm, stock.cell_mm
        self.top_mm = stock.top_mm.copy()
        self.cut_by_line = np.zeros(self.top_mm.shape, dtype=np.int32)  # 0: not touched
        self.radius_mm = float(radius_mm)
        self.shares = shares
        self._keep_off_mm = float(rapid_clearance_mm)
        self._tile_cells = max(1, round(radius_mm / 2 / stock.cell_mm))
        self._tile_mm = self._tile_cells * self.cell_mm
        self._corners = np.zeros((shares, 5))
        self._crowns = [crowns_of(self.top_mm, share, shares) for share in range(shares)]
        self._owner_line = 0
        self._last_point = np.full(3, np.nan)
        self._shank_reach_mm, self._flutes_mm = map(float, shank or (0.0, math.inf))
        self.refresh()

    def _bounds(self, reach_mm: float) -> Array:
        """Return the highest stock per tile within reach + one tile, which the cutter could meet on a short move."""
        n = self._tile_cells
        ny, nx = self.top_mm.shape
        rows = np.maximum.reduceat(self.top_mm, np.arange(0, ny, n), axis=0)
        tiles = np.maximum.reduceat(rows, np.arange(0, nx, n), axis=1)
        size = 2 * (math.ceil(reach_mm / (n * self.cell_mm)) + 1) + 1
        return maximum_filter1d(maximum_filter1d(tiles, size, axis=0), size, axis=1)

    def refresh(self) -> None:
        """Tighten the bounds that let moves pass over cut ground; call before the shares of a batch."""
        self._ceiling = self._bounds(self.radius_mm)
        self._shank_ceiling = self._bounds(self._shank_reach_mm) if self._shank_reach_mm else self._ceiling

    def sweep(self, batch: MoveBatch, share: int) -> Drops:
        """Cut one batch in the rows of one share. Different shares may run at the same time."""
        drops = np.zeros(len(batch) + 1)
        cells = np.full(len(batch) + 1, -1, dtype=np.int64)
        tally = np.zeros((len(batch) + 1, TALLIES))
        sweep(
            *(self.top_mm, self.cut_by_line, self.x0_mm, self.y0_mm, self.cell_mm),
            *(self._ceiling, self._tile_mm, self._crowns[share]),
            *(batch.points_mm, batch.is_rapid, batch.line, self._owner_line, self.radius_mm, self._keep_off_mm),
            *((self._shank_reach_mm, self._flutes_mm, self._shank_ceiling),),
            *(share, self.shares, self._corners[share], drops, cells, tally),
        )
        return Drops(depth_mm=drops, cell=cells, tally=tally)

    def finish_batch(self, batch: MoveBatch) -> None:
        """Note the end of a batch: all its shares are done."""
        moved = np.flatnonzero((batch.points_mm[1:] != batch.points_mm[:-1]).any(axis=1))
        if moved.size:
            self._owner_line = int(batch.line[moved[-1]])
            self._last_point = batch.points_mm[moved[-1] + 1].copy()

    def cut_at_rest(self) -> tuple[float, int]:
        """Cut at the end of the last move, where the ball stops; return (drop, cell), counted for the last move."""
        if not np.isfinite(self._last_point).all():
            return 0.0, -1
        depth_mm, cell, _ = cap(
            *(self.top_mm, self.cut_by_line, self.x0_mm, self.y0_mm, self.cell_mm, float(self.top_mm.max())),
            *(*self._last_point, self.radius_mm, 0, 1, self._owner_line),
        )
        return depth_mm, cell

    def cut(self, batch: MoveBatch) -> Drops:
        """Cut one batch in all shares, one after the other."""
        self.refresh()
        parts = [self.sweep(batch, share) for share in range(self.shares)]
        self.finish_batch(batch)
        return deepest(parts)

    def place_mm(self, cell: int) -> tuple[float, float]:
        """Return the centre of a cell given by its flat index."""
        j, i = divmod(int(cell), self.top_mm.shape[1])
        return self.x0_mm + (i + 0.5) * self.cell_mm, self.y0_mm + (j + 0.5) * self.cell_mm

    def places_mm(self, cells: np.ndarray) -> tuple[Array, Array]:
        """Return x and y of the centres of cells given by flat index."""
        rows, columns = np.divmod(cells, self.top_mm.shape[1])
        return self.x0_mm + (columns + 0.5) * self.cell_mm, self.y0_mm + (rows + 0.5) * self.cell_mm

    def stock(self) -> StockGrid:
        return StockGrid(x0_mm=self.x0_mm, y0_mm=self.y0_mm, cell_mm=self.cell_mm, top_mm=self.top_mm)


def deepest(parts: list[Drops]) -> Drops:
    """Return the greatest drop of each move over the shares, and their tallies together."""
    depth, cell, tally = parts[0].depth_mm, parts[0].cell, parts[0].tally.copy()
    for part in parts[1:]:
        cell = np.where(part.depth_mm > depth, part.cell, cell)
        depth = np.maximum(depth, part.depth_mm)
        other = part.tally
        tally[:, :REACH] += other[:, :REACH]
        tally[:, REACH] = np.maximum(tally[:, REACH], other[:, REACH])
        higher = other[:, STRIKE] > tally[:, STRIKE]
        tally[higher, STRIKE:] = other[higher, STRIKE:]
    return Drops(depth_mm=depth, cell=cell, tally=tally)


_SIZE_MM, _FINEST_MM, _COARSEST_MM = 1.0, 0.0025, 0.01
_FLAT_MM = 0.05  # after a flat cutter: its stairs are tenths of a millimetre


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """One window: the reason for its place, and the fine stock before the pass."""

    name: str
    stock: StockGrid


def place_windows(heightfield: Heightfield, spec: PassSpec, before: StockGrid) -> tuple[Window, ...]:
    """Return corners, one edge, the centre, and where the lens is most concave, most convex and steepest.

    The stock before the pass is known only at the whole part's cells. A window starts from the highest of the nearest
    cells, so afterwards its heights are the work of this pass, or too high, but never too low.
    """
    width, height = heightfield.width_mm, heightfield.height_mm
    size = min(max(_SIZE_MM, 4 * spec.pitch_mm), width / 3, height / 3)
    cell_mm = min(max(spec.pitch_mm / 5, _FINEST_MM), _COARSEST_MM) if spec.is_ball else _FLAT_MM
    n = max(8, round(size / cell_mm))
    highest = maximum_filter(before.top_mm, size=3)
    windows = []
    for name, x_mm, y_mm in _places(heightfield):
        x0 = float(np.clip(x_mm - size / 2, 0, width - size))
        y0 = float(np.clip(y_mm - size / 2, 0, height - size))
        centres = (np.arange(n) + 0.5) * size / n
        columns = np.clip(((x0 + centres - before.x0_mm) / before.cell_mm).astype(int), 0, highest.shape[1] - 1)
        rows = np.clip(((y0 + centres - before.y0_mm) / before.cell_mm).astype(int), 0, highest.shape[0] - 1)
        stock = StockGrid(x0_mm=x0, y0_mm=y0, cell_mm=size / n, top_mm=highest[np.ix_(rows, columns)])
        windows.append(Window(name=name, stock=stock))
    return tuple(windows)


def _places(heightfield: Heightfield) -> list[tuple[str, float, float]]:
    width, height = heightfield.width_mm, heightfield.height_mm
    mean, spread, slope2 = _shape(heightfield)
    inner = (slice(2, -2), slice(2, -2)) if min(heightfield.z_mm.shape) > 8 else (slice(None), slice(None))

    def at_most(values: Array) -> tuple[float, float]:
        offset = inner[0].start or 0
        j, i = divmod(int(values[inner].argmax()), values[inner].shape[1])
        return float(heightfield.x_mm[i + offset]), float(heightfield.y_mm[j + offset])

    return [
        ("lower left corner", 0.0, 0.0),
        ("lower right corner", width, 0.0),
        ("upper left corner", 0.0, height),
        ("upper right corner", width, height),
        ("right edge", width, height / 2),
        ("centre", width / 2, height / 2),
        ("most concave", *at_most(mean + spread)),
        ("most convex", *at_most(spread - mean)),
        ("steepest", *at_most(slope2)),
    ]


def _shape(heightfield: Heightfield) -> tuple[Array, Array, Array]:
    """Return (ny, nx) each: mean of the second derivatives, half the spread of their eigenvalues, slope squared."""
    zy, zx = np.gradient(heightfield.z_mm, heightfield.dy_mm, heightfield.dx_mm)
    zxy, zxx = np.gradient(zx, heightfield.dy_mm, heightfield.dx_mm)
    zyy = np.gradient(zy, heightfield.dy_mm, axis=0)
    return np.asarray((zxx + zyy) / 2), np.asarray(np.hypot((zxx - zyy) / 2, zxy)), np.asarray(zx**2 + zy**2)
