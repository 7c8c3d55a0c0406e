"""The C2 bicubic spline through a uniform grid: coefficients, values and derivatives.

B-spline form on a uniform knot grid. A grid of (ny, nx) nodes has (ny + 2, nx + 2) coefficients; coefficient
[j + 1, i + 1] belongs to node [j, i]. The end condition is not-a-knot, so scipy's RectBivariateSpline(y, x, z)
through the same nodes is the same surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from optics.run_out import RunOut
from optics.threads import run_on_rows

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@njit(cache=True, nogil=True)
def _fit_columns(lo: int, hi: int, nodes: Array, coefs: Array) -> None:
    """Compute coefficients (n + 2, m) of cubic splines down columns lo .. hi - 1 of nodes (n, m), n >= 4, not-a-knot.

    The third-derivative continuity at the second node, together with (c[i-1] + 4 c[i] + c[i+1]) / 6 = f[i], gives
    c[1] = f[1] - (f[0] - 2 f[1] + f[2]) / 6 in closed form; the rest is one tridiagonal system (Thomas).
    """
    n = nodes.shape[0]
    for k in range(lo, hi):
        coefs[2, k] = nodes[1, k] - (nodes[0, k] - 2.0 * nodes[1, k] + nodes[2, k]) / 6.0
        coefs[n - 1, k] = nodes[n - 2, k] - (nodes[n - 1, k] - 2.0 * nodes[n - 2, k] + nodes[n - 3, k]) / 6.0
    ratio = np.zeros(n)  # elimination factors; row 1 is known
    for i in range(2, n - 2):
        pivot = 4.0 - ratio[i - 1]
        ratio[i] = 1.0 / pivot
        for k in range(lo, hi):
            coefs[i + 1, k] = (6.0 * nodes[i, k] - coefs[i, k]) / pivot
    for i in range(n - 3, 1, -1):
        for k in range(lo, hi):
            coefs[i + 1, k] -= ratio[i] * coefs[i + 2, k]
    for k in range(lo, hi):
        coefs[1, k] = 6.0 * nodes[1, k] - 4.0 * coefs[2, k] - coefs[3, k]
        coefs[0, k] = 6.0 * nodes[0, k] - 4.0 * coefs[1, k] - coefs[2, k]
        coefs[n, k] = 6.0 * nodes[n - 2, k] - 4.0 * coefs[n - 1, k] - coefs[n - 2, k]
        coefs[n + 1, k] = 6.0 * nodes[n - 1, k] - 4.0 * coefs[n, k] - coefs[n - 1, k]


def _fit_all_columns(nodes: Array) -> Array:
    """Return (n + 2, m): `_fit_columns` of all columns."""
    coefs = np.empty((nodes.shape[0] + 2, nodes.shape[1]))
    run_on_rows(_fit_columns, nodes.shape[1], nodes, coefs)
    return coefs


@njit(cache=True, nogil=True, inline="always")
def spline_weights(f: float) -> tuple[float, float, float, float]:
    """Return uniform cubic B-spline weights of the four coefficients around a point at fraction f of its cell."""
    g = 1.0 - f
    return g * g * g / 6.0, (4.0 - 6.0 * f * f + 3.0 * f**3) / 6.0, (4.0 - 6.0 * g * g + 3.0 * g**3) / 6.0, f**3 / 6.0


@njit(cache=True, nogil=True, inline="always")
def slope_weights(f: float) -> tuple[float, float, float, float]:
    """Return derivatives of `spline_weights` by the fraction f of the cell."""
    g = 1.0 - f
    return -0.5 * g * g, 1.5 * f * f - 2.0 * f, 2.0 * g - 1.5 * g * g, 0.5 * f * f


@njit(cache=True, nogil=True)
def spline_jet(
    coefs: Array, x0: float, y0: float, inv_dx: float, inv_dy: float, x: float, y: float
) -> tuple[float, float, float, float, float, float]:
    """Return the value and derivatives (z, zx, zy, zxx, zxy, zyy) at (x, y); beyond the grid the last cell's cubic goes
    on.
    """
    ny, nx = coefs.shape
    u = (x - x0) * inv_dx
    v = (y - y0) * inv_dy
    i = min(max(int(math.floor(u)), 0), nx - 4)
    j = min(max(int(math.floor(v)), 0), ny - 4)
    f = u - i
    g = v - j
    f1 = 1.0 - f
    g1 = 1.0 - g
    wx = spline_weights(f)
    dx = (-0.5 * f1 * f1, 1.5 * f * f - 2.0 * f, -1.5 * f1 * f1 + 2.0 * f1, 0.5 * f * f)
    ddx = (f1, 3.0 * f - 2.0, 3.0 * f1 - 2.0, f)
    wy = spline_weights(g)
    dy = (-0.5 * g1 * g1, 1.5 * g * g - 2.0 * g, -1.5 * g1 * g1 + 2.0 * g1, 0.5 * g * g)
    ddy = (g1, 3.0 * g - 2.0, 3.0 * g1 - 2.0, g)
    z = zx = zy = zxx = zxy = zyy = 0.0
    for b in range(4):
        c0 = coefs[j + b, i]
        c1 = coefs[j + b, i + 1]
        c2 = coefs[j + b, i + 2]
        c3 = coefs[j + b, i + 3]
        r = wx[0] * c0 + wx[1] * c1 + wx[2] * c2 + wx[3] * c3
        rx = dx[0] * c0 + dx[1] * c1 + dx[2] * c2 + dx[3] * c3
        rxx = ddx[0] * c0 + ddx[1] * c1 + ddx[2] * c2 + ddx[3] * c3
        z += wy[b] * r
        zx += wy[b] * rx
        zxx += wy[b] * rxx
        zy += dy[b] * r
        zxy += dy[b] * rx
        zyy += ddy[b] * r
    return (
        z,
        zx * inv_dx,
        zy * inv_dy,
        zxx * inv_dx * inv_dx,
        zxy * inv_dx * inv_dy,
        zyy * inv_dy * inv_dy,
    )


@njit(cache=True, nogil=True)
def _fill_jets(
    lo: int, hi: int, coefs: Array, x0: float, y0: float, inv_dx: float, inv_dy: float, x: Array, y: Array, out: Array
) -> None:
    for k in range(lo, hi):
        jet = spline_jet(coefs, x0, y0, inv_dx, inv_dy, x[k], y[k])
        for d in range(6):
            out[d, k] = jet[d]


@njit(cache=True, nogil=True)
def _fill_concave_curvatures(
    lo: int, hi: int, coefs: Array, x0: float, y0: float, inv_dx: float, inv_dy: float, x: Array, y: Array, out: Array
) -> None:
    for j in range(lo, hi):
        for i in range(x.size):
            _, zx, zy, zxx, zxy, zyy = spline_jet(coefs, x0, y0, inv_dx, inv_dy, x[i], y[j])
            g = 1.0 + zx * zx + zy * zy
            mean = ((1.0 + zy * zy) * zxx - 2.0 * zx * zy * zxy + (1.0 + zx * zx) * zyy) / (2.0 * g * np.sqrt(g))
            gauss = (zxx * zyy - zxy * zxy) / (g * g)
            out[j, i] = mean + np.sqrt(max(mean * mean - gauss, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BicubicSpline:
    """A C2 surface z(x, y). `coefs` is (ny + 2, nx + 2); node [0, 0] stands at (x0_mm, y0_mm)."""

    coefs: Array
    x0_mm: float
    y0_mm: float
    dx_mm: float
    dy_mm: float

    @classmethod
    def through(cls, z_mm: Array, *, x0_mm: float, y0_mm: float, dx_mm: float, dy_mm: float) -> BicubicSpline:
        """Return the interpolating not-a-knot spline through nodes z_mm (ny, nx), both at least 4."""
        if min(z_mm.shape) < 4:
            raise ValueError(f"a bicubic spline needs at least 4 x 4 nodes, not {z_mm.shape[1]} x {z_mm.shape[0]}")
        down = _fit_all_columns(np.array(z_mm, dtype=np.float64, order="C"))  # copies, all of one type: writable
        coefs = np.ascontiguousarray(_fit_all_columns(np.ascontiguousarray(down.T)).T)
        coefs.setflags(write=False)
        return cls(coefs=coefs, x0_mm=x0_mm, y0_mm=y0_mm, dx_mm=dx_mm, dy_mm=dy_mm)

    @property
    def kernel_arguments(self) -> tuple[Array, float, float, float, float]:
        """Arguments of `spline_jet` before the point: coefficients, origin, inverse spacings."""
        return self.coefs, self.x0_mm, self.y0_mm, 1.0 / self.dx_mm, 1.0 / self.dy_mm

    def jets(self, x_mm: ArrayLike, y_mm: ArrayLike) -> Array:
        """Return (6, ...) values and derivatives z, zx, zy, zxx, zxy, zyy at the broadcast points."""
        x, y = np.broadcast_arrays(np.asarray(x_mm, dtype=np.float64), np.asarray(y_mm, dtype=np.float64))
        out = np.empty((6, x.size))
        points = x.flatten(), y.flatten()  # copies, all of one type: writable
        run_on_rows(_fill_jets, x.size, *self.kernel_arguments, *points, out)
        return out.reshape((6, *x.shape))

    def heights_mm(self, x_mm: ArrayLike, y_mm: ArrayLike) -> Array:
        return self.jets(x_mm, y_mm)[0]

    def concave_curvature(self, x_mm: Array, y_mm: Array) -> Array:
        """Return (ny, nx) greatest principal curvature, positive in a hollow, at columns x_mm and rows y_mm [1/mm]."""
        out = np.empty((y_mm.size, x_mm.size))
        run_on_rows(_fill_concave_curvatures, y_mm.size, *self.kernel_arguments, x_mm, y_mm, out)
        return out

    def extend(self, by_mm: float, *, rim_mm: float = 0.0) -> BicubicSpline:
        """Return the same surface, exactly, on its own grid, and a run-out of at least by_mm around it (`run_out`)."""
        pad_x, pad_y = math.ceil(by_mm / self.dx_mm), math.ceil(by_mm / self.dy_mm)
        coefs = RunOut(cells=(pad_y, pad_x), dy_mm=self.dy_mm, dx_mm=self.dx_mm, rim_mm=rim_mm).extend(self.coefs)
        coefs.setflags(write=False)
        return BicubicSpline(
            coefs=coefs,
            x0_mm=self.x0_mm - pad_x * self.dx_mm,
            y0_mm=self.y0_mm - pad_y * self.dy_mm,
            dx_mm=self.dx_mm,
            dy_mm=self.dy_mm,
        )
