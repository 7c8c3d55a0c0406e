"""The swept ball against dense ball positions, and the laws of cutting: stock never grows, cusps, full depth."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.checking.removal import RemovalGrid, deepest
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid


def batch_of(points, rapid=None, first_line=1) -> MoveBatch:
    points = np.asarray(points, dtype=np.float64)
    n = len(points) - 1
    return MoveBatch(
        points_mm=points,
        is_rapid=np.zeros(n, dtype=bool) if rapid is None else np.asarray(rapid, dtype=bool),
        feed_mm_per_min=np.full(n, 600.0),
        line=np.arange(first_line, first_line + n),
        spindle_rpm=np.full(n, 1e4),
        pause_s=np.full(n, -1.0),
        lines_read=n,
        bytes_read=0,
        ended=True,
    )


def grid_of(n=40, cell_mm=0.08, top_mm=None) -> StockGrid:
    top = np.zeros((n, n)) if top_mm is None else top_mm
    return StockGrid(x0_mm=0.0, y0_mm=0.0, cell_mm=cell_mm, top_mm=top)


def under_still_balls(stock: StockGrid, points, radius_mm, *, per_move: int, grown: bool = False):
    """Brute force: the ball put down at many places of every move.

    Grown by half the way between two places, every ball in between lies inside one of them: a lower bound. Only the
    cells that a move's ball can reach are looked at.
    """
    left = stock.top_mm.copy()
    for a, b in pairwise(points):
        r = radius_mm + (np.linalg.norm(b - a) / (per_move - 1) / 2 if grown else 0)
        (i0, i1), (j0, j1) = (
            np.searchsorted(axis, (min(a[k], b[k]) - r, max(a[k], b[k]) + r))
            for k, axis in enumerate((stock.x_mm, stock.y_mm))
        )
        x, y, under = stock.x_mm[i0:i1], stock.y_mm[j0:j1, None], left[j0:j1, i0:i1]
        for t in np.linspace(0, 1, per_move):
            cx, cy, cz = a + t * (b - a)
            inside = r**2 - (x - cx) ** 2 - (y - cy) ** 2
            ball = np.where(inside > 1e-12 * r**2, cz + radius_mm - np.sqrt(np.maximum(inside, 0)), np.inf)
            np.minimum(under, ball, out=under)
    return left


coordinate = st.floats(-0.5, 3.7)
depth = st.floats(-1.2, 0.2)


@st.composite
def tool_paths(draw):
    """Free, smooth, axis-parallel and plunging paths: each takes another branch of the kernel."""
    kind = draw(st.sampled_from(["free", "smooth", "rows", "plunges"]))
    n = draw(st.integers(1, 6))
    points = [np.array([draw(coordinate), draw(coordinate), draw(depth)])]
    heading = draw(st.floats(0, 6.28))
    for k in range(n):
        heading += draw(st.floats(-0.6, 0.6))
        if kind == "free":
            point = np.array([draw(coordinate), draw(coordinate), draw(depth)])
        elif kind == "smooth":
            way = np.array([math.cos(heading), math.sin(heading), draw(st.floats(-0.7, 0.7))])
            point = points[-1] + draw(st.floats(0.05, 0.5)) * way
        elif kind == "rows":
            point = points[-1] + ([0.0, 0.1, -0.05] if k % 2 else [0.6 - 0.6 * (k % 4), 0.0, 0.0])
        else:
            point = points[-1] + draw(st.sampled_from([[0, 0, -0.4], [0, 0, 0.3], [0.3, 0.2, 0.0]]))
        points.append(point)
    return np.array(points)


@given(tool_paths(), st.floats(0.2, 1.0), st.integers(0, 6))
@settings(max_examples=80, deadline=None)
def test_the_sweep_is_the_lower_envelope_of_the_moving_ball(points, radius_mm, split):
    stock = grid_of()
    grid = RemovalGrid(stock, radius_mm=radius_mm, shares=2)
    split = min(split, len(points) - 1)
    for part in (points[: split + 1], points[split:]):
        if len(part) > 1:
            grid.cut(batch_of(part))
    grid.cut_at_rest()
    assert_between_brute_forces(grid, stock, points, radius_mm)


def assert_between_brute_forces(grid, stock, points, radius_mm):
    """1e-7 mm: on the rim, where the ball is vertical, rounding of 1e-16 in the square shows as its root."""
    assert (grid.top_mm <= under_still_balls(stock, points, radius_mm, per_move=300) + 1e-7).all()
    assert (grid.top_mm >= under_still_balls(stock, points, radius_mm, per_move=300, grown=True) - 1e-7).all()


@pytest.mark.thorough
@pytest.mark.parametrize("turn_deg", [5, 20, 25, 30])
@pytest.mark.parametrize("dip", [-0.3, 0.0, 0.3])
def test_nothing_stands_in_the_wedge_at_a_corner(turn_deg, dip):
    """Soft corners in plan and in height, both ways, on cells much finer than the wedge they open."""
    stock = grid_of(n=160, cell_mm=0.02)
    heading = np.radians(10 + turn_deg * np.array([0, 1, 0, -1, 0]))
    slope = dip * np.array([1, -1, -1, 1, 1])
    steps = 0.45 * np.column_stack([np.cos(heading), np.sin(heading), slope])
    points = np.array([0.6, 1.2, -0.4]) + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    grid = RemovalGrid(stock, radius_mm=0.5)
    grid.cut(batch_of(points))
    grid.cut_at_rest()
    assert_between_brute_forces(grid, stock, points, 0.5)


@pytest.mark.thorough
@pytest.mark.parametrize("turn_deg", [0, 40, 90, 135, 180, 270])
def test_short_steep_moves_over_a_slope_take_off_a_layer_everywhere(turn_deg):
    """Up and down a slope of 35 degrees in all directions: their strips are bent, most cells are not met."""
    turn, climb, layer_mm, radius_mm = np.radians(turn_deg), 0.7, 0.05, 0.6
    x, y = np.meshgrid(grid_of(n=60, cell_mm=0.04).x_mm, grid_of(n=60, cell_mm=0.04).y_mm)
    along = (x - 1.2) * np.cos(turn) + (y - 1.2) * np.sin(turn)
    stock = grid_of(n=60, cell_mm=0.04, top_mm=climb * along)
    ways = np.linspace(-1.4, 1.4, 29)
    rows = [np.column_stack([ways[:: 1 - 2 * (k % 2)], np.full(29, -0.3 + 0.15 * k)]) for k in range(5)]
    u, v = np.vstack(rows).T
    tip_mm = climb * u - layer_mm * np.hypot(1, climb) + radius_mm * (np.hypot(1, climb) - 1)
    place = 1.2 + np.column_stack([u * np.cos(turn) - v * np.sin(turn), u * np.sin(turn) + v * np.cos(turn)])
    points = np.column_stack([place, tip_mm])
    grid = RemovalGrid(stock, radius_mm=radius_mm, shares=2)
    drops = grid.cut(batch_of(points))
    grid.cut_at_rest()
    assert_between_brute_forces(grid, stock, points, radius_mm)
    deepest_mm = drops.depth_mm[8:16].max(), drops.depth_mm[8:16].min()
    assert deepest_mm == pytest.approx((layer_mm * np.hypot(1, climb),) * 2, rel=0.05)


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(0.05, 2.0))
def test_a_column_on_the_rim_is_not_cut_from_wherever_the_ball_comes(arrival_rad, leaving_rad, way_mm):
    """Cells of 128 / 2200 mm lie exactly 3 mm from where rows end at whole millimetres: the rounding of a last digit
    would count as the whole height of the wall there.
    """
    cell_mm, apex = 128 / 2200, np.array([103.0, 10.0, -33.0])
    wall = np.full((14, 14), -100.0)
    wall[7, 7] = 0.0  # at (106, 10)
    stock = StockGrid(x0_mm=2055 * cell_mm - 14, y0_mm=405 * cell_mm - 14, cell_mm=cell_mm, top_mm=wall)
    beside = [way_mm * np.array([math.cos(one), math.sin(one), 0.0]) for one in (arrival_rad, leaving_rad)]
    grid = RemovalGrid(stock, radius_mm=3.0)
    grid.cut(batch_of([apex - beside[0], apex, apex - beside[1]]))
    grid.cut_at_rest()
    assert grid.top_mm[7, 7] == 0.0


def test_a_straight_groove_is_exact():
    grid = RemovalGrid(grid_of(), radius_mm=0.5)
    grid.cut(batch_of([[-1, 1.6, -0.3], [5, 1.6, -0.3]]))
    across = grid.top_mm[:, 20]
    w = grid.stock().y_mm - 1.6
    expected = np.minimum(0, np.where(abs(w) < 0.5, -0.3 + 0.5 - np.sqrt(np.maximum(0.25 - w**2, 0)), 0))
    np.testing.assert_allclose(across, expected, atol=1e-15)


@given(tool_paths(), tool_paths())
@settings(max_examples=40, deadline=None)
def test_removed_stock_never_grows_back(first, second):
    grid = RemovalGrid(grid_of(), radius_mm=0.5)
    grid.cut(batch_of(first))
    before = grid.top_mm.copy()
    grid.cut(batch_of(second))
    assert (grid.top_mm <= before).all()


@pytest.mark.parametrize("pitch_mm", [0.05, 0.2, 0.5])
def test_parallel_rows_on_a_flat_leave_the_cusp(pitch_mm):
    """R - sqrt(R^2 - (p/2)^2), at a cell centred on the middle between rows."""
    radius_mm = 0.5
    stock = StockGrid(x0_mm=0.0, y0_mm=-pitch_mm / 10, cell_mm=pitch_mm / 5, top_mm=np.zeros((51, 40)))
    rows = [[[-1, k * pitch_mm, -0.2], [9, k * pitch_mm, -0.2]][:: 1 - 2 * (k % 2)] for k in range(-2, 13)]
    grid = RemovalGrid(stock, radius_mm=radius_mm)
    grid.cut(batch_of(np.concatenate(rows)))
    middle = StockGrid(
        x0_mm=0.0, y0_mm=0.0, cell_mm=pitch_mm, top_mm=np.zeros((8, 8))
    )  # its cell centres are the middles
    fine = RemovalGrid(middle, radius_mm=radius_mm)
    fine.cut(batch_of(np.concatenate(rows)))
    cusp = radius_mm - math.sqrt(radius_mm**2 - (pitch_mm / 2) ** 2)
    np.testing.assert_allclose(fine.top_mm + 0.2, cusp, rtol=1e-9)
    assert grid.top_mm[:, 10:30].max() + 0.2 <= cusp * (1 + 1e-9)


def test_the_drop_of_short_moves_is_the_full_depth_of_cut():
    """However short the moves, the engagement is the depth they cut, not the sliver each adds."""
    x = np.arange(0.0, 3.0, 0.01)
    path = np.column_stack([x, np.full(x.size, 1.64), np.full(x.size, -0.7)])
    grid = RemovalGrid(grid_of(n=400, cell_mm=0.008), radius_mm=0.5)
    drops = grid.cut(batch_of(path))
    np.testing.assert_allclose(drops.depth_mm[60:-10], 0.7, atol=1e-4)


def test_the_cut_at_the_end_of_a_feed_is_not_charged_to_the_rapid_after_it():
    grid = RemovalGrid(grid_of(), radius_mm=0.5)
    path = [[1.0, 1.6, 1.0], [1.0, 1.6, -0.3], [2.0, 1.6, -0.3], [2.0, 1.6, 1.0], [3.0, 1.6, 1.0]]
    drops = grid.cut(batch_of(path, rapid=[False, False, True, True]))
    assert drops.depth_mm[1] > 0.25 and drops.depth_mm[2] > 0.25
    np.testing.assert_array_equal(drops.depth_mm[3:], 0.0)


def test_a_drop_found_one_batch_late_comes_in_slot_zero():
    grid = RemovalGrid(grid_of(), radius_mm=0.5)
    plunge = grid.cut(batch_of([[1.0, 1.6, 1.0], [1.0, 1.6, -0.3]], first_line=7))
    after = grid.cut(batch_of([[1.0, 1.6, -0.3], [1.0, 1.6, 1.0]], rapid=[True], first_line=8))
    assert plunge.depth_mm.max() == 0
    assert after.depth_mm[0] == pytest.approx(0.3, abs=0.01)
    assert after.depth_mm[1] == 0
    assert grid.cut_by_line.max() == 7


@given(tool_paths(), st.integers(2, 5))
@settings(max_examples=30, deadline=None)
def test_the_result_does_not_depend_on_how_the_work_is_shared(points, shares):
    one, many = RemovalGrid(grid_of(), radius_mm=0.5), RemovalGrid(grid_of(), radius_mm=0.5, shares=shares)
    alone = one.cut(batch_of(points))
    many.refresh()
    together = deepest([many.sweep(batch_of(points), share) for share in reversed(range(shares))])
    np.testing.assert_array_equal(one.top_mm, many.top_mm)
    np.testing.assert_array_equal(one.cut_by_line, many.cut_by_line)
    np.testing.assert_array_equal(alone.depth_mm, together.depth_mm)


def test_a_block_is_covered_by_whole_cells():
    class Block:
        width_mm, height_mm, margin_mm = 10.0, 7.0, 1.5

    grid = StockGrid.block(Block(), 0.3)
    assert grid.top_mm.shape == (34, 44)
    assert grid.x0_mm <= -1.5 and grid.x_mm[-1] + 0.15 >= 11.5
    assert grid.y0_mm + grid.top_mm.shape[0] * 0.3 >= 8.5
    assert grid.highest_mm(20, 21, 0, 1) is None
    assert grid.highest_mm(0, 1, 0, 1) == 0
    with pytest.raises(ValueError):
        grid.top_mm[0, 0] = 1


@pytest.mark.parametrize("away", [-0.95, -0.4, 0.3, 0.95])
def test_a_wall_beside_cut_ground_is_seen(away):
    """The bounds that let moves pass over low ground hold for all that the ball's flank may touch."""
    radius_mm, cell_mm = 0.8, 0.05
    top = np.full((80, 80), -1.5)
    wall = round((2.0 + away * radius_mm) / cell_mm)
    top[:, wall] = 0.0
    grid = RemovalGrid(grid_of(n=80, cell_mm=cell_mm, top_mm=top), radius_mm=radius_mm)
    drops = grid.cut(batch_of([[2.0, 0.5, -0.9], [2.0, 3.5, -0.9]]))
    beside_mm = (wall + 0.5) * cell_mm - 2.0
    under_mm = -0.9 + radius_mm - math.sqrt(radius_mm**2 - beside_mm**2)
    assert grid.top_mm[40, wall] == pytest.approx(under_mm, abs=1e-9)
    assert drops.depth_mm.max() == pytest.approx(-under_mm, abs=1e-9)
