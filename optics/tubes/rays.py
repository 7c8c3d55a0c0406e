"""Converts gradients with respect to rays into gradients with respect to heights: the transpose of lattice.py. The
gradient by moves of the lit points on the screen becomes the gradient by the spline's coefficients, through Snell's law
(or the mirror's), the spline's basis and, in `fit_transposed`, the fit of coefficients to heights. All of it is exact.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from optics.light import Beam, meet
from optics.spline import Array, slope_weights, spline_weights
from optics.tubes.lattice import combine_rows


@njit(cache=True, nogil=True, inline="always")
def _surface(value: Array, slope: Array, i: int, f: float, dx: float) -> tuple[float, float, float]:
    w0, w1, w2, w3 = spline_weights(f)
    d0, d1, d2, d3 = slope_weights(f)
    z = w0 * value[i] + w1 * value[i + 1] + w2 * value[i + 2] + w3 * value[i + 3]
    zx = (d0 * value[i] + d1 * value[i + 1] + d2 * value[i + 2] + d3 * value[i + 3]) / dx
    zy = w0 * slope[i] + w1 * slope[i + 1] + w2 * slope[i + 2] + w3 * slope[i + 3]
    return z, zx, zy


@njit(cache=True, nogil=True)
def _ray_transposed(
    beam: Beam, x: float, y: float, z: float, zx: float, zy: float, throw: float, pull_x: float, pull_y: float
) -> tuple[float, float, float]:
    """Return gains by z, zx, zy if moving the lit point gains pull_x, pull_y [1/mm]. Notation of `light.leave`."""
    ax, ay, az, _, _, _ = meet(beam, x, y, z)
    n = beam.refractive_index
    nz = 1.0 / math.sqrt(1.0 + zx * zx + zy * zy)
    nx, ny = -zx * nz, -zy * nz
    cos = ax * nx + ay * ny + az * nz
    if beam.is_mirror:
        keep, push, bend = 1.0, -2.0 * cos, -2.0
    else:
        inner = 1.0 - n * n * (1.0 - cos * cos)
        if inner <= 0.0 or cos <= 0.0:
            return 0.0, 0.0, 0.0
        root = math.sqrt(inner)
        keep, push = n, root - n * cos
        bend = -n * push / root  # d push / d cos
    tx, ty, tz = keep * ax + push * nx, keep * ay + push * ny, keep * az + push * nz
    if tz <= 0.0:
        return 0.0, 0.0, 0.0
    drop = (throw - z) / tz
    by_tx, by_ty = pull_x * drop, pull_y * drop
    by_tz = -(by_tx * tx + by_ty * ty) / tz
    by_z = -(pull_x * tx + pull_y * ty) / tz
    by_cos = bend * (by_tx * nx + by_ty * ny + by_tz * nz)
    by_nx, by_ny, by_nz = push * by_tx + by_cos * ax, push * by_ty + by_cos * ay, push * by_tz + by_cos * az
    along = (by_nx * nx + by_ny * ny + by_nz * nz) * nz * nz
    if beam.is_point:
        turn_x, turn_y, turn_z = _turn_by_height(beam, x, y, z, ax, ay, az)
        by_z += turn_x * (keep * by_tx + by_cos * nx) + turn_y * (keep * by_ty + by_cos * ny)
        by_z += turn_z * (keep * by_tz + by_cos * nz)
    return by_z, -nz * by_nx - zx * along, -nz * by_ny - zy * along


@njit(cache=True, nogil=True)
def _turn_by_height(
    beam: Beam, x: float, y: float, z: float, ax: float, ay: float, az: float
) -> tuple[float, float, float]:
    """Return the derivative by z of the direction in which a point's light meets (x, y, z)."""
    if beam.is_mirror:
        far = (z - beam.z) / az
        return -ax * az / far, -ay * az / far, (1.0 - az * az) / far
    sine = math.sqrt(ax * ax + ay * ay)
    if sine == 0.0:
        return 0.0, 0.0, 0.0
    n, away, depth = beam.refractive_index, beam.face - beam.z, z - beam.face
    outside = n * sine
    w = outside / math.sqrt(1.0 - outside * outside)  # tangent before the face: light._tangent_before_face
    root = math.sqrt(n * n + (n * n - 1.0) * w * w)
    by_z = -(w / root) / (away + depth * n * n / root**3) / (n * (1.0 + w * w) ** 1.5)
    return by_z * ax / sine, by_z * ay / sine, -by_z * sine / az


@njit(cache=True, nogil=True)
def push_row(
    coefs: Array, k: int, x0: float, y0: float, dx: float, dy: float, sub: int, beam: Beam, throw: float,
    inv_px: float, inv_py: float, pull_x: Array, pull_y: Array, by_coefs: Array, work: Array,
) -> None:  # fmt: skip
    """Add to by_coefs the gain by the coefficients if moving the lit points of lattice row k gains pull_x, pull_y.

    pull (columns,) [1/pixel]; work (4, coefficients along x) is scratch.
    """
    cells = coefs.shape[1] - 3
    value, slope, by_value, by_slope = work[0], work[1], work[2], work[3]
    cell = min(k // sub, coefs.shape[0] - 4)
    g = k / sub - cell
    combine_rows(coefs, cell, g, dy, value, slope)
    by_value[:] = 0.0
    by_slope[:] = 0.0
    y = y0 + k * dy / sub
    for c in range(cells * sub + 1):
        if pull_x[c] == 0.0 and pull_y[c] == 0.0:
            continue
        i = min(c // sub, cells - 1)
        f = c / sub - i
        z, zx, zy = _surface(value, slope, i, f, dx)
        x = x0 + c * dx / sub
        gz, gx, gy = _ray_transposed(beam, x, y, z, zx, zy, throw, pull_x[c] * inv_px, pull_y[c] * inv_py)
        gx /= dx
        w, d = spline_weights(f), slope_weights(f)
        for m in range(4):
            by_value[i + m] += w[m] * gz + d[m] * gx
            by_slope[i + m] += w[m] * gy
    w, d = spline_weights(g), slope_weights(g)
    for m in range(4):
        for i in range(cells + 3):
            by_coefs[cell + m, i] += w[m] * by_value[i] + d[m] / dy * by_slope[i]


@njit(cache=True, nogil=True)
def _columns_transposed(by_coefs: Array) -> Array:
    """Return the transpose of spline._fit_columns: (n + 2, m) to (n, m), its steps in reverse. by_coefs is used up."""
    g = by_coefs
    n = g.shape[0] - 2
    out = np.zeros((n, g.shape[1]))
    pivot = np.empty(n)
    ratio = 0.0
    for i in range(2, n - 2):
        pivot[i] = 4.0 - ratio
        ratio = 1.0 / pivot[i]
    for end, inward in ((n + 1, -1), (0, 1)):  # outermost first
        for step in range(2):
            k = end + inward * step
            node = (n - 1 - step) if inward < 0 else step
            out[node] += 6.0 * g[k]
            g[k + inward] -= 4.0 * g[k]
            g[k + 2 * inward] -= g[k]
    for i in range(2, n - 2):
        g[i + 2] -= g[i + 1] / pivot[i]
    for i in range(n - 3, 1, -1):
        out[i] += 6.0 * g[i + 1] / pivot[i]
        g[i] -= g[i + 1] / pivot[i]
    for k, node in ((2, 1), (n - 1, n - 2)):
        out[node] += g[k] * (4.0 / 3.0)
        out[node - 1] -= g[k] / 6.0
        out[node + 1] -= g[k] / 6.0
    return out


def fit_transposed(by_coefs: Array) -> Array:
    """Return (ny, nx) gain by heights, of the (ny + 2, nx + 2) gain by coefficients of the spline through them."""
    across = _columns_transposed(np.ascontiguousarray(by_coefs.T))
    return _columns_transposed(np.ascontiguousarray(across.T))
