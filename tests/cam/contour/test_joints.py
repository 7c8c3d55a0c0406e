"""Laws of the shortest curve of bounded curvature."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.contour.joints import WORDS, draw, shortest

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
