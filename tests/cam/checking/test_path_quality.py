"""Direction, turns and entries of paths for which they are known."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cam.checking.path_quality import PathQuality
from cam.passes import ball_pass
from cam.reading.gcode import MoveBatch
from optics.heightfield import Heightfield
from tests.cam.programs import measure_program, read_program

SIDE, PITCH, RADIUS = 6.0, 0.1, 0.5
SPEC = ball_pass("finish", radius_mm=RADIUS, pitch_mm=PITCH, stock_to_leave_mm=0.0, step_down_mm=0.1)


def plane(slope: float) -> Heightfield:
    """Rises along x: contour lines run along y."""
    x = np.linspace(0, SIDE, 61)
    return Heightfield.on_aperture(np.tile(slope * (x - SIDE) - 0.5, (61, 1)), width_mm=SIDE, height_mm=SIDE)


def text(points, *, decimals=4, lifted=()) -> bytes:
    """A program along tips (n, 3); `lifted` moves go 0.05 mm above."""
    lines = ["G21 G90 G94 G17 G54", "G0 Z5", "M3 S20000", "G4 P1"]
    lines += [f"G0 X{points[0][0]:.{decimals}f} Y{points[0][1]:.{decimals}f}", f"G1 Z{points[0][2]:.6f} F300", "F600"]
    for k, (x, y, z) in enumerate(points[1:]):
        lines.append(f"X{x:.{decimals}f} Y{y:.{decimals}f} Z{z + (0.05 if k in lifted else 0):.6f}")
    return "\n".join([*lines, "G0 Z5", "M5", "M2", ""]).encode()


def on_plane(xy, slope):
    """Tips of the ball on the plane: R (sqrt(1 + s^2) - 1) above it."""
    xy = np.asarray(xy, dtype=float)
    z = slope * (xy[:, 0] - SIDE) - 0.5 + RADIUS * (math.hypot(1, slope) - 1)
    return np.column_stack([xy, z])


def measured(xy, *, slope=0.0, **how):
    return measure_program(read_program([text(on_plane(xy, slope), **how)]), plane(slope), SPEC)


def rows(direction: float, spacing=PITCH, step=0.2):
    """Lines at an angle to the contour lines of `plane`, inside the aperture; joined at their ends."""
    along, across = (
        np.array([math.sin(direction), math.cos(direction)]),
        np.array([math.cos(direction), -math.sin(direction)]),
    )
    u = np.arange(-1.5, 1.5 + 1e-9, step)
    lines = [SIDE / 2 + np.outer(u[:: 1 - 2 * (n % 2)], along) + n * spacing * across for n in range(-10, 11)]
    return np.concatenate(lines)


@example(math.radians(13.5), 0.3)
@example(math.radians(16.5), 0.3)
@example(math.radians(73.5), 0.3)
@example(math.radians(76.5), 0.3)
@settings(max_examples=20, deadline=None)
@given(st.floats(0, math.pi / 2), st.floats(0.02, 0.5))
def test_lines_within_15_degrees_of_the_contour_are_aligned(direction, slope):
    lines = measured(rows(direction), slope=slope)
    links = 20 * PITCH / (21 * 3 + 20 * PITCH)  # across the lines
    if abs(direction - math.radians(15)) > 0.02 and abs(direction - math.radians(75)) > 0.02:
        aligned = (1 - links) if direction < math.radians(15) else links if direction > math.radians(75) else 0.0
        assert lines.aligned_share == pytest.approx(aligned, abs=0.01)


def test_where_it_is_flat_every_direction_is_right():
    assert measured(rows(1.0), slope=0.005).aligned_share == 1.0


def circle(radius, step, turns=1.0):
    angle = np.arange(0, turns * 2 * math.pi, step / radius)
    return SIDE / 2 + radius * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.thorough
@settings(max_examples=40, deadline=None)
@given(st.floats(0.5, 12), st.floats(0.02, 2.0))
def test_a_circle_turns_with_its_radius_whatever_its_vertices(pitches, spacing):
    """Up to 2 / 3 of the radius apart, and on the raster of 1e-4 mm down to 2 um."""
    radius, step = pitches * PITCH, min(spacing, 0.6 * pitches) * PITCH
    share = measured(circle(radius, step)).tight_turn_share
    if abs(pitches - 5) > 0.25:
        assert share == pytest.approx(1.0 if pitches < 5 else 0.0, abs=0.08 + step / radius)  # its ends are not joined


@pytest.mark.parametrize("parts", [4, 8, 40])
def test_hairpins_count_about_their_own_length(parts):
    """Half circles of half a pitch between rows of 5 mm: 1.6 pitches each, and at most half a pitch of the rows."""
    lines, count = [], 20
    for n in range(count):
        ends = np.array([[0.5, 0.0], [5.5, 0.0]])[:: 1 - 2 * (n % 2)]
        lines.append(np.linspace(*ends, 501) + np.array([0.0, 1 + n * PITCH]))
        angle, way = np.linspace(0, math.pi, parts + 1)[1:-1], 1 - 2 * (n % 2)
        arc = PITCH / 2 * np.column_stack([way * np.sin(angle), 1 - np.cos(angle)])
        lines.append(arc + lines[-1][-1])
    found = measured(np.concatenate(lines))
    whole = count * 5 + (count - 1) * math.pi / 2 * PITCH
    assert found.turns_over_60_per_m == 0
    assert 1.4 * (count - 1) * PITCH / whole < found.tight_turn_share < 2.8 * count * PITCH / whole


@settings(max_examples=25, deadline=None)
@given(st.floats(10, 170))
def test_corners_are_counted_above_60_degrees(degrees):
    """A zigzag of 21 legs with one corner between each two."""
    lean = math.radians(degrees) / 2
    path = np.array([(0.5 + 0.2 * k * math.cos(lean), 3 + (k % 2) * 0.2 * math.sin(lean)) for k in range(22)])
    found = measured(np.concatenate([np.linspace(a, b, 5)[:-1] for a, b in pairwise(path)]))
    corners = found.turns_over_60_per_m * found.length_mm / 1000
    assert corners == pytest.approx(20 if degrees > 60 else 0, abs=1e-6) or abs(degrees - 60) < 0.5


def test_rounding_to_a_tenth_of_a_micrometre_makes_no_turns():
    """Vertices 1 um apart on a straight line off the raster: no corner, no tight turn."""
    line = np.linspace([1.0, 2.0], [1.9, 2.37], 900)
    found = measured(line)
    assert found.turns_over_60_per_m == 0 and found.tight_turn_share < 0.01


@pytest.mark.parametrize("at_once", [70, 500, 100_000])
def test_batches_do_not_change_the_measures(at_once):
    lens = plane(0.1)
    (whole,) = read_program([text(on_plane(circle(0.4, 0.01, turns=3), 0.1))])
    quality = PathQuality(lens, SPEC)

    class Touching:
        def __init__(self, count):
            self.end_touch_mm = np.zeros(count)

    for k in range(0, len(whole), at_once):
        cut = slice(k, min(k + at_once, len(whole)))
        names = ("is_rapid", "feed_mm_per_min", "line", "spindle_rpm", "pause_s")
        part = {name: getattr(whole, name)[cut] for name in names}
        batch: MoveBatch = replace(whole, points_mm=whole.points_mm[k : cut.stop + 1], **part)
        quality.add(batch, Touching(len(batch)))
    found = quality.measure()
    once = measured(circle(0.4, 0.01, turns=3), slope=0.1)
    assert found.tight_turn_share == pytest.approx(once.tight_turn_share, rel=0.01)
    assert found.aligned_share == pytest.approx(once.aligned_share, abs=0.01)


def test_entries_and_what_hovers():
    line = np.column_stack([np.linspace(1, 5, 41), np.full(41, 3.0)])
    once = measured(line)
    assert (once.entries, once.rapids_inside) == (1, 0)
    assert once.length_mm == pytest.approx(4.0)
    hovering = measured(line, lifted=range(10, 20))
    assert hovering.entries == 1
    assert hovering.length_mm == pytest.approx(4.0 - 1.1, abs=1e-6)  # up and down again do not count either
    block = text(on_plane(line, 0.0)).decode().splitlines()
    block[20:20] = ["G0 Z5", "G1 Z-0.5"]
    twice = measure_program(read_program(["\n".join([*block, ""]).encode()]), plane(0.0), SPEC)
    assert twice.entries == 2


def test_a_rapid_through_the_block_is_counted():
    lines = text(on_plane([[1.0, 3.0], [2.0, 3.0]], 0.0)).decode().replace("G0 Z5\nM5", "G0 X4\nZ5\nM5")
    assert measure_program(read_program([lines.encode()]), plane(0.0), SPEC).rapids_inside == 1
