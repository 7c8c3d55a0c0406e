"""The forward model under any light, against rays that start at the source and closed forms of exact focus."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from optics.bench import Bench, Screen
from optics.caustic import simulate_caustic
from optics.heightfield import Heightfield
from optics.light import Light
from optics.tubes.edges import polygon_coverage

N = 1.49
WIDE, HIGH, THROW, THICK = 24.0, 16.0, 25.0, 9.0
SCREEN = Screen(width_mm=30.0, height_mm=14.0, centre_x_mm=11.0, centre_y_mm=9.0)
PROFILE = np.random.default_rng(3).uniform(0.3, 1.0, (3, 4))
PENTAGON = np.array([[2.0, 1.0], [20.0, 0.5], [23.0, 9.0], [11.0, 15.5], [1.0, 8.0]])
LIGHTS: dict[str, dict[str, Any]] = {
    "tilted": {"light": Light(tilt_rad=(0.06, -0.04))},
    "uneven": {"light": Light(profile=PROFILE)},
    "point, near": {"light": Light(kind="point", distance_mm=40.0)},
    "point, uneven, aside": {"light": Light(kind="point", distance_mm=90.0, profile=PROFILE, tilt_rad=(0.1, 0.2))},
    "mirror": {"light": Light(tilt_rad=(-0.05, 0.03)), "mirror": True},
    "mirror, point": {"light": Light(kind="point", distance_mm=70.0, tilt_rad=(0.05, 0.1)), "mirror": True},
    "outline": {"outline_mm": PENTAGON},
    "outline, point": {"outline_mm": PENTAGON[::-1], "light": Light(kind="point", distance_mm=50.0)},
}


def surface(x: np.ndarray, y: np.ndarray, depth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A lopsided surface and its two slopes, in closed form."""
    u, v = 0.4 * x + 0.2 * y, 0.5 * y
    z = -4 + depth * np.sin(u) * np.cos(v) + 0.05 * x
    slope_y = depth * (0.2 * np.cos(u) * np.cos(v) - 0.5 * np.sin(u) * np.sin(v))
    return z, 0.4 * depth * np.cos(u) * np.cos(v) + 0.05, slope_y


def lopsided(depth: float = 0.5) -> Heightfield:
    z, *_ = surface(*np.meshgrid(np.linspace(0, WIDE, 73), np.linspace(0, HIGH, 49)), depth)
    return Heightfield.on_aperture(z, width_mm=WIDE, height_mm=HIGH)


def bench_of(**changes: Any) -> Bench:
    return Bench(
        width_mm=WIDE, height_mm=HIGH, throw_mm=THROW, refractive_index=N, screen=SCREEN, thickness_mm=THICK, **changes
    )


def snell(d: np.ndarray, normal: np.ndarray, index: float) -> np.ndarray:
    """Unit rays d behind a surface, the vector form; index: before over behind. normal against the ray."""
    cos = -(d * normal).sum(axis=0)
    inner = 1 - index**2 * (1 - cos**2)
    return index * d + (index * cos - np.sqrt(inner)) * normal


def traced(depth: float, bench: Bench, pixels: tuple[int, int], side: int = 900) -> tuple[np.ndarray, float]:
    """(irradiance, share beside the screen): rays from the source through a grid of points on the face."""
    light, up = bench.light, -1.0 if bench.mirror else 1.0
    face = 0.0 if bench.mirror else -bench.thickness_mm
    fx, fy = np.meshgrid(np.linspace(-9, WIDE + 9, side), np.linspace(-9, HIGH + 9, side))
    tan_x, tan_y = (math.tan(a) for a in light.tilt_rad)
    if light.kind == "point":
        away = light.distance_mm
        d = np.stack([fx - (WIDE / 2 - away * tan_x), fy - (HIGH / 2 - away * tan_y), np.full_like(fx, up * away)])
        strength = (away / np.linalg.norm(d, axis=0)) ** 3
    else:
        d = np.broadcast_to(np.array([tan_x, tan_y, up])[:, None, None], (3, side, side)).copy()
        strength = np.ones_like(fx)
    d /= np.linalg.norm(d, axis=0)
    if light.profile is not None:
        my, mx = light.profile.shape
        axes = np.linspace(0, HIGH, my), np.linspace(0, WIDE, mx)
        strength *= RegularGridInterpolator(axes, light.profile)((np.clip(fy, 0, HIGH), np.clip(fx, 0, WIDE)))
    if not bench.mirror:
        d = snell(d, np.array([0.0, 0.0, -1.0])[:, None, None], 1 / N)
    way = np.full_like(fx, (-4.0 - face)) / d[2]
    for _ in range(6):  # Newton, to where the ray meets the surface
        x, y = fx + way * d[0], fy + way * d[1]
        z, zx, zy = surface(x, y, depth)
        way -= (face + way * d[2] - z) / (d[2] - zx * d[0] - zy * d[1])
    inside = (x > 0) & (x < WIDE) & (y > 0) & (y < HIGH)
    if bench.outline_mm is not None:
        inside &= within(bench.outline_mm, x, y)
    normal = np.stack([-zx, -zy, np.ones_like(zx)]) / np.sqrt(1 + zx**2 + zy**2)
    out = d - 2 * (d * normal).sum(axis=0) * normal if bench.mirror else snell(d, -normal, N)
    reach = (bench.throw_mm - face - way * d[2]) / out[2]
    at_x, at_y = x + reach * out[0], y + reach * out[1]
    s = bench.screen
    box = ((s.bottom_mm, s.bottom_mm + s.height_mm), (s.left_mm, s.left_mm + s.width_mm))
    amount, *_ = np.histogram2d(at_y[inside], at_x[inside], bins=pixels, range=box, weights=strength[inside])
    amount /= strength[inside].sum() / (pixels[0] * pixels[1])
    return amount, 1 - amount.mean()


def within(corners: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of a convex polygon."""
    turn = np.roll(corners, -1, axis=0) - corners
    sides = [tx * (y - cy) - ty * (x - cx) for (cx, cy), (tx, ty) in zip(corners, turn, strict=True)]
    return np.all([side > 0 for side in sides], axis=0) | np.all([side < 0 for side in sides], axis=0)


@pytest.mark.parametrize("name", LIGHTS)
def test_tubes_agree_with_rays_from_the_source(name: str) -> None:
    """Some 400 thousand rays that land on 35 pixels: their own grain is below 1 % of a pixel's light."""
    bench = bench_of(**LIGHTS[name])
    depth = 0.1 if bench.mirror else 0.5  # a mirror turns light by 4 times as much
    tubes = simulate_caustic(lopsided(depth), bench, pixels=(5, 7))
    rays, outside = traced(depth, bench, (5, 7))
    assert tubes.reflected_share == 0
    assert tubes.outside_share == pytest.approx(outside, abs=3e-3)
    assert tubes.irradiance.max() > 1.2 * tubes.irradiance.mean()
    np.testing.assert_allclose(tubes.irradiance, rays, rtol=0.01, atol=0.01)


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(["collimated", "sun", "point"]),
    distance_mm=st.floats(20.0, 1e6),
    tilt=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    mirror=st.booleans(),
    relief=st.floats(0.0, 1.0),
)
def test_no_light_is_lost_or_made(
    seed: int, kind: Any, distance_mm: float, tilt: tuple[float, float], mirror: bool, relief: float
) -> None:
    """What is not totally reflected arrives in a hall, to rounding, whatever the light and the surface."""
    rng = np.random.default_rng(seed)
    light = Light(kind=kind, distance_mm=distance_mm, size_mm=2.0, tilt_rad=tilt, profile=rng.random((2, 3)))
    lens = Heightfield.on_aperture(
        relief * (0.1 if mirror else 2.0) * rng.random((12, 12)) - 4.0, width_mm=WIDE, height_mm=HIGH
    )
    hall = Screen(width_mm=4000.0, height_mm=4000.0, centre_x_mm=10.0, centre_y_mm=10.0)
    bench = replace(bench_of(light=light, mirror=mirror, outline_mm=PENTAGON), screen=hall)
    caustic = simulate_caustic(lens, bench, pixels=(64, 64), tubes_per_cell=2, beams=3)
    assert caustic.irradiance.min() > -1e-9
    assert caustic.irradiance.mean() + caustic.reflected_share == pytest.approx(1.0, abs=1e-11)
    assert 0 <= caustic.reflected_share <= 1


@settings(max_examples=10)
@given(shift=st.floats(-1e-7, 1e-7))
def test_general_light_meets_the_even_one(shift: float) -> None:
    """A ray's way is continuous in the light's tilt: the kernel of vertical light is the limit of the general one."""
    lens = lopsided()
    straight = simulate_caustic(lens, bench_of(), pixels=(14, 20)).irradiance
    tilted = simulate_caustic(lens, bench_of(light=Light(tilt_rad=(shift, 1e-9))), pixels=(14, 20)).irradiance
    far = simulate_caustic(lens, bench_of(light=Light(kind="point", distance_mm=1e9)), pixels=(14, 20)).irradiance
    np.testing.assert_allclose(tilted, straight, atol=2e-5)
    np.testing.assert_allclose(far, straight, atol=2e-5)


def test_a_plate_shows_the_lights_own_profile() -> None:
    """A profile that rises evenly in x and y: pixels whose rims lie on the lattice hold its exact mean."""
    profile = np.array([[1.0, 4.0], [3.0, 6.0]])
    plate = Heightfield.on_aperture(np.full((9, 9), -1.0), width_mm=20.0, height_mm=20.0)
    bench = Bench.centre_on(
        width_mm=20.0, height_mm=20.0, throw_mm=30.0, refractive_index=N, light=Light(profile=profile)
    )
    middle = (np.arange(8) + 0.5) / 8
    expected = 1 + 3 * middle[None, :] + 2 * middle[:, None]
    light = simulate_caustic(plate, bench, pixels=(8, 8), tubes_per_cell=2).irradiance
    np.testing.assert_allclose(light, expected / expected.mean(), rtol=1e-9)


def focusing_lens(throw: float = 30.0, vertices: int = 81) -> Heightfield:
    """n t + |(p, t) - q0| constant: every vertical ray meets in the axis, throw - 3 mm above Z0."""
    axis = np.linspace(0.0, 20.0, vertices)
    r2 = (axis[None, :] - 10) ** 2 + (axis[:, None] - 10) ** 2
    path = throw + 1.0
    b = N * path - throw
    height = (b - np.sqrt(b**2 - (N**2 - 1) * (path**2 - r2 - throw**2))) / (N**2 - 1) - 3.0
    return Heightfield.on_aperture(height, width_mm=20.0, height_mm=20.0)


def test_the_sun_makes_an_image_of_itself() -> None:
    """Behind a small pupil, at the focus: a disc of diameter size x distance, whose mean square radius is R^2 / 2."""
    lens = focusing_lens()
    screen = Screen(width_mm=2.0, height_mm=2.0, centre_x_mm=10.0, centre_y_mm=10.0)
    pupil = 10 + 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    light = Light(kind="sun", size_deg=0.53)
    bench = Bench.centre_on(width_mm=20.0, height_mm=20.0, throw_mm=27.0, refractive_index=N, light=light)
    bench = replace(bench, screen=screen, outline_mm=pupil)
    light_at = simulate_caustic(lens, bench, pixels=(200, 200), beams=60).irradiance
    axis = (np.arange(200) + 0.5) / 100 - 1
    square = (light_at * (axis[None, :] ** 2 + axis[:, None] ** 2)).sum() / light_at.sum()
    top = float(lens.z_mm.max())
    assert math.sqrt(2 * square) == pytest.approx((27.0 - top) * math.radians(0.53) / 2, rel=0.01)


def test_a_paraboloid_mirror_focuses_on_one_point() -> None:
    """z = r^2 / 4 f sends light along its axis through the height f: exact."""
    axis, focal = np.linspace(0.0, 20.0, 81), 60.0
    z = ((axis[None, :] - 9.95) ** 2 + (axis[:, None] - 10.05) ** 2) / (4 * focal)
    mirror = Heightfield.on_aperture(z - 4.0, width_mm=20.0, height_mm=20.0)
    bench = Bench.centre_on(width_mm=20.0, height_mm=20.0, throw_mm=focal - 4.0, refractive_index=N, mirror=True)
    light = simulate_caustic(mirror, bench, pixels=(200, 200)).irradiance
    assert light[100, 99] == pytest.approx(200 * 200, rel=1e-6)


def test_coverage_of_a_turned_square_is_its_area() -> None:
    """And does not depend on the way round."""
    turn = np.exp(1j * (0.3 + np.pi / 2 * np.arange(4)))
    corners = np.stack([6 + 4 * turn.real, 5 + 4 * turn.imag], axis=1)
    cover = polygon_coverage(corners, (10, 12))
    assert cover.sum() == pytest.approx(32.0, rel=1e-12)
    assert cover[5, 6] == pytest.approx(1.0)
    np.testing.assert_allclose(polygon_coverage(corners[::-1], (10, 12)), cover, atol=1e-12)
