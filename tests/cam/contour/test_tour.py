"""Laws of the tour: every track once, joints short and as wide as there is room for, and inside it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.contour.joints import WORDS, draw, shortest
from cam.contour.tour import TIGHTEST_PITCHES, TURN_PITCHES, Room, tour_tracks, turn_radius_mm
from cam.contour.tracer import ContourLines

PITCH = 0.1


@given(st.floats(0.005, 1.0), st.floats(1.0, 300.0))
def test_turns_are_wide_on_a_large_lens_and_never_tighter_than_the_least(pitch, side):
    radius = turn_radius_mm(pitch, side)
    assert TIGHTEST_PITCHES * pitch <= radius * (1 + 1e-12)
    assert radius <= TURN_PITCHES * pitch * (1 + 1e-12)
    assert turn_radius_mm(pitch, 2 * side) >= radius
    if side > 1000 * pitch:
        assert radius == pytest.approx(TURN_PITCHES * pitch), "wide enough for five pitches: not felt by a mill"
    if side < 100 * pitch:
        assert radius == pytest.approx(TIGHTEST_PITCHES * pitch), "a turn at every row's end would be half the path"


def rows(count: int, length_mm: float) -> ContourLines:
    y = PITCH * np.arange(count)
    ends = np.stack([np.column_stack([np.zeros(count), y]), np.column_stack([np.full(count, length_mm), y])], axis=1)
    return ContourLines(xy_mm=ends.reshape(-1, 2), start=np.arange(0, 2 * count + 1, 2))


def room(radius: float, ring: float, length_mm: float, count: int) -> Room:
    return Room(x_from=-ring, x_to=length_mm + ring, y_from=-ring, y_to=PITCH * count + ring, radius=radius)


def turned(xy: np.ndarray) -> np.ndarray:
    ahead = np.diff(xy, axis=0)
    ahead = ahead[np.hypot(*ahead.T) > 1e-9]
    angle = np.diff(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return np.abs((angle + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.thorough
@settings(max_examples=30, deadline=None)
@given(st.integers(2, 30), st.floats(0.5, 5.0), st.floats(0.5, 3.0), st.floats(0.3, 5.0))
def test_every_row_is_on_the_path_once_and_the_path_stays_in_the_room_without_corners(count, length, radius, ring):
    """Even where the ring is a third of a pitch wide: turns are as tight as that, not corners."""
    tracks, into = rows(count, length), room(radius * PITCH, ring * PITCH, length, count)
    path = tour_tracks(tracks, into, (0.0, -ring * PITCH / 2, 0.0), pitch_mm=PITCH)
    for row in tracks.xy_mm.reshape(-1, 2, 2):
        at = [k for k in range(len(path) - 1) if {tuple(path[k]), tuple(path[k + 1])} == {tuple(row[0]), tuple(row[1])}]
        assert len(at) == 1
    slack = 1e-9
    assert path[:, 0].min() >= into.x_from - slack
    assert path[:, 0].max() <= into.x_to + slack
    assert path[:, 1].min() >= into.y_from - slack
    assert path[:, 1].max() <= into.y_to + slack
    assert turned(path).max() < np.radians(60)


def test_where_there_is_room_turns_have_their_radius():
    tracks, into = rows(20, 5.0), room(3 * PITCH, 8 * PITCH, 5.0, 20)
    path = tour_tracks(tracks, into, (0.0, -4 * PITCH, 0.0), pitch_mm=PITCH)
    steps = np.hypot(*np.diff(path, axis=0).T)
    arcs = (steps[1:] < 0.5 * PITCH) & (steps[:-1] < 0.5 * PITCH)
    bend = turned(path)[arcs] / (0.5 * (steps[1:] + steps[:-1])[arcs])
    assert bend.max() <= 1.05 / (3 * PITCH)


@pytest.mark.parametrize("seed", range(4))
def test_no_tracks_are_left_behind_to_cross_the_lens_for(seed):
    """Rows with ends at random; a joint has 4.7 to 5.2 pitches on average, 5.7 to 5.9 where the nearest is taken."""
    count, rng = 60, np.random.default_rng(seed)
    begin = rng.uniform(0, 2, count)
    tracks, into = rows(count, 5.0), room(0.48 * PITCH, 12 * PITCH, 5.0, count)
    tracks.xy_mm[:, 0] = np.column_stack([begin, begin + rng.uniform(1, 3, count)]).ravel()
    path = tour_tracks(tracks, into, (-PITCH, 0.0, 0.0), pitch_mm=PITCH)
    joints = np.hypot(*np.diff(path, axis=0).T).sum() - np.diff(tracks.xy_mm[:, 0])[::2].sum()
    assert joints < 5.3 * PITCH * count


@pytest.mark.thorough
def test_a_closed_track_is_gone_round_once_and_left_where_it_was_entered():
    angle = np.linspace(0, 2 * np.pi, 61)
    ring = np.column_stack([2 + np.cos(angle), 2 + np.sin(angle)])
    ring[-1] = ring[0]
    tracks = ContourLines(xy_mm=ring, start=np.array([0, 61]))
    into = Room(x_from=-1, x_to=5, y_from=-1, y_to=5, radius=0.2)
    path = tour_tracks(tracks, into, (1.0, -0.5, 0.0), pitch_mm=PITCH)
    on_it = np.abs(np.hypot(*(path - 2).T) - 1) < 1e-9
    assert on_it.sum() == 61
    first, last = np.flatnonzero(on_it)[[0, -1]]
    np.testing.assert_allclose(path[first], path[last])
    assert last - first == 60
    assert path[-1, 0] in (-1, 5) or path[-1, 1] in (-1, 5), "the path ends at the border of its room"


PLACE, HEADING, RADIUS = st.floats(-5, 5), st.floats(-math.pi, math.pi), st.floats(0.1, 2)
POSE = st.tuples(PLACE, PLACE, HEADING)


def drawn(a, radius, curve) -> np.ndarray:
    out = np.empty((100, 2))
    return np.concatenate([[a[:2]], out[: draw(*a, radius, *curve[1:], out, 0)]])


@given(POSE, POSE, RADIUS)
def test_it_ends_at_the_place_with_the_heading(a, b, radius):
    curve = shortest(*a, *b, radius)
    points = drawn(a, radius, curve)
    assert np.hypot(*(points[-1] - b[:2])) < 1e-6 * (1 + radius)
    turned = a[2] + sum(way * piece for way, piece in zip(WORDS[curve[1]], curve[2:], strict=True))
    assert math.cos(turned - b[2]) == pytest.approx(1, abs=1e-9)


@given(POSE, POSE, RADIUS)
def test_the_way_back_is_as_long(a, b, radius):
    there = shortest(*a, *b, radius)[0]
    back = shortest(*b[:2], b[2] + math.pi, *a[:2], a[2] + math.pi, radius)[0]
    assert back == pytest.approx(there, abs=1e-5 * (1 + radius))
    assert there >= math.hypot(b[0] - a[0], b[1] - a[1]) - 1e-9


@given(POSE, st.floats(2, 8), RADIUS)
def test_to_a_row_two_radii_off_it_is_half_a_circle(a, _, radius):
    x, y, h = a
    across = (x - 2 * radius * math.sin(h), y + 2 * radius * math.cos(h))
    assert shortest(*a, *across, h + math.pi, radius)[0] == pytest.approx(math.pi * radius, rel=1e-6)
