"""Moves near a clamp: the nearest of many points of each move, and words that name clamp and line."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cam.checking.collision import CLEARANCE_MM, Clamps, corners_mm, distances_below_mm
from cam.passes import Clamp
from tests.cam.checking.test_engagement import batch_of

CLAMP = Clamp(x_mm=-12, y_mm=40, width_mm=10, depth_mm=20, height_mm=4)
COORDINATES = st.tuples(*(st.floats(low, high) for low, high in ((-40, 30), (10, 90), (-10, 12))))


@given(points=st.lists(COORDINATES, min_size=2, max_size=8))
def test_each_move_is_as_near_as_the_nearest_of_its_points_below_the_top(points):
    points = np.array(points)
    found = distances_below_mm(points[:-1], points[1:], CLAMP, 100.0)
    t = np.linspace(0, 1, 4001)[:, None]
    low, high = corners_mm(CLAMP)
    for start, end, distance_mm in zip(points[:-1], points[1:], found, strict=True):
        on_it = start + t * (end - start)
        away = np.hypot(*np.maximum(np.maximum(low - on_it[:, :2], on_it[:, :2] - high), 0).T)
        away = away[on_it[:, 2] < CLAMP.height_mm + CLEARANCE_MM]
        step_mm = np.linalg.norm(end - start) / 4000
        assert distance_mm <= away.min(initial=np.inf) + 1e-9
        assert away.min(initial=np.inf) <= distance_mm + step_mm + 1e-9 or distance_mm == np.inf or not away.size


@given(points=st.lists(COORDINATES, min_size=2, max_size=8), most_mm=st.floats(0, 20))
def test_what_is_passed_over_as_too_far_is_too_far(points, most_mm):
    points = np.array(points)
    every = distances_below_mm(points[:-1], points[1:], CLAMP, 1000.0)
    some = distances_below_mm(points[:-1], points[1:], CLAMP, most_mm)
    assert (every[some != every] > most_mm).all()


def test_the_clamp_and_the_worst_line_are_named():
    """Along x = 1.5 a cutter of 3 mm is 3.5 mm from a clamp that ends at x = -2, and should be 4."""
    for points, words in (
        ([(1.5, 0, 5), (1.5, 30, -1), (1.5, 70, -1)], "line 2 at X1.500 Y70.000 comes 0.500 mm too near"),
        ([(-20, 50, 4.9), (10, 50, 4.9)], "comes 4.000 mm too near"),
        ([(-20, 50, 5.1), (10, 50, 5.1)], None),
        ([(2.1, 0, -1), (2.1, 90, -1)], None),
    ):
        clamps = Clamps((CLAMP,), radius_mm=0.5, shank_radius_mm=3.0)
        clamps.add(batch_of(points))
        assert clamps.faults == [] if words is None else words in clamps.faults[0]
        assert all("stock.clamps.0" in fault for fault in clamps.faults)
