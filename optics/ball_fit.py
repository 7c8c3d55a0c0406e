"""Changes a lens as little as possible so that a ball cutter fits: its concave curvature stays under 1 / radius.

For small slopes, the surfaces that fit are a convex set, bounded by one half space for each point and direction. So the
lens is projected onto each half space that it violates, one after the other (Kaczmarz, Gauss-Seidel), in the spline's
own coefficients and at points twice as close as its vertices. Each step moves curvature from a point to its neighbours
and does not change the slopes around them, so light moves by a pixel or two and none is lost.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from optics.heightfield import Heightfield
from optics.spline import Array, Mask, slope_weights, spline_weights
from optics.threads import run_on_rows

Rows = NDArray[np.int64]
_TILE = 16  # points along its side
_ROUNDING = 1e-6
_AIM = 0.97  # of the allowed curvature: slightly below it, so that the steps end
SWEEPS = 300  # 20 for photographs, 100 where much of a picture is black


@njit(cache=True, nogil=True)
def _mark_suspects(c: Array, per_xx: float, per_yy: float, per_xy: float, limit: float, tiles: Mask) -> None:
    """Mark tiles where the curvature may exceed the limit: differences of coefficients c bound those of the surface."""
    ny, nx = c.shape
    for j in range(1, ny - 1):
        for i in range(1, nx - 1):
            across = (c[j, i - 1] - 2.0 * c[j, i] + c[j, i + 1]) * per_xx
            along = (c[j - 1, i] - 2.0 * c[j, i] + c[j + 1, i]) * per_yy
            twist = 0.0
            for b in range(j - 1, j + 1):
                for a in range(i - 1, i + 1):
                    twist = max(twist, abs(c[b + 1, a + 1] - c[b + 1, a] - c[b, a + 1] + c[b, a]) * per_xy)
            if max(across, along) + twist > limit:
                for b in range(max(2 * j - 4, 0) // _TILE, min((2 * j + 4) // _TILE + 1, tiles.shape[0])):
                    for a in range(max(2 * i - 4, 0) // _TILE, min((2 * i + 4) // _TILE + 1, tiles.shape[1])):
                        tiles[b, a] = True


@njit(cache=True, nogil=True, inline="always")
def _bend_weights(f: float) -> tuple[float, float, float, float]:
    """Return second derivatives of `spline_weights` by the fraction f of the cell."""
    return 1.0 - f, 3.0 * f - 2.0, 1.0 - 3.0 * f, f


@njit(cache=True, nogil=True)
def _tightest(zx: float, zy: float, zxx: float, zxy: float, zyy: float) -> tuple[float, float, float, float]:
    """Return the greatest principal curvature k, positive in a hollow, and m with k = mxx zxx + mxy zxy + myy zyy."""
    gxx, gxy, gyy = 1.0 + zx * zx, zx * zy, 1.0 + zy * zy
    square = 1.0 + zx * zx + zy * zy
    root = math.sqrt(square)
    mean = (gyy * zxx - 2.0 * gxy * zxy + gxx * zyy) / (2.0 * square * root)
    k = mean + math.sqrt(max(mean * mean - (zxx * zyy - zxy * zxy) / (square * square), 0.0))
    hxx, hxy, hyy = zxx - k * root * gxx, zxy - k * root * gxy, zyy - k * root * gyy  # times the direction: zero
    ex, ey = (-hxy, hxx) if abs(hxx) > abs(hyy) else (hyy, -hxy)
    if ex == 0.0 and ey == 0.0:
        ex = 1.0
    size = root * (ex * ex * gxx + 2.0 * ex * ey * gxy + ey * ey * gyy)
    return k, ex * ex / size, 2.0 * ex * ey / size, ey * ey / size


@njit(cache=True, nogil=True)
def _relax_point(c: Array, y: float, x: float, inv_dy: float, inv_dx: float, limit: float) -> bool:
    """Change c so that the curvature at (x, y) [cells] is allowed; return whether it was over the limit."""
    i = min(max(int(math.floor(x)), 0), c.shape[1] - 4)
    j = min(max(int(math.floor(y)), 0), c.shape[0] - 4)
    wx, dx, bx = spline_weights(x - i), slope_weights(x - i), _bend_weights(x - i)
    wy, dy, by = spline_weights(y - j), slope_weights(y - j), _bend_weights(y - j)
    per_xx, per_xy, per_yy = inv_dx * inv_dx, inv_dx * inv_dy, inv_dy * inv_dy
    zx = zy = zxx = zxy = zyy = 0.0
    for b in range(4):
        c0, c1, c2, c3 = c[j + b, i], c[j + b, i + 1], c[j + b, i + 2], c[j + b, i + 3]
        r = wx[0] * c0 + wx[1] * c1 + wx[2] * c2 + wx[3] * c3
        rx = dx[0] * c0 + dx[1] * c1 + dx[2] * c2 + dx[3] * c3
        zx += wy[b] * rx
        zy += dy[b] * r
        zxx += wy[b] * (bx[0] * c0 + bx[1] * c1 + bx[2] * c2 + bx[3] * c3)
        zxy += dy[b] * rx
        zyy += by[b] * r
    if max(zxx * per_xx, zyy * per_yy) + abs(zxy) * per_xy <= limit:
        return False
    k, mxx, mxy, myy = _tightest(zx * inv_dx, zy * inv_dy, zxx * per_xx, zxy * per_xy, zyy * per_yy)
    if k <= limit:
        return False
    mxx, mxy, myy = mxx * per_xx, mxy * per_xy, myy * per_yy
    square = 0.0
    for b in range(4):
        for a in range(4):
            square += (mxx * wy[b] * bx[a] + mxy * dy[b] * dx[a] + myy * by[b] * wx[a]) ** 2
    step = (k - _AIM * limit) / square
    for b in range(4):
        for a in range(4):
            c[j + b, i + a] -= step * (mxx * wy[b] * bx[a] + mxy * dy[b] * dx[a] + myy * by[b] * wx[a])
    return True


@njit(cache=True, nogil=True)
def _sweep(
    first: int, last: int, which: Rows, c: Array, inv_dy: float, inv_dx: float, limit: float, tiles: Mask, tight: Mask
) -> None:
    """Relax the points of the marked tiles in rows which[first:last]; tight marks tiles with points over the limit."""
    rows, columns = 2 * c.shape[0] - 1, 2 * c.shape[1] - 1
    for b in which[first:last]:
        for a in range(tiles.shape[1]):
            if not tiles[b, a]:
                continue
            for j in range(b * _TILE, min((b + 1) * _TILE, rows)):
                for i in range(a * _TILE, min((a + 1) * _TILE, columns)):
                    if _relax_point(c, 0.5 * j - 1.0, 0.5 * i - 1.0, inv_dy, inv_dx, limit):
                        tight[b, a] = True


def fit_ball(lens: Heightfield, radius_mm: float, *, sweeps: int = SWEEPS) -> Heightfield:
    """Return the lens with concave curvature of at most 1 / radius_mm, its top unchanged; the lens itself if it already
    fits.

    sweeps : over the points that still violate the limit. The result may not fit yet, but is closer to fitting than
    before

    The spline's end condition makes its two outermost cells one cubic, so its outermost coefficients follow from the
    others; only those are changed.
    """
    coefs = np.ascontiguousarray(lens.spline().coefs[1:-1, 1:-1])
    inv_dx, inv_dy, limit = 1.0 / lens.dx_mm, 1.0 / lens.dy_mm, (1.0 - _ROUNDING) / radius_mm
    tight = np.zeros([(2 * n - 2) // _TILE + 1 for n in coefs.shape], dtype=np.bool_)
    done = 0
    while done < sweeps:
        fresh = not tight.any()
        tiles = _suspects(coefs, inv_dy, inv_dx, limit, tight) if fresh else _and_neighbours(tight)
        tight[:] = False
        marked = np.flatnonzero(tiles.any(axis=1))
        for odd in (0, 1):  # rows of the same parity share no coefficient
            which = marked[marked % 2 == odd]
            run_on_rows(_sweep, which.size, which, coefs, inv_dy, inv_dx, limit, tiles, tight)
        if fresh and not tight.any():
            break
        done += 1
    if done == 0:
        return lens
    z = _at_nodes(coefs)
    return replace(lens, z_mm=z - z.max() + lens.z_mm.max())


def ball_fits(lens: Heightfield, radius_mm: float) -> bool:
    """Return whether a ball of that radius fits every hollow, judged by curvature."""
    return fit_ball(lens, radius_mm, sweeps=1) is lens


def _suspects(coefs: Array, inv_dy: float, inv_dx: float, limit: float, tiles: Mask) -> Mask:
    """Return tiles of points where the curvature may exceed the limit; all tiles along the rim, where bounds would cost
    more.
    """
    marked = np.zeros_like(tiles)
    marked[0], marked[-1], marked[:, 0], marked[:, -1] = True, True, True, True
    _mark_suspects(coefs, inv_dx**2, inv_dy**2, inv_dx * inv_dy, limit, marked)
    return marked


def _and_neighbours(tiles: Mask) -> Mask:
    return np.asarray(binary_dilation(tiles, np.ones((3, 3))))


def _at_nodes(coefs: Array) -> Array:
    """Return (ny, nx) heights of nodes from their (ny, nx) coefficients; the cubics at both rims continue."""
    for _ in range(2):
        first = 4.0 * coefs[0] - 6.0 * coefs[1] + 4.0 * coefs[2] - coefs[3]
        last = 4.0 * coefs[-1] - 6.0 * coefs[-2] + 4.0 * coefs[-3] - coefs[-4]
        whole = np.concatenate([first[None], coefs, last[None]])
        coefs = ((whole[:-2] + 4.0 * whole[1:-1] + whole[2:]) / 6.0).T
    return np.ascontiguousarray(coefs)
