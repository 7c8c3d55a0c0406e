"""How a contour pass is judged: no track may be missing anywhere, and the report says how the path runs."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from cam.checking.check import PassCheck, check_program
from cam.passes import Stock, ball_pass
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield
from tests.cam.checks import MILL

SIDE, RADIUS, PITCH = 4.0, 0.5, 0.1
STOCK = Stock(width_mm=SIDE, height_mm=SIDE, thickness_mm=10, margin_mm=2)
SPEC = replace(
    ball_pass("finish", radius_mm=RADIUS, pitch_mm=PITCH, stock_to_leave_mm=0.0, step_down_mm=0.1), strategy="contour"
)


@pytest.fixture(scope="module")
def bowl() -> Heightfield:
    """Half a hollow along x: contour lines run along y."""
    x = np.linspace(0, SIDE, 81)
    return Heightfield.on_aperture(np.tile(-1.2 + 0.06 * x**2, (81, 1)), width_mm=SIDE, height_mm=SIDE)


@pytest.fixture(scope="module")
def path(bowl):
    """(n, 3) tips on columns along y, there and back, on the lens and one radius beyond."""
    surface = bowl.spline_with_run_out(2.0)
    y = np.linspace(-RADIUS, SIDE + RADIUS, 126)
    x = np.linspace(-RADIUS, SIDE + RADIUS, round((SIDE + 2 * RADIUS) / PITCH) + 1)
    xy = np.concatenate([np.column_stack([np.full(126, v), y[:: 1 - 2 * (k % 2)]]) for k, v in enumerate(x)])
    u, v = xy.T.copy()
    for _ in range(100):
        h, hx, hy = surface.jets(u, v)[:3]
        q = np.sqrt(1 + hx**2 + hy**2)
        u, v = xy[:, 0] + RADIUS * hx / q, xy[:, 1] + RADIUS * hy / q
    return np.column_stack([xy, h + RADIUS / q - RADIUS])


def check(points, lens, spec=SPEC, told=None) -> PassCheck:
    first = points[0]
    lines = ["G21 G90 G94 G17 G54", "G0 Z5", "M3 S24000", "G4 P1", f"G0 X{first[0]:.4f} Y{first[1]:.4f}"]
    lines += [f"G1 Z{first[2]:.5f} F300", "F600", *(f"X{x:.4f} Y{y:.4f} Z{z:.5f}" for x, y, z in points[1:])]
    text = "\n".join([*lines, "G0 Z5", "M5", "M2", ""]).encode()
    block = StockGrid.block(STOCK, 0.05)
    grid = np.meshgrid(block.x_mm, block.y_mm)
    return check_program(
        [text],
        heightfield=lens,
        spec=spec,
        stock=STOCK,
        stock_top=replace(block, top_mm=lens.spline_with_run_out(3.0).heights_mm(*grid) + 0.03),
        kinematics=MILL,
        safe_z_mm=5.0,
        total_bytes=len(text),
        on_progress=None if told is None else told.append,
    )


@pytest.mark.thorough
def test_a_whole_path_passes_and_is_described(bowl, path):
    told: list[float] = []
    result = check(path, bowl, told=told)
    assert result.ok, result.faults
    assert result.max_gap_mm == pytest.approx(PITCH, abs=1.5e-4)
    report = json.loads(json.dumps(result.as_report()))
    assert set(report["contour"]) == {"aligned_share", "length_ratio", "turns_over_60_per_m", "tight_turn_share"}
    assert report["contour"]["aligned_share"] == 1.0
    assert report["contour"]["length_ratio"] == pytest.approx((51 * 5 + 50 * PITCH) * PITCH / SIDE**2, rel=2e-3)
    assert report["contour"]["turns_over_60_per_m"] == pytest.approx(100 / 260 * 1000, rel=0.01)  # two at each end
    assert told == sorted(told) and told[-1] == pytest.approx(1.0)
    assert "contour" not in check(path, bowl, replace(SPEC, strategy="raster")).as_report()


@pytest.mark.parametrize("missing_mm", [0.12, 0.4, 1.6])
def test_a_stretch_left_out_is_a_fault_with_its_place_and_width(bowl, path, missing_mm):
    """The tool rises by a twentieth of a millimetre along one track: shorter than two pitches, and longer."""
    middle = np.array([2.3, 1.7])
    over = (abs(path[:, 0] - middle[0]) < 1e-6) & (abs(path[:, 1] - middle[1]) < missing_mm / 2 + 1e-9)
    result = check(np.where(over[:, None], path + np.array([0, 0, 0.05]), path), bowl)
    (fault,) = [fault for fault in result.faults if "mm apart" in fault]
    x, y = (float(v) for v in re.search(r"X(\S+) Y(\S+)", fault).groups())
    missing = (over.sum() + 1) * 0.04  # the moves up and down count as missing as well
    wanted = min(2 * PITCH, PITCH + missing**2 / (4 * PITCH))
    assert result.max_gap_mm == pytest.approx(wanted, abs=2e-4)
    assert np.hypot(x - middle[0], y - middle[1]) < max(PITCH, missing_mm)
    assert "allowed 0.1022" in fault or "allowed 0.1021" in fault


def test_a_track_that_hovers_is_missing_and_one_that_gouges_is_judged_as_ever(bowl, path):
    deep = path.copy()
    deep[3000, 2] -= 0.01
    faults = check(deep, bowl).faults
    assert len(faults) == 1 and "below the lens" in faults[0]


def test_rows_wider_than_the_pitch_are_no_contour_pass(bowl, path):
    """1.05 pitches: a raster may, rows are only counted there; a contour pass is scanned to 1.02."""
    spec = replace(SPEC, pitch_mm=PITCH / 1.05)
    assert any("mm apart" in fault for fault in check(path, bowl, spec).faults)
    assert check(path, bowl, replace(spec, strategy="raster")).ok
