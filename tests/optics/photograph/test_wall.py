"""What a photograph of a lens's light tells of its wall, its light and its surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optics.bench import Bench, Screen
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.heightfield import Heightfield
from optics.irradiance import picture_from_irradiance, target_irradiance
from optics.lens_settings import LensSettings
from optics.photograph import register
from optics.photograph.rays import ORDERS, SETTINGS, WallRays, surface_mode
from optics.photograph.views import area_average
from optics.photograph.wall import WallFit, fit_wall
from optics.spline import Array
from tests.levels import mostly_thorough
from tests.optics.photographs import camera, photographed

EXAMPLES = Path(__file__).parents[3] / "examples"
SIDE_MM, THROW_MM, PIXELS, FINE, RIM = 25.0, 100.0, 96, 3, 16  # RIM: pixels around the picture


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench.centre_on(width_mm=SIDE_MM, height_mm=SIDE_MM, throw_mm=THROW_MM, refractive_index=1.49)


@pytest.fixture(scope="module")
def lens(bench: Bench) -> Heightfield:
    """Of a photograph of a person: full of detail, as caustics are."""
    return portrait_lens(bench)


def portrait_lens(bench: Bench) -> Heightfield:
    picture = Image.open(EXAMPLES / "astronaut.png").convert("L").resize((PIXELS, PIXELS), Image.Resampling.BOX)
    target = target_irradiance((np.asarray(picture) / 255.0) ** 2.2, viewed_from="lens")
    return design_lens(target, LensSettings(bench=bench, skim_mm=0.1, corrections=0)).heightfield


def light_on_the_wall(lens: Heightfield, bench: Bench, *, throw_mm: float = THROW_MM) -> Array:
    """As the viewer sees it, finer than the prediction, with what lies beside the picture; by the full simulation."""
    wide = PIXELS + 2 * RIM
    screen = Screen(
        width_mm=SIDE_MM * wide / PIXELS,
        height_mm=SIDE_MM * wide / PIXELS,
        centre_x_mm=SIDE_MM / 2,
        centre_y_mm=SIDE_MM / 2,
    )
    moved = replace(bench, throw_mm=throw_mm, screen=screen)
    light = simulate_caustic(lens, moved, pixels=(FINE * wide, FINE * wide)).irradiance
    return picture_from_irradiance(light, viewed_from="lens")


def looked_at(lens: Heightfield, bench: Bench, light: Array) -> WallFit:
    """The fit to a photograph of that light from 30 degrees aside; the prediction is the lens's own light."""
    predicted = simulate_caustic(lens, bench, pixels=(PIXELS, PIXELS)).irradiance
    shot = photographed(
        light,
        camera(aside_deg=30.0, roll_deg=2.0, shape=(450, 600)),
        margin=RIM / PIXELS,
        shape=(450, 600),
        shading=0.1,
    )
    place = register(shot.photo, predicted, fit_tone=True)
    return fit_wall(shot.photo, place, lens, bench, predicted)


@pytest.mark.parametrize("off", mostly_thorough([0.02, -0.02], quick=[0.02]))
def test_a_wall_in_the_wrong_place_is_told_with_its_sign(lens: Heightfield, bench: Bench, off: float) -> None:
    """Two percent of the throw to a fifth of itself, from a photograph in perspective, by shape and not by scale."""
    fit = looked_at(lens, bench, light_on_the_wall(lens, bench, throw_mm=THROW_MM * (1 + off)))
    assert fit.throw_mm.exceeds(2)
    assert fit.throw_mm.value == pytest.approx(off * THROW_MM, rel=0.2)
    assert fit.correlation > fit.before


@pytest.mark.thorough
def test_a_wall_in_its_place_is_not_said_to_be_off(lens: Heightfield, bench: Bench) -> None:
    fit = looked_at(lens, bench, light_on_the_wall(lens, bench))
    assert abs(fit.throw_mm.value) < 0.004 * THROW_MM
    estimates = (fit.throw_mm, *fit.wall_tilt_rad, *fit.light_tilt_rad, *fit.surface_um)
    assert not any(one.exceeds(3) for one in estimates), estimates


@pytest.mark.parametrize(
    ("order", "um"),
    [
        ((3, 0), -5.0),
        pytest.param((2, 1), 5.0, marks=pytest.mark.thorough),
        pytest.param((2, 2), 5.0, marks=pytest.mark.thorough),
    ],
)
def test_a_low_order_error_of_the_surface_is_told_with_its_sign(
    lens: Heightfield, bench: Bench, order: tuple[int, int], um: float
) -> None:
    """Five micrometres, to a third, and of no other kind."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, lens.x_mm.size)] * 2)
    off = Heightfield(x_mm=lens.x_mm, y_mm=lens.y_mm, z_mm=lens.z_mm + 1e-3 * um * surface_mode(order, x, y, 1.0))
    fit = looked_at(lens, bench, light_on_the_wall(off, bench))
    found = dict(zip(ORDERS, fit.surface_um, strict=True))
    assert found[order].exceeds(4)
    assert found[order].value == pytest.approx(um, rel=0.33)
    assert all(abs(one.value) < 0.5 * abs(um) for other, one in found.items() if other != order and one.is_determined)


@pytest.mark.thorough
def test_what_is_not_told_is_said_to_be_unknown(bench: Bench) -> None:
    """A weak, smooth lens sends all light nearly straight: another distance changes nothing that could be seen."""
    arch = np.sin(np.linspace(0, np.pi, 65))
    weak = Heightfield.on_aperture(0.004 * np.outer(arch, arch) - 0.2, width_mm=SIDE_MM, height_mm=SIDE_MM)
    fit = looked_at(weak, bench, light_on_the_wall(weak, bench, throw_mm=1.02 * THROW_MM))
    assert not fit.throw_mm.is_determined


def test_rays_of_the_set_up_as_it_is_make_the_simulated_light(lens: Heightfield, bench: Bench) -> None:
    rays = WallRays(lens, bench, (PIXELS, PIXELS), 0)
    full = simulate_caustic(lens, bench, pixels=(PIXELS, PIXELS)).irradiance
    assert np.abs(rays.light(np.zeros(SETTINGS)) - full).mean() < 0.01


def test_a_wall_that_leans_is_farther_on_one_side(
    lens: Heightfield, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each column of a leaning wall shows what an upright one at that column's distance does."""
    monkeypatch.setattr("optics.photograph.rays._without_affine", lambda _before, after: after)
    rays, setting = WallRays(lens, bench, (PIXELS, PIXELS), 0), np.zeros(SETTINGS)
    setting[1] = np.radians(20.0)
    leaning = rays.light(setting)
    x_mm = (np.arange(PIXELS) + 0.5) * SIDE_MM / PIXELS - SIDE_MM / 2
    for column in (6, 30, 60, 90):
        away = replace(bench, throw_mm=THROW_MM + np.tan(np.radians(20.0)) * x_mm[column])
        upright = simulate_caustic(lens, away, pixels=(PIXELS, PIXELS)).irradiance
        off = np.abs(leaning[:, column] - upright[:, column]).mean()
        assert off < 0.2 * np.abs(rays.light(np.zeros(SETTINGS))[:, column] - upright[:, column]).mean() + 0.02


def test_each_ray_goes_on_to_where_a_leaning_wall_stands(bench: Bench) -> None:
    """What counts is how far away the wall is where the ray meets it, not where it would have met it upright."""
    arch = np.sin(np.linspace(0, np.pi, 65))
    lens = Heightfield.on_aperture(2.0 * np.outer(arch, arch) - 2.0, width_mm=SIDE_MM, height_mm=SIDE_MM)
    rays = WallRays(lens, bench, (PIXELS, PIXELS), 0)
    upright, farther, leaning = np.zeros((3, SETTINGS))
    farther[0], leaning[1], leaning[2] = 1.0, np.radians(20.0), np.radians(-10.0)
    before, after, hits = (np.stack(rays._trace_hits(setting)) for setting in (upright, farther, leaning))
    x_mm, y_mm = (hits - PIXELS / 2) * SIDE_MM / PIXELS
    away_mm = np.tan(leaning[1]) * x_mm + np.tan(leaning[2]) * y_mm
    assert np.abs(away_mm).max() > 5.0
    np.testing.assert_allclose(hits, before + away_mm * (after - before), atol=1e-9)


@pytest.mark.thorough
def test_light_aslant_and_a_farther_wall_are_those_of_the_bench(
    lens: Heightfield, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("optics.photograph.rays._without_affine", lambda _before, after: after)
    rays, setting = WallRays(lens, bench, (PIXELS, PIXELS), 0), np.zeros(SETTINGS)
    setting[0], setting[4] = 3.0, np.radians(0.5)
    light = replace(bench.light, tilt_rad=(0.0, np.radians(0.5)))
    full = simulate_caustic(
        lens, replace(bench, throw_mm=THROW_MM + 3.0, light=light), pixels=(PIXELS, PIXELS)
    ).irradiance
    assert np.abs(rays.light(setting) - full)[4:-4, 4:-4].mean() < 0.02


@pytest.mark.thorough
def test_a_measured_width_makes_the_distance_surer(bench: Bench) -> None:
    """Rays that spread: a farther wall shows a wider picture, which a rule on the wall tells and a camera cannot."""
    wide = replace(bench, screen=replace(bench.screen, width_mm=32.0, height_mm=32.0))
    lens = portrait_lens(wide)
    setting = np.zeros(SETTINGS)
    setting[0] = 2.0
    wider = WallRays(lens, wide, (PIXELS, PIXELS), 0).width(setting)
    assert wider > 1.002
    around = replace(wide.screen, width_mm=44.0, height_mm=44.0)
    light = simulate_caustic(lens, replace(wide, throw_mm=THROW_MM + 2.0, screen=around), pixels=(400, 400)).irradiance
    seen, margin = picture_from_irradiance(light, viewed_from="lens"), (44 / 32 - 1) / 2
    shot = photographed(seen, camera(aside_deg=20.0, shape=(450, 600)), margin=margin, shape=(450, 600))
    predicted = simulate_caustic(lens, wide, pixels=(PIXELS, PIXELS)).irradiance
    place = register(shot.photo, predicted, fit_tone=True)
    without, measured = (
        fit_wall(shot.photo, place, lens, wide, predicted, picture_width_mm=width).throw_mm
        for width in (None, 32.0 * wider)
    )
    assert measured.deviation < without.deviation
    assert measured.value == pytest.approx(2.0, rel=0.2)


def test_averages_of_the_light_do_not_change_with_the_view(lens: Heightfield, bench: Bench) -> None:
    """The same light in fewer pixels: what a coarse view starts from."""
    fine, coarse = (WallRays(lens, bench, (n, n), 0).light(np.zeros(SETTINGS)) for n in (96, 48))
    assert np.abs(area_average(fine, (48, 48)) - coarse).mean() < 0.02
