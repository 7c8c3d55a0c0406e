"""Slopes along rows of a mill with steps of 4 um against brute force: the ball at every step of Bresenham's lines."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from cam.as_milled.stepping import measure_spread
from cam.as_milled.tracks import Tracks
from cam.moves import cut, rapid
from cam.posts.dialects import GRBL
from cam.rows.rounding import Rounding, on_raster
from tests.cam.as_milled.test_as_milled import facets_of, lens, surface_of
from tests.cam.as_milled.test_as_milled_brute_force import HIGH, LOW, brute_slopes, near_the_window
from tests.cam.facet_points import rms, spread_over
from tests.cam.programs import row_tracks

STEP_MM = 0.004


def on_whole_steps(tracks: Tracks, pitch_mm: float) -> Tracks:
    """The same rows with vertices where the path goes through whole steps."""
    paths = [rapid(tracks.tips_mm[0]), cut(tracks.tips_mm[1:], 500.0)]
    rounding = Rounding(digits=GRBL.digits.coarsen(STEP_MM), pitch_mm=pitch_mm)
    tips = np.concatenate([path.points_mm for path in on_raster(paths, rounding)])
    return replace(tracks, tips_mm=tips, joined=np.arange(len(tips)) > 0)


def run_every_step(tracks: Tracks) -> Tracks:
    """Each step of the longest axis a move of its own, those in one direction together."""
    places, chained = [np.rint(tracks.tips_mm[:1] / STEP_MM)], [np.zeros(1, dtype=bool)]
    ends = np.rint(tracks.tips_mm / STEP_MM).astype(int)
    for begin, end, joined in zip(ends[:-1], ends[1:], tracks.joined[1:], strict=True):
        count = np.abs(end - begin).max() if joined else 1
        done = np.arange(1, count + 1)[:, None]
        places.append(begin + np.sign(end - begin) * ((2 * np.abs(end - begin) * done + count) // (2 * max(count, 1))))
        chained.append(np.full(count, joined))
    tips, joined = STEP_MM * np.concatenate(places), np.concatenate(chained)
    turns = np.ones(len(tips), dtype=bool)
    turns[1:-1] = (np.abs(np.diff(tips, n=2, axis=0)) > STEP_MM / 2).any(axis=1) | ~(joined[1:-1] & joined[2:])
    return Tracks(radius_mm=tracks.radius_mm, tips_mm=tips[turns], joined=joined[turns])


@pytest.mark.thorough
@pytest.mark.parametrize("whole_steps", [True, False])
@pytest.mark.parametrize(
    ("radius", "pitch", "tilt", "bend"),
    [(0.5, 0.03, (0.05, -0.02), (0.005, 0.005)), (1.0, 0.05, (0.05, 0.02), (0.1, -0.1))],
    ids=["gently sloped", "strongly bent"],
)
def test_slopes_along_rows_are_those_of_every_step(radius, pitch, tilt, bend, whole_steps):
    """Their rms within 10 %, and what is left of waves in their light, where half or more is left, within 0.1."""
    over = lens(tilt=tilt, bend=bend)
    rows = row_tracks(over, radius_mm=radius, pitch_mm=pitch)
    made = (on_whole_steps(rows, pitch) if whole_steps else rows).run_on_mill(step_mm=STEP_MM)
    surface = surface_of(made, over, pitch_mm=pitch, step_mm=STEP_MM, within_mm=STEP_MM)
    points, weights = spread_over(facets_of(surface), LOW, HIGH)
    mine = points[:, 3] - over.spline().jets(points[:, 0], points[:, 1])[1]
    x, y = np.random.default_rng(5).uniform(LOW, HIGH, (3000, 2)).T
    every = run_every_step(near_the_window(made, 0.3 * radius + 0.6))
    theirs = brute_slopes(every, x, y)[0] - over.spline().jets(x, y)[1]
    assert rms(mine, weights) == pytest.approx(rms(theirs), rel=0.1)
    for wave in np.array([0.5, 1.0]) / rms(theirs):
        left = float(np.cos(wave * theirs).mean())
        assert float(np.average(np.cos(wave * mine), weights=weights)) == pytest.approx(left, abs=0.1)


def test_steps_add_nothing_where_there_are_none_or_all_is_level():
    for over, step_mm in ((lens(tilt=(0.1, 0.0)), 0.0), (lens(), STEP_MM)):
        made = row_tracks(over, radius_mm=1.0, pitch_mm=0.05).run_on_mill(step_mm=step_mm)
        found = measure_spread([made], over, step_mm=step_mm, reach_mm=0.2)
        assert not found.half_width.any()
        assert (np.diff(found.slopes) > 0).all()


def test_steps_add_teeth_to_a_slope():
    """A tooth for each step: even slopes in +- s / 2mR, where rows are too far apart to hide them."""
    slope, radius, step = 0.1, 0.5, 0.01
    over = lens(tilt=(slope, 0.0))
    made = row_tracks(over, radius_mm=radius, pitch_mm=0.2).run_on_mill(step_mm=step)
    found = measure_spread([made], over, step_mm=step, reach_mm=0.3)
    assert np.median(found.half_width) == pytest.approx(step / (2 * slope * radius), rel=0.3)
    assert math.isclose(np.median(found.slopes), slope, rel_tol=0.05)
