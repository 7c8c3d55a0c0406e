"""Rows along X: their positions, and the exact surface along them. For rows along Y, X and Y are exchanged, first of
the lens, the block and the stock, and afterwards of the paths.

Exchanging axes is exact (no rotation, no rounding), so everything about rows along X also holds for rows along Y. It
also exchanges left and right: climb milling is decided by `PassSpec.direction`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numba import njit

from cam.moves import Array, Path
from cam.passes import PassSpec, Stock
from cam.rows.vertices import TICKS_PER_MM, VertexRule, march_row, most_vertices, thin_points
from cam.surface.contact import touch
from cam.surface.stock_grid import StockGrid
from cam.surface.tool_surface import RoughSurface, ToolSurface
from optics.heightfield import Heightfield

THREADS = 2
THREAD_NAME = "cam-rows"
ROWS_PER_CHUNK = 16


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Rows at y_mm (n,), each from left_mm to right_mm; turns bulge out by turn_mm beyond either end.

    The tip's region is the aperture grown by one cutter radius on every side; the turns are inside it.
    """

    y_mm: Array
    left_mm: float
    right_mm: float
    turn_mm: float

    @classmethod
    def over(cls, stock: Stock, spec: PassSpec) -> Rows:
        """Lay even rows, at most one pitch apart, the first and the last exactly one radius outside the aperture."""
        reach = spec.radius_mm
        span = stock.height_mm + 2 * reach
        count = math.ceil(span / spec.pitch_mm - 1e-9)
        y = on_ticks(np.linspace(-reach, stock.height_mm + reach, count + 1))
        if np.diff(y).max() > spec.pitch_mm + 1e-9:  # rounding made a gap too wide
            count = math.ceil(span / (spec.pitch_mm - 1 / TICKS_PER_MM))
            y = on_ticks(np.linspace(-reach, stock.height_mm + reach, count + 1))
        turn = math.ceil(spec.pitch_mm / 2 * TICKS_PER_MM) / TICKS_PER_MM
        left, right = on_ticks(np.array([-reach + turn, stock.width_mm + reach - turn]))
        return cls(y_mm=y, left_mm=float(left), right_mm=float(right), turn_mm=turn)

    @property
    def length_mm(self) -> float:
        return self.right_mm - self.left_mm

    def stride_within(self, distance_mm: float) -> int:
        """Return the largest stride of rows that are no farther apart than distance_mm."""
        return max(1, int(distance_mm / max(1e-9, float(np.diff(self.y_mm).max()))))

    def every(self, stride: int) -> Rows:
        """Return every stride-th row, and the last."""
        return replace(self, y_mm=self.y_mm[self._choose_rows(stride)])

    def between(self, stride: int) -> Rows:
        """Return the rows that `every` leaves out."""
        return replace(self, y_mm=self.y_mm[~self._choose_rows(stride)])

    def _choose_rows(self, stride: int) -> npt.NDArray[np.bool_]:
        chosen = np.arange(self.y_mm.size) % stride == 0
        chosen[-1] = True
        return chosen


def on_ticks(values: Array) -> Array:
    rounded: Array = np.round(values * TICKS_PER_MM) / TICKS_PER_MM
    return rounded


@njit(cache=True, nogil=True)
def turn_parts(bulge):  # type: ignore[no-untyped-def]
    """Return the number of chords of a turn that goes out this far [mm]."""
    return 4 if bulge < 0.05 else 8


@njit(cache=True, nogil=True)
def _follow(b, rule, y, rows, left, right, bulge, forward, out):  # type: ignore[no-untyped-def]
    """Write the first `rows` rows of y and the turn after each into out; for a row after them in y, only the turn to it
    is written.

    A turn is a half circle over (y0, y1), on the surface, in `parts` chords; its points lie on the writing raster.
    """
    count = int(np.int64(0))  # a plain 0 is another type for numba: march_row would be compiled twice
    parts = turn_parts(bulge)
    for j in range(rows):
        start, end = (left, right) if forward else (right, left)
        count = march_row(b, rule, y[j], start, end, out, count)
        forward = not forward
        if j + 1 >= y.size:
            break
        way = 1.0 if end > start else -1.0
        px, py = end, y[j]
        for m in range(1, parts):
            angle = math.pi * m / parts
            tx = math.floor((end + way * bulge * math.sin(angle)) * 10_000 + 0.5) / 10_000
            ty = 0.5 * (y[j] + y[j + 1]) - 0.5 * (y[j + 1] - y[j]) * math.cos(angle)
            ty = math.floor(ty * 10_000 + 0.5) / 10_000
            px, py, tip = touch(b, tx, ty, px, py)[:3]
            out[count, 0], out[count, 1], out[count, 2] = tx, ty, tip
            count += 1
    return count


def _chunk(surface: ToolSurface, rows: Rows, rule: VertexRule, first: int) -> Array:
    """Return rows first.. of one chunk and the turns after them, the one into the next chunk included."""
    y = rows.y_mm[first : first + ROWS_PER_CHUNK + 1]
    count = min(y.size, ROWS_PER_CHUNK)
    out = np.empty((count * (most_vertices(rows.length_mm, rule) + 8), 3))
    forward = first % 2 == 0
    filled = _follow(surface.kernel, rule, y, count, rows.left_mm, rows.right_mm, rows.turn_mm, forward, out)
    return out[:filled].copy()


def continuous_rows(surface: ToolSurface, rows: Rows, rule: VertexRule) -> Iterator[Array]:
    """Yield all rows back and forth on one unbroken path, as pieces (n, 3) in order; a few are computed at a time."""
    starts = range(0, rows.y_mm.size, ROWS_PER_CHUNK)
    yield from map_in_order(lambda first: _chunk(surface, rows, rule, first), starts)


def climbs_rightward(spec: PassSpec) -> bool:
    """Return whether rows cut one way, each beyond the last in Y, climb when they run in +X.

    The spindle turns clockwise, so a cutter climbs with the stock on its right: rows in -X, the next one farther in +Y.
    Rows along Y are made with the axes exchanged (`turn_lens`), which makes right of left.
    """
    return spec.direction == "y"


def separate_rows(surface: ToolSurface, rows: Rows, rule: VertexRule, *, rightward: bool) -> Iterator[Array]:
    """Yield every row separately, all in the same direction (paper, Fig. 13)."""
    start, end = (rows.left_mm, rows.right_mm) if rightward else (rows.right_mm, rows.left_mm)

    def row(index: int) -> Array:
        out = np.empty((most_vertices(rows.length_mm, rule), 3))
        return out[: march_row(surface.kernel, rule, rows.y_mm[index], start, end, out, 0)].copy()

    yield from map_in_order(row, range(rows.y_mm.size))


def sample_rows(surface: RoughSurface, rows: Rows, sag_mm: float) -> Iterator[Array]:
    """Yield all rows of a flat cutter back and forth on one unbroken path, row by row, each with the turn after it."""
    x = on_ticks(np.linspace(rows.left_mm, rows.right_mm, math.ceil(rows.length_mm / surface.node_step_mm) + 1))
    angle = np.pi * np.arange(1, turn_parts(rows.turn_mm)) / turn_parts(rows.turn_mm)
    for j, y in enumerate(rows.y_mm):
        way = 1 if j % 2 == 0 else -1
        line = np.column_stack([x, np.full_like(x, y), surface.tip_heights_mm(x, y)])
        row = thin_points(line, sag_mm)[::way]
        if j + 1 == rows.y_mm.size:
            yield row
            return
        turn_x = on_ticks(row[-1, 0] + way * rows.turn_mm * np.sin(angle))
        turn_y = on_ticks((y + rows.y_mm[j + 1] - (rows.y_mm[j + 1] - y) * np.cos(angle)) / 2)
        yield np.concatenate([row, np.column_stack([turn_x, turn_y, surface.tip_heights_mm(turn_x, turn_y)])])


def map_in_order(work, items) -> Iterator[Array]:  # type: ignore[no-untyped-def]
    """Yield work(item) of each item in order, THREADS at a time, at most two waiting for each."""
    waiting: deque[Future[Array]] = deque()
    with ThreadPoolExecutor(THREADS, thread_name_prefix=THREAD_NAME) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > 2 * THREADS:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def turn_lens(heightfield: Heightfield) -> Heightfield:
    return replace(heightfield, x_mm=heightfield.y_mm, y_mm=heightfield.x_mm, z_mm=heightfield.z_mm.T)


def turn_block(stock: Stock) -> Stock:
    return replace(stock, width_mm=stock.height_mm, height_mm=stock.width_mm)


def turn_stock(stock_top: StockGrid) -> StockGrid:
    return replace(stock_top, x0_mm=stock_top.y0_mm, y0_mm=stock_top.x0_mm, top_mm=stock_top.top_mm.T)


def turn_paths(paths: Iterable[Path]) -> Iterator[Path]:
    for path in paths:
        yield replace(path, points_mm=path.points_mm[:, [1, 0, 2]])
