"""A prepared picture has more contrast where it shows, no halo, its black where it leaks, and any picture survives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from optics.errors import TargetError
from optics.preparation import has_two_tones, prepare_picture

SIDE = 96


def waves(period_px: float, height: float) -> np.ndarray:
    """Faint waves on a ramp of light from left to right."""
    y, x = np.mgrid[:SIDE, :SIDE]
    return (0.2 + 0.5 * x / SIDE) * (1 + height * np.sin(2 * np.pi * y / period_px))


def wave_height(picture: np.ndarray, period_px: float) -> float:
    """Of the waves down the middle columns, relative to the light there."""
    inner = picture[:, SIDE // 3 : 2 * SIDE // 3]
    profile = (inner / inner.mean(axis=0)).mean(axis=1)
    phase = 2 * np.pi * np.arange(SIDE) / period_px
    return float(2 * np.hypot(profile @ np.sin(phase), profile @ np.cos(phase)) / SIDE)


def on_the_wall(picture: np.ndarray, detail_px: float) -> np.ndarray:
    """Blurred to that width at half maximum."""
    return np.asarray(gaussian_filter(picture, detail_px / 2.355, mode="nearest"))


@pytest.mark.parametrize("detail_px", [4.0, 8.0])
def test_what_is_a_few_details_long_shows_on_the_wall_as_it_is_in_the_picture(detail_px: float) -> None:
    """Faint waves of three details lose a third by the blur; prepared, the wall shows them no fainter than given."""
    picture, period_px = waves(3 * detail_px, 0.1), 3 * detail_px
    shown, prepared = (on_the_wall(p, detail_px) for p in (picture, prepare_picture(picture, detail_px)))
    given_height = wave_height(picture, period_px)
    assert wave_height(shown, period_px) < 0.75 * given_height
    assert given_height < wave_height(prepared, period_px) < 1.5 * given_height


def test_contrast_is_raised_most_just_above_the_detail() -> None:
    gains = [
        wave_height(prepare_picture(waves(period_px, 0.1), 4.0), period_px)
        / wave_height(waves(period_px, 0.1), period_px)
        for period_px in (12.0, 24.0, 48.0, 96.0)
    ]
    assert gains == sorted(gains, reverse=True)


def test_an_edge_gets_no_halo_on_the_wall() -> None:
    """Beside a step between two greys (with a third elsewhere) neither side overshoots by a twentieth of its light."""
    picture = np.full((SIDE, SIDE), 0.2)
    picture[:, SIDE // 2 :] = 0.6
    picture[: SIDE // 4] = 0.4
    row = on_the_wall(prepare_picture(picture, 5.0), 5.0)[SIDE * 3 // 4]
    dark, bright = row[SIDE // 4 : SIDE // 2], row[SIDE // 2 : SIDE * 3 // 4]
    assert dark.min() > dark[0] * 19 / 20
    assert bright.max() < bright[-1] * 21 / 20
    assert bright[-1] > 2 * dark[0]


@given(st.integers(0, 2**32 - 1), st.floats(1.0, 30.0))
def test_darker_stays_darker_where_nothing_is_fine(seed: int, detail_px: float) -> None:
    """Broad forms keep their order: of two places that differ plainly and lie far apart, the brighter is brighter."""
    rng = np.random.default_rng(seed)
    tones = rng.permutation(np.linspace(0.05, 0.9, 4))
    picture = tones.repeat(40)[None, :].repeat(40, axis=0)
    prepared = prepare_picture(picture, detail_px)[20, 20::40]
    assert (np.argsort(prepared) == np.argsort(tones)).all()


@given(st.integers(0, 2**32 - 1), st.floats(0.3, 60.0), st.floats(0.0, 0.4))
def test_it_stays_light_for_any_picture(seed: int, detail_px: float, black: float) -> None:
    """Within 0 and 1 or the lifted black, finite, of the same shape, the given picture untouched."""
    rng = np.random.default_rng(seed)
    picture = gaussian_filter(rng.random((31, 44)) ** 3, 1.0)
    before = picture.copy()
    prepared = prepare_picture(picture, detail_px, black=black)
    assert (picture == before).all()
    assert prepared.shape == picture.shape
    assert np.isfinite(prepared).all()
    assert prepared.min() >= 0.999 * black * prepared.mean()
    assert prepared.max() <= 1.0


def test_black_is_lifted_to_the_leak_and_no_further() -> None:
    picture = waves(20.0, 0.2)
    picture[:30] = 0.0
    without, lifted = (prepare_picture(picture, 6.0, black=black) for black in (0.0, 0.1))
    assert lifted.min() == pytest.approx(0.1 * lifted.mean(), rel=1e-3)
    bright = without > 0.2 * without.mean()
    assert (lifted[bright] == without[bright]).all()


def test_two_tones_are_left_as_they_are() -> None:
    """A logo has no contrast to bring out; neither has one tone. The very array comes back."""
    y, x = np.mgrid[:SIDE, :SIDE]
    logo = gaussian_filter((np.hypot(x - 40, y - 50) < 30).astype(float), 0.7)
    for picture in (logo, np.full((SIDE, SIDE), 0.3)):
        assert has_two_tones(picture)
        assert prepare_picture(picture, 5.0, black=0.1) is picture
    assert not has_two_tones(waves(20.0, 0.3))
    three = np.choose((x // 32), [0.05, 0.3, 1.0])
    assert not has_two_tones(three)


def test_the_scale_is_the_detail_not_the_pixel() -> None:
    """A picture of twice the pixels, prepared for twice the pixels of detail, is the same picture."""
    coarse = waves(24.0, 0.15)
    fine = coarse.repeat(2, axis=0).repeat(2, axis=1)
    small = prepare_picture(coarse, 8.0)
    large = prepare_picture(fine, 16.0).reshape(SIDE, 2, SIDE, 2).mean(axis=(1, 3))
    assert np.abs(large - small).mean() < 0.02 * small.mean()


@pytest.mark.parametrize("detail_px", [0.0, -1.0, float("nan"), float("inf")])
def test_a_detail_of_no_size_is_an_error(detail_px: float) -> None:
    with pytest.raises(TargetError, match="more than 0 pixels"):
        prepare_picture(waves(20.0, 0.2), detail_px)
