"""What a block does to light beside its milled side: haze and a back that is not flat."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optics.bench import Bench
from optics.block import Back, lower_by_back
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.heightfield import Array, Heightfield
from optics.lens_settings import LensSettings
from optics.light import Light
from optics.metrics import psnr_db
from optics.milled import simulate_milled
from tests.benchmarks.pictures import target

PIXELS = 64
BENCH = Bench.centre_on(width_mm=40.0, height_mm=40.0, throw_mm=80.0, refractive_index=1.49)
WAVY = Back(flatness_mm=0.02, period_mm=25.0)
FLAWED = replace(BENCH, haze=0.1, back=WAVY)


def flat_lens(bench: Bench = BENCH) -> Heightfield:
    return Heightfield.on_aperture(np.full((81, 81), -0.1), width_mm=bench.width_mm, height_mm=bench.height_mm)


@pytest.fixture(scope="module")
def lens() -> Heightfield:
    return design_lens(target("camera", PIXELS), LensSettings(bench=BENCH, skim_mm=0.1)).heightfield


def light(lens: Heightfield, bench: Bench) -> Array:
    return simulate_caustic(lens, bench, pixels=(PIXELS, PIXELS)).irradiance


@given(
    haze=st.floats(0.0, 0.5), throw_mm=st.floats(1.0, 500.0), ny=st.integers(1, 40), nx=st.integers(1, 40),
    seed=st.integers(0, 9),
)  # fmt: skip
def test_haze_moves_light_and_makes_none(haze: float, throw_mm: float, ny: int, nx: int, seed: int) -> None:
    picture = np.random.default_rng(seed).uniform(0.0, 5.0, (ny, nx))
    seen = replace(BENCH, haze=haze, throw_mm=throw_mm).add_haze(picture)
    assert seen.min() >= (1.0 - haze) * picture.min() - 1e-12
    assert (1.0 - haze) * picture.sum() - 1e-9 <= seen.sum() <= picture.sum() + 1e-9


def test_a_point_of_light_has_a_veil_of_ten_degrees_with_all_the_light_that_was_scattered() -> None:
    wide, point = replace(BENCH.screen, width_mm=200.0, height_mm=100.0), np.zeros((201, 201))
    point[100, 100] = 1.0
    veil = (replace(BENCH, haze=0.2, screen=wide).add_haze(point) - 0.8 * point) / 0.2
    assert veil.sum() == pytest.approx(1.0, abs=1e-3)  # a screen of 3.5 deviations
    for axis, pixel_mm in ((0, 100.0 / 201), (1, 200.0 / 201)):
        along = veil.sum(axis=1 - axis)
        deviation_mm = math.sqrt(along @ (np.arange(along.size) - along.size // 2) ** 2) * pixel_mm
        assert deviation_mm == pytest.approx(80.0 * math.tan(math.radians(10.0)), rel=0.02)


def test_what_is_scattered_past_the_screen_counts_as_beside_it(lens: Heightfield) -> None:
    clear, hazy = (simulate_caustic(lens, bench, pixels=(32, 32)) for bench in (BENCH, replace(BENCH, haze=0.3)))
    assert hazy.outside_share > clear.outside_share + 0.02
    assert hazy.irradiance.mean() + hazy.outside_share + hazy.reflected_share == pytest.approx(1.0)


@settings(max_examples=20)
@given(flatness_mm=st.floats(0.001, 0.1), period_mm=st.floats(15.0, 300.0))
def test_a_back_lies_between_two_planes_and_its_slopes_are_its_own(flatness_mm: float, period_mm: float) -> None:
    back, at = Back(flatness_mm=flatness_mm, period_mm=period_mm), np.linspace(0.0, period_mm, 400)
    rise = back.rise_mm(at[None, :], at[:, None])
    assert rise.min() >= 0.0 and rise.max() <= flatness_mm
    assert np.ptp(rise) == pytest.approx(flatness_mm, rel=1e-3)
    np.testing.assert_allclose(np.gradient(rise[0], at)[1:-1], back.slope(at)[1:-1], atol=1e-3 * flatness_mm)


def test_light_through_a_wavy_back_goes_as_snell_s_law_sends_it_through_both_faces() -> None:
    """One ray at a time: refracted at the wave, then at the flat front."""
    bench = replace(BENCH, back=WAVY, light=Light())
    lens = lower_by_back(flat_lens(), bench.back)
    for x, y in ((3.0, 9.0), (12.0, 31.0), (27.0, 20.0)):
        slopes = np.array([WAVY.slope(np.array(x)), WAVY.slope(np.array(y))])
        inside = -slopes * (1.0 - 1.0 / 1.49)  # small angles: towards the normal, which leans against the slope
        there = lens.spline().jets(np.array([[x]]), np.array([[y]]))[1:3].ravel()
        np.testing.assert_allclose(there * (1.49 - 1.0), 1.49 * inside, rtol=2e-3, atol=1e-6)


def test_facets_show_a_block_s_flaws_as_the_lens_itself_does() -> None:
    """A flat lens of facets a millimetre wide, each curved as its corners' slopes say."""
    axis = np.arange(0.0, 40.0, 0.5)
    x, y = np.meshgrid(axis, axis)
    corners = [np.stack([x + i, y + j, *(np.full_like(x, z) for z in (-0.1, 0.0, 0.0))], -1)
               for i, j in ((0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.0, 0.5))]  # fmt: skip
    facets = np.stack(corners, axis=2).reshape(-1, 4, 5)
    seen = simulate_milled(lambda number: facets, 1, flat_lens(), FLAWED, pixels=(PIXELS, PIXELS)).irradiance
    np.testing.assert_allclose(seen, light(flat_lens(), FLAWED), atol=2e-3)
    assert np.abs(seen - 1.0).max() > 0.02


def test_a_lens_is_made_for_a_block_without_flaws(lens: Heightfield) -> None:
    """So the same programs come of it, whatever the block is like."""
    again = design_lens(target("camera", PIXELS), LensSettings(bench=FLAWED, skim_mm=0.1)).heightfield
    np.testing.assert_array_equal(again.z_mm, lens.z_mm)


def test_each_flaw_costs_and_is_named(lens: Heightfield) -> None:
    aim = target("camera", PIXELS)
    own_db = psnr_db(light(lens, FLAWED), aim)
    gains = {name: psnr_db(light(lens, bench), aim) - own_db for name, bench in FLAWED.without_each_flaw().items()}
    assert set(gains) == {"haze", "back"}
    assert min(gains.values()) > 0.1
    assert BENCH.without_each_flaw() == {}
