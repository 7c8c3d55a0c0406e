"""The smooth map through the vertices of a moved grid, and its inverse: what the paper's surface is read from."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import RectBivariateSpline

from optics.map_inversion import screen_positions
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
        """Return (ny, nx, 2) grid coordinates q of the vertices (at_x_mm[i], at_y_mm[j]) of a regular grid.

        Starts from the bilinear inverse in the quad that holds the point. A Newton step, with the Jacobian of the
        start, counts only where it brings the point nearer and stays within a cell; elsewhere (beside a crease, where
        the smooth map may fold) the answer before it stands.
        """
        u, v = screen_positions(self._moved_mm[..., 0], self._moved_mm[..., 1], at_x_mm, at_y_mm)
        columns, rows = np.arange(self._x_mm.size), np.arange(self._y_mm.size)
        q = np.stack([np.interp(u, columns, self._x_mm), np.interp(v, rows, self._y_mm)], axis=-1).reshape(-1, 2)
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
        """Return (n, 2) points p of the grid coordinates q (n, 2)."""
        return q + np.stack([self._shift_x.ev(q[:, 1], q[:, 0]), self._shift_y.ev(q[:, 1], q[:, 0])], axis=1)

    def _inverse_jacobians(self, q: Array) -> Array:
        """Return (n, 2, 2) inverse of dp/dq; zero where the smooth map turns over."""
        y, x = q[:, 1], q[:, 0]
        xx, xy = 1.0 + self._shift_x.ev(y, x, dy=1), self._shift_x.ev(y, x, dx=1)
        yx, yy = self._shift_y.ev(y, x, dy=1), 1.0 + self._shift_y.ev(y, x, dx=1)
        determinant = xx * yy - xy * yx
        inverse = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=determinant > 0.0)
        return np.stack([yy, -xy, -yx, xx], axis=1).reshape(-1, 2, 2) * inverse[:, None, None]


def spline_over(x_mm: Array, y_mm: Array, values: Array) -> RectBivariateSpline:
    """Return the interpolating bicubic spline of values (ny, nx); call .ev(y, x): the first argument runs along the
    rows.
    """
    return RectBivariateSpline(y_mm, x_mm, values, kx=3, ky=3, s=0)
