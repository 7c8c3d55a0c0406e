"""Estimates a mill's errors from row to row from the grain in the light of the half as milled.

Theory of operation. A row that is too deep cuts a wider groove, at the cost of its neighbours. Each groove spreads its
light over a few rows, so the light, averaged along the rows, has grain across them that grows with the errors. There is
no formula: rows with random errors of several sizes are cut and lit in one dimension and blurred like the photograph,
and the size with the photograph's grain is the result. Multiplying two means of different columns removes the
photograph's own noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from optics.coupon.layout import HEIGHT_MM, Half, window_mm
from optics.coupon.reading import Rectified
from optics.heightfield import Array

_TRIED_MM = np.geomspace(0.0001, 0.004, 12)
_PIECES = 24  # random pieces for each size
_RIM_MM, _SLOW_MM = 1.6, 0.5  # left out at either rim; slower changes come from the strips and the lamp
_BIN_MM = 0.05
_SEED = 11


@dataclass(frozen=True, slots=True, kw_only=True)
class RowErrors:
    """Standard deviation of a row's height, and the range of 68 %; grain: variance of the light.

    high_mm is inf where errors are as large as the cusps between rows: then grain no longer grows with them.
    """

    z_noise_mm: float
    low_mm: float
    high_mm: float
    grain: float


def measure_grain(picture: Rectified, clean: Array, half: Half) -> float:
    """Return the variance of the light across rows over what it would be without errors: `clean` (ny,), any unit."""
    begin, end = window_mm(half)
    columns = np.flatnonzero((picture.x_mm >= begin) & (picture.x_mm < end))
    parts = []
    for some in (columns[0::2], columns[1::2]):
        usable = picture.usable[:, some]
        light = np.where(usable, picture.light[:, some], 0.0)
        parts.append(light.sum(axis=1) / np.maximum(usable.sum(axis=1), 1) / np.maximum(clean, 1e-9))
    inner = (picture.y_mm >= _RIM_MM) & (picture.y_mm <= HEIGHT_MM - _RIM_MM)
    step = float(picture.y_mm[1] - picture.y_mm[0])
    first, second = (_remove_slow(part[inner], step) for part in parts)
    return float((first * second).mean())


def fit_row_errors(
    grain: float, *, radius_mm: float, pitch_mm: float, lever_mm: float, blur_mm: float
) -> RowErrors:  # fmt: skip
    """Return the size of row errors that gives light this grain.

    lever_mm : the distance to the wall times (n - 1)
    """
    level, spread = np.empty(_TRIED_MM.size), np.empty(_TRIED_MM.size)
    for number, sigma in enumerate(_TRIED_MM):
        found = np.log(_grain_of_rows(float(sigma), radius_mm, pitch_mm, lever_mm, blur_mm))
        level[number], spread[number] = found.mean(), found.std()
    level = np.maximum.accumulate(level)
    seen = math.log(max(grain, 1e-12))

    def size(value: float) -> float:
        return float(np.exp(np.interp(value, level + 1e-6 * np.arange(level.size), np.log(_TRIED_MM))))

    middle = size(seen)
    error = float(np.interp(middle, _TRIED_MM, spread))
    open_end = seen + error >= level[-1] - 0.1 * error
    high = math.inf if open_end else size(seen + error)
    return RowErrors(z_noise_mm=middle, low_mm=size(seen - error), high_mm=high, grain=grain)


def _grain_of_rows(sigma_mm: float, radius_mm: float, pitch_mm: float, lever_mm: float, blur_mm: float) -> Array:
    """Return (pieces,) variance of the light of pieces whose rows have errors of that size."""
    rng = np.random.default_rng(_SEED)
    rows = math.ceil((HEIGHT_MM + 2 * radius_mm) / pitch_mm) + 1
    bins = round(HEIGHT_MM / _BIN_MM)
    edges = _BIN_MM * np.arange(bins + 1)
    inner = slice(round(_RIM_MM / _BIN_MM), bins - round(_RIM_MM / _BIN_MM))
    out = np.empty(_PIECES)
    for piece in range(_PIECES):
        y: Array = pitch_mm * np.arange(rows, dtype=np.float64) - radius_mm
        y, begin, end = _grooves(y, sigma_mm * rng.standard_normal(rows), radius_mm)
        first = begin + lever_mm * (begin - y) / radius_mm  # a groove spreads its light evenly
        wide = (end - begin) * (1.0 + lever_mm / radius_mm)
        before = (end - begin)[:, None] * np.clip((edges - first[:, None]) / wide[:, None], 0.0, 1.0)
        light = np.diff(before.sum(axis=0)) / _BIN_MM
        light = gaussian_filter1d(light, blur_mm / _BIN_MM, mode="nearest")
        out[piece] = max(float((_remove_slow(light[inner], _BIN_MM) ** 2).mean()), 1e-12)
    return out


def _grooves(y_mm: Array, z_mm: Array, radius_mm: float) -> tuple[Array, Array, Array]:
    """Return the rows (n,) that others do not cut away, and the interval of the surface that each makes.

    The lowest of the parabolas (y - y_j)^2 / 2R + z_j are those on the lower hull of the points (y_j, z_j + y_j^2 /
    2R).
    """
    height = z_mm + y_mm**2 / (2 * radius_mm)
    hull: list[int] = []
    for j in range(y_mm.size):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (height[b] - height[a]) * (y_mm[j] - y_mm[b]) < (height[j] - height[b]) * (y_mm[b] - y_mm[a]):
                break
            hull.pop()
        hull.append(j)
    y, h = y_mm[hull], height[hull]
    borders = radius_mm * np.diff(h) / np.diff(y)
    return y, np.concatenate([[y[0]], borders]), np.concatenate([borders, [y[-1]]])


def _remove_slow(light: Array, step_mm: float) -> Array:
    """Return the part that changes faster than the strips, over the mean."""
    slow = gaussian_filter1d(light, _SLOW_MM / step_mm, mode="nearest")
    return np.asarray(light / np.maximum(slow, 1e-9) - 1.0)
