"""Layers and entries: what is left out, joined, stepped down and ramped."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.checking.removal import RemovalGrid
from cam.materials import SLOT_FEED
from cam.moves import CLEARANCE_MM, RAPID_CLEARANCE_MM, Motion
from cam.passes import Stock, ball_pass
from cam.posts.dialects import GRBL
from cam.program import pass_paths
from cam.rows.entries import RAMP_SLOPE, enter, make_ramp
from cam.rows.layers import Field, chain_spans, plan_layers, spans
from cam.rows.raster import Rows
from cam.surface.stock_grid import StockGrid
from cam.surface.stock_touch import StockTouch
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield
from tests.cam.lenses import make_bumps
from tests.cam.programs import generate_program, read_program

STOCK = Stock(width_mm=8, height_mm=6, thickness_mm=10, margin_mm=2)
ROUGH = ball_pass("rough", radius_mm=1.0, pitch_mm=0.3, stock_to_leave_mm=0.1, step_down_mm=0.8)
FINISH = ball_pass("finish", radius_mm=0.5, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.3)


@given(st.lists(st.booleans(), min_size=1, max_size=60), st.integers(0, 3), st.integers(0, 5))
def test_spans_cover_what_is_active_once(active, pad, gap):
    mask = np.array(active)
    (found,) = spans(mask[None], pad=pad, gap=gap)
    covered = np.zeros(mask.size, dtype=int)
    for first, last in found:
        covered[first : last + 1] += 1
    assert (covered[mask] == 1).all()
    assert covered.max() <= 1
    assert all(b[0] - a[1] > gap for a, b in pairwise(found))
    if gap == 0:
        assert covered.sum() <= mask.sum() + 2 * pad * len(found)


@given(st.lists(st.lists(st.booleans(), min_size=12, max_size=12), min_size=1, max_size=10), st.booleans())
def test_every_span_is_cut_once(masks, link):
    by_row = spans(np.array(masks), pad=0, gap=0)
    wanted = sorted((row, *span) for row, row_spans in enumerate(by_row) for span in row_spans)
    runs = list(chain_spans(by_row, most_samples=3, link=link))
    assert sorted((r.row, r.first, r.last) for r in runs) == wanted
    for before, run in pairwise(runs):
        if run.joined:
            assert link
            assert run.row == before.row + 1
            assert run.upward != before.upward
            assert abs(run.start - before.end) <= 3
    if not link:
        assert all(r.upward and not r.joined for r in runs)


@pytest.mark.parametrize("radius_mm", [0.5, 2.0])
def test_a_ball_meets_a_flat_block_at_its_top_and_rounds_its_edge(radius_mm):
    touch = StockTouch.of(StockGrid.block(STOCK, 0.1), radius_mm)
    assert touch.flat
    assert touch.at(4.0, 3.0) == 0.0
    beside = touch.at(10.0 + 0.6 * radius_mm, 3.0)  # 0.6 R beside the block: down by R (1 - 0.8)
    assert beside == pytest.approx(-0.2 * radius_mm, abs=0.03 * radius_mm)
    assert touch.at(10.0 + 2 * radius_mm, 3.0) < -1e3


def test_a_ball_meets_shaped_stock():
    """Against the definition: the highest of top(q) - (R - sqrt(R^2 - |q - c|^2)) over the lens, within the slack."""
    block = StockGrid.block(STOCK, 0.1)
    spline = make_bumps(7, relief_mm=1.5).spline_with_run_out(3.0)
    top_mm = spline.heights_mm(block.x_mm[None, :], block.y_mm[:, None])
    top = StockGrid(x0_mm=block.x0_mm, y0_mm=block.y0_mm, cell_mm=0.1, top_mm=top_mm)
    touch = StockTouch.of(top, 0.8)
    fine = np.linspace(-0.79, 0.79, 301)
    dx, dy = np.meshgrid(fine, fine)
    bump = 0.8 - np.sqrt(np.maximum(0.64 - dx**2 - dy**2, 0))
    for x, y in np.random.default_rng(7).uniform((0, 0), (8, 6), (40, 2)):
        exact = (spline.heights_mm(x + dx, y + dy) - bump).max()
        assert exact - touch.slack_mm <= touch.at(x, y) <= exact + touch.slack_mm
        refined = touch.exactly(np.array([x]), np.array([y]))[0]
        assert exact - 2 * touch.slack_mm <= refined <= exact + 1e-4


def field(lens, spec, top) -> tuple[Field, StockTouch]:
    surface = ToolSurface.over(lens, radius_mm=spec.radius_mm, allowance_mm=spec.stock_to_leave_mm)
    met = StockTouch.of(top, spec.radius_mm)
    return Field.along(Rows.over(STOCK, spec), surface, met), met


@pytest.mark.parametrize("spec", [ROUGH, FINISH])
def test_a_flat_block_comes_off_in_planes(spec):
    """Planes one step-down apart, the last at or below the deepest target; a finish keeps a skin for exact rows."""
    plan = plan_layers(*field(make_bumps(1, relief_mm=3.0), spec, StockGrid.block(STOCK, 0.1)), spec)
    levels = [layer.level_mm for layer in plan.layers]
    np.testing.assert_allclose(levels, -spec.step_down_mm * (1 + np.arange(len(levels))))
    assert plan.exact_rows is spec.finishes
    assert all((layer.offset_mm > 0) is spec.finishes for layer in plan.layers)


def test_no_layers_where_one_step_does_it():
    shallow = make_bumps(1, relief_mm=0.1)
    plan = plan_layers(*field(shallow, FINISH, StockGrid.block(STOCK, 0.1)), FINISH)
    assert plan.layers == ()
    assert plan.exact_rows


def test_a_shaped_block_comes_off_parallel_to_the_target():
    block = StockGrid.block(STOCK, 0.1)
    stepped = block.top_mm - 0.2 * (block.x_mm > 4)[None, :]
    top = StockGrid(x0_mm=block.x0_mm, y0_mm=block.y0_mm, cell_mm=0.1, top_mm=stepped)
    spread, met = field(make_bumps(1, relief_mm=1.0), FINISH, top)
    plan = plan_layers(spread, met, FINISH)
    deepest = (spread.stock_mm - spread.target_mm).max() + met.slack_mm
    assert [layer.offset_mm for layer in plan.layers] == pytest.approx(
        [0.24 * k for k in range(len(plan.layers), 0, -1)]
    )
    assert plan.layers[0].offset_mm + 0.24 >= deepest
    assert plan.exact_rows


@given(
    z=st.lists(st.floats(-3, -0.2), min_size=2, max_size=12),
    step_mm=st.floats(0.1, 3.0),
    stock_mm=st.floats(-4.0, 0.0),
)
def test_the_tool_enters_stock_on_a_shallow_ramp(z, step_mm, stock_mm):
    """Straight down only in air; then no steeper than 3 degrees or the path, never below it; ends where it starts."""
    line = np.column_stack([np.arange(len(z)) * step_mm, np.zeros(len(z)), z])
    across, down, *ramps = enter(line, stock_mm, ROUGH, safe_z_mm=5.0)
    assert across.motion is Motion.RAPID
    np.testing.assert_array_equal(
        across.points_mm, [[0, 0, 5.0], [0, 0, max(stock_mm, z[0], 0.0) + RAPID_CLEARANCE_MM]]
    )
    reached = down.points_mm[-1, 2]
    assert down.feed_mm_per_min == ROUGH.plunge_mm_per_min
    if stock_mm <= z[0]:
        assert reached == z[0]
        assert not ramps
        return
    assert reached == stock_mm + CLEARANCE_MM
    points = np.concatenate([down.points_mm[-1:], ramps[0].points_mm])
    run, fall = np.abs(np.diff(points[:, 0])), -np.diff(points[:, 2])
    path = np.interp(points[:, 0], line[:, 0], line[:, 2])
    assert (fall <= np.maximum(RAMP_SLOPE * run, -np.diff(path)) + 1e-9).all()
    assert (points[1:, 2] >= path[1:] - 1e-9).all()
    np.testing.assert_array_equal(points[-1], line[0])


def test_a_ramp_cuts_its_whole_stretch():
    """When it is done nothing stands above the stretch it ran on: the last leg lies on the path."""
    assert np.degrees(np.arctan(RAMP_SLOPE)) <= 3.0 + 1e-9
    line = np.column_stack([np.linspace(0, 40, 81), np.zeros(81), np.full(81, -1.5)])
    points = make_ramp(line, 0.1)
    assert points[:, 0].max() <= 15.5
    assert (points[-1] == line[0]).all()
    assert len(points) <= 10  # a straight leg is one move
    legs = np.flatnonzero(np.diff(np.sign(np.diff(points[:, 0]))))
    assert points[legs[-1] + 1 :, 2].min() == pytest.approx(-1.5)


def rest_of(spec, radius_mm: float):
    """What a rough pass with one ball leaves of a small lens, and where a second rough pass cuts it."""
    lens, top = make_bumps(3, relief_mm=1.6, spread_mm=0.7), StockGrid.block(STOCK, 0.1)
    first = replace(spec, radius_mm=radius_mm)
    grid = RemovalGrid(top, radius_mm=radius_mm)
    text = generate_program(lens, first, STOCK, stock_top=top, post=GRBL)
    for batch in read_program(text):
        grid.cut(batch)
    grid.cut_at_rest()
    return lens, grid.stock()


@pytest.mark.parametrize("radius_mm", [0.8, 2.0])
def test_a_second_rough_pass_goes_where_the_first_one_really_left_stock(radius_mm):
    """Its layers and their depth come from the simulated stock: every cut of it takes off something, none too much."""
    lens, left = rest_of(ROUGH, radius_mm)
    second = replace(ROUGH, radius_mm=0.5, pitch_mm=0.2, stock_to_leave_mm=0.05, step_down_mm=0.1)
    spread, met = field(lens, second, left)
    plan = plan_layers(spread, met, second)
    deepest = float((spread.stock_mm - spread.target_mm).max()) + met.slack_mm
    assert len(plan.layers) == int(np.ceil(deepest / second.step_down_mm)) - 1
    grid = RemovalGrid(left, radius_mm=second.radius_mm)
    drops = [
        grid.cut(batch).depth_mm
        for batch in read_program(generate_program(lens, second, STOCK, stock_top=left, post=GRBL))
    ]
    assert max(d.max() for d in drops) <= 1.06 * second.step_down_mm + 0.05
    in_layers = [layer.offset_mm for layer in plan.layers]
    assert in_layers == sorted(in_layers, reverse=True)


def test_a_ball_meets_no_wall_that_one_of_its_size_has_left():
    """Deeper than its radius the wall of a pass before stands at the ball's equator: it passes by and takes off
    nothing, so that nothing has to be taken off before.
    """
    lens, left = rest_of(ROUGH, 0.8)
    finish = replace(FINISH, radius_mm=0.8)
    spread, met = field(lens, finish, left)
    assert (spread.stock_mm - spread.target_mm).max() > finish.step_down_mm  # as the lattice tells
    plan = plan_layers(spread.refine(met, finish.step_down_mm - met.slack_mm), met, finish)
    assert plan.layers == ()
    grid = RemovalGrid(left, radius_mm=finish.radius_mm)
    text = generate_program(lens, finish, STOCK, stock_top=left, post=GRBL)
    assert max(grid.cut(batch).depth_mm.max() for batch in read_program(text)) <= finish.step_down_mm


def test_a_bigger_first_ball_leaves_the_second_one_more_to_do():
    second = replace(ROUGH, radius_mm=0.5, pitch_mm=0.2, stock_to_leave_mm=0.05, step_down_mm=0.04)
    lengths = []
    for radius_mm in (0.8, 2.0):
        lens, left = rest_of(ROUGH, radius_mm)
        points = np.concatenate([path.points_mm for path in pass_paths(lens, second, STOCK, stock_top=left)])
        lengths.append(float(np.hypot(*np.diff(points[:, :2], axis=0).T).sum()))
    assert 1.05 * lengths[0] < lengths[1]


def test_slots_are_cut_slowly_and_only_first_rows():
    """On a flat block: stock on both sides of a row happens once per stretch, on the way in."""
    lens, top = make_bumps(1, relief_mm=0.4), StockGrid.block(STOCK, 0.1)
    spec = replace(ROUGH, step_down_mm=0.9)
    slots = rows = 0.0
    for path in pass_paths(lens, spec, STOCK, stock_top=top):
        if path.feed_mm_per_min not in (None, spec.plunge_mm_per_min):
            length = float(np.hypot(*np.diff(path.points_mm[:, :2], axis=0).T).sum())
            slow = path.feed_mm_per_min <= SLOT_FEED * spec.feed_mm_per_min
            slots, rows = slots + length * slow, rows + length * (not slow)
    assert 0 < slots < 4 * (STOCK.width_mm + 2 * spec.radius_mm) < rows


def least_depth_of_descents(lens, spec):
    """The deepest that each descent below the top of a flat block cuts; of all of them the least."""
    top = StockGrid.block(STOCK, 0.05)
    grid = RemovalGrid(top, radius_mm=spec.radius_mm)
    (batch,) = read_program(generate_program(lens, spec, STOCK, stock_top=top, post=GRBL))
    depth_mm = grid.cut(batch).depth_mm[1:]
    feeds = (np.minimum(batch.start_mm[:, 2], batch.end_mm[:, 2]) < 0) & ~batch.is_rapid
    descents = np.split(np.arange(feeds.size), np.flatnonzero(np.diff(feeds)) + 1)
    return min(depth_mm[one].max() for one in descents if feeds[one[0]])


def test_no_way_goes_along_a_wall_where_a_turn_has_been():
    """The last plane cuts one corner alone, two rows wide, and the turn between them goes along all of its wall."""
    x, y = np.linspace(0.0, STOCK.width_mm, 41), np.linspace(0.0, STOCK.height_mm, 31)
    tilted = 0.1 * (y[:, None] - x[None, :] - STOCK.height_mm) - 0.1
    lens = Heightfield.on_aperture(tilted, width_mm=STOCK.width_mm, height_mm=STOCK.height_mm)
    assert least_depth_of_descents(lens, replace(ROUGH, step_down_mm=0.85)) > 1e-6


@pytest.mark.parametrize(("seed", "step_down_mm"), [(0, 0.3), (0, 0.5), (1, 0.3), (1, 0.8)])
def test_rows_beside_what_stands_are_no_reason_to_enter(seed, step_down_mm):
    spec = replace(ROUGH, step_down_mm=step_down_mm, direction="y")
    assert least_depth_of_descents(make_bumps(seed, relief_mm=2.0), spec) > 1e-6
