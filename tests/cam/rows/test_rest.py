"""Rest passes: only where stock was left, once per region, and without a step where they end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.errors import PassValueError
from cam.moves import Motion
from cam.passes import Stock, ball_pass
from cam.program import pass_paths
from cam.rows.rest import RestAreas
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield
from tests.cam.checks import checked

W, H, CELL = 12.0, 8.0, 0.05
STOCK = Stock(width_mm=W, height_mm=H, thickness_mm=10, margin_mm=3)
BIG = ball_pass("finish", radius_mm=3.0, pitch_mm=0.2, stock_to_leave_mm=0.0, step_down_mm=2.0)
REST = replace(ball_pass("rest", radius_mm=0.5, pitch_mm=0.05, stock_to_leave_mm=0.0, step_down_mm=0.2), where="rest")


def pitted(*pits: tuple[float, float]) -> Heightfield:
    """An even slope and pits 0.1 mm deep, hollow with a radius of 0.8 mm: a ball of 0.5 mm fits, one of 3 mm not."""
    x, y = np.meshgrid(np.linspace(0, W, 241), np.linspace(0, H, 161))
    z = -0.3 + 0.01 * x
    for cx, cy in pits:
        z = z - 0.1 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 0.08))
    return Heightfield.on_aperture(z - max(0.0, z.max() + 0.05), width_mm=W, height_mm=H)


TWO = ((3.5, 4.0), (8.5, 3.0))


@pytest.fixture(scope="module")
def lens():
    return pitted(*TWO)


@pytest.fixture(scope="module")
def before(lens):
    result = checked(lens, BIG, STOCK, StockGrid.block(STOCK, CELL))
    assert result.ok, result.faults
    assert result.unreached_share > 0.001
    return result.stock_top


@pytest.mark.parametrize(("direction", "link"), [("x", "u-turn"), ("y", "u-turn"), ("x", "retract")])
def test_what_the_big_ball_left_is_gone_after_one_entry_per_pit(lens, before, direction, link):
    result = checked(lens, replace(REST, direction=direction, link=link), STOCK, before)
    assert result.ok, result.faults
    assert result.unreached == ()
    assert result.rest.regions == 2
    assert result.entries <= 2
    assert result.gouge_um < 0.1
    assert result.rest.area_mm2 < 0.35 * W * H
    left = RestAreas.of(result.stock_top, lens, REST)
    assert not left.core.any()


def test_it_cuts_nowhere_else_and_leaves_no_step(lens, before):
    """Beyond the band the stock is untouched; across it the surface nowhere gets steeper than the cusps were before."""
    areas = RestAreas.of(before, lens, REST)
    after = checked(lens, REST, STOCK, before).stock_top
    assert (after.top_mm <= before.top_mm).all()
    untouched = areas.beyond_mm > areas.blend_mm + REST.pitch_mm
    np.testing.assert_array_equal(after.top_mm[untouched], before.top_mm[untouched])
    x, y = np.meshgrid(after.x_mm, after.y_mm)
    over = after.top_mm - lens.spline_with_run_out(4.0).heights_mm(x, y)
    earlier = before.top_mm - lens.spline_with_run_out(4.0).heights_mm(x, y)
    band = (areas.beyond_mm > 0.2) & (areas.beyond_mm < areas.blend_mm + 0.5)
    band &= (x > 0) & (x < W) & (y > 0) & (y < H)
    assert _steepest(over, band) <= 1.05 * _steepest(earlier, band)


def _steepest(over, where) -> float:
    """Greatest difference of neighbouring cells, both of them in the mask."""
    across = np.abs(np.diff(over, axis=1))[where[:, 1:] & where[:, :-1]]
    along = np.abs(np.diff(over, axis=0))[where[1:] & where[:-1]]
    return float(max(across.max(), along.max()))


def test_where_nothing_is_left_nothing_is_cut(before):
    even = pitted()
    top = checked(even, BIG, STOCK, StockGrid.block(STOCK, CELL)).stock_top
    assert list(pass_paths(even, REST, STOCK, stock_top=top)) == []


def test_it_is_refused_on_an_uncut_block(lens):
    with pytest.raises(PassValueError, match="where"):
        list(pass_paths(lens, REST, STOCK, stock_top=StockGrid.block(STOCK, CELL)))
    with pytest.raises(PassValueError, match="raster"):
        replace(REST, strategy="contour")


@given(x=st.floats(0, W), y=st.floats(0, H))
@settings(deadline=None, max_examples=50)
def test_tips_rise_from_the_surface_and_only_outwards(lens, before, x, y):
    areas = RestAreas.of(before, lens, REST)
    here = np.array([x]), np.array([y])
    lift, beyond = areas.lifts_mm(*here)[0], areas.distances_mm(*here)[0]
    if beyond <= 0:
        assert lift == 0
    elif beyond <= areas.blend_mm:
        assert 0 < lift <= areas.lift_mm
    else:
        assert areas.lift_mm < lift <= 4 * areas.lift_mm


def test_between_regions_the_tool_goes_over_safe_height(lens, before):
    paths = list(pass_paths(lens, REST, STOCK, stock_top=before))
    lifts = [path for path in paths if path.motion is Motion.RAPID]
    assert len(lifts) == 4  # down and up for each of the two regions
    assert all(path.points_mm[:, 2].max() == 5.0 for path in lifts)
