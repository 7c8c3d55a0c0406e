"""Adversarial pictures end in a lens without folds or NaN, or in a refusal that names the throw."""

from __future__ import annotations

import numpy as np
import pytest

from optics.bench import Bench
from optics.irradiance import target_irradiance
from optics.transport.optical_path import Preimages
from optics.transport.solver import solve_transport
from tests.benchmarks.hard_pictures import KINDS, hard_pictures
from tests.benchmarks.targets import MOST_TURNED, ending

EVERY_KIND = list(hard_pictures(len(KINDS) + 4, seed=11))


@pytest.mark.thorough
@pytest.mark.parametrize("hard", EVERY_KIND, ids=lambda hard: f"{hard.kind} {hard.number}")
def test_ends_well(hard) -> None:  # type: ignore[no-untyped-def]
    assert ending(hard).fault == ""


@pytest.mark.thorough
@pytest.mark.parametrize("hard", list(hard_pictures(24, seed=23)), ids=lambda hard: f"{hard.kind} {hard.number}")
def test_ends_well_thoroughly(hard) -> None:  # type: ignore[no-untyped-def]
    assert ending(hard).fault == ""


def test_black_and_white_takes_few_steps_on_any_grid() -> None:
    """11, 11 and 13 steps; 15, 16 and 19 where the step is not divided by the local size of the operator."""
    y, x = (np.mgrid[0:128, 0:128] + 0.5) / 128 - 0.5
    light = ((abs(np.hypot(x, y) - 0.3) < 0.05) | (abs(x) + abs(y - 0.05) < 0.1)).astype(float)
    bench = Bench.centre_on(width_mm=100.0, height_mm=100.0, throw_mm=100.0, refractive_index=1.49)
    path = solve_transport(light / light.mean(), bench, skim_mm=0.1)
    assert path.converged
    assert max(level.iterations for level in path.levels) <= 14


def test_one_bright_pixel_on_the_rim_converges_without_a_fold() -> None:
    """4096 times the mean. With the mixed products unbounded, folds are solutions: it stops with 1.7 % turned over."""
    light = np.zeros((64, 64))
    light[63, 32] = 1.0
    bench = Bench.centre_on(width_mm=100.0, height_mm=100.0, throw_mm=200.0, refractive_index=1.49)
    path = solve_transport(light / light.mean(), bench, skim_mm=0.1)
    assert path.converged
    preimages = Preimages(bench, light.shape)
    preimages.evaluate(path.path_mm)
    area = preimages.across * preimages.along - preimages.mixed
    assert -area[area < 0].sum() / area.size <= 0.007


@pytest.mark.thorough  # 4 s
def test_a_picture_that_folds_is_made_softer_and_says_so() -> None:
    """A spot of 7 x 8 pixels on a ribbon of 16 x 4096: 0.4 mm of glass for 100 mm of light."""
    light = np.zeros((16, 4096))
    light[9:16, 1295:1303] = np.tri(7, 8)
    bench = Bench.centre_on(width_mm=100.0, height_mm=100.0 / 256, throw_mm=100.0, refractive_index=1.49)
    path = solve_transport(target_irradiance(light, viewed_from="behind"), bench, skim_mm=0.1)
    assert np.isfinite(path.path_mm).all()
    assert path.levels[-1].turned <= MOST_TURNED
    assert path.converged == (path.floor == 0.0)
