"""Facing leaves Z0 and nothing else; cutting out leaves the lens and its tabs; the check sees where it is not so."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.around.check import AroundCheck, CheckedMill, check_cut_out, check_facing
from cam.around.paths import (
    aperture_corners,
    find_highest_along,
    make_cut_out_paths,
    make_facing_paths,
    offset_loop,
    segment_distances,
)
from cam.around.specs import CutOut, Facing
from cam.cutters import CUTTERS, CutterShape
from cam.errors import OutlineError, PassValueError, SafeHeightError
from cam.moves import Path, cut, rapid
from cam.parts import PartLimits, PassFrame, programs
from cam.passes import Stock
from cam.posts.dialects import POSTS
from cam.reading.gcode import LANGUAGES
from cam.surface.stock_grid import StockGrid
from tests.cam.checks import MILL

SAFE_Z = 5.0
STOCK = Stock(width_mm=12, height_mm=8, thickness_mm=6, margin_mm=5)
FACING = Facing(
    above_mm=1.2, shape="flat", radius_mm=2, pitch_mm=2.4, step_down_mm=0.5, feed_mm_per_min=1000,
    plunge_mm_per_min=300, spindle_rpm=12000,
)  # fmt: skip
CUT_OUT = CutOut(
    radius_mm=1.5, tabs=3, tab_width_mm=2, tab_height_mm=1, through_mm=0, step_down_mm=1.5, feed_mm_per_min=500,
    plunge_mm_per_min=200, spindle_rpm=12000,
)  # fmt: skip
STAR = np.array([[6, 0], [8, 3], [12, 4], [8, 5], [6, 8], [4, 5], [0, 4], [4, 3]], dtype=float)
ELLIPSE = np.array([[6 + 6 * cos(k * pi / 32), 4 + 4 * sin(k * pi / 32)] for k in range(64)])
DIALECTS = sorted(POSTS)


def mill_of(dialect: str) -> CheckedMill:
    digits = POSTS[dialect].digits
    return CheckedMill(
        kinematics=MILL, safe_z_mm=SAFE_Z, language=LANGUAGES[dialect],
        digit_mm=digits.z_mm, xy_digit_mm=digits.xy_mm,
    )  # fmt: skip


def written(paths: list[Path], *, dialect: str = "grbl", limits: PartLimits | None = None) -> list[list[bytes]]:
    frame = PassFrame(
        remarks=("around",), rpm=12000, plunge_mm_per_min=300, safe_z_mm=SAFE_Z,
        aperture_mm=(STOCK.width_mm, STOCK.height_mm),
    )  # fmt: skip
    return [list(text) for text in programs(paths, POSTS[dialect], frame, limits)]


def raw(above_mm: float, cell_mm: float = 0.1) -> StockGrid:
    block = StockGrid.block(STOCK, cell_mm)
    top_mm = np.full(block.top_mm.shape, above_mm)
    return StockGrid(x0_mm=block.x0_mm, y0_mm=block.y0_mm, cell_mm=cell_mm, top_mm=top_mm)


def faced(facing: Facing, paths: list[Path] | None = None, *, dialect: str = "grbl", **more) -> AroundCheck:
    paths = paths if paths is not None else list(make_facing_paths(facing, STOCK, safe_z_mm=SAFE_Z))
    parts = written(paths, dialect=dialect, **more)
    return check_facing(parts, facing, stock=STOCK, stock_top=raw(facing.above_mm), mill=mill_of(dialect))


def cut_free(
    cut_out: CutOut,
    corners: np.ndarray,
    paths: list[Path] | None = None,
    *,
    dialect: str = "grbl",
    stock_top: StockGrid | None = None,
    **more,
) -> AroundCheck:
    top = stock_top or raw(0.0)
    loop = offset_loop(corners, cut_out.radius_mm, allowance_mm=0.005 + POSTS[dialect].digits.xy_mm)
    if paths is None:
        high = find_highest_along(loop, cut_out.radius_mm, top)
        paths = list(make_cut_out_paths(cut_out, STOCK, loop, top_mm=high, safe_z_mm=SAFE_Z))
    return check_cut_out(
        written(paths, dialect=dialect, **more), cut_out, stock=STOCK, stock_top=top, mill=mill_of(dialect),
        corners_mm=corners, loop_mm=loop,
    )  # fmt: skip


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_flat_cutter_leaves_the_whole_block_at_z0_and_nothing_below(dialect: str) -> None:
    check = faced(FACING, dialect=dialect)
    assert check.ok, check.faults
    assert (check.stock_top.top_mm == 0).all()
    assert check.bounds["z"] == [0.0, SAFE_Z]
    assert check.max_engagement_mm == pytest.approx(0.4, abs=0.02)


def test_a_ball_leaves_no_more_than_its_cusps() -> None:
    ball = replace(FACING, shape="ball", pitch_mm=0.5)
    check = faced(ball)
    assert check.ok, check.faults
    assert 0.9 * ball.cusp_mm < check.stock_top.top_mm.max() <= ball.cusp_mm
    assert check.stock_top.top_mm.min() >= 0


def test_a_shape_lies_between_the_flat_end_mill_and_the_ball() -> None:
    """Its cusps are the ball's between rows that its flat part does not reach."""
    flat, ball, bull = CUTTERS["flat"], CUTTERS["ball"], CutterShape(name="bull", corner_share=0.25, pitch_share=1.0)
    assert [shape.widest_pitch_mm(2.0) for shape in (flat, bull, ball)] == [4.0, 3.5, 2.0]
    assert flat.cusp_mm(2.0, 4.0) == bull.cusp_mm(2.0, 3.0) == 0.0
    assert ball.cusp_mm(2.0, 0.4) == pytest.approx(2.0 - (4.0 - 0.04) ** 0.5, rel=1e-12)
    assert bull.cusp_mm(2.0, 3.2) == pytest.approx(ball.cusp_mm(0.5, 0.2), rel=1e-12)
    with pytest.raises(PassValueError, match="flat, ball"):
        replace(FACING, shape="cone")


@settings(max_examples=20, deadline=None)
@given(st.floats(0.05, 3.5), st.floats(0.5, 3), st.floats(0.3, 2.0), st.floats(0.1, 2))
def test_any_facing_passes_its_own_check(above_mm, radius_mm, pitch_share, step_down_mm) -> None:
    facing = replace(
        FACING, above_mm=above_mm, radius_mm=radius_mm, pitch_mm=pitch_share * radius_mm, step_down_mm=step_down_mm
    )
    assert faced(facing).faults == ()


def test_a_facing_that_is_wrong_is_found() -> None:
    def with_points(change) -> list[Path]:
        return [
            replace(path, points_mm=change(path.points_mm.copy())) if path.feed_mm_per_min == 1000 else path
            for path in make_facing_paths(FACING, STOCK, safe_z_mm=SAFE_Z)
        ]

    def deeper(points):
        return points - np.array([0, 0, 0.01])

    def rows_left_out(points):
        return np.concatenate([points[:6], points[10:]])

    assert any("below Z0" in fault for fault in faced(FACING, with_points(deeper)).faults)
    assert any("left above Z0" in fault for fault in faced(FACING, with_points(rows_left_out)).faults)
    one_layer = replace(FACING, step_down_mm=2)
    paths = list(make_facing_paths(one_layer, STOCK, safe_z_mm=SAFE_Z))
    assert any("in one cut" in fault for fault in faced(FACING, paths).faults)


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("corners", [aperture_corners(STOCK), ELLIPSE, STAR], ids=["rectangle", "ellipse", "star"])
def test_the_lens_is_cut_free_but_for_tabs_as_high_and_wide_as_asked(corners: np.ndarray, dialect: str) -> None:
    """And not a cell of it is touched, nor does the cutter come nearer to it than by its radius."""
    check, digit_mm = cut_free(CUT_OUT, corners, dialect=dialect), POSTS[dialect].digits.z_mm
    assert check.ok, check.faults
    assert [tab.height_mm for tab in check.tabs] == pytest.approx([1.0] * 3, abs=0.01 + 1.5 * digit_mm)
    assert check.clear_um is not None and 0 <= check.clear_um < 25
    assert check.gouge_um == check.left_um == 0
    assert check.entries == 1
    assert check.max_engagement_mm <= 1.5 * 1.05 + 0.015
    through = check.stock_top.top_mm <= -STOCK.thickness_mm + digit_mm
    assert through.any()
    assert check.bounds["z"][0] == pytest.approx(-6, abs=1e-9)


@settings(max_examples=20, deadline=None)
@given(
    st.floats(0.4, 2.0), st.integers(0, 4), st.floats(0.5, 3), st.floats(0.3, 2.5), st.floats(0.3, 3), st.floats(0, 0.5)
)
def test_any_cut_out_that_fits_passes_its_own_check(radius_mm, tabs, width_mm, height_mm, step_down_mm, through_mm):
    task = CutOut(
        radius_mm=radius_mm, tabs=tabs, tab_width_mm=width_mm, tab_height_mm=height_mm, through_mm=through_mm,
        step_down_mm=step_down_mm, feed_mm_per_min=500, plunge_mm_per_min=200, spindle_rpm=12000,
    )  # fmt: skip
    try:
        check = cut_free(task, aperture_corners(STOCK))
    except PassValueError as error:
        assert error.name == "tabs"
        return
    assert check.faults == ()
    assert len(check.tabs) == tabs


def test_the_stock_that_passes_have_left_is_where_the_first_ramp_begins() -> None:
    """A moat 2 mm deep around the lens: nothing is cut in the air above it, and the first layer is one step."""
    low = replace_top(raw(0.0), lambda x, y: np.where((x > -5) & (x < 17) & (y > -5) & (y < 13), -2.0, 0.0))
    whole, deep = cut_free(CUT_OUT, ELLIPSE), cut_free(CUT_OUT, ELLIPSE, stock_top=low)
    assert deep.ok, deep.faults
    assert deep.time_s < 0.85 * whole.time_s


def replace_top(grid: StockGrid, height) -> StockGrid:
    return StockGrid(
        x0_mm=grid.x0_mm, y0_mm=grid.y0_mm, cell_mm=grid.cell_mm,
        top_mm=height(grid.x_mm[None, :], grid.y_mm[:, None]),
    )  # fmt: skip


def test_a_cut_out_that_is_wrong_is_found() -> None:
    corners = aperture_corners(STOCK)
    loop = offset_loop(corners, CUT_OUT.radius_mm)

    def paths_of(task: CutOut, way: np.ndarray = loop) -> list[Path]:
        return list(make_cut_out_paths(task, STOCK, way, top_mm=0.0, safe_z_mm=SAFE_Z))

    def faults(paths: list[Path]) -> str:
        return "\n".join(cut_free(CUT_OUT, corners, paths).faults)

    assert faults(paths_of(CUT_OUT)) == ""
    assert "into the lens" in faults(paths_of(CUT_OUT, loop + 0.02))
    assert "of the lens itself" in faults(paths_of(CUT_OUT, loop + 0.2))
    assert "the tab at" in faults(paths_of(replace(CUT_OUT, tabs=0)))
    assert "the tab at" in faults(paths_of(replace(CUT_OUT, tab_height_mm=0.8)))
    assert "the tab at" in faults(paths_of(replace(CUT_OUT, tab_width_mm=1.0)))
    assert "left in the slot" in faults(paths_of(replace(CUT_OUT, tab_height_mm=1.0))[:-3])
    assert "in one cut" in faults(paths_of(replace(CUT_OUT, step_down_mm=3.0)))
    assert "goes to Z-6.1" in faults(paths_of(replace(CUT_OUT, through_mm=0.1)))
    x, y = loop[0]
    assert "is a rapid" in faults([*paths_of(CUT_OUT), rapid((x, y, -1))])
    still = [*paths_of(CUT_OUT)]
    assert "beyond the block" in faults([*still, rapid((-30, 0, SAFE_Z))])
    for to_mm in (2, SAFE_Z):  # a move that rises on its way crosses low, too
        assert "below the safe height" in faults([*still, rapid((x, y, SAFE_Z), (x, y, 2)), rapid((x + 1, y, to_mm))])


RAYS = st.lists(
    st.tuples(st.floats(0, 2 * pi), st.floats(0.4, 1)), min_size=3, max_size=9, unique_by=lambda ray: round(ray[0], 1)
)


@settings(max_examples=40, deadline=None)
@given(RAYS, st.floats(0.3, 3))
def test_the_way_around_any_outline_keeps_the_radius_or_is_refused(rays, radius_mm) -> None:
    """And nowhere is farther from a convex one than that and the allowance: nothing of the block hangs on."""
    angles = np.array(sorted(angle for angle, _ in rays))
    if np.diff(np.append(angles, angles[0] + 2 * pi)).max() > 0.95 * pi:
        return  # the middle is not inside
    reach = np.array([length for _, length in sorted(rays)])
    corners = 20 * reach[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    try:
        loop = offset_loop(corners, radius_mm)
    except OutlineError as error:
        assert error.nearest_mm < radius_mm
        return
    away = segment_distances(loop[:-1], loop[1:], corners)
    assert away.min() >= radius_mm
    assert (loop[0] == loop[-1]).all()
    area = np.sum(loop[:-1, 0] * loop[1:, 1] - loop[1:, 0] * loop[:-1, 1]) / 2
    assert area < 0  # clockwise: climbing, with the lens on the right
    if (reach == reach[0]).all():
        assert away.max() <= radius_mm + 0.0051


def test_a_pocket_behind_a_narrow_mouth_cannot_be_cut_out_in_one_line() -> None:
    pocket = np.array(
        [[0, 0], [12, 0], [12, 8], [6.5, 8], [6.5, 7], [9, 7], [9, 2], [3, 2], [3, 7], [5.5, 7], [5.5, 8], [0, 8]],
        dtype=float,
    )
    with pytest.raises(OutlineError, match="mouth too narrow"):
        offset_loop(pocket, 1.0)


def test_what_cannot_be_is_refused_before_the_first_move() -> None:
    loop = offset_loop(ELLIPSE, 1.5)
    with pytest.raises(PassValueError, match=r"tabs = 9 .*at most"):
        list(make_cut_out_paths(replace(CUT_OUT, tabs=9), STOCK, loop, top_mm=0.0, safe_z_mm=SAFE_Z))
    with pytest.raises(SafeHeightError):
        list(make_cut_out_paths(CUT_OUT, STOCK, loop, top_mm=0.0, safe_z_mm=0.5))
    with pytest.raises(SafeHeightError, match=r"at least 2\.2"):
        list(make_facing_paths(FACING, STOCK, safe_z_mm=2.0))
    with pytest.raises(PassValueError, match="pitch_mm"):
        replace(FACING, pitch_mm=4.1)


def test_a_cut_out_may_be_split_into_programs() -> None:
    """Each comes down into the slot of the one before; together they leave what the whole one leaves."""
    whole = cut_free(CUT_OUT, ELLIPSE)
    split = cut_free(CUT_OUT, ELLIPSE, limits=PartLimits(most_bytes=3000))
    assert split.ok, split.faults
    np.testing.assert_allclose(split.stock_top.top_mm, whole.stock_top.top_mm, atol=0.06)
    assert split.lines > whole.lines


def test_a_cut_with_the_spindle_off_is_found() -> None:
    paths = [rapid((-8, 0, SAFE_Z), (-8, 0, 2.2)), cut([(-8, 0, 0.8), (20, 0, 0.8)], 500), rapid((20, 0, SAFE_Z))]
    text = [b"".join(piece for piece in written(paths)[0]).replace(b"M3S12000\n", b"")]
    check = check_facing([text], FACING, stock=STOCK, stock_top=raw(1.2), mill=mill_of("grbl"))
    assert any("spindle off" in fault for fault in check.faults)
