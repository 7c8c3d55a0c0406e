"""The forward model against cases whose light is known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RectBivariateSpline

from optics.bench import Bench, Screen
from optics.caustic import share_by_way_of, simulate_caustic
from optics.heightfield import Heightfield
from optics.refraction import tangent_per_slope
from optics.tubes.edges import add_edge

N = 1.49


def lens_of(height, vertices: int = 81) -> Heightfield:
    """A 20 mm lens z = height(x, y)."""
    axis = np.linspace(0.0, 20.0, vertices)
    return Heightfield.on_aperture(height(*np.meshgrid(axis, axis)), width_mm=20.0, height_mm=20.0)


def facing(screen: Screen, *, throw_mm: float) -> Bench:
    """Collimated light; what the aperture measures is the heightfield's affair."""
    return Bench(width_mm=20.0, height_mm=20.0, throw_mm=throw_mm, refractive_index=N, screen=screen)


def test_flat_lens_shows_nothing(screen: Screen) -> None:
    flat = lens_of(lambda x, y: 0 * x - 0.3)
    caustic = simulate_caustic(flat, facing(screen, throw_mm=40), pixels=(30, 20))
    np.testing.assert_allclose(caustic.irradiance, 1.0, atol=1e-12)
    assert abs(caustic.outside_share) < 1e-12


@pytest.mark.parametrize("slope", [-0.3, 0.1, 0.45])
def test_prism_shifts_and_stretches_by_exact_snell(slope: float) -> None:
    """On z = -12 + s x the ray from x lands at x + (H - z) m s: an even patch of width W (1 - m s^2), shifted."""
    throw, m = 40.0, tangent_per_slope(slope**2, N)
    prism = lens_of(lambda x, y: -12 + slope * x)
    wide = Screen(width_mm=80.0, height_mm=20.0, centre_x_mm=10.0, centre_y_mm=10.0)
    light = simulate_caustic(prism, facing(wide, throw_mm=throw), pixels=(20, 800)).irradiance[10]
    left = m * slope * (throw + 12)
    right = 20 + m * slope * (throw + 12 - slope * 20)
    edges = np.linspace(-30, 50, 801)
    covered = np.clip(np.minimum(edges[1:], right) - np.maximum(edges[:-1], left), 0, None) / 0.1
    np.testing.assert_allclose(light, covered * 80 / (right - left), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("focal_mm", [60.0, 200.0, -100.0])
def test_paraxial_parabola_changes_the_light_by_the_square_of_its_magnification(focal_mm: float) -> None:
    """z = -r^2 / (2 (n - 1) f): near the axis the beam is scaled by 1 - H / f, its irradiance by 1 / (1 - H / f)^2."""
    lens = lens_of(lambda x, y: -((x - 10) ** 2 + (y - 10) ** 2) / (2 * (N - 1) * focal_mm))
    spot = Screen(width_mm=0.2, height_mm=0.2, centre_x_mm=10.0, centre_y_mm=10.0)
    throw = 20.0
    caustic = simulate_caustic(lens, facing(spot, throw_mm=throw), pixels=(2, 2), tubes_per_cell=8)
    per_area = caustic.irradiance.sum() / 4 / (0.2 * 0.2 / 400.0)
    assert per_area == pytest.approx((1 - throw / focal_mm) ** -2, rel=0.01)


def test_hyperboloid_focuses_on_one_point() -> None:
    """n t + |(p, t) - q0| constant: every ray meets in q0 (exact, not paraxial)."""
    throw, index = 30.0, N
    path = throw + 1.0

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        b, r2 = index * path - throw, (x - 10.05) ** 2 + (y - 9.95) ** 2
        return (b - np.sqrt(b**2 - (index**2 - 1) * (path**2 - r2 - throw**2))) / (index**2 - 1) - 3.0

    lens = lens_of(height, vertices=161)
    screen = Screen(width_mm=20.0, height_mm=20.0, centre_x_mm=10.0, centre_y_mm=10.0)
    caustic = simulate_caustic(lens, facing(screen, throw_mm=throw - 3), pixels=(200, 200))
    assert caustic.irradiance[99, 100] == pytest.approx(200 * 200, rel=1e-6)


@pytest.mark.parametrize(("vertices", "tubes"), [((49, 33), 4), ((13, 9), 16)])
def test_tubes_agree_with_an_independent_ray_tracer(vertices: tuple[int, int], tubes: int) -> None:
    """Rays through scipy's spline by the vector form of Snell's law, counted per pixel: an oblong, lopsided lens.

    In coarse cells the slope on the rim itself counts.
    """
    x_mm, y_mm = np.linspace(0, 24, vertices[0]), np.linspace(0, 16, vertices[1])
    x, y = np.meshgrid(x_mm, y_mm)
    lens = Heightfield(x_mm=x_mm, y_mm=y_mm, z_mm=-6 + 0.5 * np.sin(0.4 * x + 0.2 * y) * np.cos(0.5 * y) + 0.05 * x)
    screen = Screen(width_mm=30.0, height_mm=14.0, centre_x_mm=11.0, centre_y_mm=9.0)
    light = simulate_caustic(lens, facing(screen, throw_mm=25.0), pixels=(14, 20), tubes_per_cell=tubes)
    surface = RectBivariateSpline(y_mm, x_mm, lens.z_mm)
    at_x, at_y = (np.arange(1200) + 0.5) * 24 / 1200, (np.arange(800) + 0.5) * 16 / 800
    z = surface(at_y, at_x)
    normal = np.stack([-surface(at_y, at_x, dy=1), -surface(at_y, at_x, dx=1), np.ones_like(z)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cos_in = normal[..., 2]
    cos_out = np.sqrt(1 - N**2 * (1 - cos_in**2))
    ray = N * np.array([0.0, 0.0, 1.0]) + (cos_out - N * cos_in)[..., None] * normal
    way = (25.0 - z) / ray[..., 2]
    hit_x, hit_y = at_x[None, :] + way * ray[..., 0], at_y[:, None] + way * ray[..., 1]
    rays, *_ = np.histogram2d(hit_y.ravel(), hit_x.ravel(), bins=(14, 20), range=((2, 16), (-4, 26)))
    rays *= 14 * 20 / z.size
    assert light.outside_share == pytest.approx(1 - rays.mean(), abs=1e-3)
    assert light.outside_share > 0.05
    assert light.irradiance.max() > 2  # near its focus
    np.testing.assert_allclose(light.irradiance, rays, atol=0.05)


def test_45_degree_prism_reflects_everything(screen: Screen) -> None:
    prism = lens_of(lambda x, y: -25 + x)
    caustic = simulate_caustic(prism, facing(screen, throw_mm=40), pixels=(10, 10))
    assert caustic.reflected_share == pytest.approx(1.0, abs=1e-12)
    assert caustic.outside_share == pytest.approx(0.0, abs=1e-12)
    assert caustic.irradiance.sum() == 0


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), tubes=st.integers(1, 4), strength=st.floats(0.0, 3.0))
def test_no_light_is_lost_or_made(seed: int, tubes: int, strength: float) -> None:
    """Folded, focused or not: what does not leave through the frame or is reflected arrives, to rounding."""
    bumps = strength * np.random.default_rng(seed).random((12, 12))
    lens = Heightfield.on_aperture(bumps - 4.0, width_mm=20.0, height_mm=20.0)
    hall = Screen(width_mm=2000.0, height_mm=2000.0, centre_x_mm=10.0, centre_y_mm=10.0)
    caustic = simulate_caustic(lens, facing(hall, throw_mm=40), pixels=(64, 64), tubes_per_cell=tubes)
    assert caustic.irradiance.min() > -1e-9
    assert caustic.irradiance.sum() / 64**2 + caustic.reflected_share == pytest.approx(1.0, abs=1e-11)


@given(points=st.lists(st.tuples(st.floats(-3, 9), st.floats(-3, 8)), min_size=3, max_size=3))
def test_edges_of_a_triangle_sum_to_its_coverage(points: list[tuple[float, float]]) -> None:
    """Green's formula against a fine sampling of the same triangle, on pixels that it may leave on any side."""
    acc = np.zeros((5, 7))
    for (x0, y0), (x1, y1) in zip(points, [*points[1:], points[0]], strict=True):
        add_edge(acc, x0, y0, x1, y1, 1.0)
    coverage = np.cumsum(acc, axis=1)[:, :6]
    fine = 40
    x, y = np.meshgrid((np.arange(6 * fine) + 0.5) / fine, (np.arange(5 * fine) + 0.5) / fine)
    sides = [
        (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
        for (x0, y0), (x1, y1) in zip(points, [*points[1:], points[0]], strict=True)
    ]
    inside = np.all([s > 0 for s in sides], axis=0).astype(float) - np.all([s < 0 for s in sides], axis=0)
    sampled = inside.reshape(5, fine, 6, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(coverage, sampled, atol=4.0 / fine)


def test_more_tubes_converge() -> None:
    """The score of a rippled lens settles: 4 tubes a cell are within 1 % of 8."""
    lens = lens_of(lambda x, y: -1 + 0.02 * np.sin(2 * x) * np.cos(1.5 * y))
    screen = Screen(width_mm=20.0, height_mm=20.0, centre_x_mm=10.0, centre_y_mm=10.0)
    pictures = [
        simulate_caustic(lens, facing(screen, throw_mm=20), pixels=(40, 40), tubes_per_cell=k).irradiance
        for k in (4, 8)
    ]
    assert math.sqrt(np.mean((pictures[0] - pictures[1]) ** 2)) < 0.01


def test_light_by_way_of_some_cells_is_theirs_alone(screen: Screen) -> None:
    """Through a flat lens each pixel's light comes from the cells in front of it; of any lens parts and rest make 1."""
    flat, curved = lens_of(lambda x, y: 0 * x - 0.3), lens_of(lambda x, y: -0.3 - 0.002 * (x - 8) ** 2 - 0.001 * y**2)
    bench, pixels = facing(screen, throw_mm=40), (20, 16)
    left = np.broadcast_to(np.arange(80) < 40, (80, 80)).astype(float)
    share = share_by_way_of(left, flat, bench, pixels=pixels)
    np.testing.assert_allclose(share, np.broadcast_to(np.arange(16) < 8, pixels), atol=1e-9)
    one, other = (share_by_way_of(cells, curved, bench, pixels=pixels) for cells in (left, 1.0 - left))
    lit = simulate_caustic(curved, bench, pixels=pixels).irradiance > 0
    np.testing.assert_allclose((one + other)[lit], 1.0, atol=1e-9)
    assert 0.3 < one[lit].mean() < 0.7
