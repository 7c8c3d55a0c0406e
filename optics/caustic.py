"""Forward model: the light that a heightfield throws on a screen, by flux tubes.

The aperture is cut into small triangles (tubes_per_cell x tubes_per_cell x 2 in each cell of the heightfield). Each
one's corners are refracted exactly on the C2 spline, and its light is spread evenly over the triangle that they span
on the screen, by exact area overlap with the pixels. No photons, so no noise; folds add up as they do in nature.

Overlap by Green's formula: a triangle's coverage of the pixels is a sum over its directed edges, so each lattice edge
is walked once with the difference of the two densities beside it, and a prefix sum along the rows ends the work.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit

from optics.bench import Bench
from optics.heightfield import Heightfield
from optics.refraction import refracted_tangent
from optics.spline import Array, spline_weights

_STRIPS = 4  # a fixed number, so that sums do not depend on the machine's cores
_POINT_AREA = 1e-10  # a tube focused on less than this [pixels] falls on one point


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Caustic:
    """irradiance (ny, nx) in the work frame (row 0 = lowest y), in units of incident flux / number of pixels."""

    irradiance: Array
    outside_share: float  # of the incident flux, beside the screen
    reflected_share: float  # of the incident flux, totally reflected


@njit(cache=True, nogil=True)
def add_edge(acc: Array, xa: float, ya: float, xb: float, yb: float, density: float) -> None:
    """Add density x (coverage to the right of the directed edge a -> b, negative when it goes up) to acc.

    acc (ny, nx + 1) holds row-wise differences; a cumulative sum along x makes pixels of it. Coordinates in pixels.
    """
    if density == 0.0 or abs(yb - ya) < 1e-14 or not math.isfinite(density):
        return
    if math.isnan(xa) or math.isnan(xb):
        return
    ny = acc.shape[0]
    nx = acc.shape[1] - 1
    if xa >= nx and xb >= nx:
        return
    # fast path: one pixel
    ja, ia = int(math.floor(ya)), int(math.floor(xa))
    jb, ib = int(math.floor(yb)), int(math.floor(xb))
    if ja == jb and ia == ib and 0 <= ia < nx:
        if 0 <= ja < ny:
            w = -density * (yb - ya)
            f = 0.5 * (xa + xb) - ia
            acc[ja, ia] += w * (1.0 - f)
            acc[ja, ia + 1] += w * f
        return
    sign = -density
    if ya > yb:
        xa, ya, xb, yb = xb, yb, xa, ya
        sign = density
    if yb <= 0.0 or ya >= ny:
        return
    run = (xb - xa) / (yb - ya)
    y = max(ya, 0.0)
    x = xa + (y - ya) * run if y > ya else xa
    y_end = min(yb, float(ny))
    while y < y_end:
        j = min(int(math.floor(y)), ny - 1)
        y1 = min(float(j + 1), y_end)
        x1 = xb if y1 == yb else xa + (y1 - ya) * run
        _add_in_row(acc[j], x, x1, sign * (y1 - y), nx)
        x, y = x1, y1


@njit(cache=True, nogil=True)
def _add_in_row(row: Array, xa: float, xb: float, weight: float, nx: int) -> None:
    """An edge's piece inside one pixel row; weight = signed density x rise, shared along the run in proportion."""
    lo, hi = min(xa, xb), max(xa, xb)
    if lo >= nx:
        return
    if hi <= 0.0:
        row[0] += weight
        return
    if hi - lo < 1e-12:
        i = min(int(math.floor(lo)), nx - 1)
        if i < 0:
            row[0] += weight
            return
        f = min(lo - i, 1.0)
        row[i] += weight * (1.0 - f)
        row[i + 1] += weight * f
        return
    per_unit = weight / (hi - lo)
    if lo < 0.0:
        row[0] += -lo * per_unit
        lo = 0.0
    end = min(hi, float(nx))
    while lo < end:
        i = min(int(math.floor(lo)), nx - 1)
        step_end = min(float(i + 1), end)
        w = per_unit * (step_end - lo)
        f = 0.5 * (lo + step_end) - i
        row[i] += w * (1.0 - f)
        row[i + 1] += w * f
        lo = step_end


@njit(cache=True, nogil=True)
def _add_point(acc: Array, x: float, y: float, flux: float) -> None:
    j, i = int(math.floor(y)), int(math.floor(x))
    if 0 <= j < acc.shape[0] and 0 <= i < acc.shape[1] - 1:
        acc[j, i] += flux
        acc[j, i + 1] -= flux


@njit(cache=True, nogil=True, inline="always")
def _density(xa: float, ya: float, xb: float, yb: float, xc: float, yc: float, flux: float) -> float:
    """Light per pixel area of one tube; negative when the tube arrives turned over, so that its coverage counts up.

    NaN: reflected. Infinite: focused on a point.
    """
    area = 0.5 * ((xb - xa) * (yc - ya) - (xc - xa) * (yb - ya))
    if abs(area) < _POINT_AREA:
        return math.inf
    return flux / area


@njit(cache=True, nogil=True)
def _lattice_row(
    coefs: Array, cell_row: int, fraction: float, dx: float, dy: float, sub: int, first_x: float,
    throw: float, index: float, left: float, bottom: float, y: float, inv_px: float, inv_py: float,
    hit_x: Array, hit_y: Array,
) -> None:  # fmt: skip
    """Where on the screen [pixels] the rays of one row of lattice points arrive."""
    cells = coefs.shape[1] - 3
    g = fraction
    wy = spline_weights(g)
    dw = (-0.5 * (1 - g) ** 2, 1.5 * g * g - 2 * g, -1.5 * (1 - g) ** 2 + 2 * (1 - g), 0.5 * g * g)
    n = cells + 3
    value = np.empty(n)
    slope = np.empty(n)
    for i in range(n):
        c0, c1 = coefs[cell_row, i], coefs[cell_row + 1, i]
        c2, c3 = coefs[cell_row + 2, i], coefs[cell_row + 3, i]
        value[i] = wy[0] * c0 + wy[1] * c1 + wy[2] * c2 + wy[3] * c3
        slope[i] = (dw[0] * c0 + dw[1] * c1 + dw[2] * c2 + dw[3] * c3) / dy
    for s in range(sub):
        f = s / sub
        w0, w1, w2, w3 = spline_weights(f)
        d0, d1 = -0.5 * (1 - f) ** 2 / dx, (1.5 * f * f - 2 * f) / dx
        d2, d3 = (-1.5 * (1 - f) ** 2 + 2 * (1 - f)) / dx, 0.5 * f * f / dx
        last = cells + 1 if s == 0 else cells
        for i in range(last):
            if i < cells:
                v0, v1, v2, v3 = value[i], value[i + 1], value[i + 2], value[i + 3]
                z = w0 * v0 + w1 * v1 + w2 * v2 + w3 * v3
                zx = d0 * v0 + d1 * v1 + d2 * v2 + d3 * v3
                zy = w0 * slope[i] + w1 * slope[i + 1] + w2 * slope[i + 2] + w3 * slope[i + 3]
            else:  # the rim: fraction 1 of the last cell
                v1, v2, v3 = value[i], value[i + 1], value[i + 2]
                z = (v1 + 4 * v2 + v3) / 6
                zx = (v3 - v1) / (2 * dx)
                zy = (slope[i] + 4 * slope[i + 1] + slope[i + 2]) / 6
            reach = (throw - z) * refracted_tangent(zx * zx + zy * zy, index)
            x = first_x + (i + f) * dx
            hit_x[i * sub + s] = (x + reach * zx - left) * inv_px
            hit_y[i * sub + s] = (y + reach * zy - bottom) * inv_py


@njit(cache=True, nogil=True)
def _splat(
    coefs: Array, x0: float, y0: float, dx: float, dy: float, row_lo: int, row_hi: int, sub: int,
    throw: float, index: float, left: float, bottom: float, inv_px: float, inv_py: float, flux: float,
    acc: Array,
) -> float:  # fmt: skip
    """Add the tubes of cell rows row_lo..row_hi - 1 to acc; returns the flux that was totally reflected."""
    columns = (coefs.shape[1] - 3) * sub
    below_x, below_y = np.empty(columns + 1), np.empty(columns + 1)
    above_x, above_y = np.empty(columns + 1), np.empty(columns + 1)
    upper = np.zeros(columns)  # densities of the triangles that end on the lattice row below
    reflected = 0.0
    rows = coefs.shape[0] - 3
    first = True
    for k in range(row_lo * sub, row_hi * sub + 1):
        cell = min(k // sub, rows - 1)
        _lattice_row(
            coefs, cell, k / sub - cell, dx, dy, sub, x0, throw, index, left, bottom,
            y0 + k / sub * dy, inv_px, inv_py, above_x, above_y,
        )  # fmt: skip
        if not first:
            previous_right = 0.0  # density left of the next vertical edge
            for c in range(columns):
                xa, ya, xb, yb = below_x[c], below_y[c], below_x[c + 1], below_y[c + 1]
                xc, yc, xd, yd = above_x[c], above_y[c], above_x[c + 1], above_y[c + 1]
                lower = _density(xa, ya, xb, yb, xd, yd, flux)  # triangle a b d
                over = _density(xa, ya, xd, yd, xc, yc, flux)  # triangle a d c
                if not math.isfinite(lower):
                    if math.isnan(lower):
                        reflected += flux
                    else:
                        _add_point(acc, (xa + xb + xd) / 3, (ya + yb + yd) / 3, flux)
                    lower = 0.0
                if not math.isfinite(over):
                    if math.isnan(over):
                        reflected += flux
                    else:
                        _add_point(acc, (xa + xc + xd) / 3, (ya + yc + yd) / 3, flux)
                    over = 0.0
                add_edge(acc, xa, ya, xb, yb, lower - upper[c])
                add_edge(acc, xa, ya, xd, yd, over - lower)
                add_edge(acc, xa, ya, xc, yc, previous_right - over)
                previous_right = lower
                upper[c] = over
            add_edge(acc, below_x[columns], below_y[columns], above_x[columns], above_y[columns], previous_right)
        first = False
        below_x, above_x = above_x, below_x
        below_y, above_y = above_y, below_y
    for c in range(columns):
        add_edge(acc, below_x[c], below_y[c], below_x[c + 1], below_y[c + 1], -upper[c])
    return reflected


def simulate_caustic(
    heightfield: Heightfield,
    bench: Bench,
    *,
    pixels: tuple[int, int],
    tubes_per_cell: int = 4,
) -> Caustic:
    """Irradiance that the light of the bench makes on its screen by way of the heightfield.

    pixels         : (ny, nx) of the screen
    tubes_per_cell : tubes along each side of a heightfield cell; fewer than 4 flatter the score
    """
    ny, nx = pixels
    screen = bench.screen
    spline = heightfield.spline()
    cell_rows = heightfield.y_mm.size - 1
    cells = cell_rows * (heightfield.x_mm.size - 1)
    flux = ny * nx / (2 * cells * tubes_per_cell**2)  # of one triangle, where the mean pixel gets 1
    bounds = np.linspace(0, cell_rows, _STRIPS + 1).astype(int)

    def splat(strip: int) -> tuple[Array, float]:
        acc = np.zeros((ny, nx + 1))
        reflected = _splat(
            spline.coefs, spline.x0_mm, spline.y0_mm, spline.dx_mm, spline.dy_mm,
            int(bounds[strip]), int(bounds[strip + 1]), tubes_per_cell,
            bench.throw_mm, bench.refractive_index, screen.left_mm, screen.bottom_mm,
            nx / screen.width_mm, ny / screen.height_mm, flux, acc,
        )  # fmt: skip
        return acc, reflected

    with ThreadPoolExecutor(max_workers=2) as pool:
        parts = list(pool.map(splat, range(_STRIPS)))
    acc = np.sum([part[0] for part in parts], axis=0)
    irradiance = np.cumsum(acc, axis=1)[:, :nx]
    reflected_share = sum(part[1] for part in parts) / (ny * nx)
    outside = 1.0 - float(irradiance.sum()) / (ny * nx) - reflected_share
    return Caustic(irradiance=irradiance, outside_share=outside, reflected_share=reflected_share)
