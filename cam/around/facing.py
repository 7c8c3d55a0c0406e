"""Facing: rows over the whole block, entered and turned in the air beside it.

The cutter comes down beside the block and cuts into its side, so nothing is entered from above; the first row goes
along the block's front edge, half over it, so no row is a slot.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil

import numpy as np

from cam.around.specs import BESIDE_MM, Facing
from cam.errors import SafeHeightError
from cam.moves import RAPID_CLEARANCE_MM, Path, cut, rapid
from cam.passes import Stock
from cam.rows.entries import leave


def make_facing_paths(facing: Facing, stock: Stock, *, safe_z_mm: float) -> Iterator[Path]:
    """Yield the moves of the tip from safe height back to safe height; the last layer lies at Z0."""
    over_mm = facing.above_mm + RAPID_CLEARANCE_MM
    if safe_z_mm < over_mm:
        raise SafeHeightError(safe_z_mm=safe_z_mm, needed_mm=over_mm)
    beside_mm = stock.margin_mm + facing.radius_mm + BESIDE_MM
    left, right = -beside_mm, stock.width_mm + beside_mm
    front, back = -stock.margin_mm, stock.height_mm + stock.margin_mm
    rows = np.linspace(front, back, ceil((back - front) / facing.pitch_mm - 1e-9) + 1)
    x = np.where(np.arange(rows.size)[:, None] % 2 == 0, [left, right], [right, left])
    way = np.column_stack([x.ravel(), np.repeat(rows, 2), np.zeros(2 * rows.size)])
    for z_mm in facing.levels_mm:
        yield rapid((left, front, safe_z_mm), (left, front, over_mm))
        yield cut([(left, front, z_mm)], facing.plunge_mm_per_min)
        yield cut(way[1:] + np.array([0.0, 0.0, z_mm]), facing.feed_mm_per_min)
        yield leave(way[-1, 0], way[-1, 1], safe_z_mm=safe_z_mm)
