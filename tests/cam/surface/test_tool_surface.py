"""A ball rests on the lens: it touches, it never digs in, and it sees everything under it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from cam.surface import tool_surface
from cam.surface.contact import touch
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield
from tests.cam.lenses import brute_force, make_bumps, make_lens

NM = 1e-6


@pytest.mark.parametrize("slope_deg", [0, 10, 30, 45, 60])
@pytest.mark.parametrize("along", ["x", "y"])
def test_ball_on_an_incline_rides_above_it(slope_deg, along):
    """On a plane at angle a the tip is R (1/cos a - 1) above the surface: exact."""
    a = np.radians(slope_deg)
    plane = make_lens(lambda x, y: np.tan(a) * (x if along == "x" else y))
    surface = ToolSurface.over(plane, radius_mm=0.5)
    lift = surface.tip_heights_mm([4.0], [3.0]) - np.tan(a) * (4.0 if along == "x" else 3.0)
    assert lift == pytest.approx(0.5 * (1 / np.cos(a) - 1), abs=1e-4 * NM)


@pytest.mark.parametrize("allowance_mm", [0.0, 0.2])
@pytest.mark.parametrize("bend", [-0.2, -0.05, 0.05, 0.15])
def test_tip_over_a_paraboloid(bend, allowance_mm):
    """From a contact p the tip stands at p + (R + a) N - (0, 0, R): exact, as the spline holds every quadratic."""
    lens = make_lens(lambda x, y: bend / 2 * ((x - 4) ** 2 + 0.5 * (y - 3) ** 2))
    surface = ToolSurface.over(lens, radius_mm=2.0, allowance_mm=allowance_mm, run_out_mm=0.0)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(2.5, 5.5, 13), np.linspace(2, 4, 9)))
    zx, zy = bend * (x - 4), bend / 2 * (y - 3)
    w = 1 / np.sqrt(1 + zx**2 + zy**2)
    ball = 2.0 + allowance_mm
    tip = bend / 2 * ((x - 4) ** 2 + 0.5 * (y - 3) ** 2) + ball * w - 2.0
    got = surface.contacts_mm(x - ball * w * zx, y - ball * w * zy)
    np.testing.assert_allclose(got[:, 2], tip, atol=1e-3 * NM)
    np.testing.assert_allclose(got[:, :2], np.column_stack([x, y]), atol=1e-4)


def test_tip_in_a_spherical_bowl():
    """Ball in a bowl of radius B: its centre runs on a sphere of radius B - R."""
    bowl, r = 12.0, 3.0
    lens = make_lens(lambda x, y: -np.sqrt(bowl**2 - (x - 4) ** 2 - (y - 3) ** 2))
    surface = ToolSurface.over(lens, radius_mm=r, run_out_mm=0.0)
    x = np.linspace(3, 5, 21)
    tips = surface.tip_heights_mm(x, np.full(21, 3.2))
    exact = -np.sqrt((bowl - r) ** 2 - (x - 4) ** 2 - 0.2**2) - r
    np.testing.assert_allclose(tips, exact, atol=1 * NM)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 10**6), slope=st.floats(0.02, 1.5), radius_mm=st.sampled_from([0.5, 1.0, 2.0]))
def test_no_point_of_the_lens_is_inside_the_ball(seed, slope, radius_mm):
    """On any spline up to this steepest slope the ball lies as low as brute force allows, and no lower.

    The blocks of random height have curvatures far above 1/R: hardly any place has one contact only.
    """
    rng = np.random.default_rng(seed)
    nodes = np.kron(rng.uniform(-1, 0, (6, 7)), np.ones((4, 4)))[:21, :25]
    rough = Heightfield.on_aperture(nodes, width_mm=6.0, height_mm=5.0).spline_with_run_out(2 * radius_mm)
    jets = rough.jets(*np.meshgrid(np.linspace(-2, 8, 300), np.linspace(-2, 7, 300)))
    lens = Heightfield.on_aperture(nodes * slope / np.hypot(jets[1], jets[2]).max(), width_mm=6.0, height_mm=5.0)
    surface = ToolSurface.over(lens, radius_mm=radius_mm)
    spline = lens.spline_with_run_out(2 * radius_mm + 1)
    x, y = rng.uniform((0, 0), (6, 5), (6, 2)).T
    for cx, cy, (_, _, tip) in zip(x, y, surface.contacts_mm(x, y), strict=True):
        coarse = brute_force(spline, cx, cy, radius_mm) - radius_mm
        assert tip >= coarse - 1 * NM  # no gouge
        assert tip <= coarse + 1e-3  # and it touches, as well as the samples can tell
        row = ToolSurface.over(lens, radius_mm=radius_mm, row_mm=cy)
        assert row.tip_heights_mm([cx], [cy]) == pytest.approx(tip, abs=1 * NM)  # a surface for that row alone


def test_the_contact_lies_on_ball_and_lens():
    """Contact and tip belong together: the point is on the lens, one radius from the centre."""
    lens = make_bumps(3, relief_mm=2.0)
    surface = ToolSurface.over(lens, radius_mm=0.5)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 8, 40), np.linspace(0, 6, 30)))
    px, py, tip = surface.contacts_mm(x, y).T
    spline = lens.spline_with_run_out(1.0)
    drop = tip + 0.5 - spline.heights_mm(px, py)
    np.testing.assert_allclose((px - x) ** 2 + (py - y) ** 2 + drop**2, 0.25, atol=0.01 * NM)


def test_two_hills_hold_a_ball_that_newton_alone_would_sink():
    """In a groove narrower than the ball a local solution exists at the bottom; the ball must rest on the shoulders."""
    groove = make_lens(lambda x, y: -1.0 / np.cosh((x - 4) / 0.25) ** 2)
    surface = ToolSurface.over(groove, radius_mm=1.0)
    truth = brute_force(groove.spline(), 4.0, 3.0, 1.0) - 1.0
    assert surface.tip_heights_mm([4.0], [3.0])[0] == pytest.approx(truth, abs=1e-4)
    assert truth > -0.5
    naive = surface.kernel._replace(guarded=np.zeros_like(surface.kernel.guarded))
    sunk = ToolSurface(radius_mm=1.0, allowance_mm=0.0, lowest_mm=0.0, highest_mm=0.0, kernel=naive)
    assert sunk.tip_heights_mm([4.0], [3.0])[0] <= truth + 1e-4
    shallow = make_lens(lambda x, y: -0.1 * np.exp(-(((x - 4) / 2) ** 2)))
    assert not ToolSurface.over(shallow, radius_mm=1.0).kernel.guarded.any()


def test_a_hill_straight_under_the_ball_beats_lower_rests_beside_it():
    """Its top is where no search begins elsewhere: the first climb ends there, under the centre."""
    lens = make_lens(
        lambda x, y: (
            -1.0
            + 0.3 * np.exp(-((x - 4) ** 2 + (y - 3) ** 2) / 0.5)
            + 1.0 * np.exp(-((np.abs(x - 4) - 1.4) ** 2 + (y - 3) ** 2) / 0.1)
        )
    )
    tip = ToolSurface.over(lens, radius_mm=1.5).tip_heights_mm([4.0], [3.0])[0]
    assert tip == pytest.approx(lens.spline().jets(np.array([4.0]), np.array([3.0]))[0][0], abs=1e-6)


def test_far_hill_beats_the_valley_that_fits():
    """The contact nearest to the guess is a true local rest, but a spike at the ball's flank carries it higher."""
    spike = make_lens(lambda x, y: 0.9 * np.exp(-(((x - 4.9) / 0.12) ** 2)) + 0.0 * y)
    surface = ToolSurface.over(spike, radius_mm=1.2)
    truth = brute_force(spike.spline(), 4.0, 3.0, 1.2, samples=1201) - 1.2
    naive = surface.kernel._replace(guarded=np.zeros_like(surface.kernel.guarded))
    sunk = ToolSurface(radius_mm=1.2, allowance_mm=0.0, lowest_mm=0.0, highest_mm=0.0, kernel=naive)
    x = np.linspace(2.5, 4.0, 60)
    assert sunk.tip_heights_mm(x, np.full(60, 3.0))[-1] < truth - 0.05  # what the guard is for
    assert surface.tip_heights_mm(x, np.full(60, 3.0))[-1] == pytest.approx(truth, abs=2e-5)


def test_a_v_groove_is_touched_on_both_flanks():
    """Two planes at 45 degrees: along the valley the tip is R (sqrt 2 - 1) above the bottom line of the planes."""
    groove = make_lens(lambda x, y: np.abs(x - 4.0))
    tip = ToolSurface.over(groove, radius_mm=1.0).tip_heights_mm([4.0], [3.0])[0]
    assert tip == pytest.approx(np.sqrt(2) - 1, abs=1e-3)  # the spline overshoots the planes a little near the kink


@pytest.mark.thorough
def test_where_creases_end_two_rests_lie_close_together():
    """Roofs and valleys that meet: the ball hops between rests a few lattice steps apart; the higher one counts."""

    def roofs(x, y):
        ridges = np.maximum(0.35 * np.abs(x - 4) + 0.1 * y, 0.3 * np.abs(y - 3))
        return -np.minimum(ridges, 0.45 * np.hypot(x - 2, y - 4.5) + 0.1)

    sharp = make_lens(roofs)
    lens = Heightfield(x_mm=sharp.x_mm, y_mm=sharp.y_mm, z_mm=gaussian_filter(sharp.z_mm, 0.6))
    surface = ToolSurface.over(lens, radius_mm=0.5)
    spline = lens.spline_with_run_out(2.0)
    x, y = np.random.default_rng(3).uniform((1, 1), (7, 5), (20_000, 2)).T
    tight = surface.kernel.guarded[tuple(_cells(surface, x, y))]
    x, y = x[tight][:400], y[tight][:400]
    for cx, cy, tip in zip(x, y, surface.tip_heights_mm(x, y), strict=True):
        assert tip >= brute_force(spline, cx, cy, 0.5, samples=251) - 0.5 - 1 * NM
    # At this end of a crease the highest lattice node belongs to the lower rest, 34 nm down.
    place = [3.2719868311200475], [5.474714446281494]
    tip = surface.tip_heights_mm(*place)[0]
    ball = surface.kernel
    everywhere = np.full_like(ball.tile_top, np.inf)
    best_node_only, more_nodes = (_with(surface, slack=factor * ball.slack, tile_top=everywhere) for factor in (0, 10))
    assert tip > best_node_only.tip_heights_mm(*place)[0] + 20 * NM
    assert tip == pytest.approx(more_nodes.tip_heights_mm(*place)[0], abs=1e-3 * NM)


def _with(surface: ToolSurface, **changes) -> ToolSurface:
    return replace(surface, kernel=surface.kernel._replace(**changes))


def test_slope_curvature_and_motion_of_the_contact():
    """Along x, against central differences; the vertices' spacing and Newton's next guess come from them."""
    kernel = ToolSurface.over(make_bumps(3, relief_mm=2.0), radius_mm=0.5).kernel
    step = 1e-4
    for x, y in np.random.default_rng(1).uniform((0.5, 0.5), (7.5, 5.5), (50, 2)):
        before, here, after = (np.array(touch(kernel, x + d, y, x + d, y)) for d in (-step, 0, step))
        rate = (after - before) / (2 * step)  # of px, py, tip, slope
        assert rate[2] == pytest.approx(here[3], abs=1e-5)
        assert rate[3] == pytest.approx(here[4], abs=1e-3)
        assert rate[:2] == pytest.approx(here[5:], abs=1e-3)


@pytest.mark.parametrize("bend", [0.7, 1.2])
def test_newton_is_not_trusted_where_the_lens_bends_as_the_ball_does(bend):
    """Within a radius of a valley of curvature above 0.6 / R the whole footprint is searched."""
    valley = make_lens(lambda x, y: -np.exp(-bend * (x - 4) ** 2 / 2))
    surface = ToolSurface.over(valley, radius_mm=1.0)
    x = np.linspace(3.01, 4.99, 50)
    assert surface.kernel.guarded[tuple(_cells(surface, x, np.full(50, 3.0)))].all()


def _cells(surface: ToolSurface, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    k = surface.kernel
    return tuple(np.rint((a - o) / k.node_step).astype(int) for a, o in ((y, k.node_y0), (x, k.node_x0)))


def test_a_surface_that_could_not_be_computed_is_none(monkeypatch):
    """Its lattice is computed in threads: what fails there is no lattice of whatever the memory held before."""

    def run_out_of_memory(*_: object) -> None:
        raise MemoryError

    lens = make_lens(lambda x, y: 0.0 * x)
    monkeypatch.setattr(tool_surface, "_fill_lattice", run_out_of_memory)
    with pytest.raises(MemoryError):
        ToolSurface.over(lens, radius_mm=0.5)
