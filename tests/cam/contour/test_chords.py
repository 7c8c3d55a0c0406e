"""No chord of a contour path cuts into the lens, whatever lies between its ends."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cam.contour.path import SHORTEST_MM, tips_along
from cam.rows.vertices import finish_rule, rough_rule
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield

SIDE, RADIUS = 6.0, 0.5
AXIS = np.linspace(0, SIDE, 121)
RULE = finish_rule(0.5e-3, 0.05)
SLACK_MM = 1e-6
"""Beyond the sag: a chord is judged at its ends and its middle."""


def surface_of(z) -> ToolSurface:
    heights = z(AXIS[None, :], AXIS[:, None]) + np.zeros((AXIS.size, AXIS.size))
    lens = Heightfield.on_aperture(heights - heights.max() - 0.1, width_mm=SIDE, height_mm=SIDE)
    return ToolSurface.over(lens, radius_mm=RADIUS)


def line(length_mm: float, angle_rad: float, chord_mm: float) -> np.ndarray:
    """(n, 2) through the middle of the lens, on the writing raster, beyond its rim where it is long."""
    run = np.linspace(-length_mm / 2, length_mm / 2, max(2, round(length_mm / chord_mm)) + 1)
    return np.round((SIDE / 2 + run[:, None] * (np.cos(angle_rad), np.sin(angle_rad))) * 1e4) / 1e4


def below_mm(tips: np.ndarray, surface: ToolSurface) -> np.ndarray:
    """(m, 7) how far each chord runs below where the ball touches, at eighths of it."""
    t = np.arange(1, 8) / 8
    places = tips[:-1, None] + t[:, None] * (tips[1:] - tips[:-1])[:, None]
    flat = places.reshape(-1, 3)
    return (surface.tip_heights_mm(flat[:, 0], flat[:, 1]) - flat[:, 2]).reshape(-1, 7)


def ridges(bend: float, at_mm: float):
    """A crest of that curvature [1/mm] as wide as a pitch or two, across a gentle slope."""
    return lambda x, y: 0.05 * x - np.sqrt((x - at_mm) ** 2 + 0.04 / bend**2) * 0.3 + 0 * y


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.floats(0.3, 3.0), st.floats(2.0, 4.0), st.floats(0, np.pi), st.floats(0.012, 0.4))
def test_no_chord_cuts_deeper_than_the_sag_even_over_a_crest_that_its_middle_does_not_show(bend, at_mm, angle, chord):
    surface = surface_of(ridges(bend, at_mm))
    tips = tips_along(surface.kernel, RULE, line(SIDE + RADIUS, angle, chord))
    assert below_mm(tips, surface).max() <= RULE.sag_mm + SLACK_MM


def test_chords_too_short_to_be_cut_for_their_slope_are_cut_where_they_gouge():
    surface = surface_of(ridges(3.0, 3.0))
    tips = tips_along(surface.kernel, RULE, line(1.0, 0.0, 1.5 * SHORTEST_MM))
    assert np.hypot(*np.diff(tips[:, :2], axis=0).T).min() < SHORTEST_MM
    assert below_mm(tips, surface).max() <= RULE.sag_mm + SLACK_MM


def test_in_a_crease_chords_are_no_shorter_than_a_mill_can_follow():
    """Where the ball changes flanks any chord runs too high in the middle: that is stock left, not a gouge."""
    surface = surface_of(lambda x, y: 0.4 * np.abs(x - 3.0) + 0 * y)
    tips = tips_along(surface.kernel, RULE, line(2.0, 0.0, 0.2))
    assert np.hypot(*np.diff(tips[:, :2], axis=0).T).min() >= SHORTEST_MM - 1e-4


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_on_an_even_surface_no_chord_is_cut(slope):
    surface, xy = surface_of(lambda x, y: slope * x + 0 * y), line(4.0, 0.3, 0.5)
    tips = tips_along(surface.kernel, RULE, xy)
    np.testing.assert_array_equal(tips[:, :2], xy)


def test_vertices_given_stay_and_all_lie_on_the_writing_raster_and_the_surface():
    surface, xy = surface_of(ridges(1.0, 3.1)), line(4.0, 1.0, 0.3)
    tips = tips_along(surface.kernel, RULE, xy)
    kept = {tuple(np.rint(place * 1e4).astype(int)) for place in tips[:, :2]}
    assert kept >= {tuple(np.rint(place * 1e4).astype(int)) for place in xy}
    assert np.abs(tips[:, :2] * 1e4 - np.rint(tips[:, :2] * 1e4)).max() < 1e-6
    assert np.abs(surface.tip_heights_mm(tips[:, 0], tips[:, 1]) - tips[:, 2]).max() < 1e-7


def test_slope_rules_a_finish_and_sag_a_rough_pass():
    """On a cylinder of curvature k chords s have k s / 2 and k s^2 / 8."""
    k = 0.05
    surface, xy = surface_of(lambda x, y: -k / 2 * (x - 3) ** 2 + 0 * y), line(4.0, 0.0, 1.0)
    tip_k = k / (1 + k * RADIUS)
    fine = np.diff(tips_along(surface.kernel, RULE, xy)[:, 0]).max()
    assert 0.5 * fine * tip_k < 1.1 * RULE.slope_rad
    rough = rough_rule(0.03, 0.05)
    coarse = np.diff(tips_along(surface.kernel, rough, xy)[:, 0]).max()
    assert coarse**2 * tip_k / 8 < 1.1 * rough.sag_mm
    assert coarse > 3 * fine
