"""Laws of the entry going on: no turn back, a slow sinking, onto the path where its beginning is long enough."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from cam.moves import CLEARANCE_MM, Motion
from cam.passes import ball_pass
from cam.rows.entries import RAMP_SLOPE, enter_onward

SAFE_MM = 5.0
SPEC = ball_pass("finish", radius_mm=0.5, pitch_mm=0.05, stock_to_leave_mm=0.0, step_down_mm=0.2)


def first_stretch(length_mm: float, tilt: float, z_mm: float) -> np.ndarray:
    x = np.linspace(3.0, 3.0 + length_mm, 40)
    return np.column_stack([x, np.full(40, -0.25), z_mm + tilt * (x - 3.0) + 0.01 * np.sin(x)])


def entered(polyline: np.ndarray, stock_mm: float):
    paths = list(enter_onward(polyline, stock_mm, SPEC, safe_z_mm=SAFE_MM))
    rapids = [path for path in paths if path.motion is Motion.RAPID]
    return rapids, [path for path in paths if path.motion is not Motion.RAPID]


@given(st.floats(2.0, 15.0), st.floats(-0.04, 0.3), st.floats(-4.0, -0.5), st.floats(0.001, 0.5))
def test_it_sinks_along_the_path_without_turning_and_reaches_it(length, tilt, z, over):
    polyline = first_stretch(length, tilt, z)
    stock = polyline[0, 2] + over
    assume(over + CLEARANCE_MM < 0.95 * RAMP_SLOPE * length)
    rapids, cuts = entered(polyline, stock)
    assert len(rapids) == 1 and len(cuts) == 1
    points = cuts[0].points_mm
    np.testing.assert_array_equal(points[:, :2], polyline[:, :2])
    assert (points[:, 2] >= polyline[:, 2]).all(), "never below the path"
    np.testing.assert_array_equal(points[-1], polyline[-1])
    above = points[:, 2] - polyline[:, 2]
    sinking = -np.diff(above) / np.diff(points[:, 0])
    assert sinking.max() <= RAMP_SLOPE * (1 + 1e-9), "below the path's own fall, at most the ramp"
    assert points[0, 2] >= min(stock + CLEARANCE_MM, SAFE_MM) - 1e-9, "it begins above the stock"
    assert cuts[0].feed_mm_per_min == SPEC.plunge_mm_per_min
    np.testing.assert_array_equal(rapids[0].points_mm[-1, :2], polyline[0, :2])
    assert rapids[0].points_mm[:, 2].min() > stock


def test_over_no_stock_it_goes_on_at_once():
    polyline = first_stretch(10.0, 0.0, -1.0)
    _, cuts = entered(polyline, polyline[0, 2] - 0.3)
    np.testing.assert_array_equal(np.concatenate([path.points_mm for path in cuts]), polyline)


@pytest.mark.parametrize("over", [0.5, 2.0])
def test_where_the_beginning_is_too_short_the_ramp_turns_back_and_the_beginning_is_cut_after_it(over):
    polyline = first_stretch(1.5, 0.0, -3.0)
    _, cuts = entered(polyline, polyline[0, 2] + over)
    np.testing.assert_array_equal(cuts[-1].points_mm, polyline)
    way = np.concatenate([path.points_mm for path in cuts])
    x, y, z = np.diff(way, axis=0).T
    along = np.hypot(x, y) > 0
    assert (np.diff(way[:, 0])[along] < 0).any(), "back as well"
    assert (-z[along] <= (RAMP_SLOPE + 0.02) * np.hypot(x, y)[along]).all(), "no plunge into stock"
