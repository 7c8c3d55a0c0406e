"""Small lenses with a short throw, whose surface falls steeply into the run-out, must pass their own check."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.end_to_end.command import ran, settings

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("picture", "preset", "side_mm", "throw_mm"),
    [
        ("camera", "draft", 14, 42),
        ("logo", "draft", 10, 25),
        ("camera", "paper", 12, 40),
        ("logo", "recommended", 12, 40),
    ],
)
def test_a_small_steep_lens_passes_its_check(tmp_path, picture, preset, side_mm, throw_mm):
    """The first one turned from row to row at full feed, in slots of two thirds of the step-down; the last one's ball
    fits nowhere loosely: every touch is looked for under the whole ball.
    """
    values = {"image.pixels": 48, "optics.throw_mm": throw_mm, "optics.width_mm": side_mm, "optics.height_mm": side_mm}
    if preset == "recommended":
        values["plan.hours"] = 0.1  # the best picture would take rows 0.015 mm apart
    done = ran("make", EXAMPLES / f"{picture}.png", "-o", tmp_path / "job", "--preset", preset, *settings(values))
    assert done.returncode == 0, done.stderr
