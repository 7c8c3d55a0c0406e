"""Where layers end: at the walls around the run-out, and where the lens meets the top of the block."""

from __future__ import annotations

import numpy as np
import pytest

from cam.checking.check import PassCheck
from cam.passes import Stock, ball_pass
from cam.surface.stock_grid import StockGrid
from tests.cam.checks import checked
from tests.cam.lenses import make_lens

STOCK = Stock(width_mm=8, height_mm=6, thickness_mm=10, margin_mm=2.5)  # walls: a ball reaches 2 mm beyond the lens
ROUGH = ball_pass("rough", radius_mm=1.0, pitch_mm=0.3, stock_to_leave_mm=0.1, step_down_mm=0.4)
FINISH = ball_pass("finish", radius_mm=1.0, pitch_mm=0.2, stock_to_leave_mm=0.0, step_down_mm=0.3)


def milled(heightfield, specs, *, cell_mm) -> list[PassCheck]:
    top = StockGrid.block(STOCK, cell_mm)
    verdicts = []
    for spec in specs:
        verdict = checked(heightfield, spec, STOCK, top)
        verdicts.append(verdict)
        top = verdict.stock_top
    return verdicts


@pytest.mark.thorough
def test_walls_around_a_dome_hold_no_flakes_for_later_layers():
    """The tops of a dome part rows in two, so that layers turn at different places of a wall 3 mm high; 0.012 mm cells
    see the flakes between row ends, 11 um thick. Then another pass with the same ball goes along the same walls.
    """
    dome = make_lens(lambda x, y: -0.1 - 0.06 * ((x - 4.3) ** 2 + (y - 3.2) ** 2))
    for verdict in milled(dome, [ROUGH, FINISH], cell_mm=0.012):
        assert verdict.faults == ()


@pytest.mark.parametrize("edge_mm", [2.0, 2.09, 2.16, 2.24])
def test_no_row_is_missing_where_the_lens_meets_the_top_of_the_block(edge_mm):
    """A plateau whose edge runs along the rows: what stands between the last row with stock and the edge is cut too."""
    softness_mm = 0.1
    slope = make_lens(
        lambda x, y: -0.05 - 0.8 * softness_mm * np.logaddexp(0.0, (edge_mm - y + 0.02 * x) / softness_mm), per_mm=20
    )
    (verdict,) = milled(slope, [ROUGH], cell_mm=0.05)
    assert verdict.faults == ()
