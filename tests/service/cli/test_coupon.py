"""The command `coupon`: what it refuses, the sheet, and the whole way from programs to a measured finish."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from optics.finish import Finish
from service.cli.main import run
from service.job.coupon.piece import coupon_job, sheet_lines
from service.job.files import COUPON_FILES, COUPON_FIT_FILES
from tests.service.job.coupon.wall import photograph


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--photo", "x.jpg", "--machine", "grbl"], "--machine"),
        (["--photo", "x.jpg"], "holds no test piece"),
        (["--set", "optics.width_mm=30"], "40 x 20 mm"),
        (["--finish", "scrubbing"], "finish.process"),
        (["--machine", "lathe"], "machine.profile"),
        (["--set", "passes.1.stock_to_leave_mm=0.1"], "must finish"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Names what is wrong; nothing is written."""
    assert run(["coupon", "-o", str(tmp_path / "piece"), *arguments]) == 2
    errors = capfd.readouterr().err.splitlines()
    assert len(errors) == 1
    assert said in errors[0]
    assert not (tmp_path / "piece").exists()


def test_the_sheet_names_programs_minutes_and_sizes() -> None:
    """All that a person needs beside the mill stands in it, in lines of at most 100 characters."""
    job = coupon_job(machine=None, throw_mm=25.0, file=None, overrides=[])
    rows = [{"file": "pass-1-rough.nc", "time_s": 120.0}, {"file": "pass-2-finish.nc", "time_s": 600.0}]
    lines = list(sheet_lines(job, {"passes": rows}))
    text = " ".join(" ".join(lines).split())
    assert max(map(len, lines)) <= 100
    for word in (
        "pass-1-rough.nc, then pass-2-finish.nc",
        "12 min",
        "56 x 36 mm",
        "25 mm",
        "R 1",
        job.machine.name,
    ):
        assert word in text


@pytest.mark.thorough
def test_from_programs_to_a_measured_finish(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """On the default mill in less than 30 minutes of its time; a photograph from aside of the piece as that mill cuts
    it, finished with a felt, gives k0 within 15 %, and rows' errors within a factor of 1.5.
    """
    folder, finish, throw_mm = tmp_path / "piece", Finish(k0_rad_per_mm=8.0, order=1.0), 20.4
    assert run(["coupon", "-o", str(folder), "--quiet"]) == 0
    assert set(COUPON_FILES) < {path.name for path in folder.iterdir()}
    report = json.loads((folder / "report.json").read_text())
    assert sum(row["time_s"] for row in report["passes"]) < 30 * 60
    photo = tmp_path / "wall.png"
    photograph(folder, finish, throw_mm=throw_mm).save(photo)
    assert run(["coupon", "--photo", str(photo), "-o", str(folder)]) == 0
    assert "k0" in capfd.readouterr().out
    assert set(COUPON_FIT_FILES) < {path.name for path in folder.iterdir()}
    found = json.loads((folder / "coupon-fit.json").read_text())
    assert found["finish"]["k0_rad_per_mm"] == pytest.approx(8.0, rel=0.15)
    assert found["finish"]["order"] == pytest.approx(1.0, abs=0.15)
    assert found["wall"]["throw_mm"] == pytest.approx(throw_mm, abs=1.0)
    assert 0.00067 < found["mill"]["z_noise_mm"] < 0.0015
