"""Roughing with a flat or bull-nose end mill: what its surface is, what its programs leave, and what then finishes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.errors import PassValueError
from cam.passes import Stock, ball_pass
from cam.surface.stock_grid import StockGrid
from cam.surface.stock_touch import rise_mm
from cam.surface.tool_surface import RoughSurface
from tests.cam.checks import checked
from tests.cam.lenses import make_bumps

STOCK = Stock(width_mm=14, height_mm=11, thickness_mm=12, margin_mm=5)
ROUGH = ball_pass("rough", radius_mm=2.0, pitch_mm=0.5, stock_to_leave_mm=0.2, step_down_mm=1.0)
FINISH = ball_pass("finish", radius_mm=1.0, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.4)
SHARES = st.sampled_from([0.0, 0.25, 0.6])


def hills(seed: int, relief_mm: float):
    return make_bumps(seed, relief_mm=relief_mm, width_mm=14.0, height_mm=11.0, spread_mm=3.0)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 99), SHARES)
def test_an_end_on_its_surface_leaves_the_allowance_and_touches(seed, share) -> None:
    """Against the underside at many places: nowhere in the lens, and near what is left on purpose somewhere."""
    lens, spec = hills(seed, 2.0), replace(ROUGH, corner_radius_mm=2.0 * share)
    surface = RoughSurface.over(lens, spec)
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(-2, 16, 13), np.linspace(-2, 13, 11)))
    tips = surface.tip_heights_mm(x, y)
    away, turn = (side.ravel() for side in np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 2 * np.pi, 72)))
    spline = lens.spline_with_run_out(6.0)
    over = np.empty(tips.size)
    for k in range(tips.size):
        z, p, q, *_ = spline.jets(x[k] + away * np.cos(turn), y[k] + away * np.sin(turn))
        wanted = z + 0.2 * np.sqrt(1 + p * p + q * q) if share == 0 else z
        over[k] = (tips[k] + rise_mm(spec.shape, 2.0, away) - wanted).min()
    least, most = (-0.01, 0.2) if share == 0 else (0.15, 0.45)  # by the lattice's nodes, on slopes up to 1
    assert over.min() > least
    assert over.max() < most


@pytest.mark.thorough
@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 99),
    st.sampled_from([1.0, 2.0, 3.5, 6.0]),
    SHARES,
    st.sampled_from("xy"),
    st.sampled_from([0.15, 0.3, 1.0]),
)
def test_programs_of_flat_ends_pass_the_check_and_a_ball_finishes_after_them(seed, relief, share, way, pitch) -> None:
    lens, block = hills(seed, relief), StockGrid.block(STOCK)
    rough = replace(ROUGH, corner_radius_mm=2.0 * share, direction=way, pitch_mm=pitch, flute_length_mm=6.0)
    try:
        first = checked(lens, rough, STOCK, block)
    except PassValueError as error:
        assert "pitch_mm" in str(error) and pitch == 1.0 and relief == 6.0  # stairs of more than a step-down
        return
    assert first.faults == ()
    assert first.gouge_um == 0.0
    assert first.below_leave_um < 50
    assert first.max_gap_mm < 1.001 * pitch
    second = checked(lens, FINISH, STOCK, first.stock_top)
    assert second.faults == ()


def test_a_flat_end_takes_the_block_down_sooner_than_a_ball() -> None:
    lens, block = hills(1, 3.5), StockGrid.block(STOCK)
    ball, flat = (checked(lens, replace(ROUGH, corner_radius_mm=corner), STOCK, block) for corner in (None, 0.0))
    assert flat.time_s < 0.9 * ball.time_s
    assert flat.max_engagement_mm < 1.05 * ROUGH.step_down_mm


@pytest.mark.parametrize(
    "changes", [{"stock_to_leave_mm": 0.0}, {"strategy": "contour"}, {"where": "rest"}, {"corner_radius_mm": 2.1}]
)
def test_what_is_flat_only_roughs(changes) -> None:
    with pytest.raises(PassValueError, match="corner_radius_mm"):
        replace(ROUGH, **{"corner_radius_mm": 0.5, **changes})


def test_what_is_flat_meets_flat_stock_alone() -> None:
    lens, block = hills(1, 2.0), StockGrid.block(STOCK)
    shaped = checked(lens, ROUGH, STOCK, block).stock_top
    with pytest.raises(PassValueError, match="a ball, after a pass"):
        checked(lens, replace(ROUGH, corner_radius_mm=0.0, stock_to_leave_mm=0.1), STOCK, shaped)
