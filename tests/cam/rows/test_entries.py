"""Helical entries: shallow, above the floor, inside their region, and into pockets that leave a ramp no room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.moves import CLEARANCE_MM
from cam.passes import ball_pass
from cam.rows.entries import RAMP_SLOPE, Pocket, enter, make_helix

ROUGH = ball_pass("rough", radius_mm=1.0, pitch_mm=0.3, stock_to_leave_mm=0.1, step_down_mm=0.8)
WIDE = (-20.0, 20.0, -20.0, 20.0)


def bowl(curvature: float, tilt: float, depth_mm: float):
    """A floor -depth + tilt x + curvature r^2 / 2."""
    return lambda x, y: -depth_mm + tilt * x + curvature * (x * x + y * y) / 2


def line_on(floor, length_mm: float):
    x = np.round(np.linspace(0, length_mm, 5), 4)
    return np.column_stack([x, np.zeros(5), floor(x, np.zeros(5))])


@given(
    curvature=st.floats(0.0, 0.3),
    tilt=st.floats(-0.2, 0.2),
    depth_mm=st.floats(0.1, 3.0),
    length_mm=st.floats(0.3, 2.0),
    drop_mm=st.floats(0.05, 2.0),
)
def test_a_helix_sinks_slowly_and_never_below_the_floor(curvature, tilt, depth_mm, length_mm, drop_mm):
    floor = bowl(curvature, tilt, depth_mm)
    line = line_on(floor, length_mm)
    start = line[0, 2] + drop_mm
    way = make_helix(line, start, ROUGH, Pocket(floor_mm=floor, region_mm=WIDE))
    if way is None:
        assert drop_mm < 0.5  # the floor rises above where it would start
        return
    points = np.concatenate([[[*line[0, :2], start]], way])
    under = floor(points[:, 0], points[:, 1])
    assert (points[:, 2] >= under - 1e-9).all()
    run, fall = np.hypot(*np.diff(points[:, :2], axis=0).T), -np.diff(points[:, 2])
    assert (fall <= np.maximum(1.01 * RAMP_SLOPE * run, np.maximum(0, -np.diff(under)) + 1e-4)).all()
    np.testing.assert_array_equal(points[-1], line[0])
    reach = np.hypot(*(points[:, :2] - points[0, :2]).T).max()
    assert reach <= ROUGH.radius_mm + 1e-3  # no core is left standing, and no more room taken than a ball's


@pytest.mark.parametrize(("direction", "sense"), [("x", 1.0), ("y", -1.0)])
def test_on_even_floor_it_turns_the_way_that_climbs(direction, sense):
    """Round to the left on the part; rows along Y are made with the axes exchanged, which turns left into right."""
    floor = bowl(0, 0, 1.0)
    spec = ball_pass("r", radius_mm=1.0, pitch_mm=0.3, stock_to_leave_mm=0.1, step_down_mm=0.8)
    way = make_helix(
        line_on(floor, 1.0), 0.5, replace(spec, direction=direction), Pocket(floor_mm=floor, region_mm=WIDE)
    )
    assert way is not None
    x, y = way[:12, 0], way[:12, 1]
    assert np.sign(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) == sense


def test_it_keeps_to_its_region_or_is_not_made():
    floor = bowl(0, 0, 1.0)
    line = line_on(floor, 0.6)
    near_the_back = make_helix(line, 0.0, ROUGH, Pocket(floor_mm=floor, region_mm=(-9, 9, -9, 0.4)))
    assert near_the_back is not None and near_the_back[:, 1].max() <= 0.4
    assert make_helix(line, 0.0, ROUGH, Pocket(floor_mm=floor, region_mm=(-0.1, 0.1, -0.1, 0.1))) is None


def test_only_short_paths_are_entered_by_a_helix():
    floor = bowl(0, 0, 1.5)
    pocket = Pocket(floor_mm=floor, region_mm=WIDE)
    for length_mm, round_about in ((0.5, True), (40.0, False)):
        *_, way = enter(line_on(floor, length_mm), 0.0, ROUGH, safe_z_mm=5.0, pocket=pocket)
        assert bool(np.ptp(way.points_mm[:, 1]) > 0.5) is round_about
        assert way.feed_mm_per_min == ROUGH.plunge_mm_per_min
        assert way.points_mm[0, 2] <= CLEARANCE_MM
