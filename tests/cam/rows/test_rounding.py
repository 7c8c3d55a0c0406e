"""Coarse digits: never farther off than one, never worse than plain rounding, far better where the path has slope."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.moves import cut, rapid
from cam.posts.post import Digits
from cam.rows.rounding import Rounding, nearest, on_raster

PITCH_MM = 0.02
THREE = Digits(xy_mm=0.001, z_mm=0.001)
RASTERS = {
    "three decimals": THREE,
    "four decimals": Digits(xy_mm=1e-4, z_mm=1e-4),
    "steps of 2 um": Digits(xy_mm=0.002, z_mm=0.002),
    "RML": Digits(xy_mm=0.01, z_mm=0.01),
}


def row(seed: int, *, step_mm: float = 0.05, length_mm: float = 12.0) -> np.ndarray:
    """A finishing row along X: relief of a lens, vertices on the finest raster."""
    rng = np.random.default_rng(seed)
    x = np.round(np.arange(-0.3, length_mm, step_mm), 4)
    z = -3 + sum(rng.uniform(-0.3, 0.3) * np.sin(k * x / 2 + rng.uniform(0, 6)) / k**1.5 for k in range(1, 6))
    return np.column_stack([x, np.full_like(x, 1.23), z])


def placed(points: np.ndarray, rounding: Rounding) -> np.ndarray:
    paths = on_raster([rapid(points[0]), cut(points[1:], 600)], rounding)
    return np.vstack([path.points_mm for path in paths])


def errors(points: np.ndarray, made: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of what was made over the path on a fine comb, and its slope error there."""
    comb = np.arange(points[1, 0], points[-2, 0], 0.002)
    over = np.interp(comb, made[:, 0], made[:, 2]) - np.interp(comb, points[:, 0], points[:, 2])
    return over, np.diff(over) / 0.002


def badness(points: np.ndarray, made: np.ndarray) -> float:
    """Squared slope errors, along the line and to neighbours that are as wrong, averaged over the line."""
    over, slope = errors(points, made)
    return float(np.mean(slope**2) + 2 * np.mean(over**2) / PITCH_MM**2)


@pytest.mark.parametrize("name", RASTERS)
@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.03, 0.05, 0.11]))
def test_every_vertex_is_on_the_raster_and_within_a_digit_and_no_vertex_is_added(name, seed, step_mm):
    digits, points = RASTERS[name], row(seed, step_mm=step_mm)
    made = placed(points, Rounding(digits=digits, pitch_mm=PITCH_MM))
    assert len(made) <= len(points)
    np.testing.assert_allclose(made, nearest(made, digits), atol=1e-9)
    assert (np.diff(made[:, 0]) > 0).all()
    over, _ = errors(points, made)
    start = abs(made[0, 2] - points[0, 2])
    assert over.max() <= digits.z_mm + 1e-6
    assert over[comb_after(points)].min() >= -0.5 * digits.z_mm - 1e-6 - 0.02 * start


def comb_after(points: np.ndarray) -> slice:
    """Past the first moves: they begin where the rapid has ended, on the nearest digit."""
    return slice(int(1.0 / 0.002), len(points) * 1000)


@pytest.mark.parametrize("name", RASTERS)
@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.03, 0.05, 0.11]))
def test_the_light_is_never_worse_off_than_with_plain_rounding(name, seed, step_mm):
    """Vertices on the raster of X and Y already, so that both round the same points."""
    digits = Digits(xy_mm=1e-4, z_mm=RASTERS[name].z_mm)
    points = row(seed, step_mm=step_mm)
    chosen = badness(points, placed(points, Rounding(digits=digits, pitch_mm=PITCH_MM)))
    assert chosen <= 1.01 * badness(points, nearest(points, digits))


def test_plain_rounding_is_what_theory_says_and_choosing_is_several_times_better():
    plain, chosen = [], []
    for seed in range(6):
        points = row(seed)
        plain.append(np.mean(errors(points, nearest(points, THREE))[1] ** 2))
        chosen.append(np.mean(errors(points, placed(points, Rounding(digits=THREE, pitch_mm=PITCH_MM)))[1] ** 2))
    assert math.sqrt(np.mean(plain)) == pytest.approx(0.001 / (math.sqrt(6) * 0.05), rel=0.15)
    assert math.sqrt(np.mean(chosen)) < math.sqrt(np.mean(plain)) / 3


def test_corners_and_bends_stay_where_they_are():
    """A move may pass a vertex that it leaves out no farther aside than a fiftieth of the pitch."""
    angle = np.linspace(0, 5, 400)
    arc = np.column_stack([2 * np.cos(angle), 2 * np.sin(angle), -1 + 0.02 * angle])
    corner = np.array([[2.0, 0, -1.0], [2.0, -1, -1.01], [3.0, -1, -1.02], [3.0, -1.02, -1.02], [1.0, -1.02, -1.03]])
    points = np.vstack([corner[::-1], arc])
    made = placed(points, Rounding(digits=Digits(xy_mm=1e-4, z_mm=0.001), pitch_mm=PITCH_MM))
    fine = np.vstack([a + np.linspace(0, 1, 50)[:, None] * (b - a) for a, b in itertools.pairwise(made)])
    known = np.vstack([a + np.linspace(0, 1, 50)[:, None] * (b - a) for a, b in itertools.pairwise(points)])
    aside = [np.hypot(known[:, 0] - x, known[:, 1] - y).min() for x, y, _ in fine[::50]]
    assert max(aside) < 0.02 * PITCH_MM + 6e-4  # half the comb of the known path
    for place in corner:
        assert np.hypot(made[:, 0] - place[0], made[:, 1] - place[1]).min() < 1e-4


def test_long_paths_in_pieces_and_plunges():
    """No jump where pieces meet; what goes straight down is only rounded."""
    points = row(3, step_mm=0.001, length_mm=20.0)
    paths = [rapid((*points[0, :2], 5.0)), cut(points[:1], 200), cut(points[1:], 600), rapid((*points[-1, :2], 5.0))]
    made = list(on_raster(paths, Rounding(digits=THREE, pitch_mm=PITCH_MM)))
    np.testing.assert_allclose(made[1].points_mm, nearest(points[:1], THREE))
    assert len(made) == 6  # 20 000 vertices
    over, slope = errors(points, np.vstack([path.points_mm for path in made[1:-1]]))
    assert np.abs(over).max() < 0.0011 and np.abs(slope).max() < 0.6
