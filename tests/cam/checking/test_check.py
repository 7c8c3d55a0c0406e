"""The check finds what it must find, names line and place, and passes a good program.

Most programs are made here, slowly and simply: contact points by fixed-point iteration on the offset of the spline.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from cam.checking.check import UNCUT_ALLOWED_MM, PassCheck, check_program
from cam.checking.clearance import SurfaceWitness
from cam.passes import Clamp, PassSpec, Stock, ball_pass
from cam.posts.dialects import GRBL
from cam.reading import gcode
from cam.reading.gcode import ProgramError
from cam.surface.stock_grid import StockGrid
from cam.surface.stock_left import ExcessFound, StockLeft, Unreached, _deepest_in, find_excess
from optics.heightfield import Heightfield
from tests.cam.checks import MILL
from tests.cam.lenses import brute_force, make_lens
from tests.cam.programs import generate_program, read_program

WIDTH, HEIGHT, RADIUS, PITCH, SAFE = 6.0, 4.0, 0.5, 0.1, 5.0
STOCK = Stock(width_mm=WIDTH, height_mm=HEIGHT, thickness_mm=10, margin_mm=2)
SPEC = PassSpec(
    name="finish",
    radius_mm=RADIUS,
    pitch_mm=PITCH,
    stock_to_leave_mm=0.0,
    step_down_mm=0.1,
    feed_mm_per_min=600,
    plunge_mm_per_min=300,
    spindle_rpm=24000,
)
CELL = 0.05
HEAD = ["G21 G90 G94 G17 G54", f"G0 Z{SAFE:g}", "M3 S24000", "G4 P1"]
TAIL = [f"G0 Z{SAFE:g}", "M5", "M2"]


def bumpy(hollow=0.0) -> Heightfield:
    """Two soft bumps and a dent; `hollow` digs a pit of 0.15 mm that no ball of 0.5 mm can reach into."""
    x, y = np.meshgrid(np.linspace(0, WIDTH, 121), np.linspace(0, HEIGHT, 81))

    def bump(cx, cy, s):
        return np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * s * s))

    z = -0.8 + 0.4 * bump(1.5, 1.2, 1.0) + 0.3 * bump(4.6, 3.0, 0.8) - 0.25 * bump(4.0, 0.8, 0.9)
    return Heightfield.on_aperture(z - hollow * bump(3.0, 2.0, 0.15), width_mm=WIDTH, height_mm=HEIGHT)


def tips(surface, x, y, radius_mm=RADIUS):
    """Tip heights of the ball on the surface: the contact u solves u = x + R h_x / q, a contraction here."""
    u, v = x.copy(), y.copy()
    for _ in range(200):
        h, hx, hy = surface.jets(u, v)[:3]
        q = np.sqrt(1 + hx**2 + hy**2)
        u, v = x + radius_mm * hx / q, y + radius_mm * hy / q
    return h + radius_mm / q - radius_mm


def raster(lens, *, step=0.04, rows=None):
    """(n, 3) zigzag over the aperture grown by the radius, tips on the lens; `rows` picks some of the rows."""
    surface = lens.spline_with_run_out(2 * RADIUS)
    x = np.linspace(-RADIUS, WIDTH + RADIUS, round((WIDTH + 2 * RADIUS) / step) + 1)
    y = np.linspace(-RADIUS, HEIGHT + RADIUS, round((HEIGHT + 2 * RADIUS) / PITCH) + 1)
    lines = [np.column_stack([x, np.full(x.size, v)])[:: 1 - 2 * (k % 2)] for k, v in enumerate(y)]
    xy = np.concatenate([line for k, line in enumerate(lines) if rows is None or rows(k)])
    return np.column_stack([xy, tips(surface, xy[:, 0], xy[:, 1])])


def blocks(points, feed=600):
    return [f"X{x:.5f} Y{y:.5f} Z{z:.6f}" for x, y, z in points[1:]], (
        f"G0 X{points[0][0]:.5f} Y{points[0][1]:.5f}",
        f"G1 Z{points[0][2]:.6f} F300",
        f"F{feed}",
    )


def program(points) -> list[str]:
    cuts, entry = blocks(points)
    return [*HEAD, *entry, *cuts, *TAIL]


def over(lens, leave) -> StockGrid:
    """Stock that stands `leave` over the lens, and fills the margin up to just under the run-out's tips."""
    grid = StockGrid.block(STOCK, CELL)
    x, y = np.meshgrid(grid.x_mm, grid.y_mm)
    return replace(grid, top_mm=lens.spline_with_run_out(3.0).heights_mm(x, y) + leave)


def check(lines, lens, *, leave=0.03, spec=SPEC, before=None, **changes) -> PassCheck:
    settings = {
        "heightfield": lens,
        "spec": spec,
        "stock": STOCK,
        "stock_top": over(lens, leave) if before is None else before,
        "kinematics": MILL,
        "safe_z_mm": SAFE,
    }
    return check_program(["\n".join(lines).encode() + b"\n"], **{**settings, **changes})


@pytest.fixture(scope="module")
def lens():
    return bumpy()


@pytest.fixture(scope="module")
def path(lens):
    return raster(lens)


@pytest.fixture(scope="module")
def good(lens, path):
    return check(program(path), lens)


def named_line(fault: str) -> int:
    found = re.match(r"line (\d+) at X", fault)
    assert found, fault
    return int(found[1])


def test_a_good_program_passes_and_is_measured(good, path):
    assert good.ok, good.faults
    assert good.gouge_um < 0.1  # chords 0.04 mm long between exact tips sag k s^2 / 8, k < 0.5
    assert good.entries == 1
    assert good.max_gap_mm == pytest.approx(PITCH, rel=0.01) and good.max_gap_mm <= PITCH * 1.0001
    cusp_um = 1000 * PITCH**2 / 8 / RADIUS
    assert 0.8 * cusp_um < good.excess_um < 1.4 * cusp_um  # slope and convexity raise it
    assert 0.9 < good.excess_ratio < 1.05
    assert 0.02 < good.max_engagement_mm < 0.045
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    air = 2 * SAFE - path[0, 2] - path[-1, 2]
    assert good.path_length_mm == pytest.approx(length + air, rel=1e-6)
    assert good.time_s > length / 10 + 1
    np.testing.assert_allclose(good.bounds["x"], [-RADIUS, WIDTH + RADIUS], atol=1e-5)
    np.testing.assert_allclose(good.bounds["z"], [path[:, 2].min(), SAFE], atol=1e-5)
    assert good.unreached == () and good.unreached_share == 0


def test_the_stock_left_is_the_lens_and_its_cusps(good, lens):
    grid = good.stock_top
    x, y = np.meshgrid(grid.x_mm, grid.y_mm)
    inside = (x > 0) & (y > 0) & (x < WIDTH) & (y < HEIGHT)
    over_um = 1000 * (grid.top_mm - lens.spline().heights_mm(x, y))[inside]
    assert over_um.min() > -0.1
    assert over_um.max() < 5
    assert len(good.windows) == 9
    assert all(w.lowest_um > -0.1 and w.highest_um < 1.1 * w.cusp_theory_um for w in good.windows)


def test_the_report_is_plain_json_with_the_named_keys(good, path):
    report = json.loads(json.dumps(good.as_report()))
    wanted = {"lines", "bytes", "path_length_mm", "time_s", "entries", "max_engagement_mm", "gouge_um", "max_gap_mm"}
    assert wanted | {"bounds", "ok", "faults"} <= set(report)
    assert report["lines"] == len(program(path))


@pytest.mark.parametrize("depth_um", [2.0, 20.0])
@pytest.mark.parametrize("at", [0.31, 0.5, 0.77])
def test_a_gouge_is_found_and_named(lens, path, depth_um, at):
    """One vertex too low: a dent some hundredths of a millimetre wide, between the cells of the whole part."""
    k = int(np.argmin(np.hypot(path[:, 0] - WIDTH * at, path[:, 1] - HEIGHT * at)))
    bad = path.copy()
    bad[k, 2] -= depth_um / 1000
    result = check(program(bad), lens)
    assert not result.ok and len(result.faults) == 1
    assert result.gouge_um == pytest.approx(depth_um, rel=0.02)
    assert abs(named_line(result.faults[0]) - (len(HEAD) + 3 + k)) <= 1
    x, y = (float(v) for v in re.search(r"X(\S+) Y(\S+)", result.faults[0]).groups())
    assert np.hypot(x - bad[k, 0], y - bad[k, 1]) < RADIUS * 0.5
    assert "allowed 1 µm" in result.faults[0]


def test_a_dent_too_small_to_matter_is_measured_but_allowed(lens, path):
    bad = path.copy()
    bad[len(bad) // 2, 2] -= 0.0005
    result = check(program(bad), lens)
    assert result.ok and result.gouge_um == pytest.approx(0.5, rel=0.1)


def test_a_rapid_through_stock_is_found(lens, path):
    cuts, entry = blocks(path)
    half = len(cuts) // 2
    x, y, _ = path[half]
    back = [f"Z{SAFE:g}", f"X{x:.5f} Y{y:.5f}", f"G1 Z{path[half, 2]:.6f} F600"]
    crash = [f"G0 Z{SAFE:g}", "G0 X5 Y3.5", "Z-0.6", *back]
    result = check([*HEAD, *entry, *cuts[:half], *crash, *cuts[half:], *TAIL], lens)
    through = [fault for fault in result.faults if "rapid through stock" in fault]
    assert len(through) == 1
    assert named_line(through[0]) == len(HEAD) + len(entry) + half + 3
    assert not any("below the safe height" in fault for fault in result.faults)  # straight down


@pytest.mark.parametrize("gap_mm", [0.45, 0.55])
def test_a_rapid_may_go_straight_down_to_half_a_millimetre_above_the_stock(lens, path, gap_mm):
    """The stock of 0.03 mm over the lens is met first where a ball that much larger touches."""
    met = tips(lens.spline_with_run_out(3.0), path[:1, 0], path[:1, 1])[0] + 0.03
    lines = program(path)
    lines.insert(len(HEAD) + 1, f"Z{met + gap_mm:.4f}")
    result = check(lines, lens)
    assert result.ok is (gap_mm > 0.5), result.faults
    if not result.ok:
        assert len(result.faults) == 1 and named_line(result.faults[0]) == len(HEAD) + 2
        assert "to 0.5 mm above it" in result.faults[0]
    assert result.max_engagement_mm < 0.045


@pytest.mark.parametrize("across", ["X0", f"X0 Z{SAFE:g}"])
def test_a_crossing_below_the_safe_height_is_found_even_in_air(lens, path, across):
    crossing = program(path)
    crossing[-3:-3] = ["G0 Z1", across]
    result = check(crossing, lens)
    assert len(result.faults) == 1 and "Z1.000, below the safe height" in result.faults[0]
    assert named_line(result.faults[0]) == len(crossing) - 3


def test_too_deep_a_cut_is_found(lens, path):
    """The same program on stock that stands 0.4 mm over the lens from X3 on: the first row runs into it."""
    before = over(lens, 0.03)
    top = before.top_mm.copy()
    top[:, before.x_mm > 3] += 0.37
    result = check(program(path), lens, before=replace(before, top_mm=top))
    assert "step-down of 0.1 mm" in result.faults[0]
    assert result.max_engagement_mm == pytest.approx(0.4, abs=0.02)
    assert path[named_line(result.faults[0]) - len(HEAD) - 3, 0] > 2.9


def test_a_plunge_into_the_block_counts_its_whole_depth(lens):
    points = np.array([[3.0, 2.0, -0.3], [3.5, 2.0, -0.3]])
    result = check(program(points), lens, before=StockGrid.block(STOCK, CELL))
    assert result.max_engagement_mm == pytest.approx(0.3, abs=0.005)
    assert any("step-down" in fault for fault in result.faults)


def test_a_row_left_out_is_a_gap(lens):
    holed = raster(lens, rows=lambda k: k not in (20, 21))
    result = check(program(holed), lens)
    assert result.max_gap_mm == pytest.approx(3 * PITCH, rel=0.02)
    assert any("mm apart" in fault for fault in result.faults)
    assert any("left at" in fault and "could reach" in fault for fault in result.faults)


def test_one_row_left_out_is_a_gap(lens):
    result = check(program(raster(lens, rows=lambda k: k != 20)), lens)
    assert 1.7 * PITCH < result.max_gap_mm <= 2.001 * PITCH  # samples lie at random, one in a cell
    assert any("mm apart" in fault for fault in result.faults)


def test_a_large_ball_on_a_steep_rim_covers_the_corner_from_the_run_out():
    """Over the corner its tip's rows touch the run-out, a millimetre beside the aperture: tracks all the same."""
    x, y = np.meshgrid(np.linspace(0, WIDTH, 61), np.linspace(0, HEIGHT, 41))
    tilted = Heightfield.on_aperture(-0.2 - 0.4 * (x + y), width_mm=WIDTH, height_mm=HEIGHT)
    spec = ball_pass("finish", radius_mm=2.0, pitch_mm=0.3, stock_to_leave_mm=0.0, step_down_mm=1.5)
    before = StockGrid.block(STOCK, CELL)
    text = list(generate_program(tilted, spec, STOCK, stock_top=before, post=GRBL))
    result = check([line for piece in text for line in piece.decode().splitlines()], tilted, spec=spec, before=before)
    assert result.ok, result.faults
    assert result.max_gap_mm <= spec.pitch_mm


def test_a_track_is_seen_to_touch_whichever_flank_it_rests_on():
    """A spike far from the axis carries the ball; under the axis, where the search starts, there is air."""
    spike = make_lens(lambda x, y: 0.9 * np.exp(-(((x - 4.9) / 0.12) ** 2)) - 1.0 + 0.0 * y)
    tip = brute_force(spike.spline(), 4.0, 3.0, 1.2, samples=1201) - 1.2
    text = f"G21G90\nG0Z5\nX3.95Y3\nM3S1\nG1Z{tip + 0.05:.6f}F100\nX4Z{tip:.6f}\n".encode()
    (moves,) = read_program([text])
    touch_mm = SurfaceWitness(spike, radius_mm=1.2, near_mm=0.02).overlaps(moves).touch_mm
    assert tip > -0.9
    assert touch_mm[-1] == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("bend", [0.9, 1.02, 1.2, 1.5])
def test_how_far_a_ball_that_touches_a_valley_lies_in_its_walls(bend):
    """z = k x^2 / 2: by dense sampling along x, whatever the first lattice, to a tenth of a micrometre."""
    valley = make_lens(lambda x, y: bend / 2 * (x - 4) ** 2 - 0.03 * (x - 4) ** 4 - 9.0 + 0.0 * y)
    spline, radius = valley.spline_with_run_out(1.5), 1.0
    x = 4.1
    h, hx = spline.jets([x], [3.0])[:2, 0]
    q = np.hypot(1, hx)
    cx, cz = x - radius * hx / q, h + radius / q
    u = np.linspace(cx - radius, cx + radius, 200_001)
    dense = max(0.0, radius - np.hypot(u - cx, spline.heights_mm(u, np.full(u.size, 3.0)) - cz).min())
    for rings in (12, 17, 24):
        assert _deepest_in(*spline.kernel_arguments, x, 3.0, radius, rings) == pytest.approx(dense, abs=1e-4)


@pytest.mark.parametrize(("cusps", "uncut"), [(3.5, False), (6.0, True)])
def test_a_crease_may_leave_four_cusps_and_no_more(lens, cusps, uncut):
    """A row that just misses where the ball changes flanks leaves the next one a pitch away, not half a pitch."""
    spec = replace(SPEC, pitch_mm=0.2)
    plain = StockLeft.of(over(lens, 0.0), lens, spec)
    raised = replace(plain.grid, top_mm=plain.grid.top_mm + cusps * np.nan_to_num(plain.cusp_mm))
    found = find_excess(StockLeft.of(raised, lens, spec), lens, spec)
    assert (found.uncut_mm > UNCUT_ALLOWED_MM) is uncut


def test_rows_far_apart_have_forgotten_nothing_in_a_creased_lens():
    """12 mm of the lens for `astronaut` behind felt, to the micrometre. The ball touches the ridges in its creases from
    straight above alone; from the rows on either side it rests on a flank, more than some cusps higher.
    """
    with np.load(Path(__file__).with_name("creased_window.npz")) as stored:
        z = stored["arr_0"] / 1000.0
    side_mm = 11.71875
    lens = Heightfield.on_aperture(z - z.max() - 0.1, width_mm=side_mm, height_mm=side_mm)
    stock = Stock(width_mm=side_mm, height_mm=side_mm, thickness_mm=40, margin_mm=13)
    spec = ball_pass("rough", radius_mm=6.0, pitch_mm=2.0, stock_to_leave_mm=0.2, step_down_mm=1.5)
    before = StockGrid.block(stock, 0.1)
    text = b"".join(generate_program(lens, spec, stock, stock_top=before, post=GRBL)).decode().splitlines()
    found = check(text, lens, spec=spec, stock=stock, before=before)
    assert found.ok, found.faults
    left = StockLeft.of(StockGrid(x0_mm=0.0, y0_mm=0.0, cell_mm=0.1, top_mm=np.full((117, 117), -0.05)), lens, spec)
    assert find_excess(left, lens, spec).uncut_mm > 0.5  # what no rows explain


def test_a_pit_the_ball_cannot_enter_is_named_and_is_no_fault():
    pitted = bumpy(hollow=0.2)
    surface = pitted.spline_with_run_out(2 * RADIUS)
    points = raster(bumpy())
    # the highest ball by brute force near the pit, where the contact is not a contraction
    u = np.linspace(-1, 1, 161) * RADIUS * 0.999
    dx, dy = (a.ravel() for a in np.meshgrid(u, u))
    keep = dx**2 + dy**2 < RADIUS**2
    dx, dy = dx[keep], dy[keep]
    dome = np.sqrt(RADIUS**2 - dx**2 - dy**2) - RADIUS
    for k in np.flatnonzero(np.hypot(points[:, 0] - 3, points[:, 1] - 2) < 1.3):
        points[k, 2] = (surface.heights_mm(points[k, 0] + dx, points[k, 1] + dy) + dome).max() + 1e-3
    result = check(program(points), pitted, spec=replace(SPEC, step_down_mm=0.4), leave=0.06)
    assert result.ok, result.faults
    assert len(result.unreached) == 1 and 0 < result.unreached_share < 0.05
    assert np.hypot(result.unreached[0].x_mm - 3, result.unreached[0].y_mm - 2) < 0.1
    assert 30 < result.unreached[0].excess_um < 200
    (note,) = [note for note in result.notes if "reach" in note]
    assert f"cannot reach {100 * result.unreached_share:.2g} % of the lens" in note


def test_what_no_ball_reaches_is_no_share_that_reads_as_nothing():
    """One spot, high enough to be noted: "cannot reach 0.00032 %", with fewer digits "0 %"."""
    spot = Unreached(x_mm=1.0, y_mm=2.0, excess_um=90.2, area_mm2=0.00405)
    found = ExcessFound(excess_um=0.0, uncut_mm=0.0, x_mm=0.0, y_mm=0.0, unreached=(spot,), unreached_share=3.2e-6)
    with patch("cam.checking.check.find_excess", lambda *_: found):
        result = check(program(raster(bumpy())), bumpy())
    (note,) = [note for note in result.notes if "reach" in note]
    assert note == (
        "the ball of radius 0.5 mm does not reach into every crease: it leaves 90 µm on 0.004 mm² at X1.00 Y2.00"
    )


def test_stock_to_leave_is_watched(lens):
    """A roughing pass that should leave 0.05 mm but leaves 0.04: no gouge, but said."""
    spec = replace(SPEC, stock_to_leave_mm=0.05)
    surface = lens.spline_with_run_out(2 * RADIUS)
    points = raster(lens)
    points[:, 2] = tips(surface, points[:, 0], points[:, 1], RADIUS + 0.04) + 0.04
    result = check(program(points), lens, spec=spec, leave=0.12)
    assert result.gouge_um == 0
    assert result.below_leave_um == pytest.approx(10, rel=0.15)


def test_bounds_and_spindle(lens, path):
    far = np.vstack([path, [[WIDTH + 3.5, 2.0, path[-1, 2]]]])
    assert any("beyond the block" in fault for fault in check(program(far), lens).faults)
    silent = [line for line in program(path) if not line.startswith(("M3", "G4"))]
    assert any("spindle off" in fault for fault in check(silent, lens).faults)
    deep = np.vstack([path, path[-1:] - [[0, 0, 11.0]]])
    assert any("below the block" in fault for fault in check(program(deep), lens).faults)
    with pytest.raises(ProgramError, match="line 1,"):
        check(["%", *program(path)], lens)


def test_every_lift_is_an_entry(lens, path):
    cuts, entry = blocks(path)
    lifted = [*HEAD, *entry]
    for k, block in enumerate(cuts, start=1):
        lifted.append(block if k % 1000 else f"G0 Z{SAFE:g}\nX{path[k, 0]:.5f}Y{path[k, 1]:.5f}\nG1 Z{path[k, 2]:.6f}")
    result = check([*lifted, *TAIL], lens)
    assert result.ok, result.faults
    assert result.entries == 1 + len(cuts) // 1000


def test_chunks_and_progress(lens, path, good):
    text = ("\n".join(program(path)) + "\n").encode()
    told: list[float] = []
    pieces = (text[i : i + 5000] for i in range(0, len(text), 5000))
    again = check_program(
        pieces,
        heightfield=lens,
        spec=SPEC,
        stock=STOCK,
        stock_top=over(lens, 0.03),
        kinematics=MILL,
        safe_z_mm=SAFE,
        total_bytes=len(text),
        on_progress=told.append,
    )
    assert again.as_report() == good.as_report()
    np.testing.assert_array_equal(again.stock_top.top_mm, good.stock_top.top_mm)
    assert told[-1] == 1.0


def test_a_fault_is_found_wherever_the_reader_ends_a_batch(lens):
    """With one move a batch, too: what a move takes off is known with the move after it, and may count as two lines."""
    cuts, entry = blocks(raster(lens, rows=lambda k: 10 < k < 14))
    crash = ["G0 Z5", "X5 Y3.5", "Z-0.6", "G1 X5.2 F600", "M5", "X5.4 Y2.5", "M3", "Z-0.9"]
    lines = [*HEAD, *entry, *cuts, *crash, "G0 X5.6", "Z5", "X20", "X1", *TAIL]
    whole = check(lines, lens)
    for words in ("below the lens", "in one cut", "through stock", "spindle off", "safe height", "beyond", "down"):
        assert any(words in fault for fault in whole.faults), words
    with patch.object(gcode, "BATCH_BYTES", 16):
        single = check(lines, lens)
    assert [f.partition("; the worst")[0] for f in single.faults] == [
        f.partition("; the worst")[0] for f in whole.faults
    ]


def test_a_program_that_comes_near_a_clamp_is_refused(lens, path):
    """One in reach of the tips on the run-out, and one that stands just as far away as the check asks for."""
    near = Clamp(x_mm=WIDTH + 1.0, y_mm=1.0, width_mm=1.0, depth_mm=2.0, height_mm=2.0)
    for clamp, refused in ((near, True), (replace(near, x_mm=WIDTH + 2 * RADIUS + 1.001), False)):
        found = check(program(path), lens, stock=replace(STOCK, clamps=(clamp,)))
        assert any("stock.clamps.0" in fault for fault in found.faults) == refused
