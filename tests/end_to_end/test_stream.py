"""A small lens milled to the end: three programs streamed over a pty to the simulated mill, against the path cut."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cam.reading.gcode import read_program
from machines.simulated import GRBL_11, SimulatedMill
from machines.simulated.endpoints import serve_pty
from tests.end_to_end.command import ran
from tests.levels import mostly_thorough
from tests.waiting import PATIENCE_S

SPEC = """
image.pixels = 32
optics = {width_mm = 6, height_mm = 6, throw_mm = 30}
stock.margin_mm = 2
passes = [
    {name = "rough", radius_mm = 1.5, pitch_mm = 0.5, stock_to_leave_mm = 0.2, step_down_mm = 1.5},
    {name = "rough", radius_mm = 0.5, pitch_mm = 0.2, stock_to_leave_mm = 0.03, step_down_mm = 2},
    {name = "finish", radius_mm = 0.5, pitch_mm = 0.1},
]
"""
# A pty has no wire of its own; at this rate the pacing does not hold up a mill that runs a thousand times as fast.
PROFILE = """
extends = "grbl"
name = "bench"
[link]
baud = 2000000
"""
SPEEDUP = 1000.0


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("lens")
    y, x = np.mgrid[0:32, 0:32] / 31
    Image.fromarray(np.rint(120 + 60 * np.sin(3 * x + y) * y).astype(np.uint8)).save(folder / "p.png")
    (folder / "spec.toml").write_text(SPEC)
    done = ran("make", folder / "p.png", "-o", folder / "job", "--spec", folder / "spec.toml", "-q")
    assert done.returncode == 0, done.stderr
    return sorted((folder / "job").glob("pass-*.nc"))


@pytest.mark.parametrize("number", mostly_thorough(range(3), quick=(0,)))
def test_the_path_cut_is_the_path_programmed(programs: list[Path], tmp_path: Path, number: int) -> None:
    """Every move of the program is executed once, in order, to where the program says; read by cam's own parser."""
    (tmp_path / "config" / "machines").mkdir(parents=True)
    (tmp_path / "config" / "machines" / "bench.toml").write_text(PROFILE)
    folders = {"CAUSTICMILL_CONFIG_DIR": str(tmp_path / "config"), "XDG_STATE_HOME": str(tmp_path)}
    mill = SimulatedMill(GRBL_11)
    with serve_pty(mill, SPEEDUP) as endpoint:
        told = ["--port", endpoint.url, "--machine", "bench", "--yes"]
        done = ran("stream", programs[number], *told, env={**os.environ, **folders}, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    assert "finished" in done.stdout
    batches = list(read_program([programs[number].read_bytes()]))
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
