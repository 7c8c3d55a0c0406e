"""The widest gap of paths whose widest gap is known in closed form, or by brute force."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.checking.track_gaps import PIXELS_PER_PITCH, TipRegion, TrackGaps
from cam.checking.track_scan import is_inside
from tests.cam.lenses import make_bumps, make_lens

SIDE, PITCH = 3.0, 0.1
REGION = TipRegion.plain(SIDE, SIDE)
HIDDEN = 1.002 + math.sqrt(2) / PIXELS_PER_PITCH  # pitches: wider gaps cannot hide from the scan


def widest(*paths, region=REGION, pitch=PITCH):
    gaps = TrackGaps(region, pitch_mm=pitch)
    for path in paths:
        gaps.add(np.asarray(path, dtype=float), np.ones(len(path) - 1, dtype=bool))
    return gaps.find_widest()


def straight_lines(spacing, angle=0.0, offset=0.0, *, far=2.5, step=0.37):
    """Lines at any angle over the whole region, cut into moves."""
    along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    u = np.arange(-far, far, step)
    numbers = np.arange(-math.ceil(far / spacing), math.ceil(far / spacing) + 1)
    return [SIDE / 2 + np.outer(u, along) + (n * spacing + offset) * across for n in numbers]


spacings = st.floats(0.3 * PITCH, 2.6 * PITCH)
angles = st.floats(0, math.pi)


@settings(max_examples=40, deadline=None)
@given(spacings, angles, st.floats(0, 0.05))
def test_even_lines_are_as_far_apart_as_they_are(spacing, angle, offset):
    gap = widest(*straight_lines(spacing, angle, offset))
    assert gap.width_mm == pytest.approx(spacing, abs=3e-6)  # tracks are held in millionths of a millimetre


@settings(max_examples=25, deadline=None)
@given(st.floats(0.8 * PITCH, 1.0 * PITCH), angles, st.floats(0.05, 1.0))
def test_a_missing_and_a_shifted_line_open_known_gaps(spacing, angle, shift):
    lines = straight_lines(spacing, angle)
    middle = len(lines) // 2
    assert widest(*lines[:middle], *lines[middle + 1 :]).width_mm == pytest.approx(2 * spacing, abs=3e-6)
    across = np.array([-math.sin(angle), math.cos(angle)]) * shift * spacing
    moved = [*lines[:middle], lines[middle] + across, *lines[middle + 1 :]]
    gap = widest(*moved)
    if (1 + shift) * spacing > HIDDEN * PITCH:
        assert gap.width_mm == pytest.approx((1 + shift) * spacing, abs=3e-6)
    else:
        assert gap.width_mm <= (1 + shift) * spacing + 3e-6


@settings(max_examples=30, deadline=None)
@given(st.floats(0.9, 1.0), angles, st.floats(0.35, 2.5), st.floats(0.8, 2.2), st.floats(0.8, 2.2))
def test_a_short_stretch_left_out_is_found_wherever_it_is(share, angle, length, x, y):
    """Of a line a mm are missing, its neighbours s beside it: the widest circle is s + a^2 / 4s across, 2 s at most."""
    s, a = share * PITCH, length * PITCH
    along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    centre = np.array([x, y])
    lines = [centre + n * s * across + np.outer([-6, 6], along) for n in range(-80, 81) if n]
    halves = [centre + np.outer([-6, -a / 2], along), centre + np.outer([a / 2, 6], along)]
    gap = widest(*lines, *halves)
    wanted = s + a**2 / (4 * s) if a < 2 * s else 2 * s
    if wanted > HIDDEN * PITCH:
        assert gap.width_mm == pytest.approx(wanted, abs=5e-6)
        assert math.hypot(gap.x_mm - x, gap.y_mm - y) < max(a, s)


@pytest.mark.thorough
@settings(max_examples=15, deadline=None)
@given(spacings, angles, st.floats(0.2, 1.2))
def test_tracks_that_cross_do_no_harm(spacing, angle, turn):
    lines = straight_lines(spacing, angle)
    alone = widest(*lines).width_mm
    crossed = widest(*lines, *straight_lines(9 * spacing, angle + turn)).width_mm
    assert crossed <= alone + 3e-6 and crossed == pytest.approx(spacing, rel=2e-3)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.3 * PITCH, 2 * PITCH))
def test_a_zigzag_is_widest_where_its_legs_part(rise):
    """Legs from side to side that climb h each: at the rim, two legs are 2 h cos(atan(h / L)) apart."""
    count = math.ceil(SIDE / rise) + 3
    path = [((n % 2) * SIDE, (n - 1) * rise) for n in range(count)]
    assert widest(path).width_mm == pytest.approx(2 * rise * math.cos(math.atan(rise / SIDE)), abs=5e-6)


@pytest.mark.parametrize("turn_mm", [0.8 * PITCH, 1.0 * PITCH, 1.3 * PITCH])
def test_turns_of_a_spiral_are_its_lead_apart(turn_mm):
    """Far from its middle; the chords of 0.02 mm sag by 2e-5 mm at most."""
    turns = np.arange(2.5 / turn_mm, 8.5 / turn_mm, 0.0005)
    angle = 2 * math.pi * turns
    path = turn_mm * turns[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    gap = widest(path - 2.5)
    assert gap.width_mm == pytest.approx(turn_mm, rel=2e-3)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 60))
def test_any_path_against_every_point_of_a_fine_grid(seed, count):
    """Random moves, most places many pitches from any: the grid can only find less, by its own half diagonal."""
    path = np.random.default_rng(seed).uniform(0, SIDE, (count, 2)).round(6)
    side = np.linspace(0, SIDE, 201)
    x, y = np.meshgrid(side, side)
    apart = np.full(x.shape, np.inf)
    for (ax, ay), (bx, by) in pairwise(path):
        ex, ey = bx - ax, by - ay
        t = np.clip(((x - ax) * ex + (y - ay) * ey) / (ex**2 + ey**2), 0, 1)
        apart = np.minimum(apart, np.hypot(x - ax - t * ex, y - ay - t * ey))
    gap = widest(path)
    slack = 2 * math.sqrt(0.5) * (side[1] - side[0])
    assert 2 * apart.max() - 0.5 * PITCH <= gap.width_mm <= 2 * apart.max() + slack + 1e-6


def test_batches_need_not_end_where_tracks_end():
    lines = straight_lines(PITCH)
    whole = np.concatenate([line[:: 1 - 2 * (n % 2)] for n, line in enumerate(lines)])
    at_once = widest(whole)
    parts = widest(*(whole[k : k + 8] for k in range(0, len(whole) - 1, 7)))
    assert parts.width_mm == at_once.width_mm == pytest.approx(PITCH, abs=1e-6)


def test_the_middle_of_the_gap_is_named():
    lines = straight_lines(PITCH, 0.0)
    missing = len(lines) // 2 + 10
    y = lines[missing][0, 1]
    gap = widest(*lines[:missing], *lines[missing + 1 :])
    assert gap.y_mm == pytest.approx(y, abs=1e-5) and 0 <= gap.x_mm <= SIDE


def test_no_track_at_all_is_a_gap_as_wide_as_the_lens():
    assert TrackGaps(REGION, pitch_mm=PITCH).find_widest().width_mm == SIDE


def test_the_region_of_tips_is_the_lens_shifted_downhill():
    """On a plane of slope s every tip stands R s / q beside its contact, all on the same side."""
    lens = make_lens(lambda x, y: -1.0 - 0.3 * x + 0.1 * y)
    region = TipRegion.over(lens, ball_mm=0.5)
    lean = 0.5 / math.sqrt(1 + 0.3**2 + 0.1**2)
    for side, edge in (("left_mm", 0.3 * lean), ("right_mm", 8 + 0.3 * lean)):
        assert getattr(region, side) == pytest.approx(edge, abs=1e-9)
    for side, edge in (("bottom_mm", -0.1 * lean), ("top_mm", 6 - 0.1 * lean)):
        assert getattr(region, side) == pytest.approx(edge, abs=1e-9)


@pytest.mark.parametrize("ball_mm", [0.5, 2.0])
def test_a_tip_is_in_the_region_exactly_when_its_contact_is_in_the_aperture(ball_mm):
    """Contacts 10 um inside and outside the rim, all round a lens whose rim rises and falls."""
    lens = make_bumps(4, relief_mm=1.5)
    region, spline = TipRegion.over(lens, ball_mm=ball_mm), lens.spline_with_run_out(1.0)
    share = np.linspace(0.01, 0.99, 200)
    for by, wanted in ((0.01, True), (-0.01, False)):
        low, wide, high = np.full(200, by), np.full(200, 8 - by), np.full(200, 6 - by)
        for x, y in ((low, 6 * share), (wide, 6 * share), (8 * share, low), (8 * share, high)):
            _h, hx, hy = spline.jets(x, y)[:3]
            lean = ball_mm / np.sqrt(1 + hx**2 + hy**2)
            found = [is_inside(region.kernel, *tip) for tip in zip(x - lean * hx, y - lean * hy, strict=True)]
            assert np.mean(found) == wanted


def test_what_lies_outside_the_region_of_tips_need_not_be_covered():
    lens = make_lens(lambda x, y: -1.0 - 0.4 * x + 0.0 * y)
    region = TipRegion.over(lens, ball_mm=0.5)
    shift = 0.5 * 0.4 / math.hypot(1, 0.4)
    y = np.arange(0.0, 6 + 1e-9, PITCH)
    rows = [np.array([[shift, v], [8 + shift, v]]) for v in y]
    assert widest(*rows, region=region).width_mm == pytest.approx(PITCH, abs=5e-6)
    short = widest(*(row - np.array([[0, 0], [0.3, 0]]) for row in rows), region=region)
    assert short.width_mm == pytest.approx(0.6, rel=0.1)  # the rim is 0.3 mm from the ends
