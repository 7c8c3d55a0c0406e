"""Lenses and pictures the optics tests share."""

from __future__ import annotations

import numpy as np
import pytest

from optics.bench import Bench, Screen
from optics.lens_settings import LensSettings


@pytest.fixture
def screen() -> Screen:
    return Screen(width_mm=20.0, height_mm=20.0, centre_x_mm=10.0, centre_y_mm=10.0)


@pytest.fixture
def settings() -> LensSettings:
    """A 20 mm lens for a picture of the same size."""
    bench = Bench.centre_on(width_mm=20.0, height_mm=20.0, throw_mm=40.0, refractive_index=1.49)
    return LensSettings(bench=bench, skim_mm=0.1)


@pytest.fixture
def soft_picture() -> np.ndarray:
    """An asymmetric picture with soft tones, 48 x 48, row 0 on top: bright blob upper left, dim one lower right."""
    row, column = np.mgrid[0:48, 0:48] / 47.0
    blobs = np.exp(-((column - 0.25) ** 2 + (row - 0.2) ** 2) / 0.02)
    return 0.3 + blobs + 0.4 * np.exp(-((column - 0.7) ** 2 + (row - 0.75) ** 2) / 0.04)
