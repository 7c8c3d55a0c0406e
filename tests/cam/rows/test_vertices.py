"""Vertices: every chord keeps its slope error, its sag and its length; what is left out was not needed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cam.rows.vertices import TICKS_PER_MM, finish_rule, march_row, most_vertices, rough_rule, thin_points
from cam.surface.contact import touch
from cam.surface.tool_surface import ToolSurface
from tests.cam.lenses import make_bumps, make_lens


def row(surface: ToolSurface, rule, y: float, start: float, end: float) -> np.ndarray:
    out = np.empty((most_vertices(abs(end - start), rule), 3))
    return out[: march_row(surface.kernel, rule, y, start, end, out, 0)]


def slopes(surface: ToolSurface, x: np.ndarray, y: float) -> np.ndarray:
    return np.array([touch(surface.kernel, a, y, a, y)[3] for a in x])


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 10**6),
    relief_mm=st.floats(0.0, 1.5),
    y=st.floats(0, 6),
    error=st.sampled_from([0.2e-3, 0.5e-3, 2e-3]),
    forward=st.booleans(),
)
def test_chords_of_a_finishing_row(seed, relief_mm, y, error, forward):
    """Slope within the bound (5 % for what lies between probes), sag within nanometres, at every point of the row."""
    surface = ToolSurface.over(make_bumps(seed, relief_mm=relief_mm), radius_mm=0.5)
    rule = finish_rule(error, 0.1)
    ends = (-0.4, 8.4) if forward else (8.4, -0.4)
    points = row(surface, rule, y, *ends)
    assert points[[0, -1], 0] == pytest.approx(ends)
    assert (points[:, 1] == y).all()
    np.testing.assert_array_equal(np.round(points[:, 0] * TICKS_PER_MM) / TICKS_PER_MM, points[:, 0])
    steps = np.diff(points[:, 0])
    assert (np.sign(steps) == np.sign(ends[1] - ends[0])).all()
    assert np.abs(steps).max() <= rule.max_mm + 1e-9

    x = np.linspace(-0.39, 8.39, 1500)
    order = np.argsort(points[:, 0])
    xs, zs = points[order, 0], points[order, 2]
    chord = np.searchsorted(xs, x) - 1
    error_of_slope = np.abs(slopes(surface, x, y) - (np.diff(zs) / np.diff(xs))[chord])
    free = np.diff(xs)[chord] > rule.min_mm + 1.5e-4  # the shortest chords may miss it
    assert (error_of_slope[free] <= 1.05 * error).all()
    sag = np.interp(x, xs, zs) - surface.tip_heights_mm(x, np.full(x.size, y))
    assert sag[free].min() >= -1.1 * rule.sag_mm  # no chord gouges
    assert np.abs(sag[free]).max() <= 1.1 * rule.sag_mm
    np.testing.assert_allclose(zs, surface.tip_heights_mm(xs, np.full(xs.size, y)), atol=1e-9)


def test_the_run_out_is_followed_less_closely():
    """Same bounds as before where the contact is on the lens or within 0.1 mm of it, half a micrometre beyond."""
    surface = ToolSurface.over(make_bumps(5, relief_mm=1.0), radius_mm=0.5)
    everywhere = row(surface, finish_rule(0.5e-3, 0.1), 2.3, -0.5, 8.5)
    rule = finish_rule(0.5e-3, 0.1, aperture_x_mm=(0.0, 8.0))
    points = row(surface, rule, 2.3, -0.5, 8.5)
    outside = [np.count_nonzero((p[:, 0] < -0.2) | (p[:, 0] > 8.2)) for p in (points, everywhere)]
    assert outside[0] < outside[1] / 4
    x = np.linspace(-0.49, 8.49, 3000)
    contact_x, _, tip = surface.contacts_mm(x, np.full(x.size, 2.3)).T
    optical = (contact_x > -0.1) & (contact_x < 8.1)
    sag = np.interp(x, points[:, 0], points[:, 2]) - tip
    assert np.abs(sag).max() <= 1.1 * rule.run_out_sag_mm
    chord = np.searchsorted(points[:, 0], x) - 1
    free = optical & (np.diff(points[:, 0])[chord] > rule.min_mm + 1.5e-4)
    assert np.abs(sag[free]).max() <= 1.1 * rule.sag_mm
    slope = np.diff(points[:, 2]) / np.diff(points[:, 0])
    assert np.abs(slopes(surface, x[free], 2.3) - slope[chord[free]]).max() <= 1.05 * rule.slope_rad


def test_the_steepest_place_between_two_probes_counts():
    """At an inflection the slope is extreme and the curvature, which sets the next probe, is zero."""
    wave = make_lens(lambda x, y: -1.0 + 2e-3 * np.sin(2 * x) + 0 * y)
    surface, rule = ToolSurface.over(wave, radius_mm=0.5), finish_rule(0.5e-3, 1.0)
    points = row(surface, rule, 3.0, 0.5, 7.5)
    x = np.linspace(0.51, 7.49, 2000)
    chord = np.searchsorted(points[:, 0], x) - 1
    error = np.abs(slopes(surface, x, 3.0) - (np.diff(points[:, 2]) / np.diff(points[:, 0]))[chord])
    assert error.max() <= 1.02 * rule.slope_rad


@pytest.mark.thorough
def test_few_vertices_where_it_is_straight_and_as_many_as_the_curvature_asks_for():
    """s = 2 e / k: on z = k x^2 / 2 under a small ball the spacing follows the formula within 15 %."""
    flat = row(ToolSurface.over(make_lens(lambda x, y: -1.0 + 0 * x), radius_mm=0.5), finish_rule(1e-3, 0.1), 3, 0, 8)
    assert len(flat) == 9
    k = 0.05
    bowl = ToolSurface.over(make_lens(lambda x, y: k / 2 * (x - 4) ** 2), radius_mm=0.1)
    points = row(bowl, finish_rule(0.5e-3, 0.1), 3.0, 3.5, 4.5)
    assert np.median(np.diff(points[:, 0])) == pytest.approx(2 * 0.5e-3 / k, rel=0.15)


def test_rough_rows_keep_a_share_of_what_is_left():
    surface = ToolSurface.over(make_bumps(5, relief_mm=2.0), radius_mm=0.5, allowance_mm=0.03)
    points = row(surface, rough_rule(0.03, 0.1), 2.0, -0.4, 8.4)
    x = np.linspace(-0.4, 8.4, 5000)
    sag = np.interp(x, points[:, 0], points[:, 2]) - surface.tip_heights_mm(x, np.full(x.size, 2.0))
    assert np.abs(sag).max() <= 0.05 * 0.03
    assert len(points) < len(row(surface, finish_rule(0.5e-3, 0.1), 2.0, -0.4, 8.4)) / 4


@given(
    z=st.lists(st.floats(-1, 1), min_size=2, max_size=60),
    tolerance=st.floats(1e-4, 0.3),
    upward=st.booleans(),
)
def test_thinning_stays_within_its_tolerance(z, tolerance, upward):
    x = np.arange(len(z)) * 0.1
    points = np.column_stack([x, np.zeros(len(z)), z])
    kept = thin_points(points if upward else points[::-1], tolerance)
    order = np.argsort(kept[:, 0])
    assert np.abs(np.interp(x, kept[order, 0], kept[order, 2]) - z).max() <= tolerance + 1e-12
    assert {0.0, x[-1]} <= set(kept[:, 0])


@pytest.mark.parametrize("rule", [rough_rule(0.03, 0.1), finish_rule(0.5e-3, 0.1)])
def test_no_chord_cuts_a_corner_off(rule):
    """Between two flanks the slope jumps without curvature at either probe; the chord across it is short all the same.

    d s / 4 <= 2 sag, or as short as chords get.
    """
    allowance = 0.03 if rule.slope_rad == np.inf else 0.0
    surface = ToolSurface.over(
        make_lens(lambda x, y: 0.3 * np.abs(x - 4.02) - 2), radius_mm=0.5, allowance_mm=allowance
    )
    points = row(surface, rule, 3.0, 0.0, 8.0)
    x = np.linspace(3, 5, 4001)
    sag = np.interp(x, points[:, 0], points[:, 2]) - surface.tip_heights_mm(x, np.full(x.size, 3.0))
    assert np.abs(sag).max() <= max(2 * rule.sag_mm, 0.6 * rule.min_mm / 4)
    assert len(points) < 200


def test_thinning_merges_a_straight_run():
    points = np.column_stack([np.linspace(0, 100, 1000), np.zeros(1000), np.full(1000, -1.5)])
    assert len(thin_points(points, 0.01)) == 2
