"""The planner model against closed forms."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.duration import DurationModel, Kinematics
from cam.reading.gcode import MoveBatch
from tests.cam.programs import read_program


def mill(**changes) -> Kinematics:
    usual = {
        "max_rate_mm_per_min": (6000.0, 6000.0, 1200.0),
        "acceleration_mm_per_s2": (500.0, 500.0, 200.0),
        "junction_deviation_mm": 0.01,
        "planner_blocks": 16,
        "lines_per_s": 1e9,
    }
    return Kinematics(**{**usual, **changes})


def moves(points, feed=600.0, rapid=False) -> MoveBatch:
    points = np.asarray(points, dtype=np.float64)
    n = len(points) - 1
    return MoveBatch(
        points_mm=points,
        is_rapid=np.full(n, rapid),
        feed_mm_per_min=np.full(n, float(feed)),
        line=np.arange(1, n + 1),
        spindle_rpm=np.full(n, 1e4),
        pause_s=np.full(n, -1.0),
        lines_read=n,
        bytes_read=0,
        ended=True,
    )


def seconds(batch: MoveBatch, **changes) -> float:
    model = DurationModel(mill(**changes))
    model.add(batch)
    return model.seconds


@given(st.floats(0.001, 500), st.floats(10, 6000))
def test_one_straight_block_is_a_trapezoid_or_a_triangle(length, feed):
    v, a = feed / 60, 500.0
    expected = length / v + v / a if length >= v * v / a else 2 * math.sqrt(length / a)
    assert seconds(moves([[0, 0, 0], [length, 0, 0]], feed)) == pytest.approx(expected, rel=1e-6)


def test_the_weakest_axis_sets_rate_and_acceleration():
    """Straight along Z: 20 mm/s and 200 mm/s2; at 45 degrees both are sqrt(2) more."""
    assert seconds(moves([[0, 0, 0], [0, 0, -10]], 6000)) == pytest.approx(10 / 20 + 20 / 200)
    v, a, length = 20 * math.sqrt(2), 200 * math.sqrt(2), 10 * math.sqrt(2)
    assert seconds(moves([[0, 0, 0], [10, 0, -10]], 6000)) == pytest.approx(length / v + v / a)
    assert seconds(moves([[0, 0, 0], [100, 0, 0]], rapid=True)) == pytest.approx(100 / 100 + 100 / 500)


def test_splitting_a_straight_line_changes_nothing():
    x = np.linspace(0, 50, 101)
    whole = seconds(moves([[0, 0, 0], [50, 0, 0]], 1200))
    assert seconds(moves(np.column_stack([x, 0 * x, 0 * x]), 1200)) == pytest.approx(whole, rel=1e-9)


def test_a_corner_is_taken_at_the_junction_speed():
    """v^2 = a d sin(t/2) / (1 - sin(t/2)), t the angle between the two directions; here 90 degrees."""
    half = math.sin(math.pi / 4)
    corner2 = 500 * math.sqrt(2) * 0.01 * half / (1 - half)  # the corner's direction is at 45 degrees: a sqrt(2)
    v, a, length = 20.0, 500.0, 50.0
    way = 2 * v - math.sqrt(corner2)  # speeds gained and lost, times a
    ramps = (2 * v * v - corner2) / (2 * a)
    expected = 2 * (way / a + (length - ramps) / v)
    assert seconds(moves([[0, 0, 0], [50, 0, 0], [50, 50, 0]], 1200)) == pytest.approx(expected, rel=1e-9)


def test_a_reversal_stops():
    one = seconds(moves([[0, 0, 0], [30, 0, 0]], 1200))
    assert seconds(moves([[0, 0, 0], [30, 0, 0], [0, 0, 0]], 1200)) == pytest.approx(2 * one, rel=1e-9)


@pytest.mark.parametrize("length", [0.02, 0.05, 0.1])
def test_look_ahead_bounds_the_speed_of_short_segments(length):
    """The planner must be able to stop within 15 blocks: v^2 <= 2 a 15 L at their joints."""
    n = 20_000
    x = np.arange(n + 1) * length
    flat_out = {"max_rate_mm_per_min": (1e6, 1e6, 1e6)}
    took = seconds(moves(np.column_stack([x, 0 * x, 0 * x]), 1e6), **flat_out)
    bound = math.sqrt(2 * 500 * 15 * length)
    # within a block it may still speed up and slow down by half a block's worth
    assert bound * 0.999 <= n * length / took <= math.sqrt(2 * 500 * 15.5 * length)


def test_more_look_ahead_is_never_slower():
    rng = np.random.default_rng(3)
    path = np.cumsum(rng.normal(0, 0.05, (3000, 3)), axis=0)
    times = [seconds(moves(path, 3000), planner_blocks=n) for n in (2, 4, 16, 100, 1000)]
    assert times == sorted(times, reverse=True)
    assert times[0] > times[-1]


def test_short_segments_wait_for_the_line():
    x = np.arange(4001) * 0.01
    model = DurationModel(mill(lines_per_s=200))
    model.add(moves(np.column_stack([x, 0 * x, 0 * x]), 6000))
    assert model.seconds == pytest.approx(4000 / 200, rel=0.01)
    fed = DurationModel(mill())
    fed.add(moves(np.column_stack([x, 0 * x, 0 * x]), 6000))
    assert model.starved_s == pytest.approx(model.seconds - fed.seconds, rel=0.01)
    assert fed.starved_s < 1e-3


def test_a_full_buffer_holds_lines_ready_for_a_burst():
    """While a long block runs, 15 lines wait in the buffer: the short blocks after it start at once."""
    points = [[0, 0, 0], [100, 0, 0], *[[100 + 0.01 * k, 0, 0] for k in range(1, 15)]]
    fast = seconds(moves(points, 600))
    assert seconds(moves(points, 600), lines_per_s=10) == pytest.approx(fast + 0.1, abs=1e-6)


def test_a_full_buffer_takes_no_more_lines():
    """Of 100 short blocks behind a long one 14 wait in the buffer; the others come over the line when it has room."""
    points = [[0, 0, 0], [100, 0, 0], *[[100 + 0.01 * k, 0, 0] for k in range(1, 101)]]
    long_s = 100 / 10 + 10 / 500
    assert seconds(moves(points, 600), lines_per_s=10) == pytest.approx(long_s + (100 - 14) / 10, abs=0.3)


def test_dwell_and_spindle_stop_the_mill():
    text = "G21G90\nG0Z0\nG0X0Y0\n{}G1X30F1200\n{}X60\n"
    plain = DurationModel(mill())
    stopped = DurationModel(mill())
    for batch in read_program([text.format("", "").encode()]):
        plain.add(batch)
    for batch in read_program([text.format("M3S1000\nG4P2\n", "G4P0.5\n").encode()]):
        stopped.add(batch)
    # 2.5 s of dwell, and one more stop: slowing down and speeding up cost v / a
    assert stopped.seconds - plain.seconds == pytest.approx(2.5 + 20 / 500, abs=1e-6)


def test_a_dwell_before_the_position_is_known_takes_its_time():
    """Programs start that way: up, spindle on, wait, and only then across."""
    text = "G21G90\nG0Z5\nM3S1000\n{}G0X0Y0\nG1X30F1200\nM5\nM2\n"
    times = []
    for dwell in ("", "G4P4\n"):
        model = DurationModel(mill())
        for batch in read_program([text.format(dwell).encode()]):
            model.add(batch)
        times.append(model.seconds)
    assert times[1] - times[0] == pytest.approx(4.0)


@given(st.integers(1, 400), st.integers(0, 2**32 - 1))
def test_batches_change_nothing(size, seed):
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal(0, 0.2, (301, 3)), axis=0)
    whole = DurationModel(mill(lines_per_s=300))
    whole.add(moves(path))
    parts = DurationModel(mill(lines_per_s=300))
    for start in range(0, 300, size):
        piece = moves(path[start : start + size + 1])
        piece.line[:] += start
        parts.add(piece)
        assert parts.seconds >= 0  # asking on the way does no harm
    assert parts.seconds == pytest.approx(whole.seconds, rel=1e-12)


@pytest.mark.parametrize(
    "bad", [{"planner_blocks": 1}, {"lines_per_s": 0}, {"acceleration_mm_per_s2": (0.0, 1.0, 1.0)}]
)
def test_impossible_mills_are_refused(bad):
    with pytest.raises(ValueError):
        mill(**bad)


class Sent(NamedTuple):
    """A batch that says how many bytes its lines are."""

    points_mm: np.ndarray
    is_rapid: np.ndarray
    feed_mm_per_min: np.ndarray
    line: np.ndarray
    pause_s: np.ndarray
    sent_bytes: np.ndarray

    def __len__(self) -> int:
        return len(self.line)


@pytest.mark.parametrize(
    ("bytes_per_line", "lines_per_s", "line_s"), [(20, 1e9, 20 / 11520), (20, 400, 1 / 400), (40, 400, 40 / 11520)]
)
def test_a_line_arrives_after_the_longer_of_its_bytes_and_the_parsers_time(bytes_per_line, lines_per_s, line_s):
    """Blocks far shorter than their lines take to come: the line sets the time, whole batch or in pieces."""
    n = 3000
    batch = moves(np.column_stack([np.arange(n + 1) * 1e-4, np.zeros(n + 1), np.zeros(n + 1)]), feed=6000)
    sent = np.arange(1, n + 1) * float(bytes_per_line)
    fields = (batch.points_mm, batch.is_rapid, batch.feed_mm_per_min, batch.line, batch.pause_s)
    model = DurationModel(mill(lines_per_s=lines_per_s, bytes_per_s=11520))
    for first, last in ((0, 1000), (1000, 1001), (1001, n)):
        points, *others = (field[first : last + (field is fields[0])] for field in fields)
        model.add(Sent(points, *others, sent[first:last]))
    assert model.seconds == pytest.approx(n * line_s, rel=0.01)


def test_without_a_wire_rate_or_without_bytes_only_lines_count():
    n = 2000
    batch = moves(np.column_stack([np.arange(n + 1) * 1e-4, np.zeros(n + 1), np.zeros(n + 1)]), feed=6000)
    assert seconds(batch, lines_per_s=500, bytes_per_s=1.0) == pytest.approx(n / 500, rel=0.01)
    fields = (batch.points_mm, batch.is_rapid, batch.feed_mm_per_min, batch.line, batch.pause_s)
    model = DurationModel(mill(lines_per_s=500))
    model.add(Sent(*fields, np.arange(n) * 1e6))
    assert model.seconds == pytest.approx(n / 500, rel=0.01)
    with pytest.raises(ValueError, match="bytes_per_s = 0"):
        mill(bytes_per_s=0)
