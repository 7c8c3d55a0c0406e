"""The light of strips as harmonics, against formulas and against light that is simulated ray by ray."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import jv

from optics.coupon.fringes import LEVERS, Finished, Profile, fringe_coefficients, light_profile, nominal_lever_mm
from optics.coupon.layout import Coupon, Strip
from optics.coupon.reading import fold_strip
from optics.finish import Finish
from tests.optics.coupon.pieces import rectified, smooth_piece

UNTOUCHED = Finish(k0_rad_per_mm=1e6, order=1.0)


@pytest.mark.parametrize("strength", [0.3, 1.0, 4.0])
def test_an_even_ripple_makes_bessel_functions(strength: float) -> None:
    """Harmonic m of the light of a ripple of strength s is J_m(m s) to within 1 %, whether rays cross or not."""
    strip = Strip(kind="ripple", low_mm=0.0, high_mm=6.0, cycles=16, amplitude_mm=1e-4)
    lever_mm = strength / (strip.k_rad_per_mm**2 * strip.amplitude_mm)
    profile = Profile(strip=strip, harmonics_mm=np.array([1e-4 + 0j]), milled=np.zeros((2, 2), complex))
    light = Finished.of(profile, UNTOUCHED.transfer).light(lever_mm)
    m = np.arange(1, 6)
    # z = a cos(k u): slopes push light towards troughs' neighbours, X = u - m/k sin(k u)
    np.testing.assert_allclose(light[1:6].real, jv(m, m * strength), atol=0.01)
    np.testing.assert_allclose(light[1:6].imag, 0.0, atol=1e-6)
    assert light[0] == pytest.approx(1.0, abs=0.01)


def test_the_table_as_milled_is_the_light_of_the_piece() -> None:
    """Fringes that simulated rays make are those of the table, blurred as the picture is, within 0.03 of the mean."""
    piece, blur_mm, throw_mm = smooth_piece(), 0.06, 20.6
    picture = rectified(
        np.zeros((840, 1440)), piece.light("right", None, throw_mm=throw_mm), blur_mm=blur_mm, noise=0.0
    )
    lever = (throw_mm - piece.coupon.flat_mm) / (piece.coupon.throw_mm - piece.coupon.flat_mm)
    for profile in piece.profiles:
        fold = fold_strip(picture, profile.strip, "right")
        light = fringe_coefficients(profile, lever)
        k = profile.strip.k_rad_per_mm
        made = light_profile(light / light[0].real, k, fold.phase, blur_mm=blur_mm, shift_mm=0.0)
        assert np.sqrt(np.mean((fold.light - made) ** 2)) < 0.03, profile.strip


@pytest.mark.parametrize(("k0", "order"), [(4.0, 1.0), (6.0, 2.0), (9.0, 4.0)])
def test_finished_strips_are_the_light_of_a_finished_piece(k0: float, order: float) -> None:
    """What two-dimensional filtering of the whole piece and simulated rays show, the strips' own model shows: 0.04."""
    piece, finish, blur_mm = smooth_piece(), Finish(k0_rad_per_mm=k0, order=order), 0.05
    picture = rectified(piece.light("left", finish), np.zeros((840, 1440)), blur_mm=blur_mm, noise=0.0)
    for profile in piece.profiles:
        if profile.strip.kind == "ramp":  # beside the rim
            continue
        fold = fold_strip(picture, profile.strip, "left")
        light = Finished.of(profile, finish.transfer).light(nominal_lever_mm(piece.coupon))
        k = profile.strip.k_rad_per_mm
        made = light_profile(light / light[0].real, k, fold.phase, blur_mm=blur_mm, shift_mm=0.0)
        assert np.sqrt(np.mean((fold.light - made) ** 2)) < 0.04, profile.strip


def test_between_two_levers_the_table_is_smooth() -> None:
    """Halfway between two levers the table gives what a sum over the heights would: at LEVERS it is itself."""
    profile = smooth_piece().profiles[4]
    for number in (10, 30, 50):
        np.testing.assert_allclose(
            fringe_coefficients(profile, float(LEVERS[number])), profile.milled[number], atol=1e-9
        )
    assert nominal_lever_mm(Coupon(throw_mm=30.0)) == pytest.approx(0.49 * (30.0 - Coupon(throw_mm=30.0).flat_mm))
