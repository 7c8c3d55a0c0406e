"""The stage that shows the wall behind a finish: there for jobs that have one, and what it says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from optics.finish import Finish
from service.job.files import AS_FINISHED, COMPARED_FINISHED
from service.job.spec.lens_task import facts_of_light
from service.job.spec.loading import resolve_spec
from service.job.stages.as_finished import warn_of_lost_contact, warn_of_rounded_rim
from service.job.stages.table import plan
from tests.service.job.stages.jobs import StagedJob, run_job, without_light

ROWS = [
    {"name": "rough", "radius_mm": 1.0, "pitch_mm": 0.25, "stock_to_leave_mm": 0.1},
    {"name": "finish", "radius_mm": 0.5, "pitch_mm": 0.05},
]
SMALL = {
    "image": {"pixels": 48},
    "optics": {"width_mm": 12.0, "height_mm": 12.0, "throw_mm": 60.0},
    "stock": {"thickness_mm": 10.0, "margin_mm": 3.0},
    "machine": {"step_mm": 0.002, "z_noise_mm": 0.001},
    "passes": ROWS,
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> StagedJob:
    return finish_job(tmp_path_factory.mktemp("finished"))


def finish_job(folder: Path, *overrides: str) -> StagedJob:
    y, x = np.mgrid[0:48, 0:48] / 48
    grey = 0.35 + 0.3 * (np.hypot(x - 0.4, y - 0.6) < 0.25) + 0.15 * np.sin(2 * np.pi * 3 * x)
    Image.fromarray(np.uint8(255 * grey)).save(folder / "disc.png")
    finish = {"k0_rad_per_mm": 5.0, "order": 1.0, "depth_um": 20.0}
    spec = resolve_spec(base={**SMALL, "finish": finish}, overrides=overrides)
    return run_job(folder, folder / "disc.png", spec, without=("caustic", "check", "report"))


@pytest.mark.thorough
def test_the_wall_as_finished_shows_more_than_as_milled(finished: StagedJob) -> None:
    """Rows off by 1 um blur 2 mm of 60; a pad that keeps waves from 1.4 mm on takes them off."""
    milled = finished.results["as-milled"].report["as_milled"]
    seen = finished.results["as-finished"].report["as_finished"]
    assert seen["psnr_db"] > milled["psnr_db"] + 3.0
    assert seen["smallest_detail_mm"] < 0.65 * milled["smallest_detail_mm"]
    assert seen["finish"]["k0_rad_per_mm"] == 5.0
    assert 0.5 < seen["contact_share"] <= 1.0
    notes = " ".join(finished.results["as-finished"].notes["passes"])
    assert ("touches" in notes) == (seen["contact_share"] < 0.98)


@pytest.mark.thorough
def test_every_score_behind_a_finish_says_under_which_light_it_holds(finished: StagedJob) -> None:
    white = facts_of_light(finished.spec)
    for part in ("optics", "as_milled", "as_finished", "finish_tolerance"):
        assert finished.report[part]["light"] == white
    assert without_light(finished.report) == []


@given(radius_mm=st.floats(0.25, 6.0), k0_rad_per_mm=st.floats(0.7, 25.0))
def test_a_rim_that_the_finish_reaches_from_beyond_the_cut_is_told(radius_mm: float, k0_rad_per_mm: float) -> None:
    finish = Finish(k0_rad_per_mm=k0_rad_per_mm, order=2.0)
    told = warn_of_rounded_rim(finish, radius_mm)
    assert (told is not None) == (finish.reach_mm >= radius_mm + 0.1)
    assert told is None or f"{radius_mm:g} mm are milled" in told


@given(share=st.floats(0.0, 1.0))
def test_a_tool_that_does_not_reach_is_told(share: float) -> None:
    told = warn_of_lost_contact(share)
    assert (told is not None) == (share < 0.98)
    assert told is None or f"touches {100 * share:.0f} % of the lens" in told


@pytest.mark.thorough
def test_the_job_tells_of_its_rim(finished: StagedJob) -> None:
    """A ball of 0.5 mm; the finish reaches 0.85 mm."""
    assert "its outermost 0.35 mm" in " ".join(finished.results["as-finished"].notes["passes"])


@pytest.mark.thorough
def test_a_block_that_ends_beside_the_rim_is_told(tmp_path: Path) -> None:
    """Nothing is milled beyond it, wherever the ball goes; and no wall keeps the tool away."""
    small = ("stock.margin_mm=0.3", "optics.width_mm=6", "optics.height_mm=6", "image.pixels=24")
    made = finish_job(tmp_path, *small).results["as-finished"]
    assert "0.3 mm are milled around the lens: its outermost 0.55 mm" in " ".join(made.notes["passes"])
    assert made.report["rim_room"]["largest_mm"] is None


@pytest.mark.thorough
def test_the_job_tells_that_no_tool_gets_to_its_rims(finished: StagedJob) -> None:
    """Balls of 1 and 0.5 mm."""
    made = finished.results["as-finished"]
    assert "the tool of the finish does not reach the rims" in " ".join(made.notes["passes"])
    assert made.report["rim_room"]["largest_mm"] == 0.0
    assert made.report["rim_room"]["removed_g"] == pytest.approx(0.02 * (12 + 6 * 2**0.5 / 5) ** 2 * 1.19e-3, rel=1e-3)


@pytest.mark.thorough
def test_its_pictures_are_files_of_the_job(finished: StagedJob) -> None:
    assert {AS_FINISHED, COMPARED_FINISHED} <= set(finished.results["as-finished"].outputs)


def test_a_job_without_a_finish_has_no_such_stage() -> None:
    assert "as-finished" not in plan(resolve_spec(base=SMALL))
