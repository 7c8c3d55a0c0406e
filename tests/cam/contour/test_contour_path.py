"""Laws of the contour path: one polyline, every place beside a track, along the contours, on the surface."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from cam.contour import field, tracer
from cam.contour.path import SHORTEST_MM, contour_path, plan_path
from cam.moves import CLEARANCE_MM, Motion
from cam.passes import PassSpec, ball_pass
from cam.rows.entries import RAMP_SLOPE, enter_onward
from cam.rows.vertices import finish_rule, rough_rule
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield
from tests.benchmarks.pictures import bumps
from tests.levels import mostly_thorough

SIDE, PITCH, RADIUS = 10.0, 0.1, 1.5
WAYS = {
    "flat": lambda x, y: 0 * x * y,
    "ramp": lambda x, y: 0.2 * x + 0.1 * y,
    "peak": lambda x, y: np.exp(-((x - 4.3) ** 2 + (y - 5.1) ** 2) / 8),
    "cone": lambda x, y: -0.2 * np.sqrt((x - 5) ** 2 + (y - 5) ** 2 + 0.1),
    "saddle": lambda x, y: 0.02 * ((x - 5.2) ** 2 - (y - 4.9) ** 2),
    "stripes": lambda x, y: 0.2 * np.sin(1.5 * x) + 0 * y,
    "egg box": lambda x, y: 0.2 * np.sin(0.7 * x) * np.sin(0.6 * y),
    "terrace": lambda x, y: 0.5 * np.tanh(2 * (x - 5)) + 0 * y,
}
QUICK = ("terrace",)


def lens(z, *, width_mm: float = SIDE, height_mm: float = SIDE) -> Heightfield:
    x, y = np.linspace(0, width_mm, 101)[None, :], np.linspace(0, height_mm, 101)[:, None]
    heights = z(x, y) + np.zeros((101, 101))
    return Heightfield.on_aperture(heights - heights.max() - 0.1, width_mm=width_mm, height_mm=height_mm)


def hills(bumps) -> Heightfield:
    def z(x, y):
        return sum(a * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * s * s)) for cx, cy, a, s in bumps)

    return lens(z)


def pass_of(pitch_mm: float = PITCH, radius_mm: float = RADIUS, leave_mm: float = 0.0) -> PassSpec:
    return PassSpec(
        name="contour",
        strategy="contour",
        radius_mm=radius_mm,
        pitch_mm=pitch_mm,
        stock_to_leave_mm=leave_mm,
        step_down_mm=1.0,
        feed_mm_per_min=600,
        plunge_mm_per_min=300,
        spindle_rpm=24000,
    )


def tips_of(surface_of: Heightfield, spec: PassSpec | None = None) -> np.ndarray:
    spec = spec or pass_of()
    surface = surface_with(surface_of, spec)
    probe = surface_of.dx_mm
    rule = finish_rule(0.5e-3, probe) if spec.finishes else rough_rule(spec.stock_to_leave_mm, probe)
    return np.concatenate(list(contour_path(surface_of, surface, spec, rule)))


def surface_with(heightfield: Heightfield, spec: PassSpec) -> ToolSurface:
    return ToolSurface.over(heightfield, radius_mm=spec.radius_mm, allowance_mm=spec.stock_to_leave_mm)


def widest_gap(tips: np.ndarray, places: np.ndarray, step: float) -> float:
    """Twice the greatest distance from the places (n, 2) to the path, which is cut into crumbs for it."""
    length = np.hypot(*np.diff(tips[:, :2], axis=0).T)
    parts = np.maximum(1, np.ceil(length / (step / 4))).astype(int)
    k = np.repeat(np.arange(length.size), parts)
    t = (np.arange(k.size) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[k]
    crumbs = tips[k, :2] + t[:, None] * (tips[k + 1, :2] - tips[k, :2])
    return 2 * float(cKDTree(crumbs).query(places)[0].max())


def places_in(heightfield: Heightfield, step: float) -> np.ndarray:
    x, y = (np.arange(0, side + 1e-9, step) for side in (heightfield.width_mm, heightfield.height_mm))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def tips_on_the_rim(heightfield: Heightfield, surface: ToolSurface) -> np.ndarray:
    """(n, 2) where the tip stands when the ball touches the rim of the aperture: the outermost that must be reached."""
    run, width, height = np.linspace(0, 1, 400), heightfield.width_mm, heightfield.height_mm
    sides = [(0 * run, height * run), (0 * run + width, height * run), (width * run, 0 * run)]
    x, y = np.concatenate([*sides, (width * run, 0 * run + height)], axis=1)
    _, zx, zy = heightfield.spline().jets(x, y)[:3]
    lean = (surface.radius_mm + surface.allowance_mm) / np.sqrt(1 + zx**2 + zy**2)
    tips = np.column_stack([x - lean * zx, y - lean * zy])
    touched = surface.contacts_mm(*tips.T)[:, :2]
    return tips[np.hypot(*(touched - np.column_stack([x, y])).T) < 1e-3]


def turns(tips: np.ndarray) -> np.ndarray:
    ahead = np.diff(tips[:, :2], axis=0)
    angle = np.diff(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return np.abs((angle + np.pi) % (2 * np.pi) - np.pi)


def length_mm(tips: np.ndarray) -> float:
    return float(np.hypot(*np.diff(tips[:, :2], axis=0).T).sum())


def judge(tips: np.ndarray, heightfield: Heightfield, spec: PassSpec) -> None:
    """What holds for every lens and pass."""
    width, height = heightfield.width_mm, heightfield.height_mm
    reach = spec.radius_mm + 1e-9
    assert np.abs(tips[:, :2] * 1e4 - np.rint(tips[:, :2] * 1e4)).max() < 1e-6, "x and y are on the writing raster"
    assert np.hypot(*np.diff(tips[:, :2], axis=0).T).min() > 0, "every move goes somewhere"
    assert tips[:, 0].min() >= -reach
    assert tips[:, 0].max() <= width + reach
    assert tips[:, 1].min() >= -reach
    assert tips[:, 1].max() <= height + reach
    surface, step = surface_with(heightfield, spec), spec.pitch_mm / 8
    assert widest_gap(tips, places_in(heightfield, step), step) <= 1.02 * spec.pitch_mm
    assert widest_gap(tips, tips_on_the_rim(heightfield, surface), step) <= 1.02 * spec.pitch_mm
    assert turns(tips).max() < np.radians(60)
    on_it = surface.tip_heights_mm(tips[:, 0], tips[:, 1])
    assert np.abs(tips[:, 2] - on_it).max() < 1e-7


@pytest.mark.parametrize("name", mostly_thorough(WAYS, QUICK))
def test_any_shape_is_covered_by_one_path_on_the_surface(name):
    heightfield = lens(WAYS[name])
    tips = tips_of(heightfield)
    judge(tips, heightfield, pass_of())


@pytest.mark.thorough
@pytest.mark.parametrize("twist", [-0.14, -0.11, 0.11])
def test_places_up_to_the_end_of_an_acute_corner_are_wanted(twist):
    """Where a lens is twisted and the ball large, tips that touch its right corner fill an acute one, between nodes."""
    heightfield, spec = lens(lambda x, y: twist * x * y * np.exp(-(x**2 + y**2) / 20) + 0.2 * x), pass_of(0.2, 6.0)
    surface = surface_with(heightfield, spec)
    made = field.ContourField.over(heightfield, surface, pitch_mm=spec.pitch_mm)
    i, j = np.floor((tips_on_the_rim(heightfield, surface) - (made.x0_mm, made.y0_mm)).T / made.step_mm).astype(int)
    assert made.wanted[j, i].all()


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["flat", "ramp", "peak", "cone"])
def test_where_contours_are_simple_the_path_is_rows_and_turns(name):
    """A hundred pitches wide, a lens has a turn of some pitches to every one of its rows, and a rim that the ball
    touches from outside: together less than half of the rows.
    """
    assert SIDE**2 < length_mm(tips_of(lens(WAYS[name]))) * PITCH < 1.4 * SIDE**2


@pytest.mark.thorough
@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(
        st.tuples(st.floats(0, SIDE), st.floats(0, SIDE), st.floats(-0.4, 0.4), st.floats(1.2, 4.0)),
        min_size=1,
        max_size=8,
    )
)
@example([(0.0, 1.0, 0.25, 2.0), (2.0, 0.0, -0.25, 3.0), (3.0, 0.0, 0.25, 2.0)])  # a closed line with one corner
def test_random_hills_are_covered_by_one_path_on_the_surface(bumps):
    heightfield = hills(bumps)
    judge(tips_of(heightfield), heightfield, pass_of())


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("pitch", "radius", "leave"), [(0.5, 3.0, 0.2), (0.05, 0.5, 0.03), (0.1, 0.5, 0.0), (0.5, 0.5, 0.0)]
)
def test_any_pass_even_where_the_ring_is_too_narrow_for_wide_turns(pitch, radius, leave):
    heightfield = lens(WAYS["peak"], width_mm=9.97, height_mm=8.03)  # no whole number of cells, nor of pitches
    spec = pass_of(pitch, radius, leave)
    judge(tips_of(heightfield, spec), heightfield, spec)


@pytest.mark.parametrize(("bend", "pitch"), [(0.2, 0.1), (0.4, 0.1), (0.4, 0.2)])
def test_on_a_steep_dome_whose_tips_fill_the_ring_turns_are_tight_but_no_corners(bend, pitch):
    """Slopes of 0.8 to 2.3 at the rim put the tip up to 0.9 radii outside: a twentieth of a mm is left to turn in."""
    heightfield = lens(lambda x, y: -bend * ((x - 2) ** 2 + (y - 2) ** 2), width_mm=4.0, height_mm=4.0)
    spec = pass_of(pitch, 0.5)
    judge(tips_of(heightfield, spec), heightfield, spec)


@pytest.mark.parametrize(("pitch", "radius"), [pytest.param(0.15, 3.0, marks=pytest.mark.thorough), (0.34, 3.0)])
def test_a_coarse_pitch_follows_the_contours_too(pitch, radius):
    """What is asked of every ball at every pitch of plans. Made as for a fine lens: 93.8 and 90.2 %."""
    heightfield, spec = bumps(side_mm=40.0), pass_of(pitch, radius)
    surface = surface_with(heightfield, spec)
    xy = plan_path(heightfield, surface, spec, on_progress=lambda done: None)
    ahead, middle = np.diff(xy, axis=0), (xy[1:] + xy[:-1]) / 2
    contacts = surface.contacts_mm(middle[:, 0], middle[:, 1])
    inside = np.all((contacts[:, :2] > 0) & (contacts[:, :2] < 40.0), axis=1)
    _, zx, zy = heightfield.spline().jets(*contacts[inside, :2].T)[:3]
    long, slope = np.hypot(*ahead[inside].T), np.hypot(zx, zy)
    counts = slope > 0.01
    uphill = np.abs(ahead[inside, 0] * zx + ahead[inside, 1] * zy) / (slope * long)
    assert long[counts & (uphill < np.sin(np.radians(15)))].sum() / long[counts].sum() > 0.95


def test_the_path_follows_the_contours():
    """Turns at the rim are a tenth of the path here, of a 100 mm lens at a pitch of 0.02 mm one per cent."""
    heightfield, spec = lens(lambda x, y: 0.2 * x + 0.1 * y + 0.1 * np.sin(0.6 * x - 0.3 * y)), pass_of(0.05)
    tips = tips_of(heightfield, spec)
    ahead, middle = np.diff(tips[:, :2], axis=0), (tips[1:] + tips[:-1]) / 2
    contacts = surface_with(heightfield, spec).contacts_mm(middle[:, 0], middle[:, 1])
    _, zx, zy = heightfield.spline().jets(contacts[:, 0], contacts[:, 1])[:3]
    long, slope = np.hypot(*ahead.T), np.hypot(zx, zy)
    counts = (slope > 0.01) & np.all((contacts[:, :2] > 0) & (contacts[:, :2] < SIDE), axis=1)
    uphill = np.abs(ahead[:, 0] * zx + ahead[:, 1] * zy) / (slope * long)
    aligned = long[counts & (uphill < np.sin(np.radians(15)))].sum() / long[counts].sum()
    assert aligned > 0.93
    assert long.sum() * spec.pitch_mm < 1.5 * SIDE**2


def test_the_chords_keep_the_rule_of_slope_and_sag():
    """Twice as bent as any lens, and nowhere between two vertices is the tip 20 nm off: what a gouge may be."""
    heightfield, spec = lens(WAYS["egg box"]), pass_of()
    tips = tips_of(heightfield, spec)
    surface = surface_with(heightfield, spec)
    a, b = tips[:-1], tips[1:]
    for t in (0.25, 0.5, 0.75):
        between = a + t * (b - a)
        off = between[:, 2] - surface.tip_heights_mm(between[:, 0], between[:, 1])
        cuttable = np.hypot(*(b - a)[:, :2].T) > 2 * SHORTEST_MM
        inside = np.all((between[:, :2] > RADIUS) & (between[:, :2] < SIDE - RADIUS), axis=1)
        assert np.abs(off[cuttable & inside]).max() < 20e-6


@pytest.mark.thorough
def test_the_same_lens_gives_the_same_path_on_one_thread_and_on_two(monkeypatch):
    heightfield = lens(WAYS["egg box"])
    twice = [tips_of(heightfield)]
    for module in ("cam.contour.tracer", "cam.contour.holes", "cam.rows.raster"):
        monkeypatch.setattr(f"{module}.THREADS", 1)
    twice.append(tips_of(heightfield))
    np.testing.assert_array_equal(*twice)


def test_the_path_begins_with_a_straight_for_the_ramp_outside_the_aperture():
    tips = tips_of(lens(WAYS["saddle"]))
    lead_in = tips[: int(np.argmax(tips[:, 1] != tips[0, 1]))]
    assert np.ptp(lead_in[:, 0]) == pytest.approx(SIDE / 2)
    assert lead_in[0, 1] < 0


def test_no_level_line_is_lost_where_the_gradient_of_the_field_is_even():
    """On a ramp f is the distance uphill: as many tracks as pitches, all straight and parallel.

    Some lie at the corners, in cells of the field that reach beyond the aperture.
    """
    heightfield = lens(WAYS["ramp"])
    surface = surface_with(heightfield, pass_of())
    f = field.ContourField.over(heightfield, surface, pitch_mm=PITCH)
    tracks = tracer.trace(f, pitch_mm=PITCH)
    for k in range(tracks.count):
        ahead = np.diff(tracks.xy_mm[tracks.start[k] : tracks.start[k + 1]], axis=0)
        assert np.abs(ahead @ (2, 1)).max() < 0.02 * np.hypot(*ahead.T).max() * np.hypot(2, 1)
    across = (SIDE * 2 + SIDE) / np.hypot(2, 1)
    assert 1.0 <= tracks.count / (across / (2 * field.REACH_PITCHES * PITCH)) < 1.15


SAFE_MM = 5.0
SPEC = ball_pass("finish", radius_mm=0.5, pitch_mm=0.05, stock_to_leave_mm=0.0, step_down_mm=0.2)


def first_stretch(length_mm: float, tilt: float, z_mm: float) -> np.ndarray:
    x = np.linspace(3.0, 3.0 + length_mm, 40)
    return np.column_stack([x, np.full(40, -0.25), z_mm + tilt * (x - 3.0) + 0.01 * np.sin(x)])


def entered(polyline: np.ndarray, stock_mm: float):
    paths = list(enter_onward(polyline, stock_mm, SPEC, safe_z_mm=SAFE_MM))
    rapids = [path for path in paths if path.motion is Motion.RAPID]
    return rapids, [path for path in paths if path.motion is not Motion.RAPID]


@given(st.floats(2.0, 15.0), st.floats(-0.04, 0.3), st.floats(-4.0, -0.5), st.floats(0.001, 0.5))
def test_it_sinks_along_the_path_without_turning_and_reaches_it(length, tilt, z, over):
    polyline = first_stretch(length, tilt, z)
    stock = polyline[0, 2] + over
    assume(over + CLEARANCE_MM < 0.95 * RAMP_SLOPE * length)
    rapids, cuts = entered(polyline, stock)
    assert len(rapids) == 1 and len(cuts) == 1
    points = cuts[0].points_mm
    np.testing.assert_array_equal(points[:, :2], polyline[:, :2])
    assert (points[:, 2] >= polyline[:, 2]).all(), "never below the path"
    np.testing.assert_array_equal(points[-1], polyline[-1])
    above = points[:, 2] - polyline[:, 2]
    sinking = -np.diff(above) / np.diff(points[:, 0])
    assert sinking.max() <= RAMP_SLOPE * (1 + 1e-9), "below the path's own fall, at most the ramp"
    assert points[0, 2] >= min(stock + CLEARANCE_MM, SAFE_MM) - 1e-9, "it begins above the stock"
    assert cuts[0].feed_mm_per_min == SPEC.plunge_mm_per_min
    np.testing.assert_array_equal(rapids[0].points_mm[-1, :2], polyline[0, :2])
    assert rapids[0].points_mm[:, 2].min() > stock


def test_over_no_stock_it_goes_on_at_once():
    polyline = first_stretch(10.0, 0.0, -1.0)
    _, cuts = entered(polyline, polyline[0, 2] - 0.3)
    np.testing.assert_array_equal(np.concatenate([path.points_mm for path in cuts]), polyline)


@pytest.mark.parametrize("over", [0.5, 2.0])
def test_where_the_beginning_is_too_short_the_ramp_turns_back_and_the_beginning_is_cut_after_it(over):
    polyline = first_stretch(1.5, 0.0, -3.0)
    _, cuts = entered(polyline, polyline[0, 2] + over)
    np.testing.assert_array_equal(cuts[-1].points_mm, polyline)
    way = np.concatenate([path.points_mm for path in cuts])
    x, y, z = np.diff(way, axis=0).T
    along = np.hypot(x, y) > 0
    assert (np.diff(way[:, 0])[along] < 0).any(), "back as well"
    assert (-z[along] <= (RAMP_SLOPE + 0.02) * np.hypot(x, y)[along]).all(), "no plunge into stock"
