"""The forward model of a descent: its transposes, and that it is linear between two touches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from optics.bench import Bench
from optics.finish import Finish, finish_lens
from optics.heightfield import Heightfield
from optics.outcomes import FinishedHeights, MeanError, outcomes_of

FELT = Finish(k0_rad_per_mm=3.0, order=1.0, depth_mm=0.01, pad_mm=10.0)
SIDE_MM, COUNT = 12.0, 49


def lens_of(z_mm: np.ndarray) -> Heightfield:
    axis = np.linspace(0.0, SIDE_MM, COUNT)
    return Heightfield(x_mm=axis, y_mm=axis, z_mm=z_mm, rim_mm=FELT.seen_beyond_mm)


def hills(seed: int, height_mm: float) -> np.ndarray:
    rough = gaussian_filter(np.random.default_rng(seed).standard_normal((COUNT, COUNT)), 3.0)
    return height_mm * (rough - rough.max()) / np.ptp(rough)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 99))
def test_finished_heights_are_linear_between_two_touches_and_have_their_transpose(seed: int) -> None:
    z, change = hills(seed, 0.3), hills(seed + 100, 0.1)
    finishes = [None, FELT, FELT.after(1.25)]
    finished = FinishedHeights(lens_of(z), finishes)
    finished.touch(z)
    before, after = finished.of(z), finished.of(z + change)
    gains = list(np.random.default_rng(seed).standard_normal((3, COUNT, COUNT)))
    forward = sum(float((gain * (b - a)).sum()) for gain, a, b in zip(gains, before, after, strict=True))
    assert float((finished.transpose(gains, [0.0] * 3) * change).sum()) == pytest.approx(forward, rel=1e-6)


@pytest.mark.parametrize("height_mm", [0.01, 1.0])
def test_a_touch_tells_what_the_finish_leaves(height_mm: float) -> None:
    """Shallow hills are touched everywhere, high ones are not; heights are those of the finish, rims among them."""
    z = hills(3, height_mm)
    finished = FinishedHeights(lens_of(z), [FELT])
    hangs = finished.touch(z)
    (left,) = finished.of(z)
    np.testing.assert_allclose(left, finish_lens(lens_of(z), FELT).lens.z_mm, atol=1e-12)
    assert hangs.any() == (height_mm > 0.1)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 99), beside=st.integers(0, 3))
def test_heights_at_a_rim_move_the_light_no_more_than_others(seed: int, beside: int) -> None:
    """By the run-out, which follows the slope at the rim over millimetres, they would: a descent would bend them."""
    z = hills(seed, 0.3)
    finished = FinishedHeights(lens_of(z), [FELT])
    finished.touch(z)

    def share_moved(row: int) -> float:
        change = np.zeros_like(z)
        change[row, COUNT // 2] = 1e-3
        (before,), (after,) = finished.of(z), finished.of(z + change)
        return float(np.abs(np.diff(after - before, axis=0)).max()) / 1e-3

    assert share_moved(beside) < 2.1 * share_moved(COUNT // 2)  # at a mirror what is beside it counts twice


def test_the_gradient_is_that_of_the_mean_error() -> None:
    z = hills(5, 0.2)
    bench = Bench.centre_on(width_mm=SIDE_MM, height_mm=SIDE_MM, throw_mm=60.0, refractive_index=1.49)
    error = MeanError(lens_of(z), np.ones((24, 24)), bench, outcomes_of(FELT), 2)
    error.touch(z)
    z = 1.1 * z  # some places are pressed less than at the touch
    error.of(z)
    gradient, change = error.gradient(), gaussian_filter(np.random.default_rng(1).standard_normal(z.shape), 2.0)
    step = 1e-5
    slope = (error.of(z + step * change) - error.of(z - step * change)) / (2 * step)
    assert float((gradient * change).sum()) == pytest.approx(slope, rel=0.02)


def test_a_crease_costs_as_soon_as_the_pad_presses_it_less() -> None:
    """Of shallow hills, all of which the pad touches; deeper ones it leaves."""
    z = hills(3, 0.01)
    finished = FinishedHeights(lens_of(z), [FELT])
    finished.touch(z)
    costs = []
    for times in (0.5, 1.0, 4.0, 40.0, 80.0):
        finished.of(times * z)
        costs += finished.weigh_lacks()
    assert costs[:2] == [0.0, 0.0]
    assert costs == sorted(costs) and costs[-1] > costs[-2] > 0.0


def test_the_same_work_for_longer_multiplies_the_exponent() -> None:
    finish = Finish(k0_rad_per_mm=3.0, order=2.0, depth_mm=0.01)
    k = np.array([0.5, 2.0, 4.0])
    assert finish.after(1.5).transfer(k) == pytest.approx(finish.transfer(k) ** 1.5)
    assert finish.after(1.5).depth_mm == pytest.approx(0.015)
    assert sum(one.weight for one in outcomes_of(finish)) == pytest.approx(1.0)
