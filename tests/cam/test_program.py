"""Whole programs: parsed by others, cut by a slow mill, and judged by what is left of the block."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gcodeparser import parse_gcode_lines

from cam.errors import CutterTooLargeError, PassValueError, SafeHeightError, StockTooThinError
from cam.moves import Motion
from cam.passes import Stock, ball_pass
from cam.posts.dialects import GRBL
from cam.program import CHUNK_BYTES, pass_paths
from cam.surface.stock_grid import StockGrid
from cam.surface.tool_surface import ToolSurface
from tests.cam.lenses import SlowMill, make_bumps, make_lens
from tests.cam.programs import generate_program

GOLDEN = Path(__file__).parents[1] / "golden" / "tiny-pass.nc"
REWRITE = "CAUSTICMILL_REWRITE_GOLDEN"
CELL_MM = 0.06
W, H = 4.0, 3.0

ROUGH = ball_pass("rough", radius_mm=1.0, pitch_mm=0.3, stock_to_leave_mm=0.1, step_down_mm=0.7)
MIDDLE = ball_pass("semi-finish", radius_mm=0.5, pitch_mm=0.15, stock_to_leave_mm=0.03, step_down_mm=0.25)
FINISH = ball_pass("finish", radius_mm=0.5, pitch_mm=0.08, stock_to_leave_mm=0.0, step_down_mm=0.12)


def block(margin_mm: float = 1.0) -> Stock:
    return Stock(width_mm=W, height_mm=H, thickness_mm=10, margin_mm=margin_mm)


@pytest.fixture(scope="module")
def small():

    return make_bumps(4, relief_mm=1.1, width_mm=W, height_mm=H, spread_mm=0.7)


def paths(lens, spec, stock, top, **options):
    return list(pass_paths(lens, spec, stock, stock_top=top, **options))


def cut_block(moves, spec, top):
    mill = SlowMill(x_mm=top.x_mm, y_mm=top.y_mm, radius_mm=spec.radius_mm, top_mm=top.top_mm.copy())
    for path in moves:
        for point in path.points_mm:
            mill.move(point, rapid=path.motion is Motion.RAPID)
    return mill, replace(top, top_mm=mill.top_mm)


def judge(mill, spec):
    cusp_mm = 2 * spec.pitch_mm**2 / (8 * spec.radius_mm) * 2  # of the layer before, on a slope
    assert mill.rapid_cut_mm < 1e-9
    assert mill.deepest_mm <= 1.05 * spec.step_down_mm + cusp_mm
    assert mill.deepest_plunge_mm <= 1e-3


@pytest.mark.parametrize(
    ("margin_mm", "link"),
    [
        (1.0, "u-turn"),
        pytest.param(0.0, "u-turn", marks=pytest.mark.thorough),
        pytest.param(0.5, "retract", marks=pytest.mark.thorough),
    ],
)
def test_three_passes_make_the_lens(small, margin_mm, link):
    """Each within its step-down, no rapid in stock, nothing below the lens, and what is left is what was asked for."""
    stock = block(margin_mm)
    top = StockGrid.block(stock, CELL_MM)
    inside_x, inside_y = ((a > 0) & (a < size) for a, size in ((top.x_mm, W), (top.y_mm, H)))
    lens = small.spline().heights_mm(top.x_mm[None, inside_x], top.y_mm[inside_y][:, None])
    for spec in (ROUGH, MIDDLE, FINISH):
        spec = replace(spec, link=link)
        mill, top = cut_block(paths(small, spec, stock, top), spec, top)
        judge(mill, spec)
        over = top.top_mm[np.ix_(inside_y, inside_x)] - lens
        assert over.min() >= 0.9 * spec.stock_to_leave_mm - 2e-5  # vertical is never less than along the normal
    cusp_mm = FINISH.pitch_mm**2 / (8 * FINISH.radius_mm)
    surface = ToolSurface.over(small, radius_mm=0.5)
    reached = np.quantile(over, 0.9)
    assert surface.kernel.guarded.mean() < 0.6
    assert reached <= 3 * cusp_mm + CELL_MM**2 / (2 * 0.5)


@pytest.mark.thorough
def test_a_pass_alone_on_a_flat_block(small):
    """A finishing pass that meets an uncut block clears it in planes first and ends with exact rows."""
    stock = block()
    spec = replace(FINISH, pitch_mm=0.2, step_down_mm=0.6)
    mill, _ = cut_block(paths(small, spec, stock, top_of(stock)), spec, top_of(stock))
    judge(mill, spec)


def top_of(stock: Stock) -> StockGrid:
    return StockGrid.block(stock, CELL_MM)


def test_no_wall_is_left_around_the_lens(small):
    """The rough pass clears one radius beyond the aperture, so that the next ball meets no deep wall there."""
    stock = block(3.0)
    _, top = cut_block(paths(small, ROUGH, stock, top_of(stock)), ROUGH, top_of(stock))
    ring_x = (top.x_mm > -0.9) & (top.x_mm < W + 0.9)
    ring_y = (top.y_mm > -0.9) & (top.y_mm < H + 0.9)
    ring = top.top_mm[np.ix_(ring_y, ring_x)]
    spline = small.spline_with_run_out(3.0)
    over = ring - spline.heights_mm(top.x_mm[None, ring_x], top.y_mm[ring_y][:, None])
    assert np.quantile(over, 0.99) < 0.6


@pytest.mark.parametrize("spec", [ROUGH, FINISH, replace(FINISH, link="retract", pitch_mm=0.25)])
def test_rapids_only_across_at_safe_height_or_straight(small, spec):
    """And straight down never nearer to the lens than a millimetre, which the block only adds to."""
    stock = block()
    surface = ToolSurface.over(small, radius_mm=spec.radius_mm, allowance_mm=spec.stock_to_leave_mm)
    here = None
    for path in paths(small, spec, stock, top_of(stock), safe_z_mm=4.0):
        for point in path.points_mm:
            if here is not None and path.motion is Motion.RAPID:
                across = here[2] == point[2] == 4.0
                assert across or np.array_equal(here[:2], point[:2])
                assert point[2] >= here[2] or point[2] > surface.tip_heights_mm(*point[:2])[0] + 0.999
            here = point
    assert here[2] == 4.0
    assert path.motion is Motion.RAPID


def test_exact_rows_come_last_and_once_over_everything(small):
    """The finish of a shaped block is one unbroken cut: in, all rows, out."""
    stock = block()
    z = small.spline_with_run_out(4.0)
    top = top_of(stock)
    left = StockGrid(
        x0_mm=top.x0_mm,
        y0_mm=top.y0_mm,
        cell_mm=CELL_MM,
        top_mm=z.heights_mm(top.x_mm[None, :], top.y_mm[:, None]) + 0.03,
    )
    moves = paths(small, FINISH, stock, left)
    lifts = [path for path in moves if path.motion is Motion.RAPID]
    assert len(lifts) == 2
    rows = np.concatenate([p.points_mm for p in moves if p.feed_mm_per_min == FINISH.feed_mm_per_min])
    surface = ToolSurface.over(small, radius_mm=0.5)
    np.testing.assert_allclose(rows[:, 2], surface.tip_heights_mm(rows[:, 0], rows[:, 1]), atol=1e-9)


@pytest.mark.thorough
def test_local_rest_gets_layers_of_its_own(small):
    """A post that an earlier pass left comes off in steps, and only there."""
    stock = block()
    z = small.spline_with_run_out(4.0)
    top = top_of(stock)
    even = z.heights_mm(top.x_mm[None, :], top.y_mm[:, None]) + 0.03
    post = np.hypot(top.x_mm[None, :] - 2, top.y_mm[:, None] - 1.5) < 0.4
    left = StockGrid(x0_mm=top.x0_mm, y0_mm=top.y0_mm, cell_mm=CELL_MM, top_mm=even + 0.5 * post)
    moves = paths(small, FINISH, stock, left)
    mill, _ = cut_block(moves, FINISH, left)
    judge(mill, FINISH)
    lifts = [n for n, path in enumerate(moves) if path.motion is Motion.RAPID and n > 0]
    layered = np.concatenate([path.points_mm for path in moves[1 : lifts[-3]] if path.motion is Motion.CUT])
    assert np.hypot(layered[:, 0] - 2, layered[:, 1] - 1.5).max() < 0.4 + 0.5 + 1.0  # post, ball, pad


def test_program_reads_back_in_an_independent_parser(small):
    """Every coordinate inside the region, every line short, spindle on before the first cut and off at last."""
    stock = block()
    text = b"".join(generate_program(small, ROUGH, stock, stock_top=top_of(stock), post=GRBL, safe_z_mm=6.0)).decode()
    lines = text.splitlines()
    assert text.endswith("\n")
    assert "\r" not in text
    assert "%" not in text
    assert max(map(len, lines)) < 80
    parsed = list(parse_gcode_lines(text))
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    spinning = False
    for line in parsed:
        spinning |= line.command == ("M", 3)
        if line.command == ("M", 5):
            spinning = False
        values = [line.params.get(axis, np.nan) for axis in "XYZ"]
        low, high = np.fmin(low, values), np.fmax(high, values)
        if line.command == ("G", 1):
            assert spinning
    assert not spinning
    assert parsed[-1].command == ("M", 2)
    r = ROUGH.radius_mm
    assert (low >= np.array([-r, -r, small.z_mm.min() - 0.5])).all()
    assert (high <= np.array([W + r, H + r, 6.0])).all()
    assert (low[:2] <= -r + ROUGH.pitch_mm / 2 + 1e-9).all()


def test_written_finish_lies_on_the_exact_surface(small):
    """z is the only thing rounded: 2.9 nm rms, 5 nm at most."""
    stock = block()
    left = StockGrid(x0_mm=-1, y0_mm=-1, cell_mm=0.1, top_mm=np.full((50, 60), float(small.z_mm.min())))
    text = b"".join(generate_program(small, FINISH, stock, stock_top=left, post=GRBL)).decode()
    at, points, feed = {"X": 0.0, "Y": 0.0, "Z": 0.0}, [], None
    for line in text.splitlines():
        words = dict(re.findall(r"([GXYZFM])(-?[\d.]+)", line))
        feed = words.get("F", feed)
        at.update({axis: float(words[axis]) for axis in "XYZ" if axis in words})
        if words.get("G") == "0" and points:
            last, points = np.array(points), []
        elif feed == "600" and "M" not in words:
            points.append([at["X"], at["Y"], at["Z"]])
    x, y, z = last.T
    assert len(last) > 10_000
    error_nm = 1e6 * (z - ToolSurface.over(small, radius_mm=0.5).tip_heights_mm(x, y))
    assert np.abs(error_nm).max() <= 5.01
    assert np.sqrt((error_nm**2).mean()) == pytest.approx(10 / np.sqrt(12), rel=0.1)


def test_text_comes_in_pieces_and_progress_rises_to_one(small):
    stock = block()
    seen: list[float] = []
    spec = replace(FINISH, pitch_mm=0.005)
    pieces = generate_program(
        small, spec, stock, stock_top=top_of(stock), post=GRBL, slope_error_rad=1e-4, on_progress=seen.append
    )
    sizes = [len(piece) for piece in pieces]
    assert len(sizes) > 2
    assert max(sizes) < 3 * CHUNK_BYTES
    assert min(sizes[:-1]) >= CHUNK_BYTES
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    assert seen[0] < 0.1


def test_jobs_that_cannot_be_done_are_refused_before_the_first_block(small):
    stock, top = block(), top_of(block())

    def first(lens=small, spec=FINISH, stock=stock, **options):
        return next(generate_program(lens, spec, stock, stock_top=top, post=GRBL, **options))

    with pytest.raises(StockTooThinError) as thin:
        first(stock=replace(stock, thickness_mm=1.0))
    assert thin.value.lowest_mm < -1.1
    with pytest.raises(SafeHeightError):
        first(safe_z_mm=0.2)
    with pytest.raises(PassValueError):
        first(stock=replace(stock, width_mm=7.0))
    with pytest.raises(PassValueError):
        first(slope_error_rad=0.0)
    ripples = make_lens(lambda x, y: 0.05 * np.sin(9 * x) - 0.2 + 0 * y, width_mm=W, height_mm=H)
    with pytest.raises(CutterTooLargeError) as large:
        first(lens=ripples, spec=replace(FINISH, radius_mm=2.0))
    assert large.value.largest_mm <= large.value.nearly_mm < 1 / (81 * 0.05)
    assert 0.2 < large.value.reached_share < 0.9


def test_golden_program():
    """A tiny pass as readable lines. Set CAUSTICMILL_REWRITE_GOLDEN=1 to write it anew, then read the diff."""
    lens = make_lens(lambda x, y: -0.9 + 0.05 * x + 0.04 * y * y, width_mm=2.0, height_mm=1.5)
    stock = Stock(width_mm=2, height_mm=1.5, thickness_mm=3, margin_mm=1)
    spec = ball_pass("tiny", radius_mm=0.5, pitch_mm=0.5, stock_to_leave_mm=0.05, step_down_mm=0.5)
    text = b"".join(generate_program(lens, spec, stock, stock_top=StockGrid.block(stock, 0.1), post=GRBL))
    if os.environ.get(REWRITE):
        GOLDEN.parent.mkdir(exist_ok=True)
        GOLDEN.write_bytes(text)
    assert text == GOLDEN.read_bytes()
