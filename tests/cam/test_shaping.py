"""Heights on whole steps for a lens that is finished: what a low pass leaves of their errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from cam.checking.check import check_program
from cam.moves import Path, cut, rapid
from cam.passes import Stock, ball_pass
from cam.posts.dialects import GRBL
from cam.posts.post import Digits
from cam.program import generate_parts
from cam.rows.rounding import Rounding, nearest, on_raster
from cam.shaping import LONGEST_MM, ErrorMemory, ShapedRegion, shape_heights
from cam.surface.stock_grid import StockGrid
from tests.cam.checks import MILL
from tests.cam.lenses import make_bumps

STEP_MM, PITCH_MM, RADIUS_MM, SIDE_MM = 0.004, 0.05, 0.5, 6.0
ROUNDING = Rounding(digits=Digits(xy_mm=STEP_MM, z_mm=STEP_MM), pitch_mm=PITCH_MM)
REGION = ShapedRegion(low_mm=(-1.0, -1.0), high_mm=(SIDE_MM + 1, SIDE_MM + 1), radius_mm=RADIUS_MM)
X_MM = np.arange(0.01, SIDE_MM, 0.02)
Y_MM = np.arange(PITCH_MM, SIDE_MM, PITCH_MM)
FINISH_MM = 0.25  # sigma of the finish: periods of 1.1 mm are halved
SURFACES = {
    "plane": lambda x, y: -0.5 + 0.004 * x + 0.003 * y,
    "paraboloid": lambda x, y: -0.5 + 0.001 * ((x - 2.5) ** 2 + (y - 3.5) ** 2),
}


def rows(height) -> list[np.ndarray]:
    """(n, 3) rows there and back, a vertex every quarter of a millimetre."""
    x = np.linspace(0, SIDE_MM, 25)
    lines = [np.column_stack([x, np.full(x.size, y), height(x, y)]) for y in Y_MM]
    return [line[:: 1 - 2 * (k % 2)] for k, line in enumerate(lines)]


def paths_of(lines) -> list[Path]:
    return [path for line in lines for path in (rapid(line[0]), cut(line[1:], 600))]


def lines_of(paths) -> list[np.ndarray]:
    """What `paths_of` takes."""
    points = [path.points_mm for path in paths]
    return [np.vstack(pair) for pair in zip(points[::2], points[1::2], strict=True)]


def shaped(lines, region=REGION) -> list[np.ndarray]:
    return lines_of(shape_heights(paths_of(lines), ROUNDING, region))


def errors(lines, height) -> np.ndarray:
    """(rows, columns) by which the axis, on its steps within the moves too, stands off the height that is wanted."""
    made = [np.interp(X_MM, *line[np.argsort(line[:, 0])][:, [0, 2]].T) for line in lines]
    return np.round(np.array(made) / STEP_MM) * STEP_MM - height(X_MM[None, :], Y_MM[:, None])


def left_by_ball(off: np.ndarray) -> np.ndarray:
    """(4 rows, columns) lowest of all balls on four lines a pitch, without the scallop's mean."""
    along = np.arange(-12, 13)
    padded = np.pad(off, ((0, 0), (12, 12)), mode="edge")
    off = np.min([padded[:, 12 + d : 12 + d + X_MM.size] + (0.02 * d) ** 2 / (2 * RADIUS_MM) for d in along], axis=0)
    at = (np.arange(4 * len(off)) + 0.5) / 4 - 0.5
    apart = (at[:, None] - np.arange(len(off))[None, :]) * PITCH_MM
    balls = off[None] + (apart**2 / (2 * RADIUS_MM))[:, :, None]
    return np.asarray(balls.min(axis=1) - PITCH_MM**2 / (24 * RADIUS_MM))


def light_behind(surface: np.ndarray, finish_mm: float = FINISH_MM) -> float:
    """Relative error of the light 100 mm away behind the finish: (n - 1) throw times the curvature, rms."""
    dy, dx = PITCH_MM / 4, 0.02
    low = gaussian_filter(surface, (finish_mm / dy, finish_mm / dx), mode="reflect")
    bend = np.gradient(np.gradient(low, dy, axis=0), dy, axis=0) + np.gradient(np.gradient(low, dx, axis=1), dx, axis=1)
    rim_y, rim_x = int(1 / dy), int(1 / dx)
    return float(49 * bend[rim_y:-rim_y, rim_x:-rim_x].std())


@pytest.mark.parametrize(("name", "share"), [("plane", 0.25), ("paraboloid", 0.35)])
def test_behind_a_finish_little_of_the_steps_is_left(name, share):
    """Measured 0.12 and 0.20 of what is left of heights that suit the lens as milled, whose steps make terraces."""
    lines = rows(SURFACES[name])
    before = errors(lines_of(on_raster(paths_of(lines), ROUNDING)), SURFACES[name])
    after = errors(shaped(lines), SURFACES[name])
    assert light_behind(left_by_ball(after)) < share * light_behind(left_by_ball(before))


@pytest.mark.parametrize("name", SURFACES)
def test_the_mean_height_over_a_few_millimetres_is_right(name):
    """To a tenth of a step, of what the ball leaves."""
    left = left_by_ball(errors(shaped(rows(SURFACES[name])), SURFACES[name]))
    squares = left[: 4 * (len(left) // 160) * 40].reshape(-1, 80, 3, 100).mean(axis=(1, 3))  # 1 mm x 2 mm
    assert abs(left[80:-80, 50:-50].mean()) < 0.1 * STEP_MM
    assert np.abs(squares).max() < 0.15 * STEP_MM


@settings(max_examples=10, deadline=None)
@given(*[st.floats(-0.05, 0.05)] * 2, st.floats(-0.02, 0.02), st.floats(0, 1), st.sampled_from([RADIUS_MM, 20.0]))
def test_every_vertex_is_on_the_raster_and_at_most_a_step_below_the_lens(a, b, c, z, radius_mm):
    """Even where the ball is so large that of a high track nothing is left, whatever the aim."""

    def height(x, y):
        return -0.5 + z * STEP_MM + a * x + b * y + c * x * x

    for made in shaped(rows(height)[:30], replace(REGION, radius_mm=radius_mm)):
        np.testing.assert_allclose(made, nearest(made, ROUNDING.digits), atol=1e-9)
        x = np.linspace(0, SIDE_MM, 25)
        off = made[1:, 2] - np.interp(made[1:, 0], x, height(x, made[0, 1]))
        aside = abs(b) * STEP_MM / 2  # of the row, which lies on the raster of Y
        assert -STEP_MM - aside - 1e-8 <= off.min() and off.max() <= 1.5 * STEP_MM + aside + 1e-8
        assert (np.diff(made[:, 0]) * np.sign(made[-1, 0] - made[0, 0]) > 0).all()


def test_rows_along_y_are_those_along_x_with_the_axes_exchanged():
    lines = rows(SURFACES["paraboloid"])
    along_y = shaped([line[:, [1, 0, 2]] for line in lines])
    off = [errors(made, SURFACES["paraboloid"]) for made in (shaped(lines), [one[:, [1, 0, 2]] for one in along_y])]
    first, second = (light_behind(left_by_ball(one)) for one in off)
    assert second == pytest.approx(first, rel=0.02)


def test_a_spiral_over_itself_hands_its_errors_on_as_rows_do():
    """One path whose turns are neighbours: errors binned in the plane, behind the finish."""
    angle = np.cumsum(np.full(9000, 0.1) / np.sqrt(np.linspace(1, 2000, 9000)))
    radius = 0.3 + PITCH_MM * angle / (2 * np.pi)
    x, y = 3 + radius * np.cos(angle), 3 + radius * np.sin(angle)
    inside = radius < 2.8
    line = np.column_stack([x, y, SURFACES["plane"](x, y)])[inside]

    def behind(paths) -> float:
        way = np.vstack([path.points_mm for path in paths])
        run = np.hypot(*np.diff(way[:, :2], axis=0).T)
        at = np.arange(0, run.sum(), 0.01)
        px, py, pz = (np.interp(at, np.concatenate([[0], np.cumsum(run)]), way[:, d]) for d in range(3))
        off = np.round(pz / STEP_MM) * STEP_MM - SURFACES["plane"](px, py)
        total, visits = (np.histogram2d(py, px, 60, ((0, 6), (0, 6)), weights=w)[0] for w in (off, np.ones(off.size)))
        low, seen = (gaussian_filter(a, FINISH_MM / 0.1) for a in (total, visits))
        return float((low / np.maximum(seen, 1e-9))[seen > 0.5 * np.median(seen[seen > 0])].std())

    way = paths_of([line])
    assert behind(shape_heights(way, ROUNDING, REGION)) < 0.6 * behind(on_raster(way, ROUNDING))


def test_memory_is_that_of_the_region_and_paths_are_made_as_they_are_asked_for():
    asked = 0

    def endless():
        nonlocal asked
        while True:
            for path in paths_of(rows(SURFACES["plane"])):
                asked += 1
                yield path

    made = shape_heights(endless(), ROUNDING, REGION)
    for _ in range(500):
        next(made)
    assert asked == 500
    memory = ErrorMemory.over(REGION, ROUNDING)
    assert memory.owed.nbytes + memory.last.nbytes < 5_000 * (SIDE_MM + 2) ** 2  # bytes a square millimetre


def test_vertices_are_hardly_more_on_a_lens():
    """A curved one, whose moves are shorter than the longest that shaping makes."""
    x = np.arange(0, SIDE_MM + 1e-9, LONGEST_MM / 2)
    lines = [np.column_stack([x, np.full(x.size, y), -1 + 0.1 * np.sin(x) * np.cos(y)]) for y in Y_MM[:40]]
    before, after = lines_of(on_raster(paths_of(lines), ROUNDING)), shaped(lines)
    assert sum(map(len, after)) < 1.3 * sum(map(len, before))


LENS = make_bumps(4, relief_mm=0.2, width_mm=3.0, height_mm=2.0)
BLOCK = Stock(width_mm=3.0, height_mm=2.0, thickness_mm=10, margin_mm=1)
SPEC = ball_pass("finish", radius_mm=RADIUS_MM, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.5)
TOP = StockGrid.block(BLOCK, 0.05)


def program(spec=SPEC, *, step_mm: float, shaped: bool) -> bytes:
    parts = generate_parts(LENS, spec, BLOCK, stock_top=TOP, post=GRBL, step_mm=step_mm, shaped=shaped)
    return b"".join(piece for part in parts for piece in part)


def test_heights_finer_than_the_light_shows_are_not_shaped():
    assert program(step_mm=0.0, shaped=True) == program(step_mm=0.0, shaped=False)


@pytest.mark.parametrize("strategy", ["raster", pytest.param("contour", marks=pytest.mark.thorough)])
def test_a_shaped_program_passes_the_check(strategy):
    """It gouges no deeper than the check allows on such steps: one and a half of them."""
    spec = replace(SPEC, strategy=strategy)
    result = check_program(
        [program(spec, step_mm=STEP_MM, shaped=True)],
        heightfield=LENS,
        spec=spec,
        stock=BLOCK,
        stock_top=TOP,
        kinematics=MILL,
        safe_z_mm=5.0,
        digit_mm=STEP_MM,
    )
    assert result.ok, result.faults
    assert result.gouge_um <= 1050 * STEP_MM
