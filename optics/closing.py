"""Fills valleys that a cutter cannot reach: morphological closing of the surface by a parabola."""

from __future__ import annotations

import numpy as np
from numba import njit

from optics.spline import Array
from optics.threads import run_on_rows

_LEVEL = 0.1  # of the band: a rise of the rim that does no harm


@njit(cache=True, nogil=True)
def _lower_envelopes(row_lo: int, row_hi: int, f: Array, curvature: float, out: Array) -> None:
    """Compute out[r, i] = min_k f[r, k] + curvature (i - k)^2 / 2: lower envelope of equal parabolas, in linear
    time.
    """
    n = f.shape[1]
    at = np.empty(n, np.int64)
    start = np.empty(n + 1)
    for r in range(row_lo, row_hi):
        k = 0
        at[0] = 0
        start[0], start[1] = -np.inf, np.inf
        for i in range(1, n):
            while True:
                j = at[k]
                s = (f[r, i] - f[r, j]) / (curvature * (i - j)) + 0.5 * (i + j)
                if s > start[k]:
                    break
                k -= 1
            k += 1
            at[k] = i
            start[k], start[k + 1] = s, np.inf
        k = 0
        for i in range(n):
            while start[k + 1] < i:
                k += 1
            out[r, i] = f[r, at[k]] + 0.5 * curvature * (i - at[k]) ** 2


def _erode(f: Array, radius_mm: float, dx_mm: float, dy_mm: float) -> Array:
    """Return min over y of f(y) + |x - y|^2 / (2 radius): separable in x and y."""
    for spacing in (dx_mm, dy_mm):
        f = np.ascontiguousarray(f)
        out = np.empty_like(f)
        run_on_rows(_lower_envelopes, f.shape[0], f, spacing**2 / radius_mm, out)
        f = out.T
    return f


def _close(z_mm: Array, radius_mm: float, dx_mm: float, dy_mm: float) -> Array:
    dilated = -_erode(-z_mm, radius_mm, dx_mm, dy_mm)
    return _erode(dilated, radius_mm, dx_mm, dy_mm)


def _beyond_rim(z_mm: Array, radius_mm: float, dx_mm: float, dy_mm: float) -> int:
    """Return how many vertices the middle of a ball that touches the rim may lie outside; 0 if the rims are level.

    A rim of slope s is raised by s^2 radius / 2 if the surface ends there: a rim counts as level if that is negligible
    beside the closing's band.
    """
    steepest = max(
        np.abs(z_mm[0] - z_mm[1]).max() / dy_mm,
        np.abs(z_mm[-1] - z_mm[-2]).max() / dy_mm,
        np.abs(z_mm[:, 0] - z_mm[:, 1]).max() / dx_mm,
        np.abs(z_mm[:, -1] - z_mm[:, -2]).max() / dx_mm,
    )
    spacing_mm = min(dx_mm, dy_mm)
    if steepest**2 * radius_mm / 2 <= _LEVEL * spacing_mm**2 / (4 * radius_mm):
        return 0
    return min(int(steepest * radius_mm / spacing_mm) + 1, min(z_mm.shape) - 1)


def close_to_radius(z_mm: Array, *, radius_mm: float, dx_mm: float, dy_mm: float) -> Array:
    """Return heights (ny, nx) with valleys tighter than radius_mm filled: no second derivative above 1 / radius_mm.

    Along each axis the grid alone makes the closing differ from z by up to dx^2 / (4 radius), which would cost a
    photograph 6 dB; so a filling d counts as d^2 / (d + band): nearly nothing below that band, d minus the band above
    it, and smooth in between (a threshold would leave a crease, which closing has to remove). Beyond its rim the
    surface goes on with its slope: else a sloped rim (a larger screen, the inverted branch) is raised by tenths of a
    mm.
    """
    closed = _close(z_mm, radius_mm, dx_mm, dy_mm)
    beyond = _beyond_rim(z_mm, radius_mm, dx_mm, dy_mm)
    if beyond > 0:
        wider = np.pad(z_mm, beyond, mode="reflect", reflect_type="odd")
        inside = slice(beyond, -beyond)
        closed = np.minimum(closed, _close(wider, radius_mm, dx_mm, dy_mm)[inside, inside])
    band = max(dx_mm, dy_mm) ** 2 / (4 * radius_mm)
    filling = np.maximum(closed - z_mm, 0.0)
    return np.asarray(z_mm + filling**2 / (filling + band))
