"""One asymmetric picture for the tests of layouts, and what its tones mean as light."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
ROWS, COLUMNS = 24, 40
_Y, _X = np.mgrid[0:ROWS, 0:COLUMNS]
GREY = 0.7 * _X / (COLUMNS - 1) + 0.3 * _Y / (ROWS - 1)
GREY[4:9, 6:20], GREY[14:20, 25:36] = 1.0, 0.0
COLOURS = np.stack([GREY, GREY[::-1], GREY[:, ::-1]], axis=-1)
OPACITY = 0.4 + 0.6 * GREY[::-1, ::-1]
SMOOTH = 0.6 * _X / COLUMNS + 0.3 * _Y / ROWS  # for compressions that keep no edges
HUES = np.stack([SMOOTH, 0.9 * SMOOTH[::-1], SMOOTH], axis=-1)
SHARES = np.array([0.2126, 0.7152, 0.0722])  # of red, green, blue in luminance


def linear_of(values: Array) -> Array:
    """Return light of sRGB values in [0, 1]; written anew here, so that it checks the one in `linear_light`."""
    return np.asarray(np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4))
