"""A lens that may not change, and a ball too large for its valleys: planned, cut, checked and judged as milled."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.job.spec.loading import resolve_spec
from tests.service.job.stages.jobs import run_job

PICTURE = Path(__file__).parents[2] / "examples" / "camera.png"
LEFT_OUT = ("caustic", "report")  # what shows the light of the lens as designed, and the page
HOPEFUL_DB = 3.0  # by which a plan may promise too much where a rest pass blends into what surrounds it
VALUES = {
    "image.pixels": 48,
    "optics.width_mm": 12,
    "optics.height_mm": 12,
    "optics.throw_mm": 12,
    "optics.min_radius_mm": 0.25,
    "machine.step_mm": 0.0005,
    "machine.z_noise_mm": 0.0001,
    "machine.profile": "linuxcnc",  # its lines arrive fast enough for a small ball's feed in valleys
    "plan.hours": 0.27,  # a smaller ball all over the lens would take longer
}


@pytest.mark.thorough
def test_a_planned_rest_pass_is_cut_where_the_big_ball_left_stock(tmp_path: Path) -> None:
    spec = resolve_spec(preset="recommended", overrides=[f"{key}={value}" for key, value in VALUES.items()])
    report = run_job(tmp_path, PICTURE, spec, without=LEFT_OUT).report
    foretold, (finish, cleared) = report["plan"]["rest"], report["passes"][-2:]
    assert cleared["settings"]["where"] == "rest"
    assert cleared["settings"]["radius_mm"] < finish["settings"]["radius_mm"]
    assert cleared["rest"]["area_mm2"] == pytest.approx(foretold["area_mm2"], rel=0.1)
    assert foretold["area_share"] < 0.3
    assert report["as_milled"]["psnr_db"] > report["plan"]["psnr_db"] - HOPEFUL_DB
