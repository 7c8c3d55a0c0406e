"""Feeds by load: what a row takes off is known before it is cut, and the written programs take off as much a minute."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.checking.flat_removal import removal_of
from cam.checking.sweep import LEFT, RIGHT
from cam.passes import PassSpec, Stock, ball_pass
from cam.posts.dialects import GRBL
from cam.program import pass_paths
from cam.reading.gcode import MoveBatch
from cam.rows.loads import LEAST_FEED, LOAD_SHARE, MOST_FEED, Runs, choose_feeds, feed_at_load, measure_cuts
from cam.surface.stock_grid import StockGrid
from cam.surface.stock_touch import slot_section_mm2
from tests.cam.checks import checked
from tests.cam.lenses import make_bumps
from tests.cam.programs import generate_program, read_program

STOCK = Stock(width_mm=12, height_mm=9, thickness_mm=10, margin_mm=3)
FINE = ball_pass("rough", radius_mm=1.0, pitch_mm=0.1, stock_to_leave_mm=0.1, step_down_mm=0.6)


@pytest.fixture(scope="module")
def hills():

    return make_bumps(5, relief_mm=2.0, width_mm=12.0, height_mm=9.0, spread_mm=2.0)


@pytest.mark.parametrize("radius_mm", [0.5, 3.0])
@pytest.mark.parametrize("corner_share", [1.0, 0.3, 0.0])
@pytest.mark.parametrize("depth_share", [0.1, 0.5])
def test_sections_of_slots_and_of_rows_beside_others(radius_mm, corner_share, depth_share):
    """In a plane a slot is a segment of the ball's circle, and a row beside one that is cut takes pitch by depth."""
    pitch, depth = radius_mm / 6, depth_share * radius_mm
    spec = replace(FINE, radius_mm=radius_mm, corner_radius_mm=corner_share * radius_mm)
    y = pitch * np.arange(30)
    now, tips = np.zeros((30, 4)), np.full((30, 4), -depth)
    run = Runs(*np.array([[15], [0], [3], [1], [-1]]))

    def measure() -> np.ndarray:
        return measure_cuts(now.copy(), tips, y, run, spec, top_mm=0.0)[0]

    slot = measure()
    np.testing.assert_allclose(slot[:, 0], slot[:, 1])
    np.testing.assert_allclose(slot[:, :2].sum(axis=1), slot_section_mm2(spec.shape, radius_mm, depth), rtol=0.03)
    np.testing.assert_allclose(slot[:, 2], depth, rtol=0.03)
    now[:15] = -depth
    beside = measure()
    np.testing.assert_allclose(beside[:, :2].sum(axis=1), pitch * depth, rtol=0.05)
    assert (beside[:, 0] > 5 * beside[:, 1]).all()  # towards greater Y, where no row has been cut
    now[15:] = -depth
    assert measure().max() < 1e-12


def shorten(batch: MoveBatch, most_mm: float) -> MoveBatch:
    """Return the same way in moves no longer than that."""
    step = batch.end_mm - batch.start_mm
    counts = np.maximum(1, np.ceil(np.linalg.norm(step, axis=1) / most_mm)).astype(int)
    move = np.repeat(np.arange(len(batch)), counts)
    part = np.concatenate([np.arange(1, n + 1) / n for n in counts])
    return replace(
        batch,
        points_mm=np.vstack([batch.points_mm[:1], batch.start_mm[move] + part[:, None] * step[move]]),
        is_rapid=batch.is_rapid[move],
        feed_mm_per_min=batch.feed_mm_per_min[move],
        line=batch.line[move],
        spindle_rpm=batch.spindle_rpm[move],
        pause_s=batch.pause_s[move],
    )


def loads_of(text, spec: PassSpec, top: StockGrid):
    """Volume and stock a minute of each stretch of a written program as long as the ball's radius, by simulation."""
    grid, found = removal_of(spec.shape, top, radius_mm=spec.radius_mm), []
    for batch in read_program(text):
        batch = shorten(batch, spec.radius_mm / 4)
        taken = grid.cut(batch).tally[1:, LEFT : RIGHT + 1].sum(axis=1)
        length = np.linalg.norm(batch.end_mm - batch.start_mm, axis=1)
        volume = minutes = along = 0.0
        for k in range(len(batch)):
            if batch.is_rapid[k]:
                volume = minutes = along = 0.0
            if batch.is_rapid[k] or length[k] == 0.0:
                continue
            volume, along = volume + taken[k], along + length[k]
            minutes += length[k] / batch.feed_mm_per_min[k]
            if along >= spec.radius_mm:
                found.append((volume, volume / minutes))
                volume = minutes = along = 0.0
    return np.array(found).T


@pytest.mark.parametrize("pitch_mm", [0.1, 0.3])
@pytest.mark.parametrize("direction", ["x", "y"])
@pytest.mark.parametrize("corner_mm", [None, 0.3, 0.0])
def test_a_rough_pass_takes_off_as_much_a_minute_everywhere(hills, pitch_mm, direction, corner_mm):
    spec = replace(FINE, pitch_mm=pitch_mm, direction=direction, corner_radius_mm=corner_mm)
    top = StockGrid.block(STOCK, 0.05)
    volume, load = loads_of(generate_program(hills, spec, STOCK, stock_top=top, post=GRBL), spec, top)
    allowed = LOAD_SHARE * slot_section_mm2(spec.shape, spec.radius_mm, spec.step_down_mm) * spec.feed_mm_per_min
    order = np.argsort(load)
    share = np.cumsum(volume[order]) / volume.sum()
    median, nearly_all = (load[order][np.searchsorted(share, part)] for part in (0.5, 0.98))
    assert 0.6 * allowed < median < allowed
    assert nearly_all < 1.1 * allowed
    assert load.max() < 1.4 * allowed


def test_feeds_stay_within_their_bounds_and_within_the_mill_s(hills):
    top = StockGrid.block(STOCK, 0.05)
    for rates in ((5000.0, 5000.0, 1500.0), (FINE.feed_mm_per_min, 900.0, 200.0)):
        spec, here, feeds = replace(FINE, max_rate_mm_per_min=rates), np.zeros(3), set()
        for path in pass_paths(hills, spec, STOCK, stock_top=top):
            way = np.abs(np.diff(np.vstack([here, path.points_mm]), axis=0))
            here, feed = path.points_mm[-1], path.feed_mm_per_min
            if feed not in (None, spec.plunge_mm_per_min):
                assert (feed * way <= 1.02 * np.linalg.norm(way, axis=1)[:, None] * rates + 1e-6).all()
                assert LEAST_FEED * spec.feed_mm_per_min - 1 <= feed <= MOST_FEED * spec.feed_mm_per_min
                feeds.add(feed)
        assert len(feeds) > 5
        assert max(feeds) <= feed_at_load(0.0, spec)


def test_planes_are_cut_on_rows_farther_apart_and_those_between_follow_once(hills, monkeypatch):
    """No farther apart than the next plane may meet their cusps: the check passes, with no gap wider than the pitch."""
    top = StockGrid.block(STOCK, 0.05)
    sparse = checked(hills, FINE, STOCK, top)
    monkeypatch.setattr("cam.rows.layers.PLANE_CUSP_SHARE", 0.0)
    dense = checked(hills, FINE, STOCK, top)
    for verdict in (sparse, dense):
        assert verdict.ok, verdict.faults
        assert verdict.max_gap_mm <= 1.01 * FINE.pitch_mm
    assert sparse.path_length_mm < 0.75 * dense.path_length_mm
    assert sparse.time_s < 0.8 * dense.time_s
    over_um = [max(window.highest_um for window in verdict.windows) for verdict in (sparse, dense)]
    assert over_um[0] <= over_um[1] + 1000 * FINE.pitch_mm**2 / (8 * FINE.radius_mm)


@given(
    counts=st.lists(st.integers(1, 40), min_size=2, max_size=6),
    seed=st.integers(0, 9),
    corner_mm=st.sampled_from((1.0, 0.0)),
)
def test_runs_that_are_chosen_for_at_once_have_the_feeds_of_each_alone(counts, seed, corner_mm):
    lot = np.random.default_rng(seed)
    spec = replace(FINE, corner_radius_mm=corner_mm, max_rate_mm_per_min=(900.0, 900.0, 60.0))
    one, ends = np.ones(len(counts), dtype=np.int64), np.cumsum(counts)
    bite, tips_mm = lot.uniform(0.0, 0.3, (ends[-1], 3)), lot.uniform(-0.2, 0.0, ends[-1])
    runs = Runs(one, 0 * one, np.array(counts) - 1, lot.choice([-1, 1], one.size), -one)
    together = choose_feeds(bite.copy(), tips_mm, runs, spec, step_mm=0.1)
    for number, (end, count) in enumerate(zip(ends, counts, strict=True)):
        own = slice(end - count, end)
        alone = Runs(*(values[number : number + 1] for values in runs))
        np.testing.assert_array_equal(
            together[own], choose_feeds(bite[own].copy(), tips_mm[own], alone, spec, step_mm=0.1)
        )
