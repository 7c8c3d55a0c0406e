"""The surface that moves leave: laws of grooves, and brute force, point by point, over any path."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.as_milled.height_map import map_departure
from cam.as_milled.rows import sample_facets, tip_error_mm
from cam.as_milled.surface import MilledSurface, mill_heights
from cam.as_milled.tracks import Noise, Screws, Tracks
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield
from tests.cam.facet_points import rms, spread_over
from tests.cam.programs import read_program, row_tracks

SIDE_MM = 2.0


def lens(tilt=(0.0, 0.0), bend=(0.0, 0.0), side_mm=SIDE_MM):
    """A paraboloid under Z0: slopes in its middle, second derivatives."""
    axis = np.linspace(0.0, side_mm, 41)
    x, y = np.meshgrid(axis - side_mm / 2, axis - side_mm / 2)
    z = tilt[0] * x + tilt[1] * y + bend[0] * x**2 / 2 + bend[1] * y**2 / 2
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=side_mm, height_mm=side_mm)


def surface_of(tracks, over, *, pitch_mm, step_mm=0.0, z_noise_mm=0.0, within_mm=0.0):
    return MilledSurface.of_tracks(
        [tracks],
        over,
        pitch_mm=pitch_mm,
        error_mm=tip_error_mm(step_mm=step_mm, z_noise_mm=z_noise_mm),
        step_mm=within_mm,
    )


def facets_of(surface):
    return np.concatenate([surface.part(number) for number in range(surface.parts)])


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


@pytest.mark.parametrize("bend", [(0.03, -0.04), (-0.04, 0.03)])
def test_facets_share_the_aperture_among_them(bend):
    """In a valley balls at corners show between two chords, on a hill two chords meet where their balls cross."""
    over = lens(tilt=(0.2, -0.1), bend=bend)
    tracks = row_tracks(over, radius_mm=1.0, pitch_mm=0.05)
    points, weights = spread_over(facets_of(surface_of(tracks, over, pitch_mm=0.05)), np.zeros(2), np.full(2, SIDE_MM))
    assert weights.sum() == pytest.approx(SIDE_MM**2, rel=2e-3)
    assert len(points) > 1000


@pytest.mark.thorough
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
    tracks = tracks.divide(chord).run_on_mill(step_mm=step, noise=Noise(sigma_mm=0.001, seed=seed))
    facets = facets_of(surface_of(tracks, over, pitch_mm=max(0.02, step), step_mm=step, z_noise_mm=0.001))
    assert np.isfinite(facets).all()
    _, weights = spread_over(facets, np.full(2, 0.2), np.full(2, 0.8), parts=10)
    assert weights.sum() == pytest.approx(0.36, rel=0.02)


def test_steps_are_whole_and_noise_is_one_error_a_row():
    over = lens(tilt=(0.1, 0.0))
    plain = row_tracks(over, radius_mm=1.0, pitch_mm=0.1)
    stepped = plain.run_on_mill(step_mm=0.004)
    assert np.abs(stepped.tips_mm / 0.004 - np.round(stepped.tips_mm / 0.004)).max() < 1e-6
    assert np.abs(stepped.tips_mm - plain.tips_mm).max() <= 0.002 + 1e-12
    noisy = plain.run_on_mill(noise=Noise(sigma_mm=0.001))
    error = noisy.tips_mm[:, 2] - plain.tips_mm[:, 2]
    rows = [error[plain.tips_mm[:, 1] == y] for y in np.unique(plain.tips_mm[:, 1])]
    rows = [row for row in rows if row.size > 10]
    assert len(rows) > 30
    assert all(np.ptp(row) < 1e-12 for row in rows)
    assert np.std([row[0] for row in rows]) == pytest.approx(0.001, rel=0.4)
    again = plain.run_on_mill(noise=Noise(sigma_mm=0.001))
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


def test_a_trace_in_the_air_leaves_no_track():
    """The same tracks, and so the same noise, as without it."""
    trace, cuts = b"G0X-2Y-2Z5\nG1X4F900\nY4\nX-2\nY-2\n", b"M3S1000\nG0X0Y0Z5\nZ0\nG1Z-1F90\nX1\nY1Z-1.1\nG0Z5\nM2\n"
    with_it, without = (
        Tracks.of_program(read_program([text]), radius_mm=1.0) for text in (trace + cuts, b"G0X-2Y-2Z5\n" + cuts)
    )
    np.testing.assert_array_equal(with_it.tips_mm, without.tips_mm)
    np.testing.assert_array_equal(with_it.joined, without.joined)


@given(parting=st.integers(1, 4))
@settings(max_examples=4, deadline=None)
def test_a_program_that_is_read_in_batches_leaves_the_same_tracks(parting):
    (batch,) = read_program([b"G21 G90\nM3 S1000\nG0 Z5\nG0 X0 Y0\nG1 Z-1 F100\nX1\nY1\nX2\nG0 Z5\nM5\nM2\n"])
    assert len(batch) > 5
    parts = [
        replace(
            batch,
            points_mm=batch.points_mm[first : last + 1],
            **{name: getattr(batch, name)[first:last] for name in ("is_rapid", "feed_mm_per_min", "line", "pause_s")},
            spindle_rpm=batch.spindle_rpm[first:last],
        )
        for first, last in ((0, parting), (parting, len(batch)))
    ]
    whole, parted = (Tracks.of_program(batches, radius_mm=0.5) for batches in ([batch], parts))
    assert whole.joined.sum() == 3
    np.testing.assert_array_equal(parted.joined, whole.joined)
    np.testing.assert_array_equal(parted.tips_mm, whole.tips_mm)


def test_of_a_move_that_steps_have_made_vertical_the_deeper_end_counts():
    tips = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, -1.5], [2.0, 0.0, -1.0]])
    tracks = Tracks(radius_mm=0.5, tips_mm=tips, joined=np.array([False, True, True, True])).divide(10.0)
    assert tracks.tips_mm[:, 2].tolist() == [-1.0, -1.5, -1.0]
    assert tracks.joined.tolist() == [False, True, True]


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
    tracks = row_tracks(over, radius_mm=1.0, pitch_mm=0.05).run_on_mill(noise=Noise(sigma_mm=0.0003))
    whole = facets_of(surface_of(tracks, over, pitch_mm=0.05, z_noise_mm=0.0003))
    slopes = []
    for facets in (samples, whole):
        points, weights = spread_over(facets, np.full(2, 0.5), np.full(2, 5.5), parts=4)
        slopes.append(rms(points[:, 4] - over.spline().jets(points[:, 0], points[:, 1])[2], weights))
    assert slopes[0] == pytest.approx(slopes[1], rel=0.1)


RADIUS_MM = 0.8


def test_heights_are_the_lowest_ball_anywhere_on_the_tracks() -> None:
    """Against balls set down every 2 um along two chains of crooked chords; elsewhere the stock stays."""
    rng = np.random.default_rng(8)
    x = np.linspace(0.0, 1.2, 9)
    rows = [np.stack([x, np.full(9, y), -0.05 - 0.02 * rng.random(9)], axis=1) for y in (0.3, 0.42)]
    tips = np.concatenate(rows)
    joined = np.ones(18, dtype=np.bool_)
    joined[[0, 9]] = False
    before = StockGrid(x0_mm=0.0, y0_mm=0.0, cell_mm=0.04, top_mm=np.zeros((20, 30)))
    left = mill_heights([Tracks(radius_mm=RADIUS_MM, tips_mm=tips, joined=joined)], before)
    fine = np.concatenate(
        [np.stack([np.interp(np.linspace(0, 1.2, 601), x, row[:, d]) for d in range(3)], 1) for row in rows]
    )
    places = np.stack(np.meshgrid(left.x_mm, left.y_mm), axis=-1)
    away2 = ((places[:, :, None, :] - fine[:, :2]) ** 2).sum(axis=-1)
    balls = np.where(away2 < RADIUS_MM**2, fine[:, 2] + RADIUS_MM - np.sqrt(np.maximum(RADIUS_MM**2 - away2, 0.0)), 0.0)
    np.testing.assert_allclose(left.top_mm, np.minimum(balls.min(axis=2), 0.0), atol=2e-6)
    assert (left.top_mm[-1] == 0.0).any()


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


amplitudes = st.tuples(*3 * [st.floats(0.0, 0.02)])
leads = st.tuples(*3 * [st.floats(0.5, 8.0)])


@given(amplitudes, leads, st.lists(st.tuples(*3 * [st.floats(-50.0, 50.0)]), min_size=1, max_size=20))
def test_an_axis_is_off_by_what_its_screw_is_and_by_as_much_a_turn_later(
    error_mm: tuple[float, float, float], lead_mm: tuple[float, float, float], tips: list[tuple[float, float, float]]
) -> None:
    screws, tips_mm = Screws(error_mm=error_mm, lead_mm=lead_mm), np.array(tips)
    off = screws.errors_mm(tips_mm)
    assert (np.abs(off) <= np.array(error_mm) + 1e-12).all()
    np.testing.assert_allclose(off, screws.errors_mm(tips_mm + np.array(lead_mm)), atol=1e-9)
    assert (
        screws.longest_mm == min([lead for a, lead in zip(error_mm, lead_mm, strict=True) if a], default=math.inf) / 16
    )


@pytest.mark.parametrize(
    ("error_mm", "expected"),
    [
        ((0.0, 0.0, 0.004), lambda x, z: 0.004 * np.sin(2 * np.pi * z / 1.25)),
        ((0.01, 0.0, 0.0), lambda x, z: -0.3 * 0.01 * np.sin(2 * np.pi * x / 2.0)),  # aside on a slope is up or down
    ],
)
def test_a_ramp_is_left_in_the_waves_of_the_screws(error_mm: tuple[float, float, float], expected: object) -> None:
    slope, side_mm = 0.3, 8.0
    axis = np.linspace(0.0, side_mm, 81)
    lens = Heightfield.on_aperture(np.tile(slope * axis - 3.0, (81, 1)), width_mm=side_mm, height_mm=side_mm)
    screws = Screws(error_mm=error_mm, lead_mm=(2.0, 2.0, 1.25))
    tracks = row_tracks(lens, radius_mm=1.0, pitch_mm=0.05).divide(screws.longest_mm)
    made, meant = (
        map_departure([one], lens, pitch_mm=0.05, error_mm=0.005, finer=1).departure_mm[20:-20, 20:-20]
        for one in (tracks.run_on_mill(screws=screws), tracks)
    )
    # The tip stands a ball's radius off its contact, along the slope and in height.
    root = math.hypot(1.0, slope)
    x = axis[20:-20] - slope / root
    z = slope * axis[20:-20] - 3.0 - 1.0 + 1.0 / root
    wanted = expected(x, z)  # type: ignore[operator]
    np.testing.assert_allclose((made - meant).mean(axis=0), wanted, atol=0.12 * np.abs(wanted).max())
