"""A photograph of the witness marks' light says how far the finish is, in minutes, or that it is too far."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optics.witness_light import DoseReading
from service.cli.main import run
from service.errors import InputError, PictureError
from service.job import files as job_files
from service.job.photo.witness import WitnessFinding, read_witness_photo
from service.job.picture.linear_light import linear_to_srgb
from service.job.planning.witness import plan_witness
from service.job.spec.lens_task import finish_of
from service.job.spec.loading import resolve_job
from tests.optics.witness_photographs import light_on_paper, photograph_strip

VALUES = (
    "optics.width_mm=100", "optics.height_mm=80", 'finish.process="felt"', "finish.minutes=85", "passes.0.radius_mm=3",
    "passes.1.radius_mm=3",
)  # fmt: skip
REPORT = {
    "witness": {"marks": [{}]},
    "finishing": {"minutes": 85.0},
    "finish_tolerance": {"psnr_db": [24.5, 26.3, 22.3], "minutes_ratio": [0.8, 1.25]},
    "versions": {"causticmill": "any"},
}
FINDING = WitnessFinding(
    reading=DoseReading(dose=0.86, error=0.03, blur_mm=0.05, misfit=1.0), minutes=85.0, worked=None, psnr_db=None
)


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """The folder of a job, as far as its marks need it."""
    resolved = resolve_job(base={"preset": "draft"}, overrides=VALUES)
    job_files.write_json(tmp_path / job_files.SPEC, resolved.spec.plain())
    job_files.write_json(tmp_path / job_files.REPORT, REPORT)
    return tmp_path


def photograph(folder: Path, dose: float) -> Path:
    resolved = resolve_job(base={"preset": "draft"}, overrides=VALUES)
    finish = finish_of(resolved.spec)
    assert finish is not None and resolved.spec.finish.depth_um is not None
    depth_mm = resolved.spec.finish.depth_um / 1000
    light = light_on_paper(plan_witness(resolved).strip, finish, depth_mm, dose, noise_mm=0.001, lamp_mm=0.05)
    path = folder / "marks.png"
    Image.fromarray(np.rint(255 * linear_to_srgb(photograph_strip(light, seed=2))).astype(np.uint8)).save(path)
    return path


@pytest.mark.parametrize(("dose", "words"), [(0.7, "another"), (1.0, "stop: it is done"), (1.2, "too far: stop")])
def test_the_photograph_says_what_to_do(job: Path, dose: float, words: str) -> None:
    found = read_witness_photo(photograph(job, dose), job)
    assert found.reading.dose == pytest.approx(dose, rel=0.06)
    assert words in " ".join(found.sentences())


def test_the_command_prints_it(job: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["look", str(photograph(job, 0.7)), "--job", str(job), "--marks", "--minutes", "60"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert "% of the plan" in first and "another 2" in second  # of 26 minutes, by the pace of the first 60


def test_what_is_left_is_in_the_plan_s_minutes_or_at_the_pace_so_far() -> None:
    assert "another 12 min, at the same pace" in list(FINDING.sentences())
    assert "another 10 min, at the same pace" in list(replace(FINDING, worked=60.0).sentences())
    assert "go on: 14 % of the work is left" in list(replace(FINDING, minutes=None).sentences())


def test_too_far_says_what_the_wall_shows_now(job: Path) -> None:
    far = replace(FINDING, reading=replace(FINDING.reading, dose=1.25), psnr_db=22.3)
    assert "too far: stop; the wall shows about 22.3 dB now" in list(far.sentences())
    assert "too far: stop" in list(replace(far, psnr_db=None).sentences())


def test_a_job_without_marks_and_a_photograph_without_light_are_refused(job: Path) -> None:
    dark = job / "dark.png"
    Image.fromarray(np.pad(np.full((40, 40), 3, np.uint8), 100)).save(dark)
    with pytest.raises(PictureError, match=r"hardly above the dark|too small"):
        read_witness_photo(dark, job)
    job_files.write_json(job / job_files.REPORT, {**REPORT, "witness": {"obstacle": "room"}})
    with pytest.raises(InputError, match="no witness marks"):
        read_witness_photo(dark, job)
