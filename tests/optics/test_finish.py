"""What a finish levels, and the lens that foresees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optics.ball_fit import ball_fits
from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.finish import Finish, finish_lens
from optics.heightfield import Heightfield
from optics.lens_settings import LensSettings
from optics.metrics import psnr_db, smallest_detail_mm

SIDE_MM, VERTICES = 24.0, 481


def rippled(period_mm: float, height_mm: float = 1e-3, turn: float = 0.0) -> tuple[Heightfield, np.ndarray]:
    axis = np.linspace(0.0, SIDE_MM, VERTICES)
    x, y = np.meshgrid(axis - SIDE_MM / 2, axis - SIDE_MM / 2)
    wave = np.cos(2 * np.pi / period_mm * (np.cos(turn) * x + np.sin(turn) * y))
    return Heightfield(x_mm=axis, y_mm=axis, z_mm=height_mm * wave - 1.0, rim_mm=50.0), wave


def height_left(lens: Heightfield, wave: np.ndarray) -> float:
    """Of the wave, in the middle, where no rim is in reach."""
    inner = np.s_[VERTICES // 4 : -VERTICES // 4, VERTICES // 4 : -VERTICES // 4]
    z, w = lens.z_mm[inner] - lens.z_mm[inner].mean(), wave[inner] - wave[inner].mean()
    return float((z * w).sum() / (w * w).sum())


@given(
    period=st.floats(0.4, 4.0),
    k0=st.floats(1.5, 12.0),
    order=st.sampled_from([1.0, 2.0, 4.0]),
    turn=st.floats(0, 3.1),
)
@settings(max_examples=12, deadline=None)
def test_a_mark_keeps_the_height_that_the_transfer_function_says(
    period: float, k0: float, order: float, turn: float
) -> None:
    """H(k) = exp(-(k / k0)^order), whatever its direction; shorter than the tool in the hand."""
    lens, wave = rippled(period, turn=turn)
    finish = Finish(k0_rad_per_mm=k0, order=order, pad_mm=20.0)
    left = height_left(finish_lens(lens, finish).lens, wave)
    assert left == pytest.approx(
        1e-3 * float(finish.transfer(2 * np.pi / period)), abs=8e-6
    )  # the ripple ends at the rim


def test_form_longer_than_the_tool_is_followed() -> None:
    """A soft pad of 2 mm wave number would take 0.3 mm off a lens 30 mm high over 100 mm: the tool rides on it."""
    axis = np.linspace(0.0, 100.0, 257)
    x, y = np.meshgrid(axis, axis)
    lens = Heightfield(x_mm=axis, y_mm=axis, z_mm=15.0 * np.cos(2 * np.pi * x / 200) * np.cos(np.pi * y / 200) - 16.0)
    done = finish_lens(lens, Finish(k0_rad_per_mm=3.0, order=1.0, pad_mm=10.0)).lens
    inner = np.s_[64:-64, 64:-64]
    change = done.z_mm[inner] - lens.z_mm[inner]
    assert np.abs(change - change.mean()).max() < 0.03


@pytest.mark.parametrize("pad_mm", [1.0, 2.0])
def test_what_is_as_long_as_the_tool_is_half_mark_and_half_form(pad_mm: float) -> None:
    """Of half a wave as long as the tool exp(-1) is form; of the rest this finish leaves nothing."""
    lens, wave = rippled(2 * pad_mm)
    finish = Finish(k0_rad_per_mm=1.6 / pad_mm, order=4.0, pad_mm=pad_mm)
    assert finish.transfer(np.pi / pad_mm) < 1e-5
    assert height_left(finish_lens(lens, finish).lens, wave) == pytest.approx(1e-3 * np.exp(-1.0), rel=0.03)


def test_departures_are_levelled_with_the_lens() -> None:
    """Linear: the lens with a mark, finished, is the finished lens and the finished mark."""
    lens, _ = rippled(6.0)
    finish, finer, beyond = Finish(k0_rad_per_mm=4.0, order=2.0), 2, 20
    count = (VERTICES - 1) * finer + 1 + 2 * beyond
    x = (np.arange(count) - beyond) * lens.dx_mm / finer - SIDE_MM / 2
    marks = np.broadcast_to(1e-3 * np.cos(2 * np.pi * x / 0.8), (count, count))
    with_marks = finish_lens(lens, finish, departure_mm=marks, finer=finer, beyond_cells=beyond).lens
    alone = finish_lens(lens, finish, finer=finer).lens
    inner = np.s_[200:-200, 200:-200]
    left = (with_marks.z_mm - alone.z_mm)[inner]
    expected = float(finish.transfer(2 * np.pi / 0.8)) * marks[beyond:-beyond, beyond:-beyond][inner]
    assert np.abs(left - left.mean() - expected + expected.mean()).max() < 2e-6


@pytest.mark.parametrize("wrong", [{"k0_rad_per_mm": 0.0}, {"order": -1.0}, {"pad_mm": float("nan")}])
def test_figures_of_a_finish_are_positive(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(Finish(k0_rad_per_mm=3.0, order=1.0), **wrong)


@pytest.mark.parametrize("depth_mm", [None, 0.01])
def test_a_lens_made_for_its_finish_shows_more_behind_it_whatever_comes_of_it(depth_mm: float | None) -> None:
    """Than the same lens made for no finish: as planned, and with k0 0.8 and 1.25 times as much."""
    y, x = (np.mgrid[0:64, 0:64] + 0.5) / 64
    target = (
        1.0 + 0.6 * np.sin(2 * np.pi * 5 * x) * np.sin(2 * np.pi * 4 * y) + 0.8 * (np.hypot(x - 0.5, y - 0.5) < 0.2)
    )
    target /= target.mean()
    bench = Bench.centre_on(width_mm=20.0, height_mm=20.0, throw_mm=60.0, refractive_index=1.49)
    finish = Finish(k0_rad_per_mm=3.5, order=1.0, depth_mm=depth_mm)
    plain = LensSettings(bench=bench, skim_mm=0.1, min_radius_mm=0.5)
    lenses = [design_lens(target, task).heightfield for task in (plain, replace(plain, finish=finish))]
    for share, gain_db in ((1.0, 5.0), (0.8, 3.0), (1.25, 2.0)):
        done = finish.after(share**-finish.order)
        seen = [simulate_caustic(finish_lens(lens, done).lens, bench, pixels=target.shape) for lens in lenses]
        without, made_for_it = (psnr_db(one.irradiance, target) for one in seen)
        assert made_for_it > without + gain_db, share
    assert ball_fits(lenses[1], 0.5)


@pytest.mark.parametrize("sigma_px", [1.5, 3.0, 6.0])
def test_the_smallest_detail_of_a_blurred_picture_is_that_of_its_blur(sigma_px: float) -> None:
    """A Gaussian keeps half of a wave of sqrt(2 ln 2) / sigma: half its period is pi sigma / sqrt(2 ln 2) pixels."""
    target = np.random.default_rng(3).random((256, 256))
    k = 2 * np.pi * np.hypot(np.fft.fftfreq(256)[:, None], np.fft.rfftfreq(256)[None, :])
    seen = np.fft.irfft2(np.fft.rfft2(target) * np.exp(-(k**2) * sigma_px**2 / 2))
    assert smallest_detail_mm(seen, target, 0.5) == pytest.approx(
        0.5 * np.pi * sigma_px / np.sqrt(2 * np.log(2)), rel=0.12
    )
