"""Turns between exact rows: a pitch of slot at the end of each, as deep as what the pass before has left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cam.materials import SLOT_FEED
from cam.moves import Motion
from cam.passes import Stock, ball_pass
from cam.program import pass_paths
from cam.rows.loads import SLOT_DEPTH_SHARE
from cam.surface.stock_grid import StockGrid
from tests.cam.lenses import make_lens

STOCK = Stock(width_mm=8, height_mm=6, thickness_mm=10, margin_mm=3)
FINISH = ball_pass("finish", radius_mm=1.0, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.3)
DEPTH_MM = 0.5


@pytest.mark.parametrize("skin_mm", [0.01, 0.1, 0.25])
@pytest.mark.parametrize("direction", ["x", "y"])
def test_turns_in_a_thick_skin_are_slow_and_rows_never(skin_mm, direction):
    """A plane under a skin: rows keep their place across, turns do not. The first row, a slot from end to end, is left
    out here.
    """
    spec = replace(FINISH, pitch_mm=0.5, step_down_mm=0.5, direction=direction)
    top = StockGrid.block(STOCK, 0.1)
    top = replace(top, top_mm=np.full_like(top.top_mm, skin_mm - DEPTH_MM))
    across, here, slow_turns = 1 if direction == "x" else 0, np.full(3, np.nan), set()
    for path in pass_paths(make_lens(lambda x, y: 0 * x - DEPTH_MM), spec, STOCK, stock_top=top):
        for point in path.points_mm:
            turns = here[across] != point[across]
            if path.motion is Motion.CUT and point[across] > -spec.radius_mm:
                slow = turns and skin_mm - DEPTH_MM - point[2] > SLOT_DEPTH_SHARE * spec.step_down_mm
                assert path.feed_mm_per_min == spec.feed_mm_per_min * (SLOT_FEED if slow else 1.0)
                slow_turns |= {slow} if turns else set()
            here = point
    assert slow_turns == ({False, True} if skin_mm < 0.05 else {True})  # 0.1 mm deeper than the plane, 0.2 in corners
