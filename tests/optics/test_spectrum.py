"""Colours: how an eye weighs them, how the index follows them, and the picture of all of them together."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optics.bench import Bench, Screen
from optics.caustic import BEAMS, simulate_caustic
from optics.design import design_lens
from optics.finish import Finish
from optics.heightfield import Heightfield
from optics.lens_settings import LensSettings
from optics.light import Light, disc_points
from optics.metrics import psnr_db
from optics.outcomes import DESIGN_BEAMS, MeanError, outcomes_of
from optics.polish import polish_lens
from optics.spectrum import Spectrum, luminous_efficiency
from optics.tolerance import lens_tolerances, wall_for_index_mm
from tests.benchmarks.pictures import target
from tests.trials.renderer import split_colours

PMMA = 0.0085  # n_F - n_C
WHITE, SUN = Spectrum(kind="white"), Spectrum(kind="sun")
GREEN = Spectrum(kind="led", centre_nm=530.0, width_nm=35.0)
BENCH = Bench.centre_on(
    width_mm=30.0, height_mm=30.0, throw_mm=30.0, refractive_index=1.49, dispersion=PMMA, light=Light(spectrum=WHITE)
)
PIXELS = 96
spectra = st.one_of(
    st.sampled_from([WHITE, SUN]),
    st.builds(Spectrum, kind=st.just("led"), centre_nm=st.floats(400.0, 700.0), width_nm=st.floats(1.0, 200.0)),
)


def under(spectrum: Spectrum, bench: Bench = BENCH) -> Bench:
    return replace(bench, light=replace(bench.light, spectrum=spectrum))


@pytest.fixture(scope="module")
def lens() -> Heightfield:
    return design_lens(target("camera", PIXELS), LensSettings(bench=under(Spectrum()), skim_mm=0.1)).heightfield


def picture(lens: Heightfield, bench: Bench, beams: int = BEAMS) -> np.ndarray:
    return simulate_caustic(lens, bench, pixels=(PIXELS, PIXELS), beams=beams).irradiance


@pytest.mark.parametrize(
    ("nm", "seen"), [(450, 0.038), (500, 0.323), (530, 0.862), (555, 1.0), (600, 0.631), (650, 0.107), (700, 0.004)]
)
def test_an_eye_weighs_colours_as_the_standard_s_table_does(nm: float, seen: float) -> None:
    assert luminous_efficiency(nm) == pytest.approx(seen, abs=0.02)


@pytest.mark.parametrize(("nm", "index"), [(486.13, 1.4974), (546.07, 1.4934), (656.27, 1.4889)])
def test_the_index_follows_the_material(nm: float, index: float) -> None:
    """Of a line alone against PMMA's own figures (n_d 1.4917), by way of the yellow line's."""
    line, yellow = (Spectrum(kind="led", centre_nm=one, width_nm=1.0).above_white for one in (nm, 587.56))
    assert 1.4917 + PMMA * (line - yellow) == pytest.approx(index, abs=5e-4)


@given(spectra, st.integers(1, 12))
def test_parts_of_a_spectrum_hold_its_mean_and_finer_ones_those_of_coarser(spectrum: Spectrum, parts: int) -> None:
    coarse, fine = np.array(spectrum.split(parts)), np.array(spectrum.split(2 * parts))
    assert coarse.sum() == pytest.approx(0.0, abs=1e-9)
    assert (np.diff(coarse) >= -1e-12).all()
    np.testing.assert_allclose(fine.reshape(-1, 2).mean(axis=1), coarse, atol=1e-9)


def test_colours_that_bend_alike_are_one_beam() -> None:
    for bench in (under(Spectrum()), replace(BENCH, dispersion=0.0), replace(BENCH, mirror=True)):
        assert len(bench.bundle(BEAMS)) == 1
    assert [beam.refractive_index for beam in BENCH.bundle(1)] == [1.49]


def test_the_picture_in_white_is_the_mean_of_its_colours(lens: Heightfield) -> None:
    """The index that a person gives is that of the mean: no colour but that has it."""
    count = len(BENCH.bundle(BEAMS))
    seen = [
        picture(lens, replace(under(Spectrum()), refractive_index=1.49 + more)) for more in BENCH.split_index(count)
    ]
    np.testing.assert_allclose(picture(lens, BENCH), np.mean(seen, axis=0), atol=1e-9)
    assert np.mean([beam.refractive_index for beam in BENCH.bundle(BEAMS)]) == pytest.approx(1.49, abs=1e-12)


def test_white_light_is_that_of_the_eye_s_table_and_of_another_law_of_the_index() -> None:
    """A lens whose rays cross bends light far and loses 9 dB in white. Sellmeier's law in place of Cauchy's."""
    bench = replace(BENCH, width_mm=40.0, height_mm=40.0, throw_mm=60.0, branch="inverted")
    bench = replace(bench, screen=Screen(width_mm=40.0, height_mm=40.0, centre_x_mm=20.0, centre_y_mm=20.0))
    aim = target("camera", 64)
    lens = design_lens(aim, LensSettings(bench=under(Spectrum(), bench), skim_mm=0.1)).heightfield

    def score(light: np.ndarray) -> float:
        return psnr_db(light, aim)

    def seen(bench: Bench) -> np.ndarray:
        return simulate_caustic(lens, bench, pixels=(64, 64)).irradiance

    lines = sum(
        share * seen(replace(under(Spectrum(), bench), refractive_index=n)) for n, share in split_colours(bench)
    )
    assert score(seen(under(Spectrum(), bench))) > score(np.asarray(lines)) + 6.0
    assert score(seen(bench)) == pytest.approx(score(np.asarray(lines)), abs=0.1)


@pytest.mark.parametrize("spectrum", [WHITE, SUN, GREEN], ids=lambda one: one.kind)
def test_few_colours_score_as_many_do(lens: Heightfield, spectrum: Spectrum) -> None:
    bench, aim = under(spectrum), target("camera", PIXELS)
    assert psnr_db(picture(lens, bench), aim) == pytest.approx(psnr_db(picture(lens, bench, 4 * 31), aim), abs=0.1)


def test_white_light_smears_a_picture_aside_and_a_green_led_hardly() -> None:
    """All light is bent by some 20 degrees there, blue by 1 % more than red."""
    aside = Bench.centre_on(
        width_mm=30.0, height_mm=30.0, throw_mm=60.0, refractive_index=1.49, dispersion=PMMA, shift_mm=(20.0, 0.0)
    )
    aim = target("camera", PIXELS)
    lens = design_lens(aim, LensSettings(bench=aside, skim_mm=0.1)).heightfield
    one, white, green = (psnr_db(picture(lens, under(spectrum, aside)), aim) for spectrum in (Spectrum(), WHITE, GREEN))
    assert white < one - 2.0
    assert one - 1.0 < green


@pytest.mark.parametrize("beams", [7, BEAMS])
def test_no_colour_of_a_disc_favours_a_side(beams: int) -> None:
    sun = replace(BENCH, light=Light(kind="sun", spectrum=SUN))
    x, y = disc_points(beams).T
    colours = [beam.refractive_index for beam in sun.bundle(beams)]
    assert len(set(colours)) == beams
    for side in (x, y, x * x + y * y):
        assert abs(np.corrcoef(side, colours)[0, 1]) < 0.1


def test_the_sun_s_disc_and_its_colours_together(lens: Heightfield) -> None:
    """Against each of its places in each of its colours."""
    sun = replace(BENCH, light=Light(kind="sun", spectrum=SUN))
    each = [picture(lens, replace(under(Spectrum(), sun), refractive_index=1.49 + more)) for more in sun.split_index(5)]
    assert psnr_db(picture(lens, sun), np.mean(each, axis=0)) > 50.0


@pytest.mark.parametrize("more", [-0.0026, 0.0026])
def test_the_wall_moves_with_the_index(lens: Heightfield, more: float) -> None:
    """Nearer where the block bends more; there the picture is as good as anywhere, and better than on the old wall."""
    aim, off = target("camera", PIXELS), replace(under(Spectrum()), refractive_index=1.49 + more)
    wall_mm = wall_for_index_mm(lens, under(Spectrum()), more)
    assert math.copysign(1.0, wall_mm) == -math.copysign(1.0, more)
    scores = {
        by: psnr_db(picture(lens, replace(off, throw_mm=off.throw_mm + by * wall_mm)), aim)
        for by in (0.0, 0.5, 1.0, 1.5)
    }
    assert max(scores, key=lambda by: scores[by]) == 1.0
    assert scores[1.0] > scores[0.0] + 1.0


def test_tolerances_hold_index_and_wall_together(lens: Heightfield) -> None:
    aim = target("camera", PIXELS)
    higher = lens_tolerances(lens, BENCH, aim, index_spread=0.0026).index
    assert higher is not None
    assert higher.wall_mm == pytest.approx(wall_for_index_mm(lens, BENCH, 0.0026))
    assert higher.psnr_db_moved > higher.psnr_db + 0.3
    assert lens_tolerances(lens, BENCH, aim).index is None
    assert lens_tolerances(lens, replace(BENCH, mirror=True), aim, index_spread=0.0026).index is None


def test_colours_multiply_the_time_of_a_design_by_no_more_than_two() -> None:
    """A beam is what light costs: as few colours as are worth it while a lens is sought, and one behind a finish."""
    assert [len(BENCH.bundle(beams)) for beams in (1, DESIGN_BEAMS, BEAMS)] == [1, 2, 5]
    flat = Heightfield.on_aperture(np.full((9, 9), -0.1), width_mm=30.0, height_mm=30.0)
    felt = Finish(k0_rad_per_mm=2.0, order=1.0)
    for finish, count in ((None, 2), (felt, 1)):
        error = MeanError(flat, np.ones((4, 4)), BENCH, outcomes_of(finish), 1)
        assert {len(tubes.beams) for tubes in error.tubes} == {count}


def test_only_beams_that_cost_time_are_spared() -> None:
    """A disc has its places anyhow, each with a colour of its own."""
    sun = replace(BENCH, light=Light(kind="sun", spectrum=SUN))
    assert sun.spare_colours() is sun
    assert [beam.refractive_index for beam in BENCH.spare_colours().bundle(BEAMS)] == [1.49]


def test_a_polish_in_white_sees_its_colours() -> None:
    """One colour in all steps, which the last steps did not see, left 46.4 dB where these leave 47.2 (camera, 256)."""
    aside = Bench.centre_on(
        width_mm=30.0, height_mm=30.0, throw_mm=60.0, refractive_index=1.49, dispersion=PMMA, shift_mm=(12.0, 0.0),
        light=Light(spectrum=WHITE),
    )  # fmt: skip
    aim = target("camera", PIXELS)
    start = design_lens(aim, LensSettings(bench=aside, skim_mm=0.1)).heightfield
    one, white = (polish_lens(start, aim, bench, steps=8)[0] for bench in (aside.in_mean_colour(), aside))
    assert psnr_db(picture(white, aside), aim) > psnr_db(picture(one, aside), aim) + 0.5
