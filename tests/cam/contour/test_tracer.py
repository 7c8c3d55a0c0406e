"""Where tracks end."""

from __future__ import annotations

import numpy as np
import pytest

from cam.contour.field import REACH_PITCHES, ContourField
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
