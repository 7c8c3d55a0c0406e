"""Where exact rows cut at the ball's full width: turns from row to row, while the stock still stands on both sides.

Between two rows the tool goes a pitch on into stock that no row has touched yet: the next row's on the one side, what
stands at the wall of the run-out on the other. That is a slot as short as the pitch, but every row ends in one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from cam.materials import SLOT_FEED
from cam.moves import Array, Path, cut
from cam.passes import PassSpec
from cam.rows.loads import SLOT_DEPTH_SHARE

Meets = Callable[[Array], Array]
"""(n, 3) tips -> (n,) tip heights at which the ball would meet stock there."""


def first_row(polyline_mm: Array) -> Array:
    """Return the straight beginning, up to the first turn: ramps stay on it, and stock stands on both sides of it."""
    same = polyline_mm[:, 1] == polyline_mm[0, 1]
    return polyline_mm if same.all() else polyline_mm[: int(np.argmin(same))]


def row_cuts(polyline_mm: Array, before_mm: Array, meets: Meets, spec: PassSpec) -> Iterator[Path]:
    """Yield rows and turns (n, 3) at their feeds; before_mm: where the tool stands."""
    slow = np.diff(polyline_mm[:, 1], prepend=before_mm[1]) != 0  # turns alone leave a row's y
    turning = polyline_mm[slow]
    slow[slow] = meets(turning) - turning[:, 2] > SLOT_DEPTH_SHARE * spec.step_down_mm
    edges = np.flatnonzero(np.diff(slow)) + 1
    for first, end in pairwise([0, *edges.tolist(), len(slow)]):
        yield cut(polyline_mm[first:end], spec.feed_mm_per_min * (SLOT_FEED if slow[first] else 1.0))
