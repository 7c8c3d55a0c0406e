"""Lines of the level tree never cross and are never farther apart than their class allows."""

from __future__ import annotations

import numpy as np
import pytest

from cam.contour.field import RATIO
from cam.contour.levels import level_at, level_tree

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
