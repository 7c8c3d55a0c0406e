"""Closing for a cutter: only valleys are filled, and none stays tighter than asked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optics.closing import close_to_radius

D = 0.1


def closed(z: np.ndarray, radius: float) -> np.ndarray:
    return close_to_radius(z, radius_mm=radius, dx_mm=D, dy_mm=D)


@given(seed=st.integers(0, 2**32 - 1), radius=st.floats(0.3, 3.0))
def test_fills_only_valleys_and_only_once(seed: int, radius: float) -> None:
    z = np.pad(np.random.default_rng(seed).random((22, 29)), 1, mode="edge")  # rims level: beyond, slopes go on
    filled = closed(z, radius)
    assert (filled >= z - 1e-12).all()
    assert filled.max() == pytest.approx(z.max(), abs=1e-12)
    np.testing.assert_allclose(closed(filled, radius), filled, atol=3 * D**2 / (4 * radius))


def test_bowl_the_cutter_fits_is_left_alone() -> None:
    y, x = np.mgrid[-30:31, -30:31] * D
    bowl = (x**2 + y**2) / (2 * 2.0)
    np.testing.assert_allclose(closed(bowl, 1.5)[5:-5, 5:-5], bowl[5:-5, 5:-5], atol=D**2 / 1.5)  # the grid's error


@pytest.mark.parametrize("radius", [0.5, 2.0])
def test_a_dome_is_left_alone_up_to_its_steep_rim(radius: float) -> None:
    """Slope 0.6 at the rim, no valley anywhere: a closing that ended at the rim would raise it by 0.18 radii."""
    y, x = np.mgrid[-30:31, -30:31] * D
    dome = -(x**2 + 0.5 * y**2) / 10
    np.testing.assert_allclose(closed(dome, radius), dome, atol=D**2 / radius)


def test_sharp_valley_gets_the_asked_radius() -> None:
    """A V of slope 1 becomes a parabola of curvature 1 / r at its bottom."""
    x = np.arange(-40, 41) * D
    v = np.tile(np.abs(x), (81, 1))
    bottom = closed(v, 1.0)[40]
    curvature = np.diff(bottom, 2) / D**2
    assert curvature.max() < 1.15  # 1 / r, and a little where it meets the slopes
    assert bottom[40] == pytest.approx(0.5, abs=0.01)  # r / 2 above the crease


@pytest.mark.parametrize("axis", [0, 1])
def test_spacing_differs_along_x_and_y(axis: int) -> None:
    """A V along either axis of an oblong grid becomes the same parabola, r / 2 above its crease."""
    spacing = (0.1, 0.04)[axis]  # dy, dx
    line = np.abs(np.arange(-60, 61)) * spacing
    v = np.tile(line, (9, 1)) if axis else np.tile(line[:, None], (1, 9))
    filled = close_to_radius(v, radius_mm=1.0, dx_mm=0.04, dy_mm=0.1)
    middle = filled[4, 60] if axis else filled[60, 4]
    assert middle == pytest.approx(0.5, abs=0.02)


def test_what_only_the_grid_fills_is_nearly_left_alone() -> None:
    """Soft ripples a ball fits into: a plain closing adds 1.2 dx^2 / (4 r) to them, this one 0.75 of that band."""
    y, x = np.mgrid[0:61, 0:61] * D
    soft = 0.2 * np.sin(1.3 * x + 0.4) * np.cos(1.1 * y)  # curvatures up to 0.34 / mm
    band = D**2 / (4 * 1.5)
    assert np.abs(closed(soft, 1.5) - soft)[12:-12, 12:-12].max() < 0.9 * band


@given(slope=st.floats(0.0, 1.0), radius=st.floats(0.05, 3.0))
def test_a_prism_is_left_alone(slope: float, radius: float) -> None:
    """No ball is kept from a plane, nor from its rim: a lamp near the lens gives every rim a slope."""
    prism = slope * np.broadcast_to(D * np.arange(40), (30, 40))
    assert np.abs(closed(prism, radius) - prism).max() <= 0.1 * D**2 / (4 * radius) + 1e-12
