"""Light through facets: nothing is lost, the order of work does not matter, and a fine surface is the lens itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.heightfield import Heightfield
from optics.light import Light
from optics.metrics import psnr_db
from optics.milled import simulate_milled
from optics.milled_blur import deviations, predict_light

SIDE_MM = 10.0
PIXELS = (32, 32)
BENCH = Bench.centre_on(width_mm=SIDE_MM, height_mm=SIDE_MM, throw_mm=30.0, refractive_index=1.49)


def lens():
    axis = np.linspace(0.0, SIDE_MM, 41)
    x, y = np.meshgrid(axis, axis)
    z = 0.08 * np.cos(0.9 * x + 0.2) * np.cos(0.7 * y) - 0.01 * (x - 5) ** 2
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=SIDE_MM, height_mm=SIDE_MM)


def facets_of(over, *, groove_mrad=0.0, count=200):
    """The lens in count x count facets, grooves along x: slopes across from -groove to +groove in each."""
    axis = np.linspace(0.0, SIDE_MM, count + 1)
    x, y = np.meshgrid(axis, axis)
    jets = over.spline().jets(x, y)
    corners = np.stack([x, y, *jets[:3]], axis=-1)
    facets = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]], axis=2)
    facets = facets.reshape(-1, 4, 5).copy()
    facets[:, :2, 4] -= 1e-3 * groove_mrad
    facets[:, 2:, 4] += 1e-3 * groove_mrad
    return facets


def light_of(facets, bench=BENCH, parts=6, over=None):
    pieces = np.array_split(facets, parts)
    return simulate_milled(lambda k: pieces[k], parts, over or lens(), bench, pixels=PIXELS)


LIGHTS = {
    "even": BENCH,
    "sun": replace(BENCH, light=Light(kind="sun")),
    "lamp": replace(BENCH, light=Light(kind="point", distance_mm=200.0, size_mm=2.0)),
    "tilted": replace(BENCH, light=Light(tilt_rad=(0.02, -0.01))),
    "mirror": replace(BENCH, mirror=True),
    "profile": replace(BENCH, light=Light(profile=np.array([[1.0, 0.4], [0.6, 0.9]]))),
    "round": replace(BENCH, outline_mm=5.0 + 4.5 * np.stack([np.cos(a := np.linspace(0, 6.2, 60)), np.sin(a)], axis=1)),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_facets_of_the_lens_itself_make_its_own_light(name):
    over, bench = lens(), LIGHTS[name]
    ours = light_of(facets_of(over), bench, over=over)
    theirs = simulate_caustic(over, bench, pixels=PIXELS, beams=7)
    assert psnr_db(ours.irradiance, theirs.irradiance) > (45.0 if name == "round" else 55.0)
    assert ours.outside_share == pytest.approx(theirs.outside_share, abs=2e-3)


@pytest.mark.parametrize("thinned", [np.s_[::2, :], np.s_[:, ::2]], ids=["high", "wide"])
def test_an_outline_lies_where_it_is_over_cells_that_are_not_square(thinned):
    over = Heightfield.on_aperture(lens().z_mm[thinned], width_mm=SIDE_MM, height_mm=SIDE_MM)
    aside = replace(BENCH, outline_mm=np.array([[1.0, 1.0], [9.0, 2.0], [4.0, 7.0]]))
    ours = light_of(facets_of(over), aside, over=over)
    theirs = simulate_caustic(over, aside, pixels=PIXELS)
    assert psnr_db(ours.irradiance, theirs.irradiance) > 40.0


def test_light_is_conserved_however_rough_the_surface():
    wide = replace(BENCH, screen=replace(BENCH.screen, width_mm=80.0, height_mm=80.0))
    seen = light_of(facets_of(lens(), groove_mrad=60.0), wide)
    assert seen.outside_share == pytest.approx(0.0, abs=1e-12)
    assert seen.irradiance.mean() == pytest.approx(1.0, abs=1e-12)
    assert seen.irradiance.min() > -1e-9


def test_the_parts_do_not_matter():
    facets = facets_of(lens(), groove_mrad=5.0)
    one, many = light_of(facets, parts=1), light_of(facets, parts=37)
    assert np.allclose(one.irradiance, many.irradiance, rtol=0, atol=1e-11)


def test_grooves_blur_across_and_the_deeper_the_more():
    over, bench = lens(), BENCH
    plain = light_of(facets_of(over)).irradiance
    losses = [psnr_db(light_of(facets_of(over, groove_mrad=size)).irradiance, plain) for size in (2.0, 5.0, 15.0)]
    assert losses[0] > losses[1] > losses[2]
    found = deviations([facets_of(over, groove_mrad=15.0)], over, bench, PIXELS)
    assert found.slope_y_mrad == pytest.approx(15.0 / np.sqrt(3), rel=0.01)
    assert found.slope_x_mrad < 0.1
    px = 1e-3 * found.slope_y_mrad * 0.49 * 30.0 * PIXELS[0] / SIDE_MM
    assert found.blur_y_px == pytest.approx(px, rel=0.05)


def test_what_leaves_the_aperture_is_cut_off():
    facets = facets_of(lens())
    moved = facets.copy()
    moved[:, :, 0] += 0.5 * SIDE_MM
    half = light_of(moved)
    assert half.irradiance[:, : PIXELS[1] // 4].sum() < 0.02 * half.irradiance.sum()


def test_predicted_light_is_near_the_whole_simulation():
    over = lens()
    designed = simulate_caustic(over, BENCH, pixels=PIXELS).irradiance
    facets = facets_of(over, groove_mrad=60.0)
    whole = light_of(facets).irradiance
    inner = ((facets[:, :, :2].mean(axis=1) > 2) & (facets[:, :, :2].mean(axis=1) < 8)).all(axis=1)
    quick = predict_light(designed, [facets[inner]], over, BENCH)
    assert psnr_db(quick, designed) == pytest.approx(psnr_db(whole, designed), abs=1.5)


def test_a_few_slopes_stand_for_all_of_a_surface() -> None:
    """Grooves along x: none is off in x, and in y evenly from -3 to +3 mrad."""
    whole = deviations(np.array_split(facets_of(lens(), groove_mrad=3.0), 5), lens(), BENCH, PIXELS, slopes=60)
    found = whole.slopes
    assert 50 <= len(found) <= 70
    assert np.abs(found.mean(axis=0)).max() < 1e-4
    assert 1e3 * np.sqrt((found**2).mean(axis=0)) == pytest.approx([whole.slope_x_mrad, whole.slope_y_mrad], abs=0.1)


def test_samples_beside_the_aperture_deviate_by_nothing() -> None:
    beside = facets_of(lens())
    beside[:, :, 0] += 2.0 * SIDE_MM
    found = deviations([beside], lens(), BENCH, PIXELS)
    assert (found.slope_mrad, found.blur_px) == (0.0, 0.0)
    assert not found.slopes.any()
