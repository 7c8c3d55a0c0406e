"""A small lens milled to the end: three programs streamed over a pty to the simulated mill, against the path cut."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cam.passes import Stock, ball_pass
from cam.posts.dialects import GRBL
from cam.surface.stock_grid import StockGrid
from machines.simulated import GRBL_11, SimulatedMill
from machines.simulated.endpoints import serve_pty
from optics.heightfield import Heightfield
from tests.cam.programs import generate_program, read_program
from tests.end_to_end.command import ran
from tests.levels import mostly_thorough
from tests.waiting import PATIENCE_S

SIDE_MM = 6.0
STOCK = Stock(width_mm=SIDE_MM, height_mm=SIDE_MM, thickness_mm=10, margin_mm=2)
PASSES = (
    ball_pass("rough", radius_mm=1.5, pitch_mm=0.5, stock_to_leave_mm=0.2, step_down_mm=1.5),
    ball_pass("rough", radius_mm=0.5, pitch_mm=0.2, stock_to_leave_mm=0.03, step_down_mm=2),
    ball_pass("finish", radius_mm=0.5, pitch_mm=0.2, stock_to_leave_mm=0.0, step_down_mm=0.5),
)
# A pty has no wire of its own; at this rate the pacing does not hold up a mill that runs a thousand times as fast.
PROFILE = """
extends = "grbl"
name = "bench"
[link]
baud = 2000000
"""
SPEEDUP = 1000.0


@pytest.fixture(scope="module")
def lens() -> Heightfield:
    x, y = np.meshgrid(*(np.linspace(0, SIDE_MM, 65),) * 2)
    z = 0.3 * np.sin(0.5 * x + y / 6) * y / SIDE_MM
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=SIDE_MM, height_mm=SIDE_MM)


def program_of(lens: Heightfield, number: int) -> bytes:
    """On what the pass before leaves over the lens; the first on a whole block."""
    top = StockGrid.block(STOCK, 0.05)
    if number:
        heights = lens.spline_with_run_out(3.0).heights_mm(*np.meshgrid(top.x_mm, top.y_mm))
        top = replace(top, top_mm=heights + PASSES[number - 1].stock_to_leave_mm)
    return b"".join(generate_program(lens, PASSES[number], STOCK, stock_top=top, post=GRBL))


@pytest.mark.parametrize("number", mostly_thorough(range(3), quick=(0,)))
def test_the_path_cut_is_the_path_programmed(lens: Heightfield, tmp_path: Path, number: int) -> None:
    """Every move of the program is executed once, in order, to where the program says; read by cam's own parser."""
    (tmp_path / "config" / "machines").mkdir(parents=True)
    (tmp_path / "config" / "machines" / "bench.toml").write_text(PROFILE)
    folders = {"CAUSTICMILL_CONFIG_DIR": str(tmp_path / "config"), "XDG_STATE_HOME": str(tmp_path)}
    path = tmp_path / "pass.nc"
    path.write_bytes(program_of(lens, number))
    mill = SimulatedMill(GRBL_11)
    with serve_pty(mill, SPEEDUP) as endpoint:
        told = ["--port", endpoint.url, "--machine", "bench", "--yes"]
        done = ran("stream", path, *told, env={**os.environ, **folders}, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    assert "finished" in done.stdout
    batches = list(read_program([path.read_bytes()]))
    asked = np.concatenate([np.hstack([b.start_mm, b.end_mm])[b.pause_s < 0] for b in batches])
    rapid = np.concatenate([b.is_rapid[b.pause_s < 0] for b in batches])
    moved = np.abs(asked[:, 3:] - asked[:, :3]).max(axis=1) > 0  # a block without motion cuts nothing
    cut = [s for s in mill.recording.segments if s.kind == "program"]
    approach, cut = cut[: -moved.sum()], cut[-moved.sum() :]
    assert len(approach) <= 2
    assert all(s.rapid and s.end[2] > 0 for s in approach)
    assert all(s.whole for s in cut)
    assert [s.rapid for s in cut] == rapid[moved].tolist()
    np.testing.assert_allclose([[*s.start, *s.end] for s in cut], asked[moved], rtol=0, atol=1e-6)
    assert mill.serial.lost_overflow == 0
