"""Rows along Y are rows along X of the lens with its axes exchanged, and everything the check knows holds for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cam.passes import Stock, ball_pass
from cam.program import pass_paths
from cam.rows.raster import turn_block, turn_lens, turn_stock
from cam.surface.stock_grid import StockGrid
from tests.cam.checks import checked
from tests.cam.lenses import make_bumps

W, H = 5.0, 3.5
STOCK = Stock(width_mm=W, height_mm=H, thickness_mm=10, margin_mm=2)
ROUGH = ball_pass("rough", radius_mm=1.0, pitch_mm=0.3, stock_to_leave_mm=0.1, step_down_mm=0.7)
FINISH = ball_pass("finish", radius_mm=0.5, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.4)


@pytest.fixture(scope="module")
def small():

    return make_bumps(11, relief_mm=1.2, width_mm=W, height_mm=H, spread_mm=0.8)


def test_turning_twice_changes_nothing(small):
    grid = StockGrid.block(STOCK, 0.1)
    again = turn_stock(turn_stock(grid))
    assert (again.x0_mm, again.y0_mm) == (grid.x0_mm, grid.y0_mm)
    np.testing.assert_array_equal(again.top_mm, grid.top_mm)
    np.testing.assert_array_equal(turn_lens(turn_lens(small)).z_mm, small.z_mm)
    assert turn_block(turn_block(STOCK)) == STOCK


@pytest.mark.parametrize("spec", [ROUGH, FINISH])
def test_rows_along_y_are_those_of_the_turned_lens(small, spec):
    top = StockGrid.block(STOCK, 0.1)
    along_y = np.concatenate(
        [path.points_mm for path in pass_paths(small, replace(spec, direction="y"), STOCK, stock_top=top)]
    )
    turned = pass_paths(turn_lens(small), spec, turn_block(STOCK), stock_top=turn_stock(top))
    along_x = np.concatenate([path.points_mm for path in turned])
    same = min(len(along_x), len(along_y)) if spec is FINISH else 0  # a helix turns the way that climbs
    np.testing.assert_array_equal(along_y[-same:, :2], along_x[-same:, 1::-1])
    np.testing.assert_allclose(along_y[-same:, 2], along_x[-same:, 2], atol=1e-12)


@pytest.mark.parametrize("link", ["u-turn", "retract"])
def test_the_check_passes_rows_along_y(small, link):
    """Gaps, gouge, engagement and excess are measured, whatever the direction; one way is the way that climbs."""
    top = StockGrid.block(STOCK, 0.05)
    for spec in (ROUGH, FINISH):
        along_x, along_y = (checked(small, replace(spec, direction=d, link=link), STOCK, top) for d in "xy")
        for result in (along_x, along_y):
            assert result.ok, result.faults
            assert result.max_gap_mm <= spec.pitch_mm * 1.001
            assert result.gouge_um < 0.1
            assert result.max_engagement_mm <= 1.05 * spec.step_down_mm
        top = along_y.stock_top
        if link == "u-turn":
            assert abs(along_y.climb_share - 0.5) < 0.12
        else:
            assert along_x.climb_share > 0.55 and along_y.climb_share > 0.55
