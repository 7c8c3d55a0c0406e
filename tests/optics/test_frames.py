"""Any light and any frame: what the design says of a ray is what an independent trace of the lens finds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.errors import TotalReflectionError
from optics.heightfield import Heightfield
from optics.irradiance import target_irradiance
from optics.light import Light
from optics.metrics import score_caustic
from optics.outline import is_inside
from optics.transport.optical_path import Preimages, flat_path_mm, heights_mm
from optics.transport.solver import OpticalPath, solve_transport
from optics.transport_map import screen_positions
from tests.optics.areas import areas_mm2

PIXELS = 48
GAUSS = np.exp(-1.5 * (np.linspace(-1, 1, 21)[:, None] ** 2 + np.linspace(-1, 1, 21)[None, :] ** 2))
ANGLES = np.linspace(0, 2 * np.pi, 200, endpoint=False)
CIRCLE = 10 + 10 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)


def bench_of(**changes: Any) -> Bench:
    sizes: dict[str, Any] = {"width_mm": 20.0, "height_mm": 20.0, "throw_mm": 60.0, "refractive_index": 1.49}
    return Bench.centre_on(**(sizes | changes))


BENCHES = {
    "usual": bench_of(),
    "tilted": bench_of(light=Light(tilt_rad=(0.1, -0.05))),
    "uneven": bench_of(light=Light(profile=GAUSS)),
    "far point": bench_of(light=Light(kind="point", distance_mm=500.0)),
    "near point": bench_of(light=Light(kind="point", distance_mm=60.0), thickness_mm=15.0),
    "point aside": bench_of(light=Light(kind="point", distance_mm=80.0, tilt_rad=(0.2, 0.1))),
    "shifted": bench_of(screen_mm=(26.0, 26.0), shift_mm=(12.0, -6.0)),
    "shifted, tilted": bench_of(screen_mm=(14.0, 30.0), shift_mm=(8.0, 3.0), light=Light(tilt_rad=(0.1, 0.0))),
    "dense glass": bench_of(refractive_index=1.9, throw_mm=40.0),
    "mirror": bench_of(mirror=True),
    "mirror aside": bench_of(mirror=True, shift_mm=(30.0, 0.0)),
    "mirror, point": bench_of(mirror=True, shift_mm=(25.0, 5.0), light=Light(kind="point", distance_mm=90.0)),
    "inverted": bench_of(branch="inverted", throw_mm=90.0),
    "inverted, point": bench_of(branch="inverted", throw_mm=120.0, light=Light(kind="point", distance_mm=200.0)),
}


def lens_of(solution: OpticalPath, *, finer: int = 4) -> Heightfield:
    """The lens at its solved height: not put under the skim again, which would hide a wrong piston."""
    ny, nx = solution.path_mm.shape
    bench = solution.bench
    x_mm, y_mm = np.linspace(0, bench.width_mm, finer * nx + 1), np.linspace(0, bench.height_mm, finer * ny + 1)
    corners = solution.transport_map().lens_mm
    u, v = screen_positions(corners[..., 0], corners[..., 1], x_mm, y_mm)
    return Heightfield(x_mm=x_mm, y_mm=y_mm, z_mm=heights_mm(solution.path_mm, u, v, x_mm, y_mm, bench))


def refracted(d: np.ndarray, normal: np.ndarray, index: float) -> np.ndarray:
    """Snell's law by components: what lies in the surface grows by the index, the rest follows from length 1."""
    along = index * (d - (d * normal).sum(-1, keepdims=True) * normal)
    return np.asarray(along + np.sqrt(1 - (along**2).sum(-1, keepdims=True)) * normal)


def light_at(bench: Bench, points: np.ndarray) -> np.ndarray:
    """Directions (m, 3) before the surface at points (m, 3), by bisection on where the ray crosses the flat face."""
    light, n = bench.light, bench.refractive_index
    tan = np.tan(light.tilt_rad)
    if light.kind != "point":
        if bench.mirror:
            return np.broadcast_to(np.array([*tan, -1.0]) / np.sqrt(1 + tan @ tan), points.shape)
        d = np.array([[*tan, 1.0]]) / np.sqrt(1 + tan @ tan)
        return np.broadcast_to(refracted(d, np.array([[0.0, 0.0, 1.0]]), 1 / n), points.shape)
    middle = np.array([bench.width_mm, bench.height_mm]) / 2 - light.distance_mm * tan
    if bench.mirror:
        way = points - [*middle, light.distance_mm]
        return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))
    aside = points[:, :2] - middle
    run = np.linalg.norm(aside, axis=1)
    low, high = np.zeros_like(run), run.copy()
    for _ in range(60):
        crossing = (low + high) / 2
        outside = crossing / np.hypot(crossing, light.distance_mm)
        inside = (run - crossing) / np.hypot(run - crossing, points[:, 2] + bench.thickness_mm)
        low, high = np.where(outside < n * inside, crossing, low), np.where(outside < n * inside, high, crossing)
    sine = outside / n
    return np.column_stack([aside / run[:, None] * sine[:, None], np.sqrt(1 - sine**2)])


def landed(lens: Heightfield, bench: Bench, p: np.ndarray) -> np.ndarray:
    """Where light through the lens points p (m, 2) meets the screen: plain numpy, none of the kernels."""
    z, zx, zy, *_ = lens.spline().jets(p[:, 0], p[:, 1])
    normal = np.column_stack([-zx, -zy, np.ones_like(zx)]) / np.sqrt(1 + zx**2 + zy**2)[:, None]
    d = light_at(bench, np.column_stack([p, z]))
    if bench.mirror:
        out = d - 2 * (d * normal).sum(1, keepdims=True) * normal
    else:
        out = refracted(d, normal, bench.refractive_index)
    return np.asarray(p + (bench.throw_mm - z)[:, None] * out[:, :2] / out[:, 2:])


@pytest.mark.parametrize("name", BENCHES)
def test_light_lands_where_the_map_says(name: str, soft_picture: np.ndarray) -> None:
    """To 0.6 % of a pixel (usual: 0.3 %), and the picture is as good as in the usual set-up."""
    bench = BENCHES[name]
    target = target_irradiance(soft_picture, viewed_from="lens")
    solution = solve_transport(target, bench, skim_mm=0.1)
    assert solution.converged
    lens, corners = lens_of(solution), solution.transport_map()
    assert lens.z_mm.max() == pytest.approx(-0.1, abs=1e-3 * bench.throw_mm)  # the piston has come to rest
    p, q = (points[2:-2, 2:-2].reshape(-1, 2) for points in (corners.lens_mm, corners.screen_mm))
    pixel_mm = np.array([bench.screen.width_mm, bench.screen.height_mm]) / PIXELS
    miss = (landed(lens, bench, p) - q) / pixel_mm
    assert np.sqrt((miss**2).mean()) < 0.006
    caustic = simulate_caustic(lens, bench, pixels=target.shape, tubes_per_cell=2)
    score = score_caustic(caustic.irradiance, target)
    assert score.psnr_db > 58  # usual: 67 dB; the brightest places of uneven light have fewer vertices a pixel
    assert caustic.outside_share < 1e-3


@pytest.mark.parametrize(
    "outline",
    [CIRCLE, np.array([[10, 0], [20, 10], [10, 20], [0, 10.0]]), np.array([[0, 0], [20, 0], [10, 17.3]])],
    ids=["circle", "diamond", "triangle"],
)
def test_a_convex_outline_gets_all_of_the_frame(outline: np.ndarray, soft_picture: np.ndarray) -> None:
    """All light of the lens reaches the picture, the frame's comes from the rim, and rays land on their pixels."""
    bench = bench_of(outline_mm=outline)
    target = target_irradiance(soft_picture, viewed_from="lens")
    solution = solve_transport(target, bench, skim_mm=0.1)
    assert solution.converged
    lens, corners = lens_of(solution), solution.transport_map()
    area = areas_mm2(corners.lens_mm)
    x, y = outline.T
    whole = 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    assert area.sum() == pytest.approx(whole, rel=0.01)  # the rim is followed by chords of a pixel's width
    caustic = simulate_caustic(lens, bench, pixels=target.shape, tubes_per_cell=2)
    assert caustic.outside_share < 5e-3
    assert score_caustic(caustic.irradiance, target).misplaced_light < 0.01
    p, q = corners.lens_mm[2:-2, 2:-2].reshape(-1, 2), corners.screen_mm[2:-2, 2:-2].reshape(-1, 2)
    assert np.sqrt((((landed(lens, bench, p) - q) / (20 / PIXELS)) ** 2).mean()) < 0.06


def test_a_star_is_lit_where_it_is(soft_picture: np.ndarray) -> None:
    """Between a star's points there is no light, so most of the frame must come from inside the star."""
    turn = np.arange(10) * np.pi / 5
    star = 10 + np.where(np.arange(10) % 2 == 0, 10.0, 6.0)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    bench, target = bench_of(outline_mm=star), target_irradiance(soft_picture, viewed_from="lens")
    solution = solve_transport(target, bench, skim_mm=0.1)
    lens = lens_of(solution)
    even = solve_transport(target, replace(bench, outline_mm=None), skim_mm=0.1)
    unaware = simulate_caustic(lens_of(even), bench, pixels=target.shape, tubes_per_cell=2)
    aware = simulate_caustic(lens, bench, pixels=target.shape, tubes_per_cell=2)
    misplaced = [score_caustic(light.irradiance, target).misplaced_light for light in (unaware, aware)]
    assert misplaced[1] < 0.3 * misplaced[0]


def test_inside_agrees_with_the_circle() -> None:
    x = np.linspace(0.03, 19.9, 77)
    distance = np.hypot(x[None, :] - 10, x[:, None] - 10)
    inside = is_inside(CIRCLE, x, x)
    assert inside[distance < 9.99].all()  # sagitta of 200 chords: 1.2 um
    assert not inside[distance > 10].any()


@pytest.mark.parametrize("name", ["usual", "tilted", "near point", "shifted", "mirror aside", "inverted"])
def test_base_path_and_reach_describe_the_start(name: str) -> None:
    """The base spreads the aperture evenly up to relief; the reach is the derivative that the solver steps by."""
    bench = BENCHES[name]
    preimages = Preimages(bench, (24, 24))
    c = flat_path_mm(bench, (24, 24), skim_mm=0.1)
    preimages.evaluate(c)
    assert preimages.across.mean() == pytest.approx(1.0, abs=0.15)
    assert preimages.along.mean() == pytest.approx(1.0, abs=0.15)
    light = np.broadcast_to(preimages.light, c.shape)
    area = preimages.across * preimages.along - preimages.mixed
    assert (light * area).mean() == pytest.approx(1.0, abs=1e-9 if not preimages.even else 1e-3)
    before = preimages.across[12, 12]
    bump = c.copy()
    bump[12, 12] += 1e-4
    preimages.evaluate(bump)
    pixel = bench.screen.width_mm / 24
    expected = preimages.sign * 2e-4 * preimages.reach_mm[0] / pixel**2 * bench.screen.width_mm / bench.width_mm
    assert preimages.across[12, 12] - before == pytest.approx(expected, rel=0.25)


def test_raising_the_surface_lengthens_the_path_as_stated() -> None:
    for bench in BENCHES.values():
        gain = Preimages(bench, (8, 8)).path_per_height
        low, high = (flat_path_mm(bench, (8, 8), skim_mm=skim)[4, 4] for skim in (0.2, 0.1))
        assert high - low == pytest.approx(0.1 * gain, rel=1e-2)
        assert (gain < 0) == bench.mirror


def test_an_upright_beam_by_the_general_kernels_is_the_usual_solution(soft_picture: np.ndarray) -> None:
    """The fast kernel and the general one, told of an even profile, solve the same equation."""
    target = target_irradiance(soft_picture, viewed_from="lens")
    paths = [
        solve_transport(target, bench_of(light=Light(profile=profile)), skim_mm=0.1, tolerance=1e-5).path_mm
        for profile in (None, np.ones((2, 2)))
    ]
    np.testing.assert_allclose(paths[0], paths[1], atol=2e-4)  # of 59 mm; rim slopes see c at the frame, not beside it


def test_light_from_too_far_aside_is_refused(soft_picture: np.ndarray) -> None:
    """A throw that helps is named and is enough; where none can help, that is said; a mirror has no such limit."""
    target = target_irradiance(soft_picture, viewed_from="lens")
    with pytest.raises(TotalReflectionError, match="use about") as caught:
        solve_transport(target, bench_of(branch="inverted", throw_mm=24.0), skim_mm=0.1)
    enough = bench_of(branch="inverted", throw_mm=caught.value.shortest_throw_mm)
    assert solve_transport(target, enough, skim_mm=0.1).converged
    lamp = Light(kind="point", distance_mm=2.0)
    with pytest.raises(TotalReflectionError, match="no throw helps"):
        solve_transport(target, bench_of(light=lamp, thickness_mm=3.0, screen_mm=(4.0, 4.0)), skim_mm=0.1)
    assert solve_transport(target, bench_of(mirror=True, shift_mm=(90.0, 0.0)), skim_mm=0.1).converged
