"""Spreads tubes over the pixels: computes the densities of the triangles between lattice points on the screen, and
visits every edge of the lattice once, with the difference of the densities on its two sides.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.spline import Array
from optics.tubes.edges import add_edge, add_point

POINT_AREA = 1e-10  # a tube focused on less than this [pixels] counts as one point


@njit(cache=True, nogil=True, inline="always")
def triangle_area(xa: float, ya: float, xb: float, yb: float, xc: float, yc: float) -> float:
    return 0.5 * ((xb - xa) * (yc - ya) - (xc - xa) * (yb - ya))


@njit(cache=True, nogil=True, error_model="numpy")
def fill_densities(below: Array, above: Array, light: Array, density: Array, acc: Array) -> float:
    """Compute density (2, columns) of the two triangles of each square [light per pixel area]; return the reflected
    light.

    Negative where a triangle arrives turned over, so that its coverage counts up. A triangle without an area on the
    screen, reflected or focused on a point, has density 0; the point's light is added to acc at once.
    """
    odd = False
    for c in range(light.shape[1]):
        xa, ya, xd, yd = below[0, c], below[1, c], above[0, c + 1], above[1, c + 1]
        lower = triangle_area(xa, ya, below[0, c + 1], below[1, c + 1], xd, yd)
        upper = triangle_area(xa, ya, xd, yd, above[0, c], above[1, c])
        density[0, c] = light[0, c] / lower
        density[1, c] = light[1, c] / upper
        odd = odd or not (abs(lower) >= POINT_AREA) or not (abs(upper) >= POINT_AREA)
    return _fill_odd_triangles(below, above, light, density, acc) if odd else 0.0


@njit(cache=True, nogil=True)
def _fill_odd_triangles(below: Array, above: Array, light: Array, density: Array, acc: Array) -> float:
    reflected = 0.0
    for c in range(light.shape[1]):
        for k in range(2):
            xa, ya, xd, yd = below[0, c], below[1, c], above[0, c + 1], above[1, c + 1]
            xm, ym = (below[0, c + 1], below[1, c + 1]) if k == 0 else (above[0, c], above[1, c])
            area = triangle_area(xa, ya, xd, yd, xm, ym)
            if math.isnan(area):
                reflected += light[k, c]
                density[k, c] = 0.0
            elif abs(area) < POINT_AREA:
                add_point(acc, (xa + xd + xm) / 3, (ya + yd + ym) / 3, light[k, c])
                density[k, c] = 0.0
    return reflected


@njit(cache=True, nogil=True)
def fill_pixels(hit: Array, ny: int, nx: int, pixel: NDArray[np.int64], corner: Array) -> None:
    """Compute pixel (columns + 1,): index in flat acc of the pixel that a ray hits, -1: none; corner (2, ..): x, y."""
    for c in range(pixel.size):
        x, y = hit[0, c], hit[1, c]
        pixel[c] = -1
        if 0.0 <= x < nx and 0.0 <= y < ny:
            i, j = int(x), int(y)
            pixel[c] = j * (nx + 1) + i
            corner[0, c], corner[1, c] = i, j


@njit(cache=True, nogil=True, inline="always")
def _put(flat: Array, pixel: int, weight: float, share: float) -> None:
    """Add an edge's piece within a pixel: signed density x rise, and the share of it that goes to the right
    neighbour.
    """
    flat[pixel] += weight - weight * share
    flat[pixel + 1] += weight * share


@njit(cache=True, nogil=True, error_model="numpy")
def _add_edge_between(
    acc: Array, flat: Array, pa: int, pb: int, la: float, lb: float, ja: float, jb: float,
    xa: float, ya: float, xb: float, yb: float, density: float,
) -> None:  # fmt: skip
    """Add one edge from pixel pa, whose corner is (la, ja), to pb: cut in two where they are neighbours, as most
    are.
    """
    if pa >= 0 and pb >= 0:
        if ja == jb and abs(la - lb) == 1.0:
            middle = max(la, lb)
            weight = density * (ya - yb)
            first = weight * ((middle - xa) / (xb - xa))
            _put(flat, pa, first, 0.5 * (xa + middle) - la)
            _put(flat, pb, weight - first, 0.5 * (xb + middle) - lb)
            return
        if la == lb and abs(ja - jb) == 1.0:
            middle = max(ja, jb)
            cut = xa + (xb - xa) * ((middle - ya) / (yb - ya))
            _put(flat, pa, density * (ya - middle), 0.5 * (xa + cut) - la)
            _put(flat, pb, density * (middle - yb), 0.5 * (xb + cut) - lb)
            return
    add_edge(acc, xa, ya, xb, yb, density)


@njit(cache=True, nogil=True)
def add_edges(
    below: Array, above: Array, p_below: NDArray[np.int64], p_above: NDArray[np.int64], k_below: Array, k_above: Array,
    density: Array, beneath: Array, acc: Array, flat: Array,
) -> None:  # fmt: skip
    """Add the edges of a row of squares that start on its lower side; beneath: densities of the triangles under it.

    p, k : pixels of the lattice points, and those pixels' corners
    """
    columns = density.shape[1]
    before = 0.0  # density left of the next upright edge
    for c in range(columns):
        xa, ya, xb, yb = below[0, c], below[1, c], below[0, c + 1], below[1, c + 1]
        xc, yc, xd, yd = above[0, c], above[1, c], above[0, c + 1], above[1, c + 1]
        pa, pb, pc, pd = p_below[c], p_below[c + 1], p_above[c], p_above[c + 1]
        la, ja = k_below[0, c], k_below[1, c]
        along, across, up = density[0, c] - beneath[c], density[1, c] - density[0, c], before - density[1, c]
        before, beneath[c] = density[0, c], density[1, c]
        weight = moment = 0.0  # of the edges that stay within the pixel of a
        if pa == pb and pa >= 0:
            weight += along * (ya - yb)
            moment += along * (ya - yb) * (xa + xb)
        else:
            _add_edge_between(
                acc, flat, pa, pb, la, k_below[0, c + 1], ja, k_below[1, c + 1], xa, ya, xb, yb, along
            )  # fmt: skip
        if pa == pd and pa >= 0:
            weight += across * (ya - yd)
            moment += across * (ya - yd) * (xa + xd)
        else:
            _add_edge_between(
                acc, flat, pa, pd, la, k_above[0, c + 1], ja, k_above[1, c + 1], xa, ya, xd, yd, across
            )  # fmt: skip
        if pa == pc and pa >= 0:
            weight += up * (ya - yc)
            moment += up * (ya - yc) * (xa + xc)
        else:
            _add_edge_between(acc, flat, pa, pc, la, k_above[0, c], ja, k_above[1, c], xa, ya, xc, yc, up)
        if weight != 0.0 or moment != 0.0:
            right = 0.5 * moment - weight * la
            flat[pa] += weight - right
            flat[pa + 1] += right
    c = columns
    add_edge(acc, below[0, c], below[1, c], above[0, c], above[1, c], before)


@njit(cache=True, nogil=True)
def spread_tubes(row_lo: int, row_hi: int, hit_x: Array, hit_y: Array, light: Array, acc: Array) -> None:
    """Add tube rows row_lo..row_hi - 1 to acc (ny, nx + 1), whose sums along x are the picture.

    hit_x, hit_y (rows + 1, columns + 1) : where the lattice's rays arrive [pixels]
    light (rows, 2, columns)             : of the two triangles of each square; (1, 1, 1) where all have the same
    """
    columns, ny, nx = hit_x.shape[1] - 1, acc.shape[0], acc.shape[1] - 1
    own, density = np.full((2, columns), light[0, 0, 0]), np.empty((2, columns))
    below, above = np.empty((2, columns + 1)), np.empty((2, columns + 1))
    p_below, p_above = np.empty(columns + 1, dtype=np.int64), np.empty(columns + 1, dtype=np.int64)
    k_below, k_above = np.zeros((2, columns + 1)), np.zeros((2, columns + 1))
    beneath, flat = np.zeros(columns), acc.reshape(-1)
    for k in range(row_lo, row_hi + 1):
        above[0], above[1] = hit_x[k], hit_y[k]
        fill_pixels(above, ny, nx, p_above, k_above)
        if k > row_lo:
            if light.size > 1:
                own[:] = light[k - 1]
            fill_densities(below, above, own, density, acc)
            add_edges(below, above, p_below, p_above, k_below, k_above, density, beneath, acc, flat)
        below, above = above, below
        p_below, p_above = p_above, p_below
        k_below, k_above = k_above, k_below
    close_off(below, beneath, acc)


@njit(cache=True, nogil=True)
def close_off(below: Array, beneath: Array, acc: Array) -> None:
    """Add the edges above the last row of squares."""
    for c in range(beneath.size):
        add_edge(acc, below[0, c], below[1, c], below[0, c + 1], below[1, c + 1], -beneath[c])
