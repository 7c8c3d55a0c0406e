"""The shape of the test piece."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optics.ball_fit import ball_fits
from optics.coupon.layout import HALF_MM, HEIGHT_MM, WINDOW_MM, Coupon, window_mm

STEPS = st.sampled_from([0.0, 0.001, 0.00125, 0.002, 0.0025, 0.004, 0.01])


@given(step_mm=STEPS)
def test_strips_fill_the_piece_between_its_rims(step_mm: float) -> None:
    """Each strip begins where the one before ends, with rims of 1 mm at the ends, and has a core that does not fade."""
    strips = Coupon(step_mm=step_mm).strips
    assert [strips[0].low_mm, strips[-1].high_mm] == pytest.approx([1.0, HEIGHT_MM - 1.0])
    for before, after in pairwise(strips):
        assert before.high_mm == after.low_mm
    assert all(strip.high_mm - strip.low_mm > 2.2 * strip.fade_mm for strip in strips)


def test_no_ripple_is_an_overtone_of_another() -> None:
    """Periods from 0.34 to 4 mm, whole in the window, none a multiple of another, so that none is read as another."""
    cycles = [strip.cycles for strip in Coupon().ripples]
    assert WINDOW_MM / cycles[0] == 4.0
    assert 0.3 < WINDOW_MM / cycles[-1] < 0.35
    assert not [(a, b) for a in cycles for b in cycles if a < b and b % a == 0]


@given(step_mm=STEPS.filter(bool))
def test_crests_and_troughs_reach_whole_steps(step_mm: float) -> None:
    """The flat is on a step, and a ripple's amplitude just over an odd number of half steps."""
    coupon = Coupon(step_mm=step_mm)
    assert coupon.flat_mm / step_mm == pytest.approx(round(coupon.flat_mm / step_mm))
    for strip in coupon.ripples:
        halves = strip.amplitude_mm / (step_mm / 2)
        assert 0.1 < halves % 2 - 1 < 0.2


def test_both_halves_carry_the_same_ripples() -> None:
    """Heights in the window of the left half are those in the window of the right half."""
    lens = Coupon(step_mm=0.004).heightfield(0.05)
    (a, b), (c, d) = window_mm("left"), window_mm("right")
    left = lens.z_mm[:, (lens.x_mm >= a) & (lens.x_mm <= b)]
    right = lens.z_mm[:, (lens.x_mm >= c) & (lens.x_mm <= d)]
    assert c - a == HALF_MM
    np.testing.assert_allclose(left, right, atol=1e-7)


@pytest.mark.parametrize("step_mm", [0.0, 0.004])
def test_the_ball_fits_every_hollow(step_mm: float) -> None:
    """A ball of radius 1 mm, with which the piece is milled, touches all of it; nothing rises above the skim."""
    coupon = Coupon(step_mm=step_mm)
    lens = coupon.heightfield()
    assert ball_fits(lens, 1.0)
    assert lens.z_mm.max() <= -coupon.skim_mm + 1e-6
