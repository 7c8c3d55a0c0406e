"""The surface between the vertices: the same one that scipy would make, C2, and exactly kept by its run-out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RectBivariateSpline

from optics.heightfield import Heightfield


def random_lens(seed: int, ny: int = 9, nx: int = 12) -> Heightfield:
    return Heightfield.on_aperture(-np.random.default_rng(seed).random((ny, nx)), width_mm=11.0, height_mm=6.0)


@given(seed=st.integers(0, 2**32 - 1))
def test_spline_is_scipys_not_a_knot_spline(seed: int) -> None:
    """Anyone can rebuild the surface from heightfield.npz with RectBivariateSpline(y, x, z)."""
    lens = random_lens(seed)
    rng = np.random.default_rng(seed)
    x, y = 11.0 * rng.random(20), 6.0 * rng.random(20)
    reference = RectBivariateSpline(lens.y_mm, lens.x_mm, lens.z_mm)
    orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    expected = [reference.ev(y, x, dx=along_y, dy=along_x) for along_x, along_y in orders]
    np.testing.assert_allclose(lens.spline().jets(x, y), expected, atol=1e-11)


@given(seed=st.integers(0, 2**32 - 1))
def test_run_out_leaves_the_lens_alone_and_is_smooth_across_the_rim(seed: int) -> None:
    spline = random_lens(seed).spline()
    longer = spline.extend(4.0)
    rng = np.random.default_rng(seed)
    x, y = 11.0 * rng.random(20), 6.0 * rng.random(20)
    np.testing.assert_allclose(longer.jets(x, y), spline.jets(x, y), atol=1e-10)
    inside, outside = longer.jets(1e-7, y), longer.jets(-1e-7, y)
    np.testing.assert_allclose(inside, outside, atol=1e-3)  # second derivatives are continuous
    height, slope, _, bend, *_ = spline.jets(0.0 * y, y)
    most_mm = (1.0 + 6.0) * np.abs(slope) + 0.6 * np.abs(bend) + 0.3 * 41  # cells of 1 mm; fade_mm, droop
    assert (np.abs(spline.extend(40.0).heights_mm(-40.0, y) - height) < most_mm).all()  # the slope dies out


@pytest.mark.parametrize("side", [20, 230])
def test_no_points_have_no_heights(side: int) -> None:
    """Of a large lens, too, whose points are shared out to threads: some samples lie beside it."""
    axis_mm = np.arange(side) * 0.1
    lens = Heightfield(x_mm=axis_mm, y_mm=axis_mm, z_mm=np.full((side, side), -1.0))
    assert lens.spline().jets(np.empty(0), np.empty(0)).shape == (6, 0)


def test_run_out_makes_no_towers_beyond_the_corners() -> None:
    """Around a rim that twists, the corners of the run-out rise no higher than what runs out of the four sides."""
    x = np.linspace(0, 20, 81)
    wavy = -2.0 + 0.3 * np.sin(3 * x[None, :]) * np.sin(2.7 * x[:, None])
    surface = Heightfield.on_aperture(wavy, width_mm=20.0, height_mm=20.0).spline_with_run_out(6.0)
    along, away = np.linspace(0, 20, 161), np.linspace(-6.0, 0.0, 49)
    sides = [surface.heights_mm(along[None, :], away[:, None]), surface.heights_mm(away[None, :], along[:, None])]
    corner = surface.heights_mm(away[None, :], away[:, None])
    assert corner.max() <= max(side.max() for side in sides)


def test_heightfield_refuses_uneven_axes_and_nan() -> None:
    x = np.array([0.0, 1.0, 2.0, 3.5])
    with pytest.raises(ValueError, match="evenly spaced"):
        Heightfield(x_mm=x, y_mm=np.arange(4.0), z_mm=np.zeros((4, 4)))
    with pytest.raises(ValueError, match="not finite"):
        Heightfield.on_aperture(np.full((4, 4), np.nan), width_mm=1, height_mm=1)


def test_heightfield_cannot_be_changed_from_outside() -> None:
    z = np.zeros((4, 4))
    lens = Heightfield.on_aperture(z, width_mm=3, height_mm=3)
    z[0, 0] = 7
    assert lens.z_mm[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        lens.z_mm[0, 0] = 1
