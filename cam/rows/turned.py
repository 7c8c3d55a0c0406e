"""Rows along Y: lens, block and stock with X and Y exchanged, and the paths made on them exchanged back.

Exchanging axes is exact (no rotation, no rounding), so what holds for rows along X holds for rows along Y. It turns
left into right as well: whoever cares for climb milling asks `PassSpec.direction`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from cam.moves import Path
from cam.passes import Stock
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield


def turn_lens(heightfield: Heightfield) -> Heightfield:
    return replace(heightfield, x_mm=heightfield.y_mm, y_mm=heightfield.x_mm, z_mm=heightfield.z_mm.T)


def turn_block(stock: Stock) -> Stock:
    return replace(stock, width_mm=stock.height_mm, height_mm=stock.width_mm)


def turn_stock(stock_top: StockGrid) -> StockGrid:
    return replace(stock_top, x0_mm=stock_top.y0_mm, y0_mm=stock_top.x0_mm, top_mm=stock_top.top_mm.T)


def turn_paths(paths: Iterable[Path]) -> Iterator[Path]:
    for path in paths:
        yield replace(path, points_mm=path.points_mm[:, [1, 0, 2]])
