"""Lenses that were refused by their own check: small ones that fall steeply into the run-out, and the default block."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.job.spec.loading import resolve_spec
from tests.service.job.stages.jobs import run_job

EXAMPLES = Path(__file__).parents[2] / "examples"
LIGHT = ("caustic", "as-milled", "report")  # stages that look at no program, or only at one that has passed


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("picture", "preset", "side_mm", "throw_mm"),
    [
        ("camera", "draft", 20, 60),
        ("logo", "draft", 10, 25),
        ("camera", "paper", 8, 26),
        ("logo", "recommended", 8, 26),
    ],
)
def test_a_small_steep_lens_passes_its_check(tmp_path, picture, preset, side_mm, throw_mm):
    """The first one turned from row to row at full feed, in slots of two thirds of the step-down: together they are too
    long from some 16 mm on. The logo's valleys are too narrow for the ball to trust a touch near the last one.
    """
    values = {"image.pixels": 48, "optics.throw_mm": throw_mm, "optics.width_mm": side_mm, "optics.height_mm": side_mm}
    if preset == "recommended":
        values["plan.hours"] = 0.1  # the best picture would take rows 0.015 mm apart
    spec = resolve_spec(preset=preset, overrides=[f"{key}={value}" for key, value in values.items()])
    job = run_job(tmp_path, EXAMPLES / f"{picture}.png", spec, without=LIGHT)
    assert {row["ok"] for row in job.report["passes"]} == {True}


@pytest.mark.thorough
def test_the_roughing_of_the_default_block_passes_its_check(tmp_path):
    """At its full size, by a coarse picture: cells of its stock lie exactly a radius from the ends of its rows."""
    spec = resolve_spec(overrides=["image.pixels=48"])
    job = run_job(tmp_path, EXAMPLES / "camera.png", spec, without=(*LIGHT, "pass-2", "pass-3", "check"))
    assert {row["ok"] for row in job.report["passes"]} == {True}
