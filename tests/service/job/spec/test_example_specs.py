"""The specs in examples/specs are complete jobs: each kind of light, frame and surface, to be taken and changed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from service.cli.main import run
from service.job.spec.loading import resolve_spec

EXAMPLES = Path(__file__).parents[4] / "examples"
SPECS = sorted((EXAMPLES / "specs").glob("*.toml"))


def test_there_are_some() -> None:
    assert len(SPECS) >= 6


@pytest.mark.parametrize("spec", SPECS, ids=lambda path: path.stem)
def test_an_example_is_a_complete_job_that_says_what_it_is(spec: Path) -> None:
    resolve_spec(file=spec)
    assert spec.read_text().startswith("# ")


@pytest.mark.thorough
@pytest.mark.parametrize("spec", SPECS, ids=lambda path: path.stem)
def test_an_example_makes_a_lens_without_a_warning(spec: Path, tmp_path: Path) -> None:
    """With few pixels: what such a lens can show, each example shows: 27 dB is plainly the picture."""
    picture = EXAMPLES / ("logo.png" if spec.stem == "black" else "camera.png")
    arguments = ["--spec", str(spec), "--set", "image.pixels=64", "--quiet"]
    assert run(["design", str(picture), "-o", str(tmp_path / "out"), *arguments]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["warnings"] == []
    assert report["optics"]["converged"]
    assert report["optics"]["psnr_db"] > 27
