"""Machine profiles: complete, plausible, frozen; an unknown name lists the known."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import pytest

from machines.profiles import UnknownProfileError, load_profile, profile_names


@pytest.mark.parametrize("name", profile_names())
def test_every_profile_is_complete_and_plausible(name: str) -> None:
    profile = load_profile(name)
    assert profile.name == name
    assert profile.dialect == "grbl", "no other dialect can be written yet"
    for triple in (profile.travel_mm, profile.max_rate_mm_per_min, profile.acceleration_mm_per_s2):
        assert len(triple) == 3
        assert min(triple) > 0
    assert 0 < profile.safe_z_mm < profile.travel_mm[2]
    assert 0 < profile.spindle_rpm[0] < profile.spindle_rpm[1]
    assert 1 <= profile.planner_blocks <= 1000
    assert 0 < profile.step_mm <= 0.05
    assert 0 < profile.junction_deviation_mm <= 0.1
    assert profile.lines_per_s > 0


def test_the_default_profile_takes_the_default_job() -> None:
    """100 mm aperture, 3 mm ball run-out on both sides, 40 mm stock below the safe height."""
    travel = load_profile("grbl").travel_mm
    assert min(travel[:2]) >= 106
    assert travel[2] >= 40 + load_profile("grbl").safe_z_mm


def test_an_unknown_profile_lists_the_known() -> None:
    with pytest.raises(UnknownProfileError) as caught:
        load_profile("haas")
    assert caught.value.known == profile_names()
    assert "'haas'" in str(caught.value)
    assert "grbl-3018" in str(caught.value)


def test_a_name_is_never_a_path() -> None:
    with pytest.raises(UnknownProfileError):
        load_profile("../profiles/grbl")


def test_profiles_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        load_profile("grbl").safe_z_mm = 1.0  # type: ignore[misc]
