"""The picture of a grid of heights, and its gradient with respect to each height, along which polish descends.

Theory of the gradient: the transpose of the derivative of a lens's picture (spread.py) by its heights. Of a picture
error r(pixel) = dE/dI, a tube with light f, area A on the screen and W = its integral of r contributes f W / A to dE.
With rho = f / A and rbar = W / A, moving its border by v gains  rho * integral over the border of (r - rbar) v . n ds,
so a tube within one pixel has no effect. W also comes from Green's formula: the integral of R dy along the border,
where R is r summed from the left.

The light of a tube is kept as it was for the first lens: even collimated light makes it the same for all tubes anyway,
and if it does depend on the heights, the changes by polish affect it by less than a percent of the effect of
refraction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit

from optics.bench import Bench
from optics.caustic import aim_at, find_covered_cells
from optics.heightfield import Heightfield
from optics.light import Beam
from optics.spline import Array
from optics.threads import run_on_rows, thread_count
from optics.tubes.lattice import fill_light, is_even, trace_rows
from optics.tubes.rays import fit_transposed, push_row
from optics.tubes.spread import POINT_AREA, spread_tubes, triangle_area

_STRIPS = 4  # fixed, so that sums do not depend on the machine's number of cores


class TubePicture:
    """Irradiance of a lens of given axes under a bundle of beams, and the transpose of its derivative by the heights.

    pixels         : (ny, nx) of the screen
    tubes_per_cell : tubes along each side of a heightfield cell
    beams          : of an extended light; the picture is their mean
    """

    def __init__(
        self, lens: Heightfield, bench: Bench, *, pixels: tuple[int, int], tubes_per_cell: int, beams: int
    ) -> None:
        self.lens, self.bench, self.pixels, self.sub = lens, bench, pixels, tubes_per_cell
        self.rows, self.columns = ((axis.size - 1) * tubes_per_cell for axis in (lens.y_mm, lens.x_mm))
        bounds = np.linspace(0, self.rows, _STRIPS + 1).astype(int)
        self.strips = [(int(lo), int(hi)) for lo, hi in pairwise(bounds)]
        self.aim = aim_at(bench, pixels)
        self.beams = bench.bundle(beams)
        self.spline = lens.spline()
        self.lights = self._lights()
        self.hits: tuple[Array, Array] | None = None  # of the beam, if there is only one

    def picture(self, z_mm: Array) -> Array:
        """Return (ny, nx) irradiance, in units of incident light / number of pixels, of heights z_mm at the
        vertices.
        """
        self.spline = Heightfield(x_mm=self.lens.x_mm, y_mm=self.lens.y_mm, z_mm=z_mm).spline()
        self.hits = None
        acc = np.zeros((self.pixels[0], self.pixels[1] + 1))
        for beam, light in zip(self.beams, self.lights, strict=True):
            hit_x, hit_y = self._trace(beam)

            def spread(strip: tuple[int, int], x: Array = hit_x, y: Array = hit_y, light: Array = light) -> Array:
                part = np.zeros((self.pixels[0], self.pixels[1] + 1))
                spread_tubes(*strip, x, y, light, part)
                return part

            for part in self._in_strips(spread):
                acc += part
        return np.asarray(np.cumsum(acc, axis=1)[:, :-1])

    def gain(self, r: Array) -> Array:
        """Return (vertices) sum over pixels of r dI / dz, at the heights of the last picture; r (ny, nx)."""
        summed = np.zeros((self.pixels[0], self.pixels[1] + 1))
        np.cumsum(r, axis=1, out=summed[:, 1:])
        by_coefs = np.zeros_like(self.spline.coefs)
        for beam, light in zip(self.beams, self.lights, strict=True):
            hit_x, hit_y = self._trace(beam)

            def pull(
                strip: tuple[int, int], x: Array = hit_x, y: Array = hit_y, light: Array = light, beam: Beam = beam
            ) -> Array:
                part = np.zeros_like(self.spline.coefs)
                rays = (*self._surface, self.sub, beam, self.aim.throw, self.aim.per_mm_x, self.aim.per_mm_y)
                arguments: tuple[Any, ...] = (*strip, x, y, light, r, summed, *rays, part)
                pull_tubes(*arguments)
                return part

            for part in self._in_strips(pull):
                by_coefs += part
        return fit_transposed(by_coefs)

    def sample_at_vertices(self, irradiance: Array) -> Array:
        """Return (vertices) the irradiance of the pixel that each vertex lights, or of the nearest pixel, at the last
        heights.
        """
        hit_x, hit_y = self._trace(self.beams[0])
        at = [
            np.clip(np.nan_to_num(hit[:: self.sub, :: self.sub]), 0, most - 1).astype(int)
            for hit, most in ((hit_y, self.pixels[0]), (hit_x, self.pixels[1]))
        ]
        return np.asarray(irradiance[at[0], at[1]])

    @property
    def _surface(self) -> tuple[Any, ...]:
        s = self.spline
        return s.coefs, s.x0_mm, s.y0_mm, s.dx_mm, s.dy_mm

    def _in_strips(self, work: Callable[[tuple[int, int]], Array]) -> list[Array]:
        with ThreadPoolExecutor(max_workers=min(thread_count(), _STRIPS)) as pool:
            return list(pool.map(work, self.strips))

    def _trace(self, beam: Beam) -> tuple[Array, Array]:
        if self.hits is not None:
            return self.hits
        hit_x, hit_y = (np.empty((self.rows + 1, self.columns + 1)) for _ in range(2))
        run_on_rows(trace_rows, self.rows + 1, *self._surface, self.sub, beam, self.aim, hit_x, hit_y)
        if len(self.beams) == 1:
            self.hits = hit_x, hit_y
        return hit_x, hit_y

    def _lights(self) -> list[Array]:
        """Return the light (rows, 2, columns) of each square's triangles per beam; (1, 1, 1) where all have the same.

        Together they give the mean pixel 1.
        """
        cover = find_covered_cells(self.lens, self.bench)
        whole = (self.rows, 2, self.columns)
        lights = [self._light(beam, cover) for beam in self.beams]
        total = sum(float(np.broadcast_to(light, whole).sum()) for light in lights)
        return [light * (self.pixels[0] * self.pixels[1] / total) for light in lights]

    def _light(self, beam: Beam, cover: Array) -> Array:
        dx, dy = self.lens.dx_mm / self.sub, self.lens.dy_mm / self.sub
        if is_even(beam) and cover.size == 1:
            return np.full((1, 1, 1), 0.5 * dx * dy)
        light = np.empty((self.rows, 2, self.columns))
        run_on_rows(fill_light, self.rows, *self._surface, self.sub, beam, self.aim, cover, light)
        return light


@njit(cache=True, nogil=True)
def _along_edge(r: Array, summed: Array, xa: float, ya: float, xb: float, yb: float) -> tuple[float, float, float]:
    """Return integrals along a -> b, s from 0 to 1: R dy, r (1 - s) ds, r s ds. summed (ny, nx + 1) is R: r from the
    left.
    """
    ny, nx = r.shape
    dx, dy = xb - xa, yb - ya
    i, j = int(math.floor(xa)), int(math.floor(ya))
    step_x, step_y = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    next_x = (i + (dx > 0.0) - xa) / dx if dx != 0.0 else math.inf
    next_y = (j + (dy > 0.0) - ya) / dy if dy != 0.0 else math.inf
    green = first = second = s = 0.0
    while True:
        end = min(next_x, next_y, 1.0)
        if 0 <= j < ny and i >= 0:
            if i >= nx:
                green += summed[j, nx] * (end - s)
            else:
                here = r[j, i]
                half = 0.5 * (end - s) * (end + s)
                green += (end - s) * (summed[j, i] + here * (xa + 0.5 * (s + end) * dx - i))
                second += here * half
                first += here * (end - s - half)
        if end >= 1.0:
            return green * dy, first, second
        s = end
        if next_x <= next_y:
            i += step_x
            next_x += abs(1.0 / dx)
        else:
            j += step_y
            next_y += abs(1.0 / dy)


@njit(cache=True, nogil=True)
def _pull_on_corners(
    r: Array, summed: Array, light: float, xa: float, ya: float, xb: float, yb: float, xc: float, yc: float
) -> tuple[float, float, float, float, float, float]:
    """Return the gain by moving the corners of one tube: (ax, ay, bx, by, cx, cy)."""
    area = triangle_area(xa, ya, xb, yb, xc, yc)
    if not math.isfinite(area) or abs(area) < POINT_AREA:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    i, j = math.floor(xa), math.floor(ya)
    if i == math.floor(xb) and i == math.floor(xc) and j == math.floor(yb) and j == math.floor(yc):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    ny, nx = r.shape
    if max(xa, xb, xc) <= 0.0 or min(xa, xb, xc) >= nx or max(ya, yb, yc) <= 0.0 or min(ya, yb, yc) >= ny:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    ab, ab0, ab1 = _along_edge(r, summed, xa, ya, xb, yb)
    bc, bc0, bc1 = _along_edge(r, summed, xb, yb, xc, yc)
    ca, ca0, ca1 = _along_edge(r, summed, xc, yc, xa, ya)
    rho = light / area
    half = 0.5 * (ab + bc + ca) / area
    ab0, ab1, bc0 = rho * (ab0 - half), rho * (ab1 - half), rho * (bc0 - half)
    bc1, ca0, ca1 = rho * (bc1 - half), rho * (ca0 - half), rho * (ca1 - half)
    return (
        ab0 * (yb - ya) + ca1 * (ya - yc),
        ab0 * (xa - xb) + ca1 * (xc - xa),
        ab1 * (yb - ya) + bc0 * (yc - yb),
        ab1 * (xa - xb) + bc0 * (xb - xc),
        bc1 * (yc - yb) + ca0 * (ya - yc),
        bc1 * (xb - xc) + ca0 * (xc - xa),
    )


@njit(cache=True, nogil=True)
def pull_tubes(
    row_lo: int, row_hi: int, hit_x: Array, hit_y: Array, light: Array, r: Array, summed: Array,
    coefs: Array, x0: float, y0: float, dx: float, dy: float, sub: int, beam: Beam, throw: float,
    inv_px: float, inv_py: float, by_coefs: Array,
) -> None:  # fmt: skip
    """Add to by_coefs (as coefs) the gain of tube rows row_lo..row_hi - 1, where the pixels' gain is r (ny, nx)."""
    columns = hit_x.shape[1] - 1
    below, above = np.zeros((2, columns + 1)), np.zeros((2, columns + 1))
    work = np.empty((4, coefs.shape[1]))
    many = light.shape[0] > 1
    for k in range(row_lo, row_hi):
        above[:] = 0.0
        for c in range(columns):
            xa, ya, xb, yb = hit_x[k, c], hit_y[k, c], hit_x[k, c + 1], hit_y[k, c + 1]
            xc, yc, xd, yd = hit_x[k + 1, c], hit_y[k + 1, c], hit_x[k + 1, c + 1], hit_y[k + 1, c + 1]
            own, other = (light[k, 0, c], light[k, 1, c]) if many else (light[0, 0, 0], light[0, 0, 0])
            lower = _pull_on_corners(r, summed, own, xa, ya, xb, yb, xd, yd)
            over = _pull_on_corners(r, summed, other, xa, ya, xd, yd, xc, yc)
            below[0, c] += lower[0] + over[0]
            below[1, c] += lower[1] + over[1]
            below[0, c + 1] += lower[2]
            below[1, c + 1] += lower[3]
            above[0, c + 1] += lower[4] + over[2]
            above[1, c + 1] += lower[5] + over[3]
            above[0, c] += over[4]
            above[1, c] += over[5]
        push_row(
            coefs, k, x0, y0, dx, dy, sub, beam, throw, inv_px, inv_py, below[0], below[1], by_coefs, work
        )  # fmt: skip
        below, above = above, below
    push_row(
        coefs, row_hi, x0, y0, dx, dy, sub, beam, throw, inv_px, inv_py, below[0], below[1], by_coefs, work
    )  # fmt: skip
