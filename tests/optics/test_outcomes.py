"""The forward model of a descent: its transposes, and that it is linear between two touches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from optics.bench import Bench
from optics.finish import Finish, finish_surface
from optics.heightfield import Heightfield
from optics.outcomes import FinishedHeights, MeanError, outcomes_of
from optics.run_out import RunOut

FELT = Finish(k0_rad_per_mm=3.0, order=1.0, depth_mm=0.01, pad_mm=10.0)
SIDE_MM, COUNT = 12.0, 49


def lens_of(z_mm: np.ndarray) -> Heightfield:
    axis = np.linspace(0.0, SIDE_MM, COUNT)
    return Heightfield(x_mm=axis, y_mm=axis, z_mm=z_mm, rim_mm=FELT.seen_beyond_mm)


def hills(seed: int, height_mm: float) -> np.ndarray:
    rough = gaussian_filter(np.random.default_rng(seed).standard_normal((COUNT, COUNT)), 3.0)
    return height_mm * (rough - rough.max()) / np.ptp(rough)


@given(cells=st.tuples(st.integers(1, 12), st.integers(1, 12)), seed=st.integers(0, 99))
def test_the_run_outs_transpose_is_that_of_its_linear_part(cells: tuple[int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    run_out = RunOut(cells=cells, dy_mm=0.2, dx_mm=0.3)
    coefs, more = rng.standard_normal((2, 9, 8))
    gain = rng.standard_normal((9 + 2 * cells[0], 8 + 2 * cells[1]))
    forward = float((gain * (run_out.extend(coefs + more) - run_out.extend(coefs))).sum())
    assert float((run_out.transpose(gain.copy()) * more).sum()) == pytest.approx(forward, rel=1e-9)


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
    assert float((finished.transpose(gains) * change).sum()) == pytest.approx(forward, rel=1e-6)


@pytest.mark.parametrize("height_mm", [0.01, 1.0])
def test_a_touch_tells_what_the_finish_leaves(height_mm: float) -> None:
    """Shallow hills are touched everywhere, high ones are not; where the lens is, heights are those of the finish."""
    z = hills(3, height_mm)
    finished = FinishedHeights(lens_of(z), [FELT])
    hangs = finished.touch(z)
    (left,) = finished.of(z)
    expected = finish_surface(lens_of(z), FELT).z_mm
    off = left - left.max() - (expected - expected.max())
    assert hangs.any() == (height_mm > 0.1)
    assert np.abs(off - np.median(off)).max() < 0.02 * FELT.depth_mm * (50 if hangs.any() else 1)


def test_the_gradient_is_that_of_the_mean_error() -> None:
    z = hills(5, 0.2)
    bench = Bench.centre_on(width_mm=SIDE_MM, height_mm=SIDE_MM, throw_mm=60.0, refractive_index=1.49)
    error = MeanError(lens_of(z), np.ones((24, 24)), bench, outcomes_of(FELT), 2)
    error.touch(z)
    error.of(z)
    gradient, change = error.gradient(), gaussian_filter(np.random.default_rng(1).standard_normal(z.shape), 2.0)
    step = 1e-5
    slope = (error.of(z + step * change) - error.of(z - step * change)) / (2 * step)
    assert float((gradient * change).sum()) == pytest.approx(slope, rel=0.02)


def test_the_same_work_for_longer_multiplies_the_exponent() -> None:
    finish = Finish(k0_rad_per_mm=3.0, order=2.0, depth_mm=0.01)
    k = np.array([0.5, 2.0, 4.0])
    assert finish.after(1.5).transfer(k) == pytest.approx(finish.transfer(k) ** 1.5)
    assert finish.after(1.5).depth_mm == pytest.approx(0.015)
    assert sum(one.weight for one in outcomes_of(finish)) == pytest.approx(1.0)
