"""A ball that fits: no hollow is tighter afterwards, little else changes, and what fits is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.surface.stock_touch import largest_fitting_radius_mm
from optics.ball_fit import ball_fits, fit_ball
from optics.heightfield import Heightfield


def on_grid(z: np.ndarray, *, dx: float = 0.1, dy: float = 0.1) -> Heightfield:
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=dx * (z.shape[1] - 1), height_mm=dy * (z.shape[0] - 1))


@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1), radius=st.floats(0.3, 3.0), dy=st.floats(0.05, 0.2), ny=st.integers(4, 40))
def test_the_ball_fits_whatever_the_surface(seed: int, radius: float, dy: float, ny: int) -> None:
    """Rough surfaces with their rims and corners, 4 vertices a side and more, by the mill's measure of curvature."""
    lens = on_grid(0.01 * np.random.default_rng(seed).standard_normal((ny, 30)).cumsum(axis=1), dy=dy)
    fitting = fit_ball(lens, radius, sweeps=20_000)
    assert largest_fitting_radius_mm(fitting).everywhere_mm >= radius
    assert ball_fits(fitting, radius)
    assert fitting.z_mm.max() == pytest.approx(lens.z_mm.max(), abs=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_fits_is_left_alone(sign: float) -> None:
    """A bowl of radius 2.2 mm for a 2 mm ball; a dome for any ball."""
    y, x = np.mgrid[-30:31, -30:31] * 0.05
    bowl = on_grid(-sign * np.sqrt(2.2**2 - x**2 - y**2), dx=0.05, dy=0.05)
    assert fit_ball(bowl, 2.0 if sign > 0 else 0.01) is bowl
    assert ball_fits(bowl, 2.0) and ball_fits(bowl, 2.5) == (sign < 0)


@pytest.mark.parametrize("turned", [False, True])
def test_a_crease_opens_and_its_flanks_stay(turned: bool) -> None:
    """A V of slopes +-0.2 needs 0.4 radii of width: beyond twice that nothing moves."""
    x = np.arange(-40, 41) * 0.1
    v = np.tile(0.2 * np.abs(x), (81, 1))
    lens = on_grid(v.T if turned else v)
    fitting = fit_ball(lens, 2.0)
    moved = (fitting.z_mm - lens.z_mm).T if turned else fitting.z_mm - lens.z_mm
    assert np.ptp(moved[:, np.abs(x) > 0.8]) < 1e-4  # 1/4000 of what it sinks in the middle, the spline's own ringing
    assert 0.005 < np.ptp(moved) < 0.05  # a parabola over a V: 0.2^2 * 2 / 2 = 0.04 at the most
    assert largest_fitting_radius_mm(fitting).everywhere_mm == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("rim", [0, 1, 2, 3])
def test_a_hollow_at_a_rim_alone_is_opened(rim: int) -> None:
    """Curvature that runs up to 1.8 / r over the last two cells, where the spline only goes on with its cubic."""
    x = np.arange(81) * 0.1
    profile = 0.9 / 2.0 * np.maximum(0.2 - x, 0.0) ** 3 / 0.6
    lens = on_grid(np.rot90(np.tile(profile, (81, 1)), rim))
    assert not ball_fits(lens, 2.0)
    assert largest_fitting_radius_mm(fit_ball(lens, 2.0)).everywhere_mm >= 2.0


def test_too_few_sweeps_come_nearer() -> None:
    lens = on_grid(np.random.default_rng(3).standard_normal((40, 40)) * 0.01)
    some = fit_ball(lens, 2.0, sweeps=3)
    assert 2.0 > largest_fitting_radius_mm(some).everywhere_mm > largest_fitting_radius_mm(lens).everywhere_mm
