"""Where points of the lens lie in a moved grid: through its triangles, then on the smooth map through its vertices."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.interpolate import RectBivariateSpline

from optics.spline import Array

_NEWTON_STEPS = 2


class SmoothGridMap:
    """The C2 map q -> p through the vertices of a moved grid: bicubic splines of the displacement, inverted by Newton.

    x_mm (mx,), y_mm (my,) : the grid's own coordinates, ascending, spacing free
    moved_mm (my, mx, 2)   : where its vertices lie now; both triangles of every cell are still counter-clockwise
    """

    def __init__(self, x_mm: Array, y_mm: Array, moved_mm: Array) -> None:
        self._x_mm, self._y_mm, self._moved_mm = x_mm, y_mm, moved_mm
        self._shift_x = spline_over(x_mm, y_mm, moved_mm[..., 0] - x_mm[None, :])
        self._shift_y = spline_over(x_mm, y_mm, moved_mm[..., 1] - y_mm[:, None])

    def preimages_mm(self, at_x_mm: Array, at_y_mm: Array) -> Array:
        """(ny, nx, 2) grid coordinates q of the vertices (at_x_mm[i], at_y_mm[j]) of a regular grid.

        Starts from the triangle that holds the point (always found: no triangle is flipped, so the triangles map the
        frame one-to-one). A Newton step, with the Jacobian of the start, counts only where it brings the point nearer
        and stays within a cell; elsewhere (beside a crease, where the smooth map may fold) the answer before it stands.
        """
        q = located_in_triangles(self._x_mm, self._y_mm, self._moved_mm, at_x_mm, at_y_mm).reshape(-1, 2)
        wanted = np.stack(np.meshgrid(at_x_mm, at_y_mm), axis=-1).reshape(-1, 2)
        low, high = np.array([self._x_mm[0], self._y_mm[0]]), np.array([self._x_mm[-1], self._y_mm[-1]])
        reach = max(np.diff(self._x_mm).max(), np.diff(self._y_mm).max())
        miss = wanted - self.images_mm(q)
        inverse = self._inverse_jacobians(q)
        for _ in range(_NEWTON_STEPS):
            step = np.einsum("nij,nj->ni", inverse, miss)
            step *= (np.abs(step).max(axis=1) <= reach)[:, None]
            trial = np.clip(q + step, low, high)
            trial_miss = wanted - self.images_mm(trial)
            nearer = (trial_miss**2).sum(axis=1) < (miss**2).sum(axis=1)
            q[nearer], miss[nearer] = trial[nearer], trial_miss[nearer]
        return q.reshape(at_y_mm.size, at_x_mm.size, 2)

    def images_mm(self, q: Array) -> Array:
        """(n, 2) points p of the grid coordinates q (n, 2)."""
        return q + np.stack([self._shift_x.ev(q[:, 1], q[:, 0]), self._shift_y.ev(q[:, 1], q[:, 0])], axis=1)

    def _inverse_jacobians(self, q: Array) -> Array:
        """(n, 2, 2) inverse of dp/dq; zero where the smooth map turns over."""
        y, x = q[:, 1], q[:, 0]
        xx, xy = 1.0 + self._shift_x.ev(y, x, dy=1), self._shift_x.ev(y, x, dx=1)
        yx, yy = self._shift_y.ev(y, x, dy=1), 1.0 + self._shift_y.ev(y, x, dx=1)
        determinant = xx * yy - xy * yx
        inverse = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=determinant > 0.0)
        return np.stack([yy, -xy, -yx, xx], axis=1).reshape(-1, 2, 2) * inverse[:, None, None]


def spline_over(x_mm: Array, y_mm: Array, values: Array) -> RectBivariateSpline:
    """The interpolating bicubic spline of values (ny, nx); call .ev(y, x): the first argument runs along the rows."""
    return RectBivariateSpline(y_mm, x_mm, values, kx=3, ky=3, s=0)


def located_in_triangles(x_mm: Array, y_mm: Array, moved_mm: Array, at_x_mm: Array, at_y_mm: Array) -> Array:
    """(ny, nx, 2) piecewise linear pre-images of the evenly spaced vertices (at_x_mm[i], at_y_mm[j]).

    Cells of the grid are cut as in `TriangleMesh.structured`.
    errors : ValueError if a vertex lies in no triangle, i.e. the moved grid does not cover it
    """
    u = np.full((at_y_mm.size, at_x_mm.size), np.nan)
    v = np.full_like(u, np.nan)
    inverse_dx = (at_x_mm.size - 1) / (at_x_mm[-1] - at_x_mm[0])
    inverse_dy = (at_y_mm.size - 1) / (at_y_mm[-1] - at_y_mm[0])
    _locate(np.ascontiguousarray(moved_mm), float(at_x_mm[0]), float(at_y_mm[0]), inverse_dx, inverse_dy, u, v)
    if np.isnan(u).any():
        raise ValueError(f"{int(np.isnan(u).sum())} vertices lie outside the moved grid")
    columns, rows = np.arange(x_mm.size), np.arange(y_mm.size)
    return np.stack([np.interp(u, columns, x_mm), np.interp(v, rows, y_mm)], axis=-1)


@njit(cache=True, nogil=True)
def _locate(moved: Array, x0: float, y0: float, inv_dx: float, inv_dy: float, u: Array, v: Array) -> None:
    """Every triangle visits the vertices in its bounding box and claims those it holds, to a rounding's width."""
    ny, nx = u.shape
    slack = 1e-9
    for r in range(moved.shape[0] - 1):
        for c in range(moved.shape[1] - 1):
            for half in range(2):
                turn = 1 - 2 * half  # the upper triangle is walked clockwise: a, then the upper left corner, then c
                ax, ay = (moved[r, c, 0] - x0) * inv_dx, (moved[r, c, 1] - y0) * inv_dy
                bx = (moved[r + half, c + 1 - half, 0] - x0) * inv_dx
                by = (moved[r + half, c + 1 - half, 1] - y0) * inv_dy
                cx, cy = (moved[r + 1, c + 1, 0] - x0) * inv_dx, (moved[r + 1, c + 1, 1] - y0) * inv_dy
                i_lo = max(int(math.ceil(min(ax, bx, cx) - slack)), 0)
                i_hi = min(int(math.floor(max(ax, bx, cx) + slack)), nx - 1)
                j_lo = max(int(math.ceil(min(ay, by, cy) - slack)), 0)
                j_hi = min(int(math.floor(max(ay, by, cy) + slack)), ny - 1)
                for j in range(j_lo, j_hi + 1):
                    for i in range(i_lo, i_hi + 1):
                        wa = turn * ((bx - i) * (cy - j) - (cx - i) * (by - j))
                        wb = turn * ((cx - i) * (ay - j) - (ax - i) * (cy - j))
                        wc = turn * ((ax - i) * (by - j) - (bx - i) * (ay - j))
                        if math.isnan(u[j, i]) and min(wa, wb, wc) >= -slack:
                            total = wa + wb + wc
                            u[j, i] = c + (wb * (1 - half) + wc) / total
                            v[j, i] = r + (wb * half + wc) / total
