"""Laws of the light that plans foresee: how far slopes send it, which waves rows and contours leave, rims, grain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.passes import PassSpec, ball_pass
from cam.planning.pass_time import LensForm
from cam.planning.planner import Marks
from cam.planning.row_slopes import RowSlopes, SlopeSpread, even_slopes
from optics.bench import Bench
from optics.heightfield import Heightfield
from optics.refraction import tangent_per_slope
from service.job.planning.predicted_light import PictureLight
from service.job.planning.waves import Waves, compute_lost_when_sharpened

SIDE, PIXELS, INDEX, THROW = 40.0, 64, 1.49, 80.0
BALL = 3.0
SPEC = ball_pass("finish", radius_mm=BALL, pitch_mm=0.2, stock_to_leave_mm=0.0, step_down_mm=1.0)
NONE = SlopeSpread(slope=np.zeros(1), share=np.ones(1))
BENCH = Bench.centre_on(width_mm=SIDE, height_mm=SIDE, throw_mm=THROW, refractive_index=INDEX)


def slanted(slope_x: float, slope_y: float = 0.0) -> LensForm:
    x, y = np.meshgrid(*(np.linspace(0.0, SIDE, 21),) * 2)
    z = slope_x * x + slope_y * y
    return LensForm.of(Heightfield.on_aperture(z - z.max() - 0.1, width_mm=SIDE, height_mm=SIDE))


def light(target: np.ndarray, form: LensForm | None = None, *, aims: bool = False) -> PictureLight:
    made = PictureLight(target, BENCH, aims=aims)
    made.add(BALL, form or slanted(0.0), np.zeros_like(target))
    return made


def even() -> np.ndarray:
    return np.ones((PIXELS, PIXELS))


def waved(periods: int, *, along: str) -> np.ndarray:
    wave = 1.0 + 0.5 * np.cos(np.pi * 2 * periods * (np.arange(PIXELS) + 0.5) / PIXELS)
    return np.tile(wave, (PIXELS, 1)) if along == "x" else np.tile(wave[:, None], (1, PIXELS))


def rows(spread: SlopeSpread, *, off_mm: float = 0.0) -> RowSlopes:
    return RowSlopes(across=spread, along=NONE, off_mm=off_mm)


def contrast(picture: np.ndarray) -> float:
    """Of the middle, where no light of the rims is missing."""
    inner = picture[16:-16, 16:-16]
    return float(np.ptp(inner) / 2 / inner.mean())


@settings(max_examples=40)
@given(slope=st.floats(0.0, 0.25), mirror=st.booleans())
def test_a_slope_error_sends_light_as_far_as_snell_says(slope: float, mirror: bool) -> None:
    """The mean of along and across the slope, of exact Snell; the series leaves out fourth powers, 1 % at 0.25."""
    form = slanted(slope)
    made = PictureLight(even(), replace(BENCH, mirror=mirror))

    def thrown(s: float) -> float:
        return 2 * s / (1 - s * s) if mirror else s * float(tangent_per_slope(s * s, INDEX))

    small, drop = 1e-4, THROW - form.heights_mm.mean()
    along = (thrown(slope + small) - thrown(slope - small)) / (2 * small)
    across = thrown(slope) / slope if slope > small else along
    assert made.reach_mm(form) == pytest.approx(drop * (along + across) / 2, rel=0.012)


@pytest.mark.parametrize("direction", ["x", "y"])
def test_rows_blur_across_themselves(direction: str) -> None:
    """By the transform of the box that their scallops spread light over, and not at all along themselves."""
    spec, slopes = replace(SPEC, direction=direction), rows(even_slopes(radius_mm=BALL, pitch_mm=0.2))
    across, along = ("y", "x") if direction == "x" else ("x", "y")
    hurt, kept = (light(waved(4, along=way)) for way in (across, along))
    half_mm = (hurt.reach_mm(slanted(0.0)) + BALL) * 0.2 / (2 * BALL)  # its own width as well
    whole, left = contrast(kept.target), np.sinc(2 * half_mm * 4 / SIDE)
    assert contrast(kept.smooth_picture(Marks(spec=spec, slopes=slopes))) == pytest.approx(whole, abs=1e-6)
    assert contrast(hurt.smooth_picture(Marks(spec=spec, slopes=slopes))) == pytest.approx(whole * left, abs=2e-3)


@pytest.mark.parametrize(("slopes", "kept"), [((0.1, 0.0), "y"), ((0.0, 0.1), "x")])
def test_contours_blur_up_and_down_the_slope(slopes: tuple[float, float], kept: str) -> None:
    spread = rows(even_slopes(radius_mm=BALL, pitch_mm=0.3))
    waves = Waves.of((32, 32), (1.0, 1.0))
    left = waves.compute_kept(slanted(*slopes), spread, replace(SPEC, strategy="contour"), 40.0)
    along, across = (left[0], left[:, 0]) if kept == "x" else (left[:, 0], left[0])
    assert along[-1] > 0.9  # within the angle that one of the directions stands for
    assert across[-1] < 0.3
    assert left[0, 0] == pytest.approx(1.0)


def test_rims_are_darker_by_what_darkness_beyond_does_not_send() -> None:
    """Half of it at the very rim; nothing farther in than light is sent."""
    wide = SlopeSpread(slope=np.linspace(-0.1, 0.1, 801), share=np.full(801, 1 / 801))
    seen = light(even()).smooth_picture(Marks(spec=SPEC, slopes=rows(wide)))
    reach_mm = (light(even()).reach_mm(slanted(0.0)) + BALL) * 0.1
    y = (np.arange(PIXELS) + 0.5) * SIDE / PIXELS
    wanted = np.clip((1 + np.minimum(y, SIDE - y) / reach_mm) / 2, 0.0, 1.0)
    np.testing.assert_allclose(seen, np.tile(wanted[:, None], (1, PIXELS)), atol=5e-3)


@pytest.mark.parametrize("direction", ["x", "y"])
def test_a_lens_is_sharpened_where_its_rows_blur(direction: str) -> None:
    made = light(waved(3, along="x"), aims=True)
    slopes = rows(even_slopes(radius_mm=BALL, pitch_mm=0.3))
    blur_x, blur_y = made.foreseen_blur_mm(Marks(spec=replace(SPEC, direction=direction), slopes=slopes))
    across, along = (blur_y, blur_x) if direction == "x" else (blur_x, blur_y)
    assert across == pytest.approx((made.reach_mm(slanted(0.0)) + BALL) * slopes.across.rms, rel=1e-3)
    assert along == 0.0
    contours = Marks(spec=replace(SPEC, strategy="contour"), slopes=slopes)
    assert made.foreseen_blur_mm(contours) == (0.0, 0.0)
    assert light(even()).foreseen_blur_mm(Marks(spec=SPEC, slopes=slopes)) == (0.0, 0.0)


def test_sharpening_shows_more() -> None:
    target = waved(4, along="y")
    made = light(target, aims=True)
    marks = Marks(spec=SPEC, slopes=rows(even_slopes(radius_mm=BALL, pitch_mm=0.2)))
    assert made.aimed_db(marks) > made.unsharpened_db(marks) + 1.0


@pytest.mark.parametrize("strategy", ["raster", "contour"])
def test_a_guess_is_the_picture_without_its_rims(strategy: str) -> None:
    """Where light is sent less than a pixel aside, so that rims do not matter; slopes all one way."""
    spec: PassSpec = replace(SPEC, strategy=strategy, pitch_mm=0.03)
    marks = Marks(spec=spec, slopes=rows(even_slopes(radius_mm=BALL, pitch_mm=0.03)))
    target = waved(6, along="y") * waved(2, along="x")
    made = light(target, slanted(0.0, 0.1))
    assert made.psnr_db(marks) == pytest.approx(made.aimed_db(marks), abs=0.6)


def test_rows_off_in_height_cost_by_their_stripes() -> None:
    """A guess and the picture alike, by the square of the grain times that of the light."""
    target = waved(2, along="x")
    made = light(target)
    still, off = (Marks(spec=SPEC, slopes=rows(NONE, off_mm=off)) for off in (0.0, 0.002))
    grain = made.grain(off)
    assert grain > made.grain(still)
    wanted = 10 * np.log10(target.max() ** 2 / (grain**2 * np.square(target).mean()))
    assert made.psnr_db(off) == pytest.approx(wanted, abs=1e-6)
    assert made.aimed_db(off) == pytest.approx(wanted, abs=1e-6)
    speckled = made.picture(off)
    assert (speckled / target).std() == pytest.approx(grain, rel=0.05)


def test_haze_is_in_a_predicted_picture_and_its_score_and_decides_nothing() -> None:
    """It adds the same error to all plans, so that their order stays."""
    target = waved(2, along="x") * waved(3, along="y")
    clear, hazy = light(target), PictureLight(target, replace(BENCH, haze=0.2))
    hazy.add(BALL, slanted(0.0), np.zeros_like(target))
    several = [Marks(spec=SPEC, slopes=rows(NONE, off_mm=off)) for off in (0.0, 0.001, 0.002)]
    for marks in several:
        seen = hazy.picture(marks)
        np.testing.assert_array_equal(hazy.clear_picture(marks), clear.picture(marks))
        np.testing.assert_array_equal(seen, replace(BENCH, haze=0.2).add_haze(clear.picture(marks)))
        assert hazy.psnr_db(marks) < clear.psnr_db(marks)
        assert hazy.score(seen).psnr_db == pytest.approx(hazy.aimed_db(marks), abs=0.4)
    assert sorted(several, key=hazy.psnr_db) == sorted(several, key=clear.psnr_db)


@given(kept=st.floats(-0.3, 1.0))
def test_sharpening_never_loses_more_and_cannot_bring_back_what_is_gone(kept: float) -> None:
    lost = float(compute_lost_when_sharpened(np.array(kept)))
    assert 0.0 <= lost <= 1.0 - kept + 1e-12
    assert float(compute_lost_when_sharpened(np.array(0.0))) == 1.0
    assert float(compute_lost_when_sharpened(np.array(1.0))) == 0.0
