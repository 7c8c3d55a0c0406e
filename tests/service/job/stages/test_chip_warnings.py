"""The warning of a pass whose chips leave the band of the material."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from cam.checking.chips import ChipTime
from cam.passes import ball_pass
from service.job.stages.programs import _of_chips

SPEC = replace(
    ball_pass("rough", radius_mm=3.0, pitch_mm=0.5, stock_to_leave_mm=0.2, step_down_mm=1.5),
    spindle_rpm=8000.0, feed_mm_per_min=500.0, chip_mm=(0.025, 0.25),
)  # fmt: skip


def verdict(*seconds: float, written_mm: float = 0.0125) -> Any:
    """Seconds below, within and above the band."""
    assert len(seconds) == 3
    chips = ChipTime(seconds=seconds, thinnest_mm=0.0125, written_mm=written_mm, line=77, x_mm=1.0, y_mm=2.0)
    return SimpleNamespace(chips=chips)


@pytest.mark.parametrize("seconds", [(0.0, 0.0, 0.0), (2.0, 98.0, 0.0), (0.0, 98.0, 2.0)])
def test_nothing_is_said_of_a_few_moments(seconds: tuple[float, float, float]) -> None:
    assert list(_of_chips(SPEC, verdict(*seconds))) == []


def test_thin_chips_are_named_with_their_place_and_the_speed_that_helps() -> None:
    (words,) = map(str, _of_chips(SPEC, verdict(40.0, 60.0, 0.0)))
    for part in ("too thin for 40 %", "12.5 µm", "2 flutes at 8000 rpm", "line 77 at X1.00 Y2.00", "use 4000 rpm"):
        assert part in words
    assert "F200 is too low" in words and "a higher feed" in words


def test_a_feed_that_the_mill_does_not_reach_is_no_reason_to_ask_for_more() -> None:
    (words,) = map(str, _of_chips(SPEC, verdict(40.0, 60.0, 0.0, written_mm=0.03125)))
    assert "of F500 the mill reaches F200" in words and "a higher feed" not in words


def test_thick_chips_are_named_with_the_feed_at_which_they_end() -> None:
    (words,) = map(str, _of_chips(SPEC, verdict(0.0, 60.0, 40.0)))
    assert "too thick for 40 %" in words and "F4000" in words
