"""Laws of the sharpened picture: the box's variance, light is kept, and blurring brings the picture back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import uniform_filter1d

from optics.foreseen import _box, _spread, sharpen

SIDE = 64


def spread_evenly(light: np.ndarray, blur_px: tuple[float, float]) -> np.ndarray:
    out = np.empty_like(light)
    _spread(light, _box(blur_px[0]), _box(blur_px[1]), np.empty_like(light), out)
    return out


def picture() -> np.ndarray:
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    return 1.0 + 0.5 * np.sin(2 * np.pi * 6 * y) * np.cos(2 * np.pi * 2 * x)


@given(sigma_y=st.floats(0.0, 6.0), sigma_x=st.floats(0.0, 6.0))
def test_a_point_is_spread_with_the_variance_that_was_asked_for(sigma_y: float, sigma_x: float) -> None:
    point = np.zeros((SIDE, SIDE))
    point[32, 32] = 1.0
    found = spread_evenly(point, (sigma_y, sigma_x))
    away = np.arange(SIDE) - 32
    assert found.sum() == pytest.approx(1.0)
    assert found.sum(axis=1) @ away**2 == pytest.approx(sigma_y**2, abs=1e-9)
    assert found.sum(axis=0) @ away**2 == pytest.approx(sigma_x**2, abs=1e-9)


@settings(deadline=None)
@given(half=st.integers(0, 40), axis=st.sampled_from([0, 1]), seed=st.integers(0, 9))
def test_a_box_of_whole_pixels_is_the_moving_average_with_darkness_beyond_the_edges(half, axis, seed) -> None:
    """scipy's, on pictures that are not square and narrower than the widest box."""
    light, size = np.random.default_rng(seed).random((31, 50)), 2 * half + 1
    sigma = np.sqrt((size**2 - 1) / 12)
    found = spread_evenly(light, (sigma, 0.0) if axis == 0 else (0.0, sigma))
    assert found == pytest.approx(uniform_filter1d(light, size, axis=axis, mode="constant"), abs=1e-6)


def test_without_blur_the_picture_is_what_the_lens_aims_at() -> None:
    assert np.array_equal(sharpen(picture(), (0.0, 0.0)), picture())


@settings(max_examples=20, deadline=None)
@given(sigma=st.floats(0.5, 2.0))
def test_what_is_aimed_at_blurs_into_the_picture_better_than_the_picture_does(sigma: float) -> None:
    """Half of the error at least, away from the edges, of waves longer than the box: 11 pixels over 7."""
    goal, inner = picture(), (slice(16, -16), slice(16, -16))
    aim = sharpen(goal, (sigma, 0.0))
    assert aim.min() > 0
    assert aim.mean() == pytest.approx(1.0)
    lost, left = (np.abs(spread_evenly(one, (sigma, 0.0)) - goal)[inner].mean() for one in (goal, aim))
    assert left < 0.5 * lost + 0.02  # the mean is set to 1 after the edges were made brighter


def test_only_the_axis_that_is_blurred_is_sharpened() -> None:
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    stripes = 1.0 + 0.3 * np.sin(2 * np.pi * 8 * x) + 0 * y
    aim = sharpen(stripes, (3.0, 0.0))
    assert aim / aim.mean(axis=1, keepdims=True) == pytest.approx(stripes, abs=1e-9)
