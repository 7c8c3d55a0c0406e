"""Snell's law, forwards and backwards."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from optics.refraction import slope_for_shift, tangent_per_slope

SLOPES = st.floats(-0.6, 0.6)


@given(zx=SLOPES, zy=SLOPES, index=st.floats(1.3, 1.55))
def test_tangential_components_agree_across_the_surface(zx: float, zy: float, index: float) -> None:
    """eta d x N = t x N with unit directions."""
    m = tangent_per_slope(zx * zx + zy * zy, index)
    refracted = np.array([m * zx, m * zy, 1.0])
    refracted /= np.linalg.norm(refracted)
    normal = np.array([-zx, -zy, 1.0]) / math.sqrt(1 + zx * zx + zy * zy)
    incident = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(index * np.cross(incident, normal), np.cross(refracted, normal), atol=1e-12)


@given(zx=SLOPES, zy=SLOPES, drop=st.floats(1.0, 500.0))
def test_equations_8_and_9_undo_the_refraction(zx: float, zy: float, drop: float) -> None:
    m = tangent_per_slope(zx * zx + zy * zy, 1.49)
    shift = np.array([[m * zx, m * zy]]) * drop
    back = slope_for_shift(shift, np.array([drop]), refractive_index=1.49)
    np.testing.assert_allclose(back, [[zx, zy]], atol=1e-9)


def test_beyond_the_critical_slope_all_light_is_reflected() -> None:
    steepest = 1.0 / math.sqrt(1.49**2 - 1.0)  # tan of the angle of total reflection
    assert math.isfinite(tangent_per_slope((0.999 * steepest) ** 2, 1.49))
    assert math.isnan(tangent_per_slope((1.001 * steepest) ** 2, 1.49))
    assert math.isnan(tangent_per_slope(1.0, 1.49))  # the 45 degree prism
