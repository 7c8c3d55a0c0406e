"""The command `coupon`: what it refuses, the sheet, and the folder that it makes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from service.cli.main import run
from service.job.coupon.piece import coupon_job, sheet_lines
from service.job.files import COUPON_FILES


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
def test_the_folder_of_a_piece_holds_programs_and_pictures(tmp_path: Path) -> None:
    """Of wide rows, which are quick to make; what one tells is measured in tests/service/server/api/test_photos.py."""
    rows = ("passes.0.pitch_mm=1", "passes.1.pitch_mm=0.5")
    sets = [part for row in rows for part in ("--set", row)]
    assert run(["coupon", "-o", str(tmp_path / "piece"), "--quiet", *sets]) == 0
    names = {path.name for path in (tmp_path / "piece").iterdir()}
    report = json.loads((tmp_path / "piece" / "report.json").read_text())
    assert names > {*COUPON_FILES, *(row["file"] for row in report["passes"])}
    assert all(row["ok"] for row in report["passes"])
