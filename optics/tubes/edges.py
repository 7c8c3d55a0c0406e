"""Areas on a pixel grid by Green's formula: a polygon's coverage of the pixels is a sum over its directed edges.

`acc` (ny, nx + 1) holds differences along the rows; a cumulative sum along x turns them into pixels. An edge only adds
to its own pixel and the next, so a mesh costs one visit to each of its edges, however far its light spreads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from optics.spline import Array


@njit(cache=True, nogil=True)
def add_edge(acc: Array, xa: float, ya: float, xb: float, yb: float, density: float) -> None:
    """Add density x (coverage to the right of the directed edge a -> b, negative when it goes up) to acc.

    Coordinates in pixels; the edge may leave the grid on any side. A corner that is NaN adds nothing.
    """
    if density == 0.0 or not (abs(yb - ya) >= 1e-14) or math.isnan(xa) or math.isnan(xb):
        return
    ny, nx = acc.shape[0], acc.shape[1] - 1
    if xa >= nx and xb >= nx:
        return
    sign = -density
    if ya > yb:
        xa, ya, xb, yb = xb, yb, xa, ya
        sign = density
    if yb <= 0.0 or ya >= ny:
        return
    run = (xb - xa) / (yb - ya)
    y = max(ya, 0.0)
    x = xa + (y - ya) * run if y > ya else xa
    y_end = min(yb, float(ny))
    while y < y_end:
        j = min(int(math.floor(y)), ny - 1)
        y1 = min(float(j + 1), y_end)
        x1 = xb if y1 == yb else xa + (y1 - ya) * run
        _add_in_row(acc[j], x, x1, sign * (y1 - y), nx)
        x, y = x1, y1


@njit(cache=True, nogil=True)
def _add_in_row(row: Array, xa: float, xb: float, weight: float, nx: int) -> None:
    """Add an edge's piece inside one pixel row; weight = signed density x rise, shared along the run in proportion."""
    lo, hi = min(xa, xb), max(xa, xb)
    if lo >= nx:
        return
    if hi <= 0.0:
        row[0] += weight
        return
    first = int(math.floor(lo))
    if lo >= 0.0 and hi <= first + 1.0:
        share = weight * (0.5 * (lo + hi) - first)
        row[first] += weight - share
        row[first + 1] += share
        return
    per_unit = weight / (hi - lo)
    if lo < 0.0:
        row[0] += -lo * per_unit
        lo = 0.0
    end = min(hi, float(nx))
    while lo < end:
        i = min(int(math.floor(lo)), nx - 1)
        step_end = min(float(i + 1), end)
        w = per_unit * (step_end - lo)
        f = 0.5 * (lo + step_end) - i
        row[i] += w * (1.0 - f)
        row[i + 1] += w * f
        lo = step_end


@njit(cache=True, nogil=True)
def add_point(acc: Array, x: float, y: float, amount: float) -> None:
    """Add an amount to the pixel that holds (x, y); do nothing if there is none."""
    j, i = int(math.floor(y)), int(math.floor(x))
    if 0 <= j < acc.shape[0] and 0 <= i < acc.shape[1] - 1:
        acc[j, i] += amount
        acc[j, i + 1] -= amount


def polygon_coverage(corners: Array, shape: tuple[int, int]) -> Array:
    """Return (ny, nx) the share of each pixel that a simple polygon (k, 2) in pixels covers; it may turn either way."""
    acc = np.zeros((shape[0], shape[1] + 1))
    for (xa, ya), (xb, yb) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        add_edge(acc, float(xa), float(ya), float(xb), float(yb), 1.0)
    return np.clip(np.abs(np.cumsum(acc, axis=1)[:, :-1]), 0.0, 1.0)
