"""A picture made sharper by as much as milling will blur it: what the lens aims at, so that the milled one is right.

Landweber's iteration: a <- max(floor, a + B(t - B a)), B the blur, which is its own transpose. It stops early: each
step brings back finer detail for more contrast, which valleys under a ball cannot give.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from optics.spline import Array

_STEPS = 10
_FLOOR = 0.01  # of the mean: no place of a lens is without light


def sharpened(target: Array, blur_px: tuple[float, float]) -> Array:
    """What blurs into the target (ny, nx), of mean 1, as far as light allows; brighter at its edges, as beyond is dark.

    blur_px : standard deviations along the rows and the columns of the picture: y, x
    """
    if max(blur_px) <= 0:
        return target
    aim = target.copy()
    for _ in range(_STEPS):
        missing = target - gaussian_filter(aim, blur_px, mode="constant")
        aim = np.maximum(aim + gaussian_filter(missing, blur_px, mode="constant"), _FLOOR)
    return np.asarray(aim / aim.mean())
