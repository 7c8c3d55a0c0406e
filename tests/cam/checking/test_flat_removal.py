"""The end of a flat or bull-nose mill: what it leaves, how deep it bites, and that a full corner is a ball."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.checking.flat_removal import FlatRemoval
from cam.checking.removal import RemovalGrid
from cam.surface.stock_grid import StockGrid
from tests.cam.checking.test_removal import batch_of


def slow_flat(top: StockGrid, points: np.ndarray, radius_mm: float, corner_mm: float = 0.0) -> np.ndarray:
    """The end at many places of its way, one after the other."""
    left = top.top_mm.copy()
    x, y = top.x_mm[None, :], top.y_mm[:, None]
    for a, b in pairwise(points):
        for t in np.linspace(0, 1, 400):
            p = a + t * (b - a)
            away = np.hypot(x - p[0], y - p[1])
            beyond = np.maximum(away - (radius_mm - corner_mm), 0.0)
            end = p[2] + corner_mm - np.sqrt(np.maximum(corner_mm**2 - beyond**2, 0.0))
            under = away <= radius_mm
            left[under] = np.minimum(left, end)[under]
    return left


POINT = st.tuples(st.floats(-3, 9), st.floats(-3, 9), st.floats(-3, 0.5))


@settings(max_examples=25, deadline=None)
@given(st.lists(POINT, min_size=2, max_size=4, unique=True), st.floats(0.5, 2), st.sampled_from([0.0, 0.5, 1.0]))
def test_a_flat_or_rounded_end_leaves_what_it_would_at_every_place_of_its_way(points, radius_mm, share) -> None:
    """The slow one stands still at 400 places of a move, so it takes off less, by a four-hundredth of the slope."""
    way, corner_mm = np.array(points), share * radius_mm
    top = StockGrid(x0_mm=0, y0_mm=0, cell_mm=0.25, top_mm=np.zeros((24, 24)))
    fast = FlatRemoval(top, radius_mm=radius_mm, corner_mm=corner_mm)
    cut_off = fast.cut(batch_of(way))
    drops, places = cut_off.depth_mm[1:], cut_off.cell[1:]
    slow = slow_flat(top, way, radius_mm, corner_mm)
    above_mm = 1e-6 if share else 2.1e-7  # the lowest place of a rounded end is searched for; cells at a rim are higher
    assert (fast.top_mm <= slow + above_mm).all()
    sure = slow_flat(top, way, radius_mm + 0.05, corner_mm)  # places touched by the rim between two of the 400
    assert (fast.top_mm >= sure - 0.05).all()
    assert drops.max() <= -fast.top_mm.min() + 1e-12
    assert ((places >= 0) == (drops > 0)).all()


@settings(max_examples=25, deadline=None)
@given(st.lists(POINT, min_size=2, max_size=4, unique=True), st.floats(0.5, 2))
def test_an_end_that_is_all_corner_is_a_ball(points, radius_mm) -> None:
    """At its rim digits say whether a cell is touched: an end a little smaller and one a little larger are asked."""
    block = StockGrid(x0_mm=0, y0_mm=0, cell_mm=0.2, top_mm=np.zeros((30, 30)))
    ball = RemovalGrid(block, radius_mm=radius_mm)
    ends = [FlatRemoval(block, radius_mm=r, corner_mm=r) for r in (radius_mm * (1 - 1e-9), radius_mm * (1 + 1e-9))]
    for grid in (ball, *ends):
        grid.cut(batch_of(points))
        grid.cut_at_rest()
    assert (ends[0].top_mm >= ball.top_mm - 1e-6).all()
    assert (ends[1].top_mm <= ball.top_mm + 1e-6).all()


def test_a_bite_is_as_deep_in_short_moves_as_in_one() -> None:
    """A corner that comes in short moves takes a wall off in slivers: together they are the cut."""
    block = StockGrid(x0_mm=0, y0_mm=0, cell_mm=0.1, top_mm=np.zeros((100, 200)))
    x = np.linspace(-4, 24, 300)
    way = np.column_stack([x, np.full_like(x, 5.0), np.full_like(x, -1.5)])
    for corner_mm in (0.0, 1.0, 2.0):
        bites = []
        for points in (way, way[[0, -1]]):
            grid = FlatRemoval(block, radius_mm=2.0, corner_mm=corner_mm)
            bites.append(grid.cut(batch_of(points)).depth_mm.max())
        assert abs(bites[0] - bites[1]) < 1e-6
        assert abs(bites[0] - 1.5) < 1e-3  # cells lie beside the way


def test_a_wall_that_digits_leave_alone_is_no_bite_of_several_layers() -> None:
    """Where the way turns, the end misses a cell by 10 nm, and in the last layer it takes it, one digit farther on.

    Measured across the move alone, that cell lies well inside the rim.
    """
    turn = np.array([1.0, 0.0])
    cell = turn + (0.5 + 1e-5) * np.array([0.6, 0.8])
    top = StockGrid(x0_mm=cell[0] - 2.005, y0_mm=cell[1] - 2.005, cell_mm=0.01, top_mm=np.zeros((401, 401)))
    grid = FlatRemoval(top, radius_mm=0.5, rim_mm=2e-4)
    for z, digit_mm in ((-1.0, 0.0), (-2.0, 0.0), (-3.0, 1e-4)):
        x = 1.0 + digit_mm
        way = [(0, 0, z), (x, 0, z), (x, -1, z), (x, -1, 1), (9, -1, 1)]
        assert grid.cut(batch_of(way)).depth_mm.max() == pytest.approx(1.0, abs=1e-6)
        assert (grid.top_mm[200, 200] < 0) == (digit_mm > 0)


def test_moves_shorter_than_the_rim_bite_as_deep_as_others() -> None:
    block = StockGrid(x0_mm=0, y0_mm=0, cell_mm=0.1, top_mm=np.zeros((40, 40)))
    x = np.arange(-0.6, 0.6, 0.0005)
    way = np.column_stack([x, np.full_like(x, 2.0), np.full_like(x, -1.5)])
    grid = FlatRemoval(block, radius_mm=0.5, rim_mm=0.001)
    assert grid.cut(batch_of(way)).depth_mm.max() == pytest.approx(1.5, abs=1e-6)
