"""Programs of two balls over one lens: whoever went deeper makes the surface, though its tips ran elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cam.as_milled.surface import MilledSurface
from cam.as_milled.tracks import Tracks
from tests.cam.as_milled.test_as_milled import SIDE_MM, facets_of, lens
from tests.cam.facet_points import spread_over
from tests.cam.programs import row_tracks

BIG, SMALL = (2.5, 0.1), (0.5, 0.05)
"""Radius and pitch. On a slope of 0.6 tips that touch one place lie 1 mm apart."""


def lift_over(tracks: Tracks, by_mm: float) -> Tracks:
    return replace(tracks, tips_mm=tracks.tips_mm + np.array([0.0, 0.0, by_mm]))


@pytest.mark.parametrize(("big_mm", "small_mm"), [(0.02, 0.0), (0.0, 0.02)])
def test_the_deeper_program_makes_the_whole_surface(big_mm: float, small_mm: float) -> None:
    """The other one, 20 micrometres higher, leaves no trace: one layer of facets, all at the height of the deeper."""
    over = lens(tilt=(0.5, -0.33), bend=(0.05, -0.08))
    big, small = (
        lift_over(row_tracks(over, radius_mm=radius, pitch_mm=pitch), by)
        for (radius, pitch), by in ((BIG, big_mm), (SMALL, small_mm))
    )
    surface = MilledSurface.of_tracks([big, small], over, pitch_mm=BIG[1])
    facets = facets_of(surface)
    middle = facets[:, :, :3].mean(axis=1)
    inside = ((middle[:, :2] > 0.2) & (middle[:, :2] < SIDE_MM - 0.2)).all(axis=1)
    heights = over.spline().heights_mm(middle[inside, 0], middle[inside, 1])
    assert np.abs(middle[inside, 2] - heights).max() < 0.003
    _, weights = spread_over(facets, np.full(2, 0.2), np.full(2, SIDE_MM - 0.2), parts=10)
    assert weights.sum() == pytest.approx((SIDE_MM - 0.4) ** 2, rel=0.01)
