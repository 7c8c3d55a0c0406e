"""The transport map: the point on the lens from which each point of the screen gets its light; and the inverse of a
moved grid.

Which point of the grid lies on a given point of the plane? Each quad of the moved grid visits the few lens vertices
inside its bounding box and solves the inverse bilinear equation for them. No search tree: the total work is the number
of vertices times a small overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.spline import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TransportMap:
    """Pixel corners on the screen and the points of the lens that light them.

    screen_mm (ny + 1, nx + 1, 2) : the corners, work-frame x and y
    lens_mm   (ny + 1, nx + 1, 2) : their pre-images on the lens
    """

    screen_mm: Array
    lens_mm: Array

    def __post_init__(self) -> None:
        if self.screen_mm.shape != self.lens_mm.shape or self.screen_mm.shape[-1] != 2:
            raise ValueError(f"map shapes differ: screen {self.screen_mm.shape}, lens {self.lens_mm.shape}")
        for points in (self.screen_mm, self.lens_mm):
            points.setflags(write=False)


@njit(cache=True, nogil=True)
def _inverse_bilinear(
    ax: float, ay: float, bx: float, by: float, cx: float, cy: float, dx: float, dy: float, slack: float
) -> tuple[float, float, bool]:
    """Return (u, v, found) of the origin in the quad a (0,0), b (1,0), c (1,1), d (0,1), all given relative to the
    point.
    """
    ex, ey = bx - ax, by - ay
    fx, fy = dx - ax, dy - ay
    gx, gy = ax - bx + cx - dx, ay - by + cy - dy
    hx, hy = -ax, -ay
    k2 = gx * fy - gy * fx
    k1 = ex * fy - ey * fx + hx * gy - hy * gx
    k0 = hx * ey - hy * ex
    disc = k1 * k1 - 4.0 * k0 * k2
    if disc < 0.0:
        return 0.0, 0.0, False
    q = -0.5 * (k1 + math.copysign(math.sqrt(disc), k1))
    for which in range(2):
        if which == 0:
            if q == 0.0:
                continue
            v = k0 / q
        else:
            if k2 == 0.0:
                continue
            v = q / k2
        if not (-slack <= v <= 1.0 + slack):
            continue
        px, py = ex + gx * v, ey + gy * v
        u = (hx - fx * v) / px if abs(px) > abs(py) else (hy - fy * v) / py if py != 0.0 else math.nan
        if -slack <= u <= 1.0 + slack:
            return min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0), True
    return 0.0, 0.0, False


@njit(cache=True, nogil=True)
def _visit(
    px: Array, py: Array, x0: float, y0: float, inv_dx: float, inv_dy: float, slack: float, u: Array, v: Array
) -> int:
    """Fill u, v (NaN where open) of the vertices each quad contains; returns how many are still open."""
    ny, nx = u.shape
    for r in range(px.shape[0] - 1):
        for c in range(px.shape[1] - 1):
            ax, bx, dx, cx = px[r, c], px[r, c + 1], px[r + 1, c], px[r + 1, c + 1]
            ay, by, dy, cy = py[r, c], py[r, c + 1], py[r + 1, c], py[r + 1, c + 1]
            grow = 1e-9 + slack
            i_lo = max(int(math.ceil((min(ax, bx, cx, dx) - x0) * inv_dx - grow)), 0)
            i_hi = min(int(math.floor((max(ax, bx, cx, dx) - x0) * inv_dx + grow)), nx - 1)
            j_lo = max(int(math.ceil((min(ay, by, cy, dy) - y0) * inv_dy - grow)), 0)
            j_hi = min(int(math.floor((max(ay, by, cy, dy) - y0) * inv_dy + grow)), ny - 1)
            for j in range(j_lo, j_hi + 1):
                y = y0 + j / inv_dy
                for i in range(i_lo, i_hi + 1):
                    if not math.isnan(u[j, i]):
                        continue
                    x = x0 + i / inv_dx
                    s, t, found = _inverse_bilinear(
                        ax - x, ay - y, bx - x, by - y, cx - x, cy - y, dx - x, dy - y, slack
                    )
                    if found:
                        u[j, i] = c + s
                        v[j, i] = r + t
    left = 0
    for j in range(ny):
        for i in range(nx):
            if math.isnan(u[j, i]):
                left += 1
    return left


@njit(cache=True, nogil=True)
def _fill_from_neighbours(u: Array, v: Array) -> None:
    """Give open vertices the mean of their known neighbours, ring by ring outward from the known ones.

    Each vertex is visited once for each neighbour, however wide the open part is (beside a round lens).
    """
    ny, nx = u.shape
    ring, size = np.empty((ny * nx, 2), np.int64), 0
    waiting = np.zeros((ny, nx), np.bool_)
    for j in range(ny):
        for i in range(nx):
            if not math.isnan(u[j, i]):
                size = _queue_open_around(j, i, u, waiting, ring, size)
    start = 0
    while start < size:
        stop = size
        means = np.empty((stop - start, 2))
        for k in range(start, stop):
            means[k - start, 0], means[k - start, 1] = _mean_around(ring[k, 0], ring[k, 1], u, v)
        for k in range(start, stop):
            u[ring[k, 0], ring[k, 1]], v[ring[k, 0], ring[k, 1]] = means[k - start, 0], means[k - start, 1]
        for k in range(start, stop):
            size = _queue_open_around(ring[k, 0], ring[k, 1], u, waiting, ring, size)
        start = stop


@njit(cache=True, nogil=True)
def _queue_open_around(j: int, i: int, u: Array, waiting: NDArray[np.bool_], ring: NDArray[np.int64], size: int) -> int:
    """Add the open vertices beside (j, i) that are not in the queue yet; returns its size."""
    for jj in range(max(j - 1, 0), min(j + 2, u.shape[0])):
        for ii in range(max(i - 1, 0), min(i + 2, u.shape[1])):
            if math.isnan(u[jj, ii]) and not waiting[jj, ii]:
                waiting[jj, ii] = True
                ring[size, 0], ring[size, 1] = jj, ii
                size += 1
    return size


@njit(cache=True, nogil=True)
def _mean_around(j: int, i: int, u: Array, v: Array) -> tuple[float, float]:
    """Return means of u and v over the known vertices beside (j, i)."""
    count, sum_u, sum_v = 0, 0.0, 0.0
    for jj in range(max(j - 1, 0), min(j + 2, u.shape[0])):
        for ii in range(max(i - 1, 0), min(i + 2, u.shape[1])):
            if not math.isnan(u[jj, ii]):
                count += 1
                sum_u += u[jj, ii]
                sum_v += v[jj, ii]
    return sum_u / count, sum_v / count


def screen_positions(lens_x: Array, lens_y: Array, x_mm: Array, y_mm: Array) -> tuple[Array, Array]:
    """Return fractional grid indices (u along columns, v along rows), each (ny, nx), of the vertices (x_mm[i],
    y_mm[j]).

    lens_x, lens_y (my, mx)  : positions of the moved grid's nodes; its quads cover the aperture
    x_mm (nx,), y_mm (ny,)   : evenly spaced vertex positions

    Quads that a fold has turned over leave a few vertices open: these are searched with a tolerance of up to half a
    quad, and any that are still open then take the mean of their neighbours.
    """
    u = np.full((y_mm.size, x_mm.size), np.nan)
    v = np.full_like(u, np.nan)
    inv_dx = (x_mm.size - 1) / (x_mm[-1] - x_mm[0])
    inv_dy = (y_mm.size - 1) / (y_mm[-1] - y_mm[0])
    px, py = np.ascontiguousarray(lens_x), np.ascontiguousarray(lens_y)
    for slack in (1e-9, 1e-3, 0.5):
        if _visit(px, py, float(x_mm[0]), float(y_mm[0]), inv_dx, inv_dy, slack, u, v) == 0:
            return u, v
    if np.isnan(u).all():
        raise ValueError("the moved grid covers none of the vertices")
    _fill_from_neighbours(u, v)
    return u, v
