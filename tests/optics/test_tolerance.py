"""Tolerances against closed forms where there are some, and against the forward model itself where not."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.heightfield import Heightfield
from optics.irradiance import target_irradiance
from optics.lens_settings import LensSettings
from optics.light import Light
from optics.metrics import psnr_db
from optics.spline import Array
from optics.tolerance import (
    FOCUS_LOSS_DB,
    Tolerances,
    _blur_pictures,
    _shift_to,
    blur_mm,
    disc_kernel,
    lens_tolerances,
    picture_shift_mm,
    source_rad,
)

BENCH = Bench.centre_on(width_mm=20.0, height_mm=20.0, throw_mm=40.0, refractive_index=1.49)


@cache
def designed() -> tuple[Heightfield, Array, Tolerances]:
    """A lens for a picture of 48 x 48 with edges and soft tones, and its tolerances."""
    row, column = np.mgrid[0:48, 0:48] / 47.0
    picture = 0.3 + (np.hypot(column - 0.3, row - 0.3) < 0.2) + 0.5 * column * (row > 0.6)
    target = target_irradiance(gaussian_filter(picture, 0.7), viewed_from="lens")
    lens = design_lens(target, LensSettings(bench=BENCH, skim_mm=0.1)).heightfield
    return lens, target, lens_tolerances(lens, BENCH, target)


def flat(z_mm: float) -> Heightfield:
    return Heightfield.on_aperture(np.full((9, 9), z_mm), width_mm=20.0, height_mm=20.0)


@settings(max_examples=30)
@given(tilt=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), z_mm=st.floats(-20.0, 0.0))
def test_a_plate_shifts_the_picture_by_the_tangent_of_the_tilt(tilt: tuple[float, float], z_mm: float) -> None:
    """What leaves a plate goes on as it came: the lit aperture moves by (H - z) tan, whatever the index."""
    aslant = replace(BENCH, light=Light(tilt_rad=tilt))
    expected = [(40.0 - z_mm) * math.tan(angle) for angle in tilt]
    assert picture_shift_mm(flat(z_mm), BENCH, aslant) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("mirror", [False, True])
def test_a_lamp_blurs_by_how_far_its_rims_are_apart_on_the_wall(mirror: bool) -> None:
    """A lamp moved by its radius to both sides, far away: its pictures lie a blur's diameter apart, near the axis."""
    size = 6.0
    bench = replace(BENCH, mirror=mirror, light=Light(kind="point", distance_mm=600.0, size_mm=size))
    rims = [
        replace(bench, light=replace(bench.light, tilt_rad=(math.atan(side * size / 2 / 600), 0.0))) for side in (-1, 1)
    ]
    apart, _ = picture_shift_mm(flat(0.0), *rims)
    assert apart == pytest.approx(blur_mm(flat(0.0), bench, source_rad(flat(0.0), bench)), rel=1e-3)


def test_light_without_size_does_not_blur_and_the_sun_does_as_the_throw() -> None:
    assert source_rad(flat(0.0), BENCH) == 0.0
    sun = replace(BENCH, light=Light(kind="sun", size_deg=0.53))
    assert blur_mm(flat(-2.0), sun, source_rad(flat(-2.0), sun)) == pytest.approx(42.0 * math.radians(0.53))


@given(across=st.floats(0.0, 9.0), along=st.floats(0.0, 9.0))
def test_a_discs_weights_have_its_moments(across: float, along: float) -> None:
    """Sum 1, middle 0; variance of a disc d^2 / 16, and between 0 and 1/4 for sharing a shift between two pixels."""
    kernel = disc_kernel(across, along)
    assert kernel.sum() == pytest.approx(1.0) and kernel.min() >= 0
    for axis, diameter in ((0, along), (1, across)):
        shares = kernel.sum(axis=1 - axis)
        at = np.arange(shares.size) - shares.size // 2
        assert (shares * at).sum() == pytest.approx(0.0, abs=1e-9)
        assert -0.01 * diameter**2 / 16 <= (shares * at**2).sum() - diameter**2 / 16 <= 0.25 + 0.01 * diameter**2 / 16


@settings(max_examples=15)
@given(by=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)))
def test_a_shifted_picture_is_found(by: tuple[float, float]) -> None:
    y, x = np.mgrid[0:40, 0:50]

    def blob(dx: float, dy: float) -> Array:
        return np.asarray(np.exp(-((x - 22 - dx) ** 2 / 60 + (y - 18 - dy) ** 2 / 40)))

    assert _shift_to(_blur_pictures(blob(0, 0)), blob(*by)) == pytest.approx(by, abs=0.02)


def test_the_ends_of_the_focus_range_lose_what_they_say() -> None:
    lens, target, found = designed()
    near, far = found.focus_range_mm
    assert near < 0 < far
    for offset in found.focus_range_mm:
        light = simulate_caustic(lens, replace(BENCH, throw_mm=40.0 + offset), pixels=target.shape).irradiance
        assert found.psnr_db - psnr_db(light, target) == pytest.approx(FOCUS_LOSS_DB, abs=0.25)


def test_each_step_away_from_the_set_up_costs() -> None:
    *_, found = designed()
    worse = [p.psnr_db for p in found.focus]
    assert worse.index(max(worse)) == 3 and worse[:4] == sorted(worse[:4]) and worse[3:] == sorted(worse[3:])[::-1]
    for points in (found.tilts, found.sources):
        losses = [p.psnr_db for p in points]
        assert losses == sorted(losses)[::-1]
        assert found.psnr_db >= losses[0]


def test_the_shift_under_tilt_is_one_that_nothing_near_beats() -> None:
    """Half a pixel (0.2 mm) to any side shows less of the picture."""
    lens, target, found = designed()
    point = found.tilts[-1]
    aslant = replace(BENCH, light=Light(tilt_rad=(math.radians(point.tilt_deg), 0.0)))
    for by_x, by_y in ((0.2, 0.0), (-0.2, 0.0), (0.0, 0.2), (0.0, -0.2)):
        screen = replace(
            BENCH.screen,
            centre_x_mm=10.0 + point.shift_mm[0] + by_x,
            centre_y_mm=10.0 + point.shift_mm[1] + by_y,
        )
        light = simulate_caustic(lens, replace(aslant, screen=screen), pixels=target.shape, tubes_per_cell=2)
        assert psnr_db(light.irradiance, target) < point.psnr_db


def test_a_picture_under_the_sun_is_the_sharp_one_blurred() -> None:
    """Within 0.7 dB of 19 beams through the lens: a blur below a pixel, to which half pixels add a little."""
    lens, target, found = designed()
    sun = replace(BENCH, light=Light(kind="sun", size_deg=0.53))
    light = simulate_caustic(lens, sun, pixels=target.shape, tubes_per_cell=2).irradiance
    blurred = next(p for p in found.sources if p.size_deg == 0.53)
    assert blurred.psnr_db == pytest.approx(psnr_db(light, target), abs=0.7)
    assert psnr_db(blurred.irradiance, light) > blurred.psnr_db + 6
    assert lens_tolerances(lens, sun, target).psnr_db == pytest.approx(blurred.psnr_db, abs=1e-9)
