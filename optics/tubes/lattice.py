"""Flux tubes: traces the light through a lens as triangles, one row of lattice points after the other.

The lens is cut by a lattice of `sub` x `sub` squares in each of its cells, each square into two triangles. A row of the
lattice is: the surface there, where its rays arrive on the screen (in pixels), and how much light each triangle holds.
spread.py makes a picture of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from optics.light import Beam, leave, meet, strength_on_face
from optics.refraction import tangent_per_slope
from optics.spline import Array, slope_weights, spline_weights
from optics.tubes.spread import add_edges, close_off, fill_densities, fill_pixels, triangle_area


class Aim(NamedTuple):
    """The screen in the form of the kernels: mm above Z0, lower left corner, pixels per mm."""

    throw: float
    left: float
    bottom: float
    per_mm_x: float
    per_mm_y: float


@njit(cache=True, nogil=True)
def combine_rows(coefs: Array, cell: int, g: float, dy: float, value: Array, slope: Array) -> None:
    """Compute coefficients along x of the surface, and of its slope in y, at fraction g of a row of cells."""
    w0, w1, w2, w3 = spline_weights(g)
    d0, d1, d2, d3 = slope_weights(g)
    for i in range(coefs.shape[1]):
        c0, c1, c2, c3 = coefs[cell, i], coefs[cell + 1, i], coefs[cell + 2, i], coefs[cell + 3, i]
        value[i] = w0 * c0 + w1 * c1 + w2 * c2 + w3 * c3
        slope[i] = (d0 * c0 + d1 * c1 + d2 * c2 + d3 * c3) / dy


@njit(cache=True, nogil=True)
def _fill_surface_row(coefs: Array, cell: int, g: float, dx: float, dy: float, sub: int, jet: Array) -> None:
    """Compute jet (3, columns + 1): height and both slopes on the lattice row at fraction g of a row of cells."""
    cells = coefs.shape[1] - 3
    value, slope = np.empty(cells + 3), np.empty(cells + 3)
    combine_rows(coefs, cell, g, dy, value, slope)
    z, zx, zy = jet[0], jet[1], jet[2]
    for s in range(sub):
        f = s / sub
        w0, w1, w2, w3 = spline_weights(f)
        d0, d1, d2, d3 = slope_weights(f)
        for i in range(cells):
            v0, v1, v2, v3 = value[i], value[i + 1], value[i + 2], value[i + 3]
            z[i * sub + s] = w0 * v0 + w1 * v1 + w2 * v2 + w3 * v3
            zx[i * sub + s] = (d0 * v0 + d1 * v1 + d2 * v2 + d3 * v3) / dx
            zy[i * sub + s] = w0 * slope[i] + w1 * slope[i + 1] + w2 * slope[i + 2] + w3 * slope[i + 3]
    rim = cells * sub  # fraction 1 of the last cell
    z[rim] = (value[cells] + 4 * value[cells + 1] + value[cells + 2]) / 6
    zx[rim] = (value[cells + 2] - value[cells]) / (2 * dx)
    zy[rim] = (slope[cells] + 4 * slope[cells + 1] + slope[cells + 2]) / 6


@njit(cache=True, nogil=True)
def _follow_vertical(jet: Array, x0: float, step: float, y: float, index: float, aim: Aim, hit: Array) -> None:
    """Compute hit (2, columns + 1): where even, vertical light through a lattice row arrives [pixels]; NaN:
    reflected.
    """
    for c in range(jet.shape[1]):
        z, zx, zy = jet[0, c], jet[1, c], jet[2, c]
        reach = (aim.throw - z) * tangent_per_slope(zx * zx + zy * zy, index)
        hit[0, c] = (x0 + c * step + reach * zx - aim.left) * aim.per_mm_x
        hit[1, c] = (y + reach * zy - aim.bottom) * aim.per_mm_y


@njit(cache=True, nogil=True)
def _follow_beam(jet: Array, x0: float, step: float, y: float, beam: Beam, aim: Aim, hit: Array, face: Array) -> None:
    """Compute hit for any beam, and face (3, columns + 1): where the rays crossed the face [mm], the strength there."""
    for c in range(jet.shape[1]):
        x, z = x0 + c * step, jet[0, c]
        dx, dy, dz, _, face_x, face_y = meet(beam, x, y, z)
        tx, ty, tz = leave(dx, dy, dz, jet[1, c], jet[2, c], beam.refractive_index, beam.is_mirror)
        reach = (aim.throw - z) / tz
        hit[0, c] = (x + reach * tx - aim.left) * aim.per_mm_x
        hit[1, c] = (y + reach * ty - aim.bottom) * aim.per_mm_y
        face[0, c], face[1, c], face[2, c] = face_x, face_y, strength_on_face(beam, face_x, face_y)


@njit(cache=True, nogil=True)
def _fill_light_row(below: Array, above: Array, cover: Array, sub: int, light: Array) -> None:
    """Compute light (2, columns) of triangles a b d and a d c of each square: face area x mean strength x covered
    share.
    """
    for c in range(light.shape[1]):
        xa, ya, xb, yb = below[0, c], below[1, c], below[0, c + 1], below[1, c + 1]
        xc, yc, xd, yd = above[0, c], above[1, c], above[0, c + 1], above[1, c + 1]
        share = cover[c // sub] / 3.0
        shared = below[2, c] + above[2, c + 1]
        light[0, c] = share * (shared + below[2, c + 1]) * max(triangle_area(xa, ya, xb, yb, xd, yd), 0.0)
        light[1, c] = share * (shared + above[2, c]) * max(triangle_area(xa, ya, xd, yd, xc, yc), 0.0)


@njit(cache=True, nogil=True)
def is_even(beam: Beam) -> bool:
    """Return whether the light through the lens is even and vertical, so that each square of the lattice has the same
    share.
    """
    return not (beam.is_point or beam.is_mirror or beam.x != 0.0 or beam.y != 0.0 or beam.strength.size > 1)


@njit(cache=True, nogil=True)
def trace_rows(
    row_lo: int, row_hi: int, coefs: Array, x0: float, y0: float, dx: float, dy: float, sub: int,
    beam: Beam, aim: Aim, hit_x: Array, hit_y: Array,
) -> None:  # fmt: skip
    """Compute hit_x, hit_y (rows + 1, columns + 1): where lattice rows row_lo..row_hi - 1 light the screen; NaN: not.

    The same rays as follow_tubes follows, for callers that need them again.
    """
    columns, rows = hit_x.shape[1] - 1, coefs.shape[0] - 3
    jet, hit, face = np.empty((3, columns + 1)), np.empty((2, columns + 1)), np.empty((3, columns + 1))
    even = is_even(beam)
    for k in range(row_lo, row_hi):
        cell, y = min(k // sub, rows - 1), y0 + k / sub * dy
        _fill_surface_row(coefs, cell, k / sub - cell, dx, dy, sub, jet)
        if even:
            _follow_vertical(jet, x0, dx / sub, y, beam.refractive_index, aim, hit)
        else:
            _follow_beam(jet, x0, dx / sub, y, beam, aim, hit, face)
        hit_x[k], hit_y[k] = hit[0], hit[1]


@njit(cache=True, nogil=True)
def fill_light(
    row_lo: int, row_hi: int, coefs: Array, x0: float, y0: float, dx: float, dy: float, sub: int,
    beam: Beam, aim: Aim, cover: Array, light: Array,
) -> None:  # fmt: skip
    """Compute light (rows, 2, columns) of the triangles of lattice squares row_lo..row_hi - 1, as in follow_tubes."""
    columns, rows = light.shape[2], coefs.shape[0] - 3
    jet, hit, shares = np.empty((3, columns + 1)), np.empty((2, columns + 1)), np.ones(columns // sub)
    below, above = np.empty((3, columns + 1)), np.empty((3, columns + 1))
    for k in range(row_lo, row_hi + 1):
        cell = min(k // sub, rows - 1)
        _fill_surface_row(coefs, cell, k / sub - cell, dx, dy, sub, jet)
        _follow_beam(jet, x0, dx / sub, y0 + k / sub * dy, beam, aim, hit, above)
        if k > row_lo:
            if cover.size > 1:
                shares = cover[(k - 1) // sub]
            _fill_light_row(below, above, shares, sub, light[k - 1])
        below, above = above, below


@njit(cache=True, nogil=True)
def follow_tubes(
    coefs: Array, x0: float, y0: float, dx: float, dy: float, row_lo: int, row_hi: int, sub: int,
    beam: Beam, aim: Aim, cover: Array, acc: Array,
) -> tuple[float, float]:  # fmt: skip
    """Add the tubes of cell rows row_lo .. row_hi - 1 to acc; return their light and the part of it that was reflected.

    cover : (rows, cells) share of each cell that is lens; (1, 1) of 1 where all of it is
    """
    cells, rows = coefs.shape[1] - 3, coefs.shape[0] - 3
    columns, ny, nx = cells * sub, acc.shape[0], acc.shape[1] - 1
    even = is_even(beam)
    jet, light, density = np.empty((3, columns + 1)), np.empty((2, columns)), np.empty((2, columns))
    below, above = np.empty((2, columns + 1)), np.empty((2, columns + 1))
    face_below, face_above = np.empty((3, columns + 1)), np.empty((3, columns + 1))
    p_below, p_above = np.empty(columns + 1, dtype=np.int64), np.empty(columns + 1, dtype=np.int64)
    k_below, k_above = np.zeros((2, columns + 1)), np.zeros((2, columns + 1))
    beneath, shares, flat = np.zeros(columns), np.ones(cells), acc.reshape(-1)
    total = reflected = 0.0
    for k in range(row_lo * sub, row_hi * sub + 1):
        cell, y = min(k // sub, rows - 1), y0 + k / sub * dy
        _fill_surface_row(coefs, cell, k / sub - cell, dx, dy, sub, jet)
        if even:
            _follow_vertical(jet, x0, dx / sub, y, beam.refractive_index, aim, above)
        else:
            _follow_beam(jet, x0, dx / sub, y, beam, aim, above, face_above)
        fill_pixels(above, ny, nx, p_above, k_above)
        if k > row_lo * sub:
            if cover.size > 1:
                shares = cover[(k - 1) // sub]
            if not even:
                _fill_light_row(face_below, face_above, shares, sub, light)
            else:
                for c in range(columns):
                    light[:, c] = 0.5 * dx * dy / (sub * sub) * shares[c // sub]
            total += light.sum()
            reflected += fill_densities(below, above, light, density, acc)
            add_edges(below, above, p_below, p_above, k_below, k_above, density, beneath, acc, flat)
        below, above = above, below
        face_below, face_above = face_above, face_below
        p_below, p_above = p_above, p_below
        k_below, k_above = k_above, k_below
    close_off(below, beneath, acc)
    return total, reflected
