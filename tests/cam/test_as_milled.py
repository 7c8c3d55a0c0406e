"""The surface that moves leave: laws of grooves, and brute force, point by point, over any path."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.as_milled.noise import Noise
from cam.as_milled.rows import row_tracks, sample_facets, tip_error_mm
from cam.as_milled.surface import MilledSurface
from cam.as_milled.tracks import Tracks
from cam.reading.gcode import read_program
from optics.heightfield import Heightfield

SIDE_MM = 2.0


def lens(tilt=(0.0, 0.0), bend=(0.0, 0.0), side_mm=SIDE_MM):
    """A paraboloid under Z0: slopes in its middle, second derivatives."""
    axis = np.linspace(0.0, side_mm, 41)
    x, y = np.meshgrid(axis - side_mm / 2, axis - side_mm / 2)
    z = tilt[0] * x + tilt[1] * y + bend[0] * x**2 / 2 + bend[1] * y**2 / 2
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=side_mm, height_mm=side_mm)


def surface_of(tracks, over, *, pitch_mm, step_mm=0.0, z_noise_mm=0.0):
    return MilledSurface.of_tracks(
        [tracks],
        over,
        pitch_mm=pitch_mm,
        error_mm=tip_error_mm(step_mm=step_mm, z_noise_mm=z_noise_mm),
        roughness_mm=tip_error_mm(step_mm=step_mm),
    )


def facets_of(surface):
    return np.concatenate([surface.part(number) for number in range(surface.parts)])


def areas(facets):
    x, y = facets[..., 0], facets[..., 1]
    return np.abs((x[:, 2] - x[:, 0]) * (y[:, 3] - y[:, 1]) - (x[:, 3] - x[:, 1]) * (y[:, 2] - y[:, 0])) / 2


def spread_over(facets, low, high, parts=40):
    """(points (n, 5), weights): places, heights and slopes all over the facets, those within the window."""
    middle = facets[:, :, :2].mean(axis=1)
    near = ((middle > low - np.full(2, 0.3)) & (middle < high + np.full(2, 0.3))).all(axis=1)
    rng, chosen, points = np.random.default_rng(7), facets[near], []
    for _ in range(parts):
        u, v = rng.random((2, len(chosen)))
        shares = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)
        points.append(np.einsum("nkd,nk->nd", chosen, shares))
    found, weight = np.concatenate(points), np.tile(areas(chosen) / parts, parts)
    inside = ((found[:, :2] > low) & (found[:, :2] < high)).all(axis=1)
    return found[inside], weight[inside]


def rms(values, weights=None):
    return float(np.sqrt(np.average(values**2, weights=weights)))


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


@given(radius=st.floats(0.4, 3.0), share=st.floats(0.03, 0.1), direction=st.sampled_from("xy"))
@settings(max_examples=5, deadline=None)
def test_even_rows_on_a_plane_have_evenly_spread_slopes(radius, share, direction):
    """From -p / 2R to p / 2R across, rms p / (2R sqrt 3), none along: cam.md, section 1."""
    over, pitch = lens(side_mm=1.0), share * radius
    tracks = row_tracks(over, radius_mm=radius, pitch_mm=pitch, direction=direction)
    facets = facets_of(surface_of(tracks, over, pitch_mm=pitch))
    across, along = (1, 0) if direction == "x" else (0, 1)
    span = 1.0 + 2 * radius
    apart = span / math.ceil(span / pitch - 1e-9)  # rows are even, at most a pitch apart
    middle = facets[(np.abs(facets[:, :, :2].mean(axis=1) - 0.5) < 0.3).all(axis=1)]
    slopes = middle[:, :, 3 + across]
    assert np.abs(middle[:, :, 3 + along]).max() < 1e-9
    assert slopes.max() == pytest.approx(apart / 2 / radius, rel=0.02)
    assert slopes.min() == pytest.approx(-slopes.max(), rel=0.02)
    assert np.allclose(np.abs(slopes), slopes.max(), rtol=0.03)  # each facet reaches from one end to the other


def test_facets_share_the_aperture_among_them():
    over = lens(tilt=(0.2, -0.1), bend=(0.03, -0.04))
    tracks = row_tracks(over, radius_mm=1.0, pitch_mm=0.05)
    points, weights = spread_over(facets_of(surface_of(tracks, over, pitch_mm=0.05)), np.zeros(2), np.full(2, SIDE_MM))
    assert weights.sum() == pytest.approx(SIDE_MM**2, rel=2e-3)
    assert len(points) > 1000


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


@pytest.mark.parametrize(
    ("radius", "pitch", "step", "noise", "is_crossed"),
    [
        (0.5, 0.02, 0.0, 0.0, False),
        pytest.param(0.5, 0.02, 0.0, 0.0005, False, marks=pytest.mark.thorough),
        pytest.param(0.5, 0.02, 0.002, 0.0005, False, marks=pytest.mark.thorough),
        (3.0, 0.05, 0.002, 0.0, False),
        pytest.param(3.0, 0.05, 0.002, 0.0005, True, marks=pytest.mark.thorough),
        (0.5, 0.02, 0.0, 0.0, True),
    ],
)
def test_slopes_are_those_of_brute_force(radius, pitch, step, noise, is_crossed):
    """rms and histogram of what is added to the lens's slopes, within 5 %."""
    over = lens(tilt=(0.15, -0.1), bend=(0.03, -0.05))
    tracks = crossed(over, radius, pitch) if is_crossed else row_tracks(over, radius_mm=radius, pitch_mm=pitch)
    tracks = tracks.made_by(step_mm=step, noise=Noise(sigma_mm=noise))
    facets = facets_of(surface_of(tracks, over, pitch_mm=pitch, step_mm=step, z_noise_mm=noise))
    low, high = np.array([0.7, 0.8]), np.array([1.1, 1.2])
    points, weights = spread_over(facets, low, high)
    spline = over.spline()
    x, y = np.random.default_rng(5).uniform(low, high, (6000, 2)).T
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


@given(step=st.sampled_from([0.001, 0.002, 0.004, 0.02]), chord=st.floats(0.003, 0.03), seed=st.integers(0, 1000))
@settings(max_examples=3, deadline=None)
def test_facets_of_coarse_steps_cover_the_aperture_once(step, chord, seed):
    """Steps as long as moves make corners steeper than any ball shows, and slivers: no light is lost or counted twice.

    Within 2 %: the ends of slivers are found to a tenth of a move.
    """
    rng = np.random.default_rng(seed)
    over = lens(tilt=tuple(rng.uniform(-0.3, 0.3, 2)), side_mm=1.0)
    tracks = row_tracks(over, radius_mm=0.5, pitch_mm=0.02)
    near = (np.abs(tracks.tips_mm[:, 1] - 0.5) < 0.6) | ~tracks.joined
    tracks = Tracks(radius_mm=0.5, tips_mm=tracks.tips_mm[near], joined=tracks.joined[near])
    tracks = tracks.divided(chord).made_by(step_mm=step, noise=Noise(sigma_mm=0.001, seed=seed))
    facets = facets_of(surface_of(tracks, over, pitch_mm=max(0.02, step), step_mm=step, z_noise_mm=0.001))
    assert np.isfinite(facets).all()
    _, weights = spread_over(facets, np.full(2, 0.2), np.full(2, 0.8), parts=10)
    assert weights.sum() == pytest.approx(0.36, rel=0.02)


def test_steps_are_whole_and_noise_is_one_error_a_row():
    over = lens(tilt=(0.1, 0.0))
    plain = row_tracks(over, radius_mm=1.0, pitch_mm=0.1)
    stepped = plain.made_by(step_mm=0.004)
    assert np.abs(stepped.tips_mm / 0.004 - np.round(stepped.tips_mm / 0.004)).max() < 1e-6
    assert np.abs(stepped.tips_mm - plain.tips_mm).max() <= 0.002 + 1e-12
    noisy = plain.made_by(noise=Noise(sigma_mm=0.001))
    error = noisy.tips_mm[:, 2] - plain.tips_mm[:, 2]
    rows = [error[plain.tips_mm[:, 1] == y] for y in np.unique(plain.tips_mm[:, 1])]
    rows = [row for row in rows if row.size > 10]
    assert len(rows) > 30
    assert all(np.ptp(row) < 1e-12 for row in rows)
    assert np.std([row[0] for row in rows]) == pytest.approx(0.001, rel=0.4)
    again = plain.made_by(noise=Noise(sigma_mm=0.001))
    assert np.array_equal(noisy.tips_mm, again.tips_mm)


def test_a_wandering_error_keeps_its_size_and_forgets_itself():
    way = np.arange(0.0, 4000.0, 0.5)
    tips = np.stack([way, 0 * way, 0 * way], axis=1)
    joined = np.ones(way.size, dtype=bool)
    joined[[0, 4000]] = False
    error = Noise(sigma_mm=0.002, rows_run=None, wander_mm=5.0).errors_mm(tips, joined)
    assert error.std() == pytest.approx(0.002, rel=0.15)
    for apart in (2, 10, 20):
        kept = np.mean(error[:-apart] * error[apart:]) / np.mean(error**2)
        assert kept == pytest.approx(math.exp(-apart * 0.5 / 5.0), abs=0.12)


def test_only_cuts_leave_a_surface_and_a_lift_parts_two_chains():
    text = b"G21 G90\nM3 S1000\nG0 Z5\nG0 X0 Y0\nG1 Z-1 F100\nX1\nY1\nG0 Z5\nG0 X3 Y3\nG1 Z-1\nX4\nM5\nM2\n"
    tracks = Tracks.of_program(read_program([text]), radius_mm=0.5)
    assert tracks.joined.tolist() == [False, True, True, False, True]
    assert tracks.tips_mm[:, 0].tolist() == [0.0, 1.0, 1.0, 3.0, 4.0]
    assert (tracks.tips_mm[:, 2] == -1.0).all()


def test_the_deeper_of_two_programs_counts():
    """A path run again higher changes nothing; the same path again is not counted twice."""
    over = lens()
    tracks = row_tracks(over, radius_mm=1.0, pitch_mm=0.1)
    low, high = np.full(2, 0.5), np.full(2, 1.5)
    higher = Tracks(radius_mm=1.0, tips_mm=tracks.tips_mm + np.array([0, 0.03, 0.01]), joined=tracks.joined)
    alone, weights = spread_over(facets_of(surface_of(tracks, over, pitch_mm=0.1)), low, high)
    for other in (tracks, higher):
        both = MilledSurface.of_tracks([tracks, other], over, pitch_mm=0.1)
        found, share = spread_over(facets_of(both), low, high)
        assert share.sum() == pytest.approx(weights.sum(), rel=1e-3)
        assert rms(found[:, 4], share) == pytest.approx(rms(alone[:, 4], weights), rel=1e-2)


def test_samples_have_the_slopes_of_the_whole():
    over = lens(tilt=(0.1, 0.05), bend=(0.02, 0.01), side_mm=6.0)
    samples = np.concatenate(sample_facets(over, radius_mm=1.0, pitch_mm=0.05, z_noise_mm=0.0003))
    tracks = row_tracks(over, radius_mm=1.0, pitch_mm=0.05).made_by(noise=Noise(sigma_mm=0.0003))
    whole = facets_of(surface_of(tracks, over, pitch_mm=0.05, z_noise_mm=0.0003))
    slopes = []
    for facets in (samples, whole):
        points, weights = spread_over(facets, np.full(2, 0.5), np.full(2, 5.5), parts=4)
        slopes.append(rms(points[:, 4] - over.spline().jets(points[:, 0], points[:, 1])[2], weights))
    assert slopes[0] == pytest.approx(slopes[1], rel=0.1)
