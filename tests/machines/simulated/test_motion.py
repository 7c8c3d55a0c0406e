"""The simulated axes obey physics and the plan: time, corners, path, braking."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.simulated import GRBL_11, SimulatedMill
from tests.machines.simulated.terminal import power_up

FAST = replace(GRBL_11, lines_per_s=None)
ACCEL, RATE = 400.0, 5000.0 / 60


def run(lines: list[str], traits=FAST) -> SimulatedMill:
    """A mill that has executed these lines, sent one after the other's ok."""
    mill = SimulatedMill(traits)
    port = power_up(mill, None)
    waiting, k = 0, 0
    while k < len(lines) or waiting:
        while waiting < 4 and k < len(lines):
            port.write(lines[k].encode() + b"\n")
            waiting, k = waiting + 1, k + 1
        words = port.read(1000.0)
        assert words and b"error" not in words and b"ALARM" not in words, (words, k)
        waiting -= words.count(b"ok")
    while mill.firmware.state == "Run":
        mill.advance(mill.now_s + 0.5)
    return mill


@pytest.mark.parametrize(("length_mm", "feed"), [(10.0, 600.0), (100.0, 4800.0), (0.5, 4800.0), (0.001, 3000.0)])
def test_time_of_a_trapezoid(length_mm, feed):
    """From rest to rest: v/a + l/v, or 2 sqrt(l/a) if the speed is not reached."""
    mill = run([f"G1X{length_mm}F{feed}"])
    v = feed / 60
    expected = v / ACCEL + length_mm / v if length_mm > v * v / ACCEL else 2 * math.sqrt(length_mm / ACCEL)
    assert mill.recording.segments[-1].at_s - 1.0 == pytest.approx(expected, abs=2e-6 + 1e-9)


@pytest.mark.parametrize("degrees", [20.0, 60.0, 90.0, 135.0])
def test_corner_speed_by_junction_deviation(degrees):
    """v^2 = a d sin(h) / (1 - sin(h)) with h half the angle between the legs: seen in the time of two long legs."""
    turn = math.radians(degrees)
    x, y = 20 + 20 * math.cos(turn), 20 * math.sin(turn)
    slow = GRBL_11.with_settings({11: 0.02, 110: 9000, 111: 9000})
    mill = run(["G1X20F3000", f"X{x:.9f}Y{y:.9f}"], replace(slow, lines_per_s=None))
    corner_axis = max(abs(math.cos(turn) - 1), abs(math.sin(turn))) / math.hypot(math.cos(turn) - 1, math.sin(turn))
    half = math.cos(turn / 2)
    v2 = min(50.0**2, ACCEL / corner_axis * 0.02 * half / (1 - half))
    accel = [ACCEL, ACCEL / max(abs(math.cos(turn)), abs(math.sin(turn)))]
    corner = math.sqrt(v2)

    def leg(a):  # from rest to the corner speed over 20 mm with a cruise at 50 mm/s
        ramps = (2 * 2500 - v2) / (2 * a)
        return (2 * 50 - corner) / a + (20 - ramps) / 50

    assert mill.recording.segments[-1].at_s - 1.0 == pytest.approx(leg(accel[0]) + leg(accel[1]), rel=1e-6)


coordinate = st.integers(-50_000, 50_000).map(lambda n: n / 10_000)
moves = st.lists(
    st.tuples(st.sampled_from(["G0", "G1"]), coordinate, coordinate, coordinate, st.integers(50, 6000)), min_size=1
)


@given(moves=moves)
def test_path_cut_is_the_path_programmed(moves):
    """Every block once, in order, end to end."""
    mill = run([f"{g}X{x:.4f}Y{y:.4f}Z{z:.4f}F{f}" for g, x, y, z, f in moves])
    at, expected = (0.0, 0.0, 0.0), []
    for g, *point, _ in moves:
        if tuple(point) != at:
            expected.append((at, tuple(point), g == "G0"))
            at = tuple(point)
    assert [(s.start, s.end, s.rapid) for s in mill.recording.segments] == expected


@given(moves=moves, when=st.floats(0.01, 2.0))
def test_a_hold_stops_on_the_path_within_its_braking_distance_and_resumes_to_the_same_path(moves, when):
    """Braking starts behind the segment buffer (6 x 10 ms at most), then takes v^2 / 2a with the a of the path."""
    traits = replace(FAST, rx_bytes=10_000)
    mill = SimulatedMill(traits)
    port = power_up(mill, None)
    port.write(b"".join(b"%sX%.4fY%.4fZ%.4fF%d\n" % (g.encode(), x, y, z, f) for g, x, y, z, f in moves))
    mill.advance(1.0 + when)
    stepper = mill.firmware.stepper
    moving, start = stepper.moving, np.array(stepper.where(mill.now_s))
    before = list(mill.recording.segments)
    held_at = mill.now_s
    mill.press("hold")
    mill.advance(mill.now_s + 3.0)
    assert mill.firmware.state_word() == "Hold:0"
    after = mill.recording.segments[len(before) :]
    if moving:
        way = np.array([np.linalg.norm(np.subtract(s.end, s.start)) for s in after])
        done = np.linalg.norm(start - np.array(after[0].start)) if after else 0.0
        v = 1500.0 / 60 + 5000.0 / 60 * math.sqrt(2)  # nothing moves faster
        assert way.sum() - done <= v * 0.06 + v * v / (2 * 200.0)
        assert after[-1].at_s - held_at <= 0.06 + v / 200.0
    mill.press("start")
    mill.advance(mill.now_s + 1000.0)
    points = [(0.0, 0.0, 0.0), *[tuple(m[1:4]) for m in moves]]
    points = [p for k, p in enumerate(points) if k == 0 or p != points[k - 1]]
    segments = mill.recording.segments
    assert [s.end for s in segments if s.whole] == points[1:]
    corner = 0
    for s in segments:  # each piece lies on its block, pieces join
        a, b = np.array(points[corner]), np.array(points[corner + 1])
        assert np.linalg.norm(np.cross(b - a, np.array(s.end) - a)) <= 1e-6 * np.linalg.norm(b - a)
        corner += s.whole
    assert all(a.end == b.start for a, b in pairwise(segments))


def test_a_hold_brakes_behind_what_the_segment_buffer_holds():
    """40 to 50 ms at full speed, then v^2 / 2a: the figures of GRBL's segment buffer, not an instant stop."""
    mill = SimulatedMill(FAST)
    port = power_up(mill, None)
    port.write(b"G1X200F4800\n")
    mill.advance(2.0)
    start = mill.firmware.stepper.where(mill.now_s)[0]
    mill.press("hold")
    mill.advance(4.0)
    way = mill.firmware.stepper.x - start - 80.0**2 / (2 * ACCEL)
    assert 0.04 * 80 - 1e-9 <= way <= 0.05 * 80 + 1e-9


@given(moves=moves)
def test_no_segment_is_longer_than_its_slot(moves):
    """The segment buffer bounds how long a hold waits: no piece of it lasts more than 10 ms."""
    mill = SimulatedMill(replace(FAST, rx_bytes=10_000))
    port = power_up(mill, None)
    port.write(b"".join(b"%sX%.4fY%.4fZ%.4fF%d\n" % (g.encode(), x, y, z, f) for g, x, y, z, f in moves))
    for _ in range(50):
        mill.advance(mill.now_s + 0.05)
        assert all(took <= 0.01 + 1e-9 for _, _, _, took, _ in mill.firmware.stepper.segments.queue)
        assert len(mill.firmware.stepper.segments.queue) <= 5


def test_an_arc_is_cut_within_its_tolerance():
    mill = run(["G2X10Y0I5J0F1000", "G3X0Y0R5", "G17G2X0Y0I3F500"])
    points = np.array([s.end for s in mill.recording.segments])
    first = points[: next(i for i, p in enumerate(points) if tuple(p) == (10.0, 0.0, 0.0))]
    radius = np.hypot(first[:, 0] - 5, first[:, 1])
    assert radius == pytest.approx(5.0, abs=1e-9)
    assert first[:, 1].max() == pytest.approx(5.0, abs=0.01)  # G2 goes over the top, clockwise
    assert points[len(first) + 1 :, 1].max() == pytest.approx(5.0, abs=0.01)  # and G3 R back the same way
    chord = np.linalg.norm(np.diff(first, axis=0), axis=1).max()
    assert 5 - math.sqrt(25 - chord**2 / 4) <= 0.002 * 1.3
    assert tuple(points[-1]) == (0.0, 0.0, 0.0)


def test_feed_override_changes_the_speed_of_what_is_planned():
    mill = SimulatedMill(FAST)
    port = power_up(mill, None)
    port.write(b"G1X50F600\nX100\n")
    mill.advance(2.0)
    assert mill.firmware.stepper.speed == pytest.approx(10.0)
    port.write(b"\x91" * 10)
    mill.advance(2.5)
    assert mill.firmware.stepper.speed == pytest.approx(20.0)
    port.write(b"\x90")
    mill.advance(3.0)
    assert mill.firmware.stepper.speed == pytest.approx(10.0)
    port.write(b"\x92" * 9)
    mill.advance(4.0)
    assert mill.firmware.stepper.speed == pytest.approx(1.0)
    assert len(mill.firmware.stepper.planner.blocks) == 2


def test_time_of_a_finishing_path_agrees_with_the_duration_model():
    from cam.duration import DurationModel, Kinematics
    from cam.reading.gcode import MoveBatch

    rng = np.random.default_rng(5)
    n = 2500
    x = np.cumsum(rng.uniform(0.02, 0.3, n))
    points = np.column_stack((x, 0.02 * (np.arange(n) // 250), -2 + np.cumsum(rng.normal(0, 0.01, n)))).round(5)
    lines = [f"G1X{a:.5f}Y{b:.5f}Z{c:.5f}F2400" for a, b, c in points]
    mill = run(lines)
    model = DurationModel(
        Kinematics(
            max_rate_mm_per_min=(5000.0, 5000.0, 1500.0),
            acceleration_mm_per_s2=(400.0, 400.0, 200.0),
            junction_deviation_mm=0.01,
            planner_blocks=16,
            lines_per_s=1e9,
        )
    )
    every = np.vstack((np.zeros(3), points))
    model.add(
        MoveBatch(
            points_mm=every,
            is_rapid=np.zeros(n, dtype=bool),
            feed_mm_per_min=np.full(n, 2400.0),
            line=np.arange(1, n + 1),
            spindle_rpm=np.full(n, 1e4),
            lines_read=n,
            bytes_read=20 * n,
            ended=True,
            pause_s=np.full(n, -1.0),
        )
    )
    assert mill.recording.segments[-1].at_s - 1.0 == pytest.approx(model.seconds, rel=0.03)
