"""Flux tubes: the light through a lens as triangles, followed one row of lattice points after the other.

The lens is cut by a lattice of `sub` x `sub` squares in each of its cells, each square into two triangles. A row of the
lattice is: the surface there, where its rays arrive on the screen (in pixels), and how much light each triangle holds.
Then every edge of the lattice is visited once, with the difference of the densities on its two sides.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.light import Beam, leave, meet, strength_on_face
from optics.refraction import refracted_tangent
from optics.spline import Array, spline_weights
from optics.tubes.edges import add_edge, add_point

_POINT_AREA = 1e-10  # a tube focused on less than this [pixels] falls on one point


class Aim(NamedTuple):
    """The screen as kernels take it: mm above Z0, lower left corner, pixels per mm."""

    throw: float
    left: float
    bottom: float
    per_mm_x: float
    per_mm_y: float


@njit(cache=True, nogil=True)
def _surface_row(coefs: Array, cell: int, g: float, dx: float, dy: float, sub: int, jet: Array) -> None:
    """jet (3, columns + 1): height and its two slopes on the lattice row at fraction g of a row of cells."""
    cells = coefs.shape[1] - 3
    w = spline_weights(g)
    d = (-0.5 * (1 - g) ** 2, 1.5 * g * g - 2 * g, -1.5 * (1 - g) ** 2 + 2 * (1 - g), 0.5 * g * g)
    value, slope = np.empty(cells + 3), np.empty(cells + 3)
    for i in range(cells + 3):
        c0, c1, c2, c3 = coefs[cell, i], coefs[cell + 1, i], coefs[cell + 2, i], coefs[cell + 3, i]
        value[i] = w[0] * c0 + w[1] * c1 + w[2] * c2 + w[3] * c3
        slope[i] = (d[0] * c0 + d[1] * c1 + d[2] * c2 + d[3] * c3) / dy
    z, zx, zy = jet[0], jet[1], jet[2]
    for s in range(sub):
        f = s / sub
        w0, w1, w2, w3 = spline_weights(f)
        d0, d1 = -0.5 * (1 - f) ** 2 / dx, (1.5 * f * f - 2 * f) / dx
        d2, d3 = (-1.5 * (1 - f) ** 2 + 2 * (1 - f)) / dx, 0.5 * f * f / dx
        for i in range(cells):
            v0, v1, v2, v3 = value[i], value[i + 1], value[i + 2], value[i + 3]
            z[i * sub + s] = w0 * v0 + w1 * v1 + w2 * v2 + w3 * v3
            zx[i * sub + s] = d0 * v0 + d1 * v1 + d2 * v2 + d3 * v3
            zy[i * sub + s] = w0 * slope[i] + w1 * slope[i + 1] + w2 * slope[i + 2] + w3 * slope[i + 3]
    rim = cells * sub  # fraction 1 of the last cell
    z[rim] = (value[cells] + 4 * value[cells + 1] + value[cells + 2]) / 6
    zx[rim] = (value[cells + 2] - value[cells]) / (2 * dx)
    zy[rim] = (slope[cells] + 4 * slope[cells + 1] + slope[cells + 2]) / 6


@njit(cache=True, nogil=True)
def _follow_vertical(jet: Array, x0: float, step: float, y: float, index: float, aim: Aim, hit: Array) -> None:
    """hit (2, columns + 1): where even, vertical light through a lattice row arrives [pixels]; NaN: reflected."""
    for c in range(jet.shape[1]):
        z, zx, zy = jet[0, c], jet[1, c], jet[2, c]
        reach = (aim.throw - z) * refracted_tangent(zx * zx + zy * zy, index)
        hit[0, c] = (x0 + c * step + reach * zx - aim.left) * aim.per_mm_x
        hit[1, c] = (y + reach * zy - aim.bottom) * aim.per_mm_y


@njit(cache=True, nogil=True)
def _follow_beam(jet: Array, x0: float, step: float, y: float, beam: Beam, aim: Aim, hit: Array, face: Array) -> None:
    """The same for any beam, and face (3, columns + 1): where the rays crossed the face [mm], the strength there."""
    for c in range(jet.shape[1]):
        x, z = x0 + c * step, jet[0, c]
        dx, dy, dz, _, face_x, face_y = meet(beam, x, y, z)
        tx, ty, tz = leave(dx, dy, dz, jet[1, c], jet[2, c], beam.refractive_index, beam.is_mirror)
        reach = (aim.throw - z) / tz
        hit[0, c] = (x + reach * tx - aim.left) * aim.per_mm_x
        hit[1, c] = (y + reach * ty - aim.bottom) * aim.per_mm_y
        face[0, c], face[1, c], face[2, c] = face_x, face_y, strength_on_face(beam, face_x, face_y)


@njit(cache=True, nogil=True, inline="always")
def _area(xa: float, ya: float, xb: float, yb: float, xc: float, yc: float) -> float:
    return 0.5 * ((xb - xa) * (yc - ya) - (xc - xa) * (yb - ya))


@njit(cache=True, nogil=True)
def _light_of_row(below: Array, above: Array, cover: Array, sub: int, light: Array) -> None:
    """light (2, columns): of triangles a b d and a d c of each square: face area x mean strength x covered share."""
    for c in range(light.shape[1]):
        xa, ya, xb, yb = below[0, c], below[1, c], below[0, c + 1], below[1, c + 1]
        xc, yc, xd, yd = above[0, c], above[1, c], above[0, c + 1], above[1, c + 1]
        share = cover[c // sub] / 3.0
        shared = below[2, c] + above[2, c + 1]
        light[0, c] = share * (shared + below[2, c + 1]) * max(_area(xa, ya, xb, yb, xd, yd), 0.0)
        light[1, c] = share * (shared + above[2, c]) * max(_area(xa, ya, xd, yd, xc, yc), 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _densities(below: Array, above: Array, light: Array, density: Array, acc: Array) -> float:
    """density (2, columns) of the two triangles of each square [light per pixel area]; returns the light reflected.

    Negative where a triangle arrives turned over, so that its coverage counts up. A triangle without an area on the
    screen, reflected or focused on a point, has density 0; the point's light is added to acc at once.
    """
    odd = False
    for c in range(light.shape[1]):
        xa, ya, xd, yd = below[0, c], below[1, c], above[0, c + 1], above[1, c + 1]
        lower = _area(xa, ya, below[0, c + 1], below[1, c + 1], xd, yd)
        upper = _area(xa, ya, xd, yd, above[0, c], above[1, c])
        density[0, c] = light[0, c] / lower
        density[1, c] = light[1, c] / upper
        odd = odd or not (abs(lower) >= _POINT_AREA) or not (abs(upper) >= _POINT_AREA)
    return _odd_triangles(below, above, light, density, acc) if odd else 0.0


@njit(cache=True, nogil=True)
def _odd_triangles(below: Array, above: Array, light: Array, density: Array, acc: Array) -> float:
    reflected = 0.0
    for c in range(light.shape[1]):
        for k in range(2):
            xa, ya, xd, yd = below[0, c], below[1, c], above[0, c + 1], above[1, c + 1]
            xm, ym = (below[0, c + 1], below[1, c + 1]) if k == 0 else (above[0, c], above[1, c])
            area = _area(xa, ya, xd, yd, xm, ym)
            if math.isnan(area):
                reflected += light[k, c]
                density[k, c] = 0.0
            elif abs(area) < _POINT_AREA:
                add_point(acc, (xa + xd + xm) / 3, (ya + yd + ym) / 3, light[k, c])
                density[k, c] = 0.0
    return reflected


@njit(cache=True, nogil=True)
def _pixels_of(hit: Array, ny: int, nx: int, pixel: NDArray[np.int64], corner: Array) -> None:
    """pixel (columns + 1,): where in the flat acc the pixel is that a ray hits, -1: none; corner (2, ..): its x, y."""
    for c in range(pixel.size):
        x, y = hit[0, c], hit[1, c]
        pixel[c] = -1
        if 0.0 <= x < nx and 0.0 <= y < ny:
            i, j = int(x), int(y)
            pixel[c] = j * (nx + 1) + i
            corner[0, c], corner[1, c] = i, j


@njit(cache=True, nogil=True, inline="always")
def _put(flat: Array, pixel: int, weight: float, share: float) -> None:
    """An edge's piece within a pixel: signed density x rise; share of it that the right neighbour takes on."""
    flat[pixel] += weight - weight * share
    flat[pixel + 1] += weight * share


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add_edge_between(
    acc: Array, flat: Array, pa: int, pb: int, la: float, lb: float, ja: float, jb: float,
    xa: float, ya: float, xb: float, yb: float, density: float,
) -> None:  # fmt: skip
    """One edge from pixel pa, whose corner is (la, ja), to pb: cut in two where they are neighbours, as most are."""
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
def _edges_of_row(
    below: Array, above: Array, p_below: NDArray[np.int64], p_above: NDArray[np.int64], k_below: Array, k_above: Array,
    density: Array, beneath: Array, acc: Array, flat: Array,
) -> None:  # fmt: skip
    """The edges of a row of squares that start on its lower side; beneath: densities of the triangles under it.

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
def follow_tubes(
    coefs: Array, x0: float, y0: float, dx: float, dy: float, row_lo: int, row_hi: int, sub: int,
    beam: Beam, aim: Aim, cover: Array, acc: Array,
) -> tuple[float, float]:  # fmt: skip
    """Add the tubes of cell rows row_lo .. row_hi - 1 to acc; returns their light and what of it was reflected.

    cover : (rows, cells) share of each cell that is lens; (1, 1) of 1 where all of it is
    """
    cells, rows = coefs.shape[1] - 3, coefs.shape[0] - 3
    columns, ny, nx = cells * sub, acc.shape[0], acc.shape[1] - 1
    even = not (beam.is_point or beam.is_mirror or beam.x != 0.0 or beam.y != 0.0 or beam.strength.size > 1)
    jet, light, density = np.empty((3, columns + 1)), np.empty((2, columns)), np.empty((2, columns))
    below, above = np.empty((2, columns + 1)), np.empty((2, columns + 1))
    face_below, face_above = np.empty((3, columns + 1)), np.empty((3, columns + 1))
    p_below, p_above = np.empty(columns + 1, dtype=np.int64), np.empty(columns + 1, dtype=np.int64)
    k_below, k_above = np.zeros((2, columns + 1)), np.zeros((2, columns + 1))
    beneath, shares, flat = np.zeros(columns), np.ones(cells), acc.reshape(-1)
    total = reflected = 0.0
    for k in range(row_lo * sub, row_hi * sub + 1):
        cell, y = min(k // sub, rows - 1), y0 + k / sub * dy
        _surface_row(coefs, cell, k / sub - cell, dx, dy, sub, jet)
        if even:
            _follow_vertical(jet, x0, dx / sub, y, beam.refractive_index, aim, above)
        else:
            _follow_beam(jet, x0, dx / sub, y, beam, aim, above, face_above)
        _pixels_of(above, ny, nx, p_above, k_above)
        if k > row_lo * sub:
            if cover.size > 1:
                shares = cover[(k - 1) // sub]
            if not even:
                _light_of_row(face_below, face_above, shares, sub, light)
            else:
                for c in range(columns):
                    light[:, c] = 0.5 * dx * dy / (sub * sub) * shares[c // sub]
            total += light.sum()
            reflected += _densities(below, above, light, density, acc)
            _edges_of_row(below, above, p_below, p_above, k_below, k_above, density, beneath, acc, flat)
        below, above = above, below
        face_below, face_above = face_above, face_below
        p_below, p_above = p_above, p_below
        k_below, k_above = k_above, k_below
    for c in range(columns):
        add_edge(acc, below[0, c], below[1, c], below[0, c + 1], below[1, c + 1], -beneath[c])
    return total, reflected
