"""Laws of what rows leave: the scallop's slopes, the deepest rows that decide, light that is only moved about."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.as_milled.surface import MilledSurface
from cam.as_milled.tracks import Noise
from cam.planning.row_slopes import lowest_rows, row_slopes
from optics.heightfield import Heightfield
from tests.cam.programs import row_tracks

RADII, PITCHES = st.floats(0.25, 10.0), st.floats(0.005, 0.03)


def across(radius_mm: float, pitch_mm: float, noise_mm: float, step_mm: float = 0.0) -> float:
    found = row_slopes(radius_mm=radius_mm, pitch_mm=pitch_mm, step_mm=step_mm, noise_mm=noise_mm, vertex_mm=0.1)
    return found.across.rms


@given(RADII, PITCHES)
def test_without_errors_rows_leave_scallops(radius_mm: float, pitch_mm: float) -> None:
    assert across(radius_mm, pitch_mm, 0.0) == pytest.approx(pitch_mm / (2 * radius_mm * sqrt(3)), rel=1e-3)


@settings(max_examples=20, deadline=None)
@given(RADII, st.floats(1.05, 4.0), PITCHES, st.floats(0.0, 0.002))
def test_a_larger_ball_never_leaves_steeper_slopes(radius: float, more: float, pitch: float, noise: float) -> None:
    """Within what 6000 random rows tell."""
    assert across(radius * more, pitch, noise) <= 1.03 * across(radius, pitch, noise)


@pytest.mark.parametrize("noise_mm", [0.0002, 0.0005, 0.001])
def test_close_rows_are_as_steep_as_the_root_of_noise_over_radius(noise_mm: float) -> None:
    """Four times the noise, or a quarter of the radius, doubles the slopes, where rows are much closer than facets."""
    base = across(6.0, 0.01, noise_mm)
    assert across(6.0, 0.01, 4 * noise_mm) == pytest.approx(2 * base, rel=0.12)
    assert across(1.5, 0.01, noise_mm) == pytest.approx(2 * base, rel=0.12)


def test_lowest_rows_are_those_of_brute_force() -> None:
    rng = np.random.default_rng(3)
    off = rng.normal(0.0, 5.0, 60)
    rows, borders = lowest_rows(off)
    y = np.linspace(0, 59, 5901)
    lowest = np.argmin(off[:, None] + 0.5 * (y[None, :] - np.arange(60)[:, None]) ** 2, axis=0)
    assert np.mean(rows[np.searchsorted(borders, y, side="right") - 1] == lowest) > 0.99  # all but ties at borders


@given(RADII, PITCHES, st.floats(0.0, 0.002), st.floats(0.0, 0.004))
@settings(max_examples=20, deadline=None)
def test_light_is_moved_and_none_is_lost(radius: float, pitch: float, noise: float, step: float) -> None:
    found = row_slopes(radius_mm=radius, pitch_mm=pitch, step_mm=step, noise_mm=noise, vertex_mm=0.1)
    for spread in (found.across, found.along):
        kept = spread.transfer(np.array([0.0, 0.5, 3.0]), 49.0)
        assert kept[0] == pytest.approx(1.0)
        assert (np.abs(kept) <= 1.0 + 1e-9).all()
        assert float((spread.slope * spread.share).sum()) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("noise_mm", [0.0, 0.0005])
def test_slopes_are_those_of_the_facets_that_are_left(noise_mm: float) -> None:
    """On a plane, where all slopes are errors: the model of every groove says the same within 5 % (noise: 10 %)."""
    radius_mm, pitch_mm, side_mm = 1.0, 0.04, 8.0
    lens = Heightfield.on_aperture(np.full((9, 9), -0.1), width_mm=side_mm, height_mm=side_mm)
    tracks = row_tracks(lens, radius_mm=radius_mm, pitch_mm=pitch_mm)
    tracks = tracks.run_on_mill(noise=Noise(sigma_mm=noise_mm) if noise_mm else None)
    surface = MilledSurface.of_tracks([tracks], lens, pitch_mm=pitch_mm, error_mm=noise_mm)
    facets = np.concatenate([surface.part(k) for k in range(surface.parts)])
    middle = facets[..., :2].mean(axis=1)
    inside = (np.abs(middle - side_mm / 2) < side_mm / 2 - 0.5).all(axis=1)
    low, high = facets[inside][:, 0, 4], facets[inside][:, 2, 4]
    width = np.abs(facets[inside][:, 2, 1] - facets[inside][:, 0, 1])
    length = np.abs(facets[inside][:, 1, 0] - facets[inside][:, 0, 0])
    square = float(((low**2 + low * high + high**2) / 3 * width * length).sum() / (width * length).sum())
    assert across(radius_mm, pitch_mm, noise_mm) == pytest.approx(sqrt(square), rel=0.1 if noise_mm else 0.05)


@given(RADII, st.floats(0.02, 0.2), st.floats(0.0005, 0.004))
@settings(max_examples=20, deadline=None)
def test_whole_steps_never_leave_more_than_heights_between_them(radius: float, pitch: float, step: float) -> None:
    common = {"radius_mm": radius, "pitch_mm": pitch, "step_mm": step, "noise_mm": 0.0005, "vertex_mm": 0.1}
    between, on_steps = (row_slopes(**common, whole_steps=whole) for whole in (False, True))
    assert on_steps.along.rms < between.along.rms
    assert 0.0005 < on_steps.off_mm < between.off_mm


@given(RADII, PITCHES, st.floats(0.5, 2.0))
@settings(max_examples=10, deadline=None)
def test_a_steeper_lens_steepens_what_lies_across_the_rows_alone(radius: float, pitch: float, steep: float) -> None:
    common = {"radius_mm": radius, "pitch_mm": pitch, "step_mm": 0.002, "noise_mm": 0.0005, "vertex_mm": 0.1}
    flat, found = row_slopes(**common), row_slopes(**common, steepness=steep)
    assert found.across.rms == pytest.approx(steep * flat.across.rms)
    assert found.along.rms == flat.along.rms
    assert found.off_mm == flat.off_mm
