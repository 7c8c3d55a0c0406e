"""Screws whose error comes back with every turn: what they do to tips, and to the surface that these leave."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.as_milled.height_map import map_departure
from cam.as_milled.tracks import Screws
from optics.heightfield import Heightfield
from tests.cam.programs import row_tracks

amplitudes = st.tuples(*3 * [st.floats(0.0, 0.02)])
leads = st.tuples(*3 * [st.floats(0.5, 8.0)])


@given(amplitudes, leads, st.lists(st.tuples(*3 * [st.floats(-50.0, 50.0)]), min_size=1, max_size=20))
def test_an_axis_is_off_by_what_its_screw_is_and_by_as_much_a_turn_later(
    error_mm: tuple[float, float, float], lead_mm: tuple[float, float, float], tips: list[tuple[float, float, float]]
) -> None:
    screws, tips_mm = Screws(error_mm=error_mm, lead_mm=lead_mm), np.array(tips)
    off = screws.errors_mm(tips_mm)
    assert (np.abs(off) <= np.array(error_mm) + 1e-12).all()
    np.testing.assert_allclose(off, screws.errors_mm(tips_mm + np.array(lead_mm)), atol=1e-9)
    assert (
        screws.longest_mm == min([lead for a, lead in zip(error_mm, lead_mm, strict=True) if a], default=math.inf) / 16
    )


@pytest.mark.parametrize(
    ("error_mm", "expected"),
    [
        ((0.0, 0.0, 0.004), lambda x, z: 0.004 * np.sin(2 * np.pi * z / 1.25)),
        ((0.01, 0.0, 0.0), lambda x, z: -0.3 * 0.01 * np.sin(2 * np.pi * x / 2.0)),  # aside on a slope is up or down
    ],
)
def test_a_ramp_is_left_in_the_waves_of_the_screws(error_mm: tuple[float, float, float], expected: object) -> None:
    slope, side_mm = 0.3, 8.0
    axis = np.linspace(0.0, side_mm, 81)
    lens = Heightfield.on_aperture(np.tile(slope * axis - 3.0, (81, 1)), width_mm=side_mm, height_mm=side_mm)
    screws = Screws(error_mm=error_mm, lead_mm=(2.0, 2.0, 1.25))
    tracks = row_tracks(lens, radius_mm=1.0, pitch_mm=0.05).divide(screws.longest_mm)
    made, meant = (
        map_departure([one], lens, pitch_mm=0.05, error_mm=0.005, finer=1).departure_mm[20:-20, 20:-20]
        for one in (tracks.made_by(screws=screws), tracks)
    )
    # The tip stands a ball's radius off its contact, along the slope and in height.
    root = math.hypot(1.0, slope)
    x = axis[20:-20] - slope / root
    z = slope * axis[20:-20] - 3.0 - 1.0 + 1.0 / root
    wanted = expected(x, z)  # type: ignore[operator]
    np.testing.assert_allclose((made - meant).mean(axis=0), wanted, atol=0.12 * np.abs(wanted).max())
