"""Targets and scores."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, uniform_filter

from optics.errors import TargetError
from optics.irradiance import picture_from_irradiance, target_irradiance
from optics.metrics import score_caustic, seen_db


@pytest.mark.parametrize("viewed_from", ["lens", "behind"])
def test_target_is_the_picture_with_mean_one(viewed_from: str) -> None:
    picture = np.arange(12.0).reshape(3, 4)
    target = target_irradiance(picture, viewed_from=viewed_from)  # type: ignore[arg-type]
    assert target.mean() == pytest.approx(1.0)
    back = picture_from_irradiance(target, viewed_from=viewed_from)  # type: ignore[arg-type]
    np.testing.assert_allclose(back * picture.mean(), picture)


def test_flips_by_hand() -> None:
    """Row 0 of the picture is the top: the highest Y. From the lens's side +X is to the left."""
    picture = np.array([[1.0, 0.0], [0.0, 0.0]])  # upper left
    behind = target_irradiance(picture, viewed_from="behind")
    assert behind[1, 0] == 4
    lens = target_irradiance(picture, viewed_from="lens")
    assert lens[1, 1] == 4


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.zeros((4, 4)), "black everywhere"),
        (np.array([[1.0, -1.0], [1.0, 1.0]]), "not negative"),
        (np.array([[1.0, np.nan], [1.0, 1.0]]), "finite"),
        (np.ones((1, 5)), "at least 2 x 2"),
    ],
)
def test_impossible_targets_are_refused(picture: np.ndarray, words: str) -> None:
    with pytest.raises(TargetError, match=words):
        target_irradiance(picture, viewed_from="lens")


def test_scores_of_known_errors() -> None:
    target = np.ones((32, 32))
    target[:16] = 0.0
    target /= target.mean()
    same = score_caustic(target, target)
    assert same.ssim == pytest.approx(1.0)
    assert same.misplaced_light == 0
    leaky = target.copy()
    leaky[:16] += 0.1  # 5 % of the light moved from the bright half into the dark one
    leaky[16:] -= 0.1
    score = score_caustic(leaky, target)
    assert score.misplaced_light == pytest.approx(0.05)
    assert score.dark_leak == pytest.approx(0.05)
    assert score.psnr_db == pytest.approx(10 * np.log10(4 / 0.01))


@pytest.mark.parametrize(
    ("shape", "recorded"),
    [
        ((64, 48), 0.8633613416189893),
        ((11, 30), 0.8316504174310232),
        ((12, 11), 0.9113743011252005),
        ((10, 40), 0.8894421760607458),
        ((5, 5), 0.8724308129714403),
        ((2, 3), 0.9593356388825741),
        ((1, 4), 0.9766979445396876),
    ],
)
def test_structural_similarity_is_that_of_scikit_image(shape: tuple[int, int], recorded: float) -> None:
    """Recorded from its structural_similarity 0.26 with Gaussian weights (a square where 11 pixels do not fit)."""
    rng = np.random.default_rng(sum(shape))
    target = rng.random(shape)
    target *= target > 0.2
    target /= target.mean()
    irradiance = target * (1 + 0.3 * rng.standard_normal(shape))
    assert score_caustic(irradiance, target).ssim == pytest.approx(recorded, abs=1e-12)


@given(
    st.floats(0.1, 10.0), st.floats(0.0, 3.0), st.floats(0.02, 0.2), st.sampled_from([(64, 48), (512, 384), (130, 129)])
)
def test_an_eye_sees_neither_exposure_nor_grain_finer_than_it_resolves(
    gain: float, lift: float, noise: float, shape: tuple[int, int]
) -> None:
    rng = np.random.default_rng(1)
    smooth = gaussian_filter(rng.random(shape), 8.0)
    target = 1.0 + 0.3 * (smooth - smooth.mean()) / smooth.std()
    unlike = rng.standard_normal(shape) * noise
    assert seen_db(gain * target + lift, target) > 90.0
    grain = unlike - uniform_filter(unlike, 4, mode="wrap")
    ours, worse = target + grain, target + 2.0 * grain
    assert seen_db(ours, target) > seen_db(worse, target)
    if max(shape) == 512:  # four pixels in one: a quarter of the noise
        assert seen_db(ours, target) > seen_db(ours[::4, ::4], target[::4, ::4]) + 6.0
