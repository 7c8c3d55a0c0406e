"""Shank and flutes against stock that stands, and the cutter against clamps: by brute force, and what is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.checking.collision import (
    CLEARANCE_MM,
    RUB_MM,
    Clamps,
    Collisions,
    corners_mm,
    distances_below_mm,
    lens_over_flutes_mm,
    shank_of,
)
from cam.checking.removal import RemovalGrid
from cam.checking.sweep import STRIKE
from cam.passes import Clamp, ball_pass
from cam.surface.stock_grid import StockGrid
from tests.cam.checking.test_engagement import batch_of
from tests.cam.lenses import make_lens

SPEC = replace(
    ball_pass("finish", radius_mm=0.5, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.4),
    flute_length_mm=1.0,
    shank_radius_mm=1.5,
)


def walled(wall_mm=0.0, floor_mm=-2.0, n=100, cell=0.1) -> StockGrid:
    """A floor with a wall from X6 on."""
    top = np.full((n, n), floor_mm)
    top[:, 60:] = wall_mm
    return StockGrid(x0_mm=0, y0_mm=0, cell_mm=cell, top_mm=top)


def faults(points, spec=SPEC, stock=None) -> list[str]:
    grid = RemovalGrid(stock or walled(), radius_mm=spec.radius_mm, shank=shank_of(spec), shares=2)
    collisions, batch = Collisions(spec), batch_of(points)
    collisions.add(batch, grid.cut(batch), grid)
    return collisions.faults


def test_a_shank_that_strikes_a_wall_is_named():
    """Wall at Z0, tip at Z-2: flutes end at Z-1, the wall stands 1 mm above them, within 1.5 mm of the axis."""
    assert faults([(2, 2, -2), (4.3, 2, -2), (4.3, 8, -2)]) == []
    (fault,) = faults([(2, 2, -2), (4.3, 2, -2), (5.0, 5, -2)])
    assert "1.000 mm above the end of the flutes" in fault and "radius 1.5 mm" in fault
    assert fault.startswith("line 2 at X6.050")


@pytest.mark.parametrize("change", [{"flute_length_mm": 2.1}, {"shank_radius_mm": None}, {"flute_length_mm": None}])
def test_long_flutes_slim_shanks_and_unstated_ones_strike_nothing(change):
    assert faults([(2, 2, -2), (5.4, 2, -2), (5.4, 8, -2)], replace(SPEC, **change)) == []


def test_flutes_shorter_than_the_bite_are_found():
    slim = replace(SPEC, shank_radius_mm=None)
    (fault,) = faults([(4, 5, -2), (7, 5, -2)], slim)
    assert "1.000 mm above" in fault


@given(seed=st.integers(0, 10_000), reach=st.floats(0.4, 1.5), flutes=st.floats(0.1, 1.0))
@settings(deadline=None, max_examples=25)
def test_strikes_are_those_of_brute_force(seed, reach, flutes):
    """The axis at many places of every move, before the move cuts: never more, and less only by the spacing."""
    rng = np.random.default_rng(seed)
    top = np.kron(rng.uniform(-1.0, 0.0, (10, 10)), np.ones((5, 5)))
    stock = StockGrid(x0_mm=0, y0_mm=0, cell_mm=0.1, top_mm=top)
    points = np.column_stack([rng.uniform(0.5, 4.5, (6, 2)), rng.uniform(-1.5, -0.3, 6)])
    grid = RemovalGrid(stock, radius_mm=0.3, shank=(reach, flutes), shares=2)
    batch = batch_of(points)
    found = grid.cut(batch).tally[1:, STRIKE]
    again, x, y = RemovalGrid(stock, radius_mm=0.3), *np.meshgrid(stock.x_mm, stock.y_mm)
    for k in range(5):
        over = 0.0
        for share in np.linspace(0, 1, 120):
            at = points[k] + share * (points[k + 1] - points[k])
            near = np.hypot(x - at[0], y - at[1]) < reach
            over = max(over, float((again.top_mm[near] - at[2] - flutes).max(initial=0.0)))
        assert over - 1e-9 <= found[k] <= over + 0.12  # a cell may come near between two of the places, lower down
        again.cut(batch_of(points[: k + 2]))


def test_a_wall_the_flutes_have_cut_does_not_count():
    assert shank_of(replace(SPEC, shank_radius_mm=None)) == (0.5 - RUB_MM, 1.0)
    assert shank_of(replace(SPEC, flute_length_mm=None)) is None


def test_before_any_work_the_lens_alone_is_asked():
    """A ridge 1 mm high with sides of slope 1: a thick shank strikes it, a slim one and longer flutes do not."""
    ridge = make_lens(lambda x, y: -0.1 - np.minimum(np.abs(x - 4.0), 1.0) + 0 * y)
    short = replace(SPEC, flute_length_mm=0.5)
    assert lens_over_flutes_mm(ridge, short) > 0.2
    assert lens_over_flutes_mm(ridge, replace(short, flute_length_mm=1.2)) < 0
    assert lens_over_flutes_mm(ridge, replace(short, shank_radius_mm=None)) < lens_over_flutes_mm(ridge, short)
    assert lens_over_flutes_mm(ridge, replace(short, flute_length_mm=None)) == -np.inf


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
