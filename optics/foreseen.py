"""Sharpens a picture to compensate for the blur of milling, so that the milled lens shows it correctly.

Rows of a ball leave slopes even in +-pitch / 2R, so they spread each point of the picture evenly over a line: a box.
Landweber's iteration: a <- max(floor, a + B(t - B a)), where B is the blur, its own transpose. It stops early: each
step restores finer detail but needs more contrast, which valleys under a ball cannot give.
"""

from __future__ import annotations

from math import floor, sqrt

import numpy as np
from numba import njit

from optics.spline import Array

_STEPS = 30
_FLOOR = 0.01  # of the mean: every place of a lens gets light


def sharpen(target: Array, blur_px: tuple[float, float]) -> Array:
    """Return the picture that blurs into the target (ny, nx), of mean 1, as far as light allows; it is brighter at its
    edges, because it is dark beyond them.

    blur_px : standard deviations along the rows and the columns of the picture: y, x
    """
    if max(blur_px) <= 0:
        return target
    aim = target.copy()
    _win_back(target, aim, _box(blur_px[0]), _box(blur_px[1]))
    return np.asarray(aim / aim.mean())


def _box(sigma: float) -> tuple[int, float, float]:
    """Return the number of pixels to either side with equal weight, that weight, and the weight of the next ones.

    A box of n pixels has the variance (n^2 - 1) / 12; between two odd n it is a mixture of both.
    """
    half = floor((sqrt(12 * sigma**2 + 1) - 1) / 2)
    small, large = 2 * half + 1, 2 * half + 3
    share = (12 * sigma**2 + 1 - small**2) / (large**2 - small**2)
    return half, (1 - share) / small + share / large, share / large


@njit(cache=True, nogil=True)
def _win_back(target, aim, down, across):  # type: ignore[no-untyped-def]
    """Improve aim, which starts as the target, by the steps of Landweber's iteration, for the boxes of both blurs."""
    spread, beside = np.empty_like(aim), np.empty_like(aim)
    for _ in range(_STEPS):
        _spread(aim, down, across, beside, spread)
        for j in range(aim.shape[0]):
            for i in range(aim.shape[1]):
                spread[j, i] = target[j, i] - spread[j, i]
        _spread(spread, down, across, beside, spread)
        for j in range(aim.shape[0]):
            for i in range(aim.shape[1]):
                aim[j, i] = max(aim[j, i] + spread[j, i], _FLOOR)


@njit(cache=True, nogil=True)
def _spread(picture, down, across, beside, out):  # type: ignore[no-untyped-def]
    """Spread the picture over both boxes into out, which may be the picture itself; beside: scratch memory."""
    _spread_across(picture, across[0], across[1], across[2], beside)
    _spread_down(beside, down[0], down[1], down[2], out)


@njit(cache=True, nogil=True)
def _spread_across(picture, half, inner, ends, out):  # type: ignore[no-untyped-def]
    """Spread along the rows, as `_spread_down` does down the columns."""
    if inner == 1.0:
        out[:] = picture
        return
    ny, nx = picture.shape
    line = np.zeros(nx + 2 * half + 2)
    for j in range(ny):
        line[half + 1 : half + 1 + nx] = picture[j]
        total = line[: 2 * half + 1].sum()
        for i in range(nx):
            total += line[i + 2 * half + 1] - line[i]
            out[j, i] = inner * total + ends * (line[i] + line[i + 2 * half + 2])


@njit(cache=True, nogil=True)
def _spread_down(picture, half, inner, ends, out):  # type: ignore[no-untyped-def]
    """Fill out: inner times the sum from half above to half below, plus ends times the next pixel on each side."""
    if inner == 1.0:
        out[:] = picture
        return
    ny, nx = picture.shape
    total, dark = np.zeros(nx), np.zeros(nx)
    for j in range(min(half, ny)):
        for i in range(nx):
            total[i] += picture[j, i]
    for j in range(ny):
        entered = picture[j + half] if j + half < ny else dark
        beyond = picture[j + half + 1] if j + half + 1 < ny else dark
        left = picture[j - half - 1] if j - half - 1 >= 0 else dark
        for i in range(nx):
            total[i] += entered[i] - left[i]
            out[j, i] = inner * total[i] + ends * (left[i] + beyond[i])
