"""The surface that moves leave against brute force: the lowest of all balls, point by point, over any path."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cam.as_milled.tracks import Noise, Tracks
from tests.cam.as_milled.test_as_milled import facets_of, lens, surface_of
from tests.cam.facet_points import rms, spread_over
from tests.cam.programs import row_tracks

pytestmark = pytest.mark.thorough


def lowest_ball(tracks, x_mm, y_mm):
    """(n,) height of the lowest ball of the path above points, by asking every move; nothing is left out."""
    z = np.full(x_mm.size, np.inf)
    r = tracks.radius_mm
    for k in np.flatnonzero(tracks.joined):
        (ax, ay, az), (bx, by, bz) = tracks.tips_mm[k - 1 : k + 1]
        length = math.hypot(bx - ax, by - ay)
        ex, ey, m = (bx - ax) / length, (by - ay) / length, (bz - az) / length
        u, w = (x_mm - ax) * ex + (y_mm - ay) * ey, (y_mm - ay) * ex - (x_mm - ax) * ey
        rho2 = r * r - w * w
        with np.errstate(invalid="ignore"):
            s = np.clip(u - np.sqrt(rho2) * m / math.hypot(1, m), 0.0, length)
            z = np.fmin(z, az + m * s + r - np.sqrt(rho2 - (u - s) ** 2))
    return z


def brute_slopes(tracks, x_mm, y_mm, step_mm=1e-6):
    here = lowest_ball(tracks, x_mm, y_mm)
    return (
        (lowest_ball(tracks, x_mm + step_mm, y_mm) - here) / step_mm,
        (lowest_ball(tracks, x_mm, y_mm + step_mm) - here) / step_mm,
    )


def crossed(over, radius, pitch):
    """Rows along x, and coarser ones along y across them."""
    one, two = (
        row_tracks(over, radius_mm=radius, pitch_mm=p, direction=d) for p, d in ((pitch, "x"), (3.3 * pitch, "y"))
    )
    return Tracks(
        radius_mm=radius,
        tips_mm=np.concatenate([one.tips_mm, two.tips_mm]),
        joined=np.concatenate([one.joined, two.joined]),
    )


LOW, HIGH = np.array([0.7, 0.8]), np.array([1.1, 1.2])  # the window


def near_the_window(tracks, reach_mm):
    """Without the tips farther from it: of a whole path too many moves would have to be asked."""
    near = ((tracks.tips_mm[:, :2] > LOW - reach_mm) & (tracks.tips_mm[:, :2] < HIGH + reach_mm)).all(axis=1)
    joined = tracks.joined & near & np.roll(near, 1)
    return Tracks(radius_mm=tracks.radius_mm, tips_mm=tracks.tips_mm[near], joined=joined[near])


def judge(tracks, over, *, pitch, step, noise, places):
    """rms and histogram of what is added to the lens's slopes, within 5 %."""
    facets = facets_of(surface_of(tracks, over, pitch_mm=pitch, step_mm=step, z_noise_mm=noise))
    points, weights = spread_over(facets, LOW, HIGH)
    spline = over.spline()
    x, y = np.random.default_rng(5).uniform(LOW, HIGH, (places, 2)).T
    brute = brute_slopes(tracks, x, y)
    for axis in (0, 1):
        mine = points[:, 3 + axis] - spline.jets(points[:, 0], points[:, 1])[1 + axis]
        theirs = brute[axis] - spline.jets(x, y)[1 + axis]
        assert rms(mine, weights) == pytest.approx(rms(theirs), rel=0.05)
        edges = np.quantile(theirs, np.linspace(0, 1, 11))
        edges[[0, -1]] = -1.0, 1.0
        counts, _ = np.histogram(mine, edges, weights=weights)
        assert np.abs(counts / counts.sum() - 0.1).sum() / 2 < 0.05
    assert weights.sum() == pytest.approx(0.16, rel=0.02)


@pytest.mark.parametrize(
    ("radius", "pitch", "step", "noise", "is_crossed"),
    [
        (0.5, 0.02, 0.0, 0.0, False),
        (0.5, 0.02, 0.0, 0.0005, False),
        (0.5, 0.02, 0.002, 0.0005, False),
        (3.0, 0.05, 0.002, 0.0, False),
        (3.0, 0.05, 0.002, 0.0005, True),
        (0.5, 0.02, 0.0, 0.0, True),
    ],
)
def test_slopes_are_those_of_brute_force(radius, pitch, step, noise, is_crossed):
    over = lens(tilt=(0.15, -0.1), bend=(0.03, -0.05))
    tracks = crossed(over, radius, pitch) if is_crossed else row_tracks(over, radius_mm=radius, pitch_mm=pitch)
    longest_mm = np.linalg.norm(np.diff(tracks.tips_mm, axis=0)[tracks.joined[1:]], axis=1).max()
    lean_mm = 0.3 * radius  # more than the slopes put a tip aside of where it touches
    tracks = near_the_window(tracks.run_on_mill(step_mm=step, noise=Noise(sigma_mm=noise)), lean_mm + longest_mm)
    judge(tracks, over, pitch=pitch, step=step, noise=noise, places=6000)


@pytest.mark.parametrize(
    ("radius", "pitch", "step", "noise", "chord"),
    [(3.0, 0.1, 0.002, 0.0, 0.004), (3.0, 0.1, 0.002, 0.0005, 0.004), (0.5, 0.02, 0.002, 0.0005, 0.008)],
)
def test_slopes_of_moves_hardly_longer_than_steps_are_those_of_brute_force(radius, pitch, step, noise, chord):
    over = lens(tilt=(0.15, -0.1), bend=(0.03, -0.05))
    tracks = row_tracks(over, radius_mm=radius, pitch_mm=pitch).divide(chord)
    tracks = near_the_window(
        tracks.run_on_mill(step_mm=step, noise=Noise(sigma_mm=noise)), 0.2 * math.sqrt(radius) + 0.3
    )
    judge(tracks, over, pitch=pitch, step=step, noise=noise, places=3000)
