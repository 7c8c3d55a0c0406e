"""What a move bites: slots, sides and plunges on flat stock, where every figure is known."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.checking.engagement import Engagement, _slot_section
from cam.checking.removal import RemovalGrid
from cam.cutters import end_mill
from cam.passes import ball_pass
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid
from cam.surface.stock_touch import rise_mm, slot_section_mm2

CELL = 0.05
SPEC = ball_pass("rough", radius_mm=1.0, pitch_mm=0.3, stock_to_leave_mm=0.1, step_down_mm=0.6)


def batch_of(points, feed=None) -> MoveBatch:
    points = np.asarray(points, dtype=np.float64)
    n = len(points) - 1
    return MoveBatch(
        points_mm=points,
        is_rapid=np.zeros(n, dtype=bool),
        feed_mm_per_min=np.full(n, SPEC.feed_mm_per_min if feed is None else feed),
        line=np.arange(1, n + 1),
        spindle_rpm=np.full(n, 1e4),
        pause_s=np.full(n, -1.0),
        lines_read=n,
        bytes_read=0,
        ended=True,
    )


def watch(*passes, feed=None, top=None) -> Engagement:
    """Paths cut one after the other into a block 12 x 8 mm, flat unless its top is given; only the last is watched."""
    stock = StockGrid(x0_mm=0, y0_mm=0, cell_mm=CELL, top_mm=np.zeros((160, 240)) if top is None else top)
    grid = RemovalGrid(stock, radius_mm=SPEC.radius_mm, shares=2)
    for points in passes[:-1]:
        grid.cut(batch_of(points))
    engagement = Engagement(SPEC, cell_mm=CELL)
    batch = batch_of(passes[-1], feed)
    engagement.add(batch, grid.cut(batch))
    return engagement


def row(y, z=-0.5, *, backward=False):
    points = [(x, y, z) for x in (-3.0, 5.0, 9.0)]
    return points[::-1] if backward else points


@given(depth=st.floats(0.05, 1.5), radius=st.sampled_from([0.5, 1.0, 3.0]), corner=st.sampled_from([0.0, 0.3, 1.0]))
def test_the_section_of_a_slot_is_what_lies_over_the_underside(depth, radius, corner):
    w = np.linspace(-radius, radius, 40_001)
    height = np.maximum(0.0, depth * radius - rise_mm(end_mill(corner), radius, np.abs(w)))
    section = pytest.approx(np.trapezoid(height, w), rel=1e-3)
    assert _slot_section(depth * radius, radius, corner * radius) == section
    assert slot_section_mm2(end_mill(corner), radius, depth * radius) == section


def test_a_first_row_is_a_slot_and_the_next_is_none():
    first, second = watch(row(4.0)), watch(row(4.0), row(4.3))
    assert first.slot_length_mm == pytest.approx(12.0)  # whole moves
    assert first.slot_depth_mm == pytest.approx(0.5, abs=1e-3)
    assert second.slot_length_mm == 0


@given(y=st.floats(3.5, 4.5), backward=st.booleans(), upward=st.booleans())
@settings(deadline=None, max_examples=10)
def test_a_row_climbs_with_the_stock_on_its_right(y, backward, upward):
    beside = y + (0.3 if upward else -0.3)
    climbs = watch(row(y), row(beside, backward=backward)).climb_share
    assert (climbs > 0.9) is (backward is upward)
    assert climbs > 0.9 or climbs < 0.1
    assert watch(row(y)).climb_share == pytest.approx(0.5, abs=0.05)


def test_a_slot_at_full_feed_is_a_fault_and_at_half_feed_none():
    assert watch(row(4.0), feed=0.5 * SPEC.feed_mm_per_min).faults == []
    (fault,) = watch(row(4.0)).faults
    assert "full width" in fault and fault.startswith("line ")
    assert watch(row(4.0, z=-0.2)).faults == []  # counted, but shallow
    assert watch(row(4.0, z=-0.2)).slot_length_mm > 8


def test_a_slow_move_is_not_fast_for_the_end_of_a_fast_one_before_it():
    points = [(-3.0, 4.0, -0.5), (1.0, 4.0, -0.5), (1.0 + CELL, 4.0, -0.5), (12.0, 4.0, -0.5)]
    slow = 0.5 * SPEC.feed_mm_per_min
    assert watch(points, feed=[slow, 2 * slow, slow]).faults == []


@pytest.mark.parametrize(("ribs", "gaps", "faulty"), [(0.5, 1.0, False), (1.0, 0.1, True)])
def test_a_slot_is_as_fast_as_its_stock_is_cut(ribs, gaps, faulty):
    """Turns and row ends share a stretch: the feed where hardly anything is cut neither spoils nor saves it."""
    top = np.where(np.arange(240) % 8 < 5, 0.0, -1.0) + np.zeros((160, 1))  # 0.25 mm of stock, 0.15 mm of none
    x = np.sort(np.concatenate([8 * CELL * np.arange(30), 8 * CELL * np.arange(30) + 5 * CELL]))
    feeds = SPEC.feed_mm_per_min * np.resize([ribs, gaps], x.size - 1)
    assert bool(watch([(one, 4.0, -0.5) for one in x], feed=feeds, top=top).faults) is faulty


def test_a_plunge_is_named_and_a_ramp_is_none():
    down = [(6, 4, 1), (6, 4, -0.4), (6, 4, 1)]
    (fault,) = watch(down).faults
    assert re.search(r"straight down 0\.(399|400) mm", fault) and fault.startswith("line 1 at X6.000 Y4.000")
    ramp = [(4, 4, 1), (4, 4, 0.05), (8, 4, -0.15), (4, 4, -0.3), (8, 4, -0.45)]
    assert watch(ramp, feed=SPEC.plunge_mm_per_min).faults == []


def test_flutes_must_be_as_long_as_the_bite():
    assert watch(row(4.0)).flute_need_mm == pytest.approx(0.5, abs=1e-3)
    deep = watch(row(4.0, -0.4), row(4.0, -0.8), row(4.05, -1.2))
    assert deep.flute_need_mm == pytest.approx(1.2, abs=0.05)  # along the wall up to the top


def test_pauses_and_rapids_bite_nothing():
    batch = batch_of(row(4.0))
    grid = RemovalGrid(StockGrid(x0_mm=0, y0_mm=0, cell_mm=CELL, top_mm=np.zeros((160, 240))), radius_mm=1.0)
    drops = grid.cut(batch)
    engagement = Engagement(SPEC, cell_mm=CELL)
    engagement.add(replace(batch, is_rapid=np.ones(2, dtype=bool)), drops)
    assert engagement.slot_length_mm == 0
