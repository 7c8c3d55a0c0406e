"""Exact Snell refraction of light that travels +Z inside the block and leaves it through z = h(x, y)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from optics.spline import Array


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def tangent_per_slope(slope_squared: float, refractive_index: float) -> float:
    """Return m, the sideways shift per unit of height and slope: the ray runs along (m zx, m zy, 1). NaN: reflected.

    With N the unit normal, cos = N_z: d = n z + (sqrt(1 - n^2 (1 - cos^2)) - n cos) N (vector form of Snell's law),
    here divided by cos: m = k / (n (1 + s^2) - k), k = n - sqrt(1 - (n^2 - 1) s^2).
    """
    n = refractive_index
    k = n - math.sqrt(1.0 - (n * n - 1.0) * slope_squared)  # of a negative number: NaN, in kernels
    return k / (n * (1.0 + slope_squared) - k)


def slope_for_shift(shift_mm: Array, drop_mm: Array, *, refractive_index: float) -> Array:
    """Return surface gradient (..., 2) that sends vertical light sideways by shift_mm (..., 2) over a drop of drop_mm
    (...).

    grad h = shift / k,  k = eta sqrt(|shift|^2 + drop^2) - drop   (paper, eqs. 8-9)
    """
    path_mm = np.sqrt((shift_mm**2).sum(axis=-1) + drop_mm**2)
    return np.asarray(shift_mm / (refractive_index * path_mm - drop_mm)[..., None])
