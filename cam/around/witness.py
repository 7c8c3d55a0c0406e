"""Witness marks: rows side by side in the block's margin, in one path; each at its own height."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cam.around.specs import WitnessCut
from cam.errors import SafeHeightError
from cam.moves import CLEARANCE_MM, RAPID_CLEARANCE_MM, Path, cut, rapid
from cam.rows.entries import leave, make_ramp


def make_witness_paths(task: WitnessCut, *, top_mm: float, safe_z_mm: float) -> Iterator[Path]:
    """Yield the moves of the tip from safe height back to safe height: down a ramp along the first row, then to and
    fro.

    top_mm : of the highest stock there
    """
    over_mm = max(top_mm, 0.0) + RAPID_CLEARANCE_MM
    if safe_z_mm < over_mm:
        raise SafeHeightError(safe_z_mm=safe_z_mm, needed_mm=over_mm)
    outer, inner = task.across_mm
    across = np.where(np.arange(len(task.places_mm))[:, None] % 2 == 0, [outer, inner], [inner, outer])
    way = np.column_stack([np.repeat(task.places_mm, 2), across.ravel(), np.repeat(task.tips_mm, 2)])
    if task.along == "y":
        way = way[:, [1, 0, 2]]
    x, y, _ = way[0]
    start_mm = max(top_mm, 0.0) + CLEARANCE_MM
    yield rapid((x, y, safe_z_mm), (x, y, over_mm))
    yield cut([(x, y, start_mm)], task.plunge_mm_per_min)
    yield cut(make_ramp(way[:2], start_mm), task.plunge_mm_per_min)
    yield cut(way[1:], task.feed_mm_per_min)
    yield leave(way[-1, 0], way[-1, 1], safe_z_mm=safe_z_mm)
