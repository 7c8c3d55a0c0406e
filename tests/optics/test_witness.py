"""Witness marks: each disappears when it should, on a surface that the pad touches and the ball fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from optics.finish import Finish
from optics.witness import (
    SHARES,
    VISIBLE_SLOPE_RAD,
    Mill,
    NoMarksError,
    Strip,
    choose_strip,
)
from optics.witness_light import StripNotFoundError, finish_strip, fit_dose, read_strip, strip_heights_mm
from tests.optics.witness_photographs import light_on_paper, photograph_strip, work_strip
from tests.trials.witness import BENCH_MILL, FELT, ROUTER, SANDING, WITHIN, k0_error

FINISHES = (FELT, SANDING, (Finish(k0_rad_per_mm=3.1, order=1.0, pad_mm=10.0), 0.013))
MILLS = (ROUTER, BENCH_MILL, Mill(radius_mm=0.5, step_mm=0.0, noise_mm=0.0005))

finishes = st.builds(
    lambda k0, order: Finish(k0_rad_per_mm=k0, order=order, pad_mm=10.0), st.floats(1.5, 6.0), st.floats(0.8, 2.5)
)
mills = st.builds(
    lambda radius, step: Mill(radius_mm=radius, step_mm=step, noise_mm=0.0),
    st.floats(0.5, 6.0),
    st.sampled_from([0.0, 0.001, 0.002, 0.004]),
)


def chosen(finish: Finish, depth_mm: float, mill: Mill) -> Strip:
    try:
        return choose_strip(finish, depth_mm, mill, room_mm=150.0)
    except NoMarksError:
        assume(False)
        raise


def slopes_in_the_middle(strip: Strip, heights_mm: np.ndarray, u_mm: np.ndarray) -> list[float]:
    """Half of what the slope swings by in the middle of each mark."""
    slope = np.gradient(heights_mm, u_mm[1] - u_mm[0])
    swings = []
    for begin, mark in zip(strip.begins_mm, strip.marks, strict=True):
        middle = np.abs(u_mm - begin - mark.width_mm / 2) <= mark.period_mm
        swings.append(float(np.ptp(slope[middle])) / 2)
    return swings


@pytest.mark.parametrize("mill", MILLS)
@pytest.mark.parametrize(("finish", "depth_mm"), FINISHES)
def test_each_mark_on_the_worked_surface_disappears_at_its_share(finish: Finish, depth_mm: float, mill: Mill) -> None:
    """Rows of a ball in whole steps, levelled by a pad that never adds: the slope falls to what is just visible within
    a tenth of k0 of the mark's share.
    """
    strip = choose_strip(finish, depth_mm, mill, room_mm=100.0)
    u, milled = strip_heights_mm(strip)
    assert [mark.share for mark in strip.marks] == list(SHARES)
    for number, mark in enumerate(strip.marks[:-1]):
        early, late = (mark.share * times**-finish.order for times in (1.1, 0.9))
        swings = [
            slopes_in_the_middle(strip, work_strip(milled, finish, depth_mm, dose), u)[number] for dose in (early, late)
        ]
        assert swings[0] > VISIBLE_SLOPE_RAD > swings[1]


@given(finishes, st.floats(0.005, 0.04), mills)
def test_the_pad_touches_the_ball_fits_and_the_tips_are_whole_steps(
    finish: Finish, depth_mm: float, mill: Mill
) -> None:
    strip = chosen(finish, depth_mm, mill)
    for mark in strip.marks:
        k = mark.k_rad_per_mm
        assert mark.amplitude_mm < 1.02 * depth_mm * (finish.k0_rad_per_mm / k) ** finish.order
        assert mark.amplitude_mm * k**2 < 1 / mill.radius_mm
        assert mark.slope_rad(finish, mark.share) == pytest.approx(VISIBLE_SLOPE_RAD, rel=1e-3)
        if mill.step_mm:
            steps = np.array(mark.tips_mm) / mill.step_mm
            assert np.abs(steps - np.rint(steps)).max() < 1e-9


@pytest.mark.parametrize(
    ("mill", "room_mm", "obstacle"),
    [
        (replace(ROUTER, step_mm=0.05), 100.0, "steps"),
        (replace(ROUTER, noise_mm=0.02), 100.0, "noise"),
        (ROUTER, 15.0, "room"),
    ],
)
def test_where_none_can_be_made_the_reason_is_said(mill: Mill, room_mm: float, obstacle: str) -> None:
    with pytest.raises(NoMarksError) as caught:
        choose_strip(*FELT, mill, room_mm=room_mm)
    assert caught.value.obstacle == obstacle


def test_a_finish_that_takes_off_next_to_nothing_has_no_marks() -> None:
    with pytest.raises(NoMarksError) as caught:
        choose_strip(FELT[0], 1e-4, replace(ROUTER, step_mm=0.0, noise_mm=0.0), room_mm=100.0)
    assert caught.value.obstacle == "slope"


def test_in_a_short_strip_the_marks_around_the_plan_are_kept() -> None:
    whole = choose_strip(*FELT, ROUTER, room_mm=100.0)
    short = choose_strip(*FELT, ROUTER, room_mm=whole.length_mm - 1.0)
    assert [mark.share for mark in short.marks] == [0.6, 0.8, 1.0, 1.25]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("finish", "mill"), [(FELT, ROUTER), (SANDING, BENCH_MILL)])
def test_a_photograph_says_how_far_the_finish_has_come(finish: tuple[Finish, float], mill: Mill, seed: int) -> None:
    """A hundred seeds of each are in `make soak`."""
    assert abs(k0_error(*finish, mill, seed)) <= WITHIN


def test_photographs_that_say_nothing_are_refused() -> None:
    strip = choose_strip(*FELT, ROUTER, room_mm=100.0)
    light = light_on_paper(strip, *FELT, 1.0, noise_mm=0.0, lamp_mm=0.05)
    photo = photograph_strip(light, seed=1)
    for spoilt in (np.zeros((300, 300)), 0.01 * photo, np.minimum(20.0 * photo, 1.0), photo[::4, ::4]):
        with pytest.raises(StripNotFoundError):
            read_strip(spoilt, strip)


def test_the_fit_knows_the_noiseless_strip() -> None:
    """Without any error of mill, paper or camera the dose is found within 2 %, whichever end comes first."""
    from optics.witness_light import StripLight

    finish, depth_mm = FELT
    strip = choose_strip(finish, depth_mm, ROUTER, room_mm=100.0)
    light = light_on_paper(strip, finish, depth_mm, 0.9, noise_mm=0.0, lamp_mm=0.05)
    light = light[200:-200]  # its dark surround of 4 mm
    for one in (light, light[::-1]):
        found = fit_dose(StripLight(light=one, blur_mm=0.05, pixels_per_mm=30.0), strip, finish, refractive_index=1.49)
        assert found.dose == pytest.approx(0.9, rel=0.02)


def test_finish_strip_is_the_finish_s_own_law() -> None:
    finish, depth_mm = FELT
    strip = choose_strip(finish, depth_mm, ROUTER, room_mm=100.0)
    u, milled = strip_heights_mm(strip)
    once, twice = finish_strip(milled, finish, 1.0), finish_strip(finish_strip(milled, finish, 0.5), finish, 0.5)
    inner = (u > 0) & (u < strip.length_mm)
    assert np.abs(once - twice)[inner].max() < 2e-4  # of form, which a pad follows, twice is not once
