"""Level lines never cross and are never farther apart than their class allows; and where tracks end."""

from __future__ import annotations

import numpy as np
import pytest

from cam.contour.field import RATIO, REACH_PITCHES, ContourField
from cam.contour.levels import level_at, level_tree
from cam.contour.tracer import trace
from tests.cam.contour.test_contour_path import PITCH, WAYS, lens, pass_of, surface_with


def places_at(line: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) places along a polyline and unit vectors across it there."""
    ahead = np.diff(line, axis=0)
    long = np.hypot(*ahead.T)
    begins = np.concatenate([[0.0], np.cumsum(long)])[:-1]
    k = np.searchsorted(begins, way, side="right") - 1
    along = ahead / long[:, None]
    return line[k] + (way - begins[k])[:, None] * along[k], along[k][:, ::-1] * (-1, 1)


def is_wanted(field: ContourField, places: np.ndarray) -> np.ndarray:
    i, j = np.floor((places - (field.x0_mm, field.y0_mm)) / field.step_mm).astype(int).T
    return field.wanted[j.clip(0, field.wanted.shape[0] - 1), i.clip(0, field.wanted.shape[1] - 1)]


@pytest.mark.parametrize("name", ["ramp", "saddle", "stripes"])
def test_an_open_track_ends_where_nothing_is_wanted_beside_it(name):
    """Level lines go on beyond what must be covered; tracks do not, by more than a step of the grid."""
    heightfield = lens(WAYS[name])
    field = ContourField.over(heightfield, surface_with(heightfield, pass_of()), pitch_mm=PITCH)
    tracks = trace(field, pitch_mm=PITCH)
    way = np.linspace(0.0, 1.5 * field.step_mm, 7)
    across = np.linspace(-REACH_PITCHES * PITCH, REACH_PITCHES * PITCH, 41)
    ends = 0
    for k in range(tracks.count):
        line = tracks.xy_mm[tracks.start[k] : tracks.start[k + 1]]
        if (line[0] == line[-1]).all():
            continue
        for outward in (line, line[::-1]):
            places, aside = places_at(outward, way)
            beside = places[:, None] + across[:, None] * aside[:, None]
            assert is_wanted(field, beside.reshape(-1, 2)).any(), outward[0]
            ends += 1
    assert ends > 100


STEP, CLASSES = 1.0, 12


@pytest.fixture(scope="module")
def levels():
    return level_tree(-20.0, 35.0, STEP, CLASSES)


def alive_at(levels, density: float) -> np.ndarray:
    """Levels of all lines that exist at a class, in the order of their levels."""
    lines = np.flatnonzero(levels.birth - 1 < density)
    here = np.sort([level_at(levels, line, density) for line in lines])
    return here[(here > -20) & (here < 35)]


@pytest.mark.parametrize("density", np.linspace(0.0, CLASSES - 1.001, 40))
def test_neighbours_are_no_farther_apart_than_the_class_below_allows(levels, density):
    gaps = np.diff(alive_at(levels, density))
    assert gaps.max() <= STEP / RATIO ** np.floor(density) + 1e-9
    assert gaps.min() > 0


@pytest.mark.parametrize("j", range(CLASSES))
def test_at_a_whole_class_the_lines_are_even(levels, j):
    here = alive_at(levels, j)
    spacing = STEP / RATIO**j
    np.testing.assert_allclose(np.diff(here), spacing, atol=1e-9)


def test_a_family_born_together_has_room_for_turns(levels):
    for j in range(1, CLASSES):
        born = np.sort(levels.level[levels.birth == j, j])
        assert np.diff(born).min() > (1 / (RATIO - 1) - 1) * STEP / RATIO**j
