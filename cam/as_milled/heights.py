"""Heights of the surface that tracks leave, on a grid: where facets are too many and a map is wanted."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from cam.as_milled.tracks import Tracks
from cam.checking.removal import RemovalGrid
from cam.moves import Array
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid

_SHARES = 2
_AT_ONCE = 20_000  # moves between two looks at how high the stock still is


def mill_heights(tracks: Sequence[Tracks], before: StockGrid) -> StockGrid:
    """Return what the balls of these tracks leave of the stock, exact at the centres of its cells.

    before : best little above the surface: then the balls have little to go over
    """
    stock = before
    with ThreadPoolExecutor(max_workers=_SHARES) as pool:
        for one in tracks:
            for chain in _chains(one):
                grid = RemovalGrid(stock, radius_mm=one.radius_mm, shares=_SHARES)
                for first in range(0, len(chain) - 1, _AT_ONCE):
                    batch = _batch(chain[first : first + _AT_ONCE + 1])
                    grid.refresh()
                    list(pool.map(grid.sweep, [batch] * _SHARES, range(_SHARES)))
                    grid.finish_batch(batch)
                grid.cut_at_rest()
                stock = replace(before, top_mm=grid.top_mm)
    return stock


def _chains(tracks: Tracks) -> list[Array]:
    """Return the tips of each unbroken way."""
    begins = np.flatnonzero(~tracks.joined)
    return [chain for chain in np.split(tracks.tips_mm, begins[begins > 0]) if len(chain) > 1]


def _batch(tips_mm: Array) -> MoveBatch:
    count = len(tips_mm) - 1
    return MoveBatch(
        points_mm=np.ascontiguousarray(tips_mm),
        is_rapid=np.zeros(count, dtype=np.bool_),
        feed_mm_per_min=np.ones(count),
        line=np.arange(1, count + 1, dtype=np.int64),
        spindle_on=np.ones(count, dtype=np.bool_),
        pause_s=np.full(count, -1.0),
        lines_read=0,
        bytes_read=0,
        ended=False,
    )
