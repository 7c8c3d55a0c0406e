"""The optical path's kernels for the usual light: even, collimated and upright, on a rectangular lens.

Everything is in closed form, and the frame is mapped onto the frame exactly; optical_path.py has the theory,
beam_path.py the kernels for any other light.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from optics.bench import Bench
from optics.spline import Array


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def reach(c: float, sx: float, sy: float, throw: float, index: float) -> tuple[float, float]:
    """Return (R, s_z): length of the ray in air, and the cosine of its exit angle. NaN where light would be totally
    reflected.
    """
    sz2 = 1.0 - sx * sx - sy * sy
    if sz2 * index * index <= 1.0:
        return math.nan, math.nan
    sz = math.sqrt(sz2)
    return (index * throw - c) / (index * sz - 1.0), sz


@njit(cache=True, nogil=True, error_model="numpy")
def add_border(c: Array, r: int, k: int, rim_x: Array, rim_y: Array, dx: float, dy: float) -> float:
    """Return c with one ghost row and column outside, which continue it by the slope on the frame."""
    ny, nx = c.shape
    value = 0.0
    if k < 0:
        value -= rim_x[0, min(max(r, 0), ny - 1)] * dx
        k = 0
    elif k >= nx:
        value += rim_x[1, min(max(r, 0), ny - 1)] * dx
        k = nx - 1
    if r < 0:
        value -= rim_y[0, k] * dy
        r = 0
    elif r >= ny:
        value += rim_y[1, k] * dy
        r = ny - 1
    return value + c[r, k]


@njit(cache=True, nogil=True, error_model="numpy")
def fill_preimage_areas(
    row_lo: int, row_hi: int, c: Array, rim_x: Array, rim_y: Array,
    throw: float, index: float, left: float, bottom: float,
    dx: float, dy: float, width: float, height: float, across: Array, along: Array, mixed: Array, top: Array,
) -> None:  # fmt: skip
    """Compute the areas of pre-image quads of pixel rows row_lo..row_hi - 1 on the lens; the mean pixel's share is 1.

    With p at the midpoints of the pixel's four edges, (pE - pW) x (pN - pS) is the exact area of the quad:
    across[r, k] = x extent of pE - pW, along = y extent of pN - pS, mixed = the product of the other two; area =
    across * along - mixed. A compact stencil: normal derivatives from 2 points, tangential ones from 4.
    rim_x (2, ny), rim_y (2, nx) : normal slope of c on the left/right and bottom/top frame
    top (ny,)                    : greatest height t met in each row of pixels
    """
    ny, nx = c.shape
    unit_x, unit_y = nx / width, ny / height
    for r in range(row_lo, row_hi):
        qy = bottom + (r + 0.5) * dy
        highest = -math.inf
        west_x = west_y = 0.0
        for k in range(nx + 1):
            if k == 0:
                sx = rim_x[0, r]
            elif k == nx:
                sx = rim_x[1, r]
            else:
                sx = (c[r, k] - c[r, k - 1]) / dx
            if 0 < r < ny - 1 and 0 < k < nx:
                sy = (c[r + 1, k] + c[r + 1, k - 1] - c[r - 1, k] - c[r - 1, k - 1]) / (4.0 * dy)
                mid = 0.5 * (c[r, k] + c[r, k - 1])
            else:
                sy = (
                    add_border(c, r + 1, k, rim_x, rim_y, dx, dy)
                    + add_border(c, r + 1, k - 1, rim_x, rim_y, dx, dy)
                    - add_border(c, r - 1, k, rim_x, rim_y, dx, dy)
                    - add_border(c, r - 1, k - 1, rim_x, rim_y, dx, dy)
                ) / (4.0 * dy)
                mid = 0.5 * (add_border(c, r, k, rim_x, rim_y, dx, dy) + add_border(c, r, k - 1, rim_x, rim_y, dx, dy))
            ray, sz = reach(mid, sx, sy, throw, index)
            highest = max(highest, throw - ray * sz)
            px = left + k * dx - ray * sx
            if k == 0:
                px = 0.0
            elif k == nx:
                px = width
            py = qy - ray * sy
            if k > 0:
                across[r, k - 1] = (px - west_x) * unit_x
                mixed[r, k - 1] = (py - west_y) * unit_y
            west_x, west_y = px, py
        for k in range(nx):
            qx = left + (k + 0.5) * dx
            south_x = south_y = 0.0
            for side in range(2):
                e = r + side
                if e == 0:
                    sy = rim_y[0, k]
                elif e == ny:
                    sy = rim_y[1, k]
                else:
                    sy = (c[e, k] - c[e - 1, k]) / dy
                if 0 < k < nx - 1 and 0 < e < ny:
                    sx = (c[e, k + 1] + c[e - 1, k + 1] - c[e, k - 1] - c[e - 1, k - 1]) / (4.0 * dx)
                    mid = 0.5 * (c[e, k] + c[e - 1, k])
                else:
                    sx = (
                        add_border(c, e, k + 1, rim_x, rim_y, dx, dy)
                        + add_border(c, e - 1, k + 1, rim_x, rim_y, dx, dy)
                        - add_border(c, e, k - 1, rim_x, rim_y, dx, dy)
                        - add_border(c, e - 1, k - 1, rim_x, rim_y, dx, dy)
                    ) / (4.0 * dx)
                    mid = 0.5 * (
                        add_border(c, e, k, rim_x, rim_y, dx, dy) + add_border(c, e - 1, k, rim_x, rim_y, dx, dy)
                    )
                ray, sz = reach(mid, sx, sy, throw, index)
                px = qx - ray * sx
                py = bottom + e * dy - ray * sy
                if e == 0:
                    py = 0.0
                elif e == ny:
                    py = height
                if side == 0:
                    south_x, south_y = px, py
                else:
                    along[r, k] = (py - south_y) * unit_y
                    mixed[r, k] *= (px - south_x) * unit_x
        top[r] = highest


@njit(cache=True, nogil=True, error_model="numpy")
def fill_corner_preimages(
    row_lo: int, row_hi: int, c: Array, rim_x: Array, rim_y: Array,
    throw: float, index: float, left: float, bottom: float,
    dx: float, dy: float, width: float, height: float, px: Array, py: Array,
) -> None:  # fmt: skip
    """Compute lens points px, py (ny + 1, nx + 1) that light corner rows row_lo..row_hi - 1; the frame stays on it."""
    ny, nx = c.shape
    for r in range(row_lo, row_hi):
        for k in range(nx + 1):
            sw = add_border(c, r - 1, k - 1, rim_x, rim_y, dx, dy)
            se = add_border(c, r - 1, k, rim_x, rim_y, dx, dy)
            nw = add_border(c, r, k - 1, rim_x, rim_y, dx, dy)
            ne = add_border(c, r, k, rim_x, rim_y, dx, dy)
            sx = (se + ne - sw - nw) / (2.0 * dx)
            sy = (nw + ne - sw - se) / (2.0 * dy)
            ray, _ = reach(0.25 * (sw + se + nw + ne), sx, sy, throw, index)
            px[r, k] = left + k * dx - ray * sx
            py[r, k] = bottom + r * dy - ray * sy
            if k == 0:
                px[r, k] = 0.0
            elif k == nx:
                px[r, k] = width
            if r == 0:
                py[r, k] = 0.0
            elif r == ny:
                py[r, k] = height


def rim_slopes(c: Array, bench: Bench) -> tuple[Array, Array]:
    """Return the normal slopes (2, ny), (2, nx) of c that put the frame of the aperture onto the frame of the screen.

    There s = shift / R. With R as in `reach`, L = n H - c and the slope t along the frame, n s_z - 1 = s L / shift, or
    (L^2 + n^2 shift^2) s^2 + 2 shift L s = shift^2 (n^2 (1 - t^2) - 1), where s has the sign of the shift.
    """
    ny, nx = c.shape
    s, index = bench.screen, bench.refractive_index
    out_x, out_y = np.empty((2, ny)), np.empty((2, nx))
    for side in (0, 1):
        shift_x = s.left_mm + side * (s.width_mm - bench.width_mm)
        shift_y = s.bottom_mm + side * (s.height_mm - bench.height_mm)
        for out, edge, shift, step in (
            (out_x, c[:, -side], shift_x, s.height_mm / ny),
            (out_y, c[-side, :], shift_y, s.width_mm / nx),
        ):
            tangential = np.gradient(edge, step) if edge.size > 1 else np.zeros_like(edge)
            drop = index * bench.throw_mm - edge
            square = drop**2 + (index * shift) ** 2
            inner = drop**2 + square * (index**2 * (1 - tangential**2) - 1)
            out[side] = shift * (np.sqrt(np.maximum(inner, 0.0)) - drop) / square
    return out_x, out_y
