"""The light of a lens on its wall for any set-up: traces the rays again for each set-up, and spreads tubes between them
on pixels.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.polynomial import legendre

from optics.bench import Bench
from optics.convolution import convolve_same
from optics.heightfield import Heightfield
from optics.spline import Array
from optics.tolerance import blur_mm, disc_kernel, source_rad, without_size
from optics.tubes.lattice import trace_rows
from optics.tubes.picture import TubePicture
from optics.tubes.spread import spread_tubes

# Low-order errors of a surface: orders of Legendre polynomials along x and y. (2, 0) stands for the difference of the
# two bows: their sum is a weak lens, which has the same effect on the picture as a wall at another distance, so that
# moving the wall undoes it.
ORDERS = ((2, 0), *((a, n - a) for n in (2, 3, 4) for a in range(n, -1, -1) if (a, n) not in ((2, 2), (0, 2))))
SETTINGS = 5 + len(ORDERS)
_LATTICE = 4  # rays along a side of a pixel
_FURTHER = 0.1  # of the throw: distance of a second plane that gives each ray's direction
_DISC_POINTS = 256


class WallRays:
    """One lens, seen on `shape` pixels of its screen and `rim` more on all sides.

    A setting (SETTINGS,) is the wall's additional distance [mm], the angles by which it leans away towards +x and +y,
    the tilt of the light towards +x and +y [rad], and the surface's error for each of ORDERS [um], as the factor of a
    polynomial that is 1 in the corner. All zeros: the bench as it is.
    """

    def __init__(self, lens: Heightfield, bench: Bench, shape: tuple[int, int], rim: int) -> None:
        ny, nx = shape
        self._pixels = ny + 2 * rim, nx + 2 * rim
        self._share = nx * ny / (self._pixels[0] * self._pixels[1])
        screen = bench.screen
        wider = replace(
            screen,
            width_mm=screen.width_mm * self._pixels[1] / nx,
            height_mm=screen.height_mm * self._pixels[0] / ny,
        )
        self._bench = replace(without_size(bench), screen=wider)
        self._lens = _coarser(lens, _LATTICE * max(shape))
        self._sub = max(1, round(_LATTICE * max(shape) / max(self._lens.z_mm.shape)))
        self._tubes = TubePicture(self._lens, self._bench, pixels=self._pixels, tubes_per_cell=self._sub, beams=1)
        x, y = (np.linspace(-1.0, 1.0, axis.size) for axis in (self._lens.x_mm, self._lens.y_mm))
        across, along = np.meshgrid(x, y)
        self._modes = np.stack([surface_mode(one, across, along, lens.height_mm / lens.width_mm) for one in ORDERS])
        source_mm = blur_mm(lens, bench, source_rad(lens, bench))
        self._source_px = source_mm * self._tubes.aim.per_mm_x, source_mm * self._tubes.aim.per_mm_y
        self._predicted = self._trace_hits(np.zeros(SETTINGS))

    def light(self, setting: Array) -> Array:
        """Return (ny + 2 rim, nx + 2 rim) irradiance in the work frame, in units of incident light / pixels of the
        screen.

        An affine mapping of the whole picture is removed, because the camera's position compensates for it.
        """
        hit_x, hit_y = self._predicted
        if setting.any():
            hit_x, hit_y = _without_affine(self._predicted, self._trace_hits(setting))
        acc = np.zeros((self._pixels[0], self._pixels[1] + 1))
        spread_tubes(0, hit_x.shape[0] - 1, hit_x, hit_y, self._tubes.lights[0], acc)
        light = np.asarray(np.cumsum(acc, axis=1)[:, :-1]) * self._share
        if min(self._source_px) == 0.0:
            return light
        return convolve_same(light, disc_kernel(*self._source_px, points=_DISC_POINTS))

    def width(self, setting: Array) -> float:
        """Return the width of the lit area relative to that on the bench as it is."""
        was, now = (
            float(np.nanmean(hits[0][:, -1] - hits[0][:, 0])) for hits in (self._predicted, self._trace_hits(setting))
        )
        return now / was

    def _trace_hits(self, setting: Array) -> tuple[Array, Array]:
        """Return (rows + 1, columns + 1) each: where the lattice's rays meet the wall [pixels]; NaN: reflected."""
        bench, aim, s = self._bench, self._tubes.aim, self._lens
        tilt_x, tilt_y = bench.light.tilt_rad
        light = replace(bench.light, tilt_rad=(tilt_x + setting[3], tilt_y + setting[4]))
        beam = replace(bench, light=light).beam()
        error_mm = 1e-3 * np.tensordot(setting[5:], self._modes, 1)
        spline = Heightfield(x_mm=s.x_mm, y_mm=s.y_mm, z_mm=s.z_mm + error_mm).spline()
        surface = spline.coefs, spline.x0_mm, spline.y0_mm, spline.dx_mm, spline.dy_mm
        further_mm = _FURTHER * bench.throw_mm
        near, far = (np.empty((2, self._tubes.rows + 1, self._tubes.columns + 1)) for _ in range(2))
        trace_rows(0, near.shape[1], *surface, self._sub, beam, aim, near[0], near[1])
        beyond = aim._replace(throw=aim.throw + further_mm)
        trace_rows(0, near.shape[1], *surface, self._sub, beam, beyond, far[0], far[1])
        slope = (far - near) / further_mm
        lean_x, lean_y = math.tan(setting[1]) / aim.per_mm_x, math.tan(setting[2]) / aim.per_mm_y
        rise_mm = setting[0] + lean_x * (near[0] - self._pixels[1] / 2) + lean_y * (near[1] - self._pixels[0] / 2)
        way_mm = rise_mm / (1.0 - lean_x * slope[0] - lean_y * slope[1])
        return near[0] + way_mm * slope[0], near[1] + way_mm * slope[1]


def surface_mode(order: tuple[int, int], x: Array, y: Array, shape: float) -> Array:
    """Return one of ORDERS at points from -1 to 1 from rim to rim of an aperture of that shape (height / width)."""
    (a, b) = order
    if order == (2, 0):
        return np.asarray(_polynomial(2, x) - shape**2 * _polynomial(2, y))
    return np.asarray(_polynomial(a, x) * _polynomial(b, y))


def _polynomial(order: int, x: Array) -> Array:
    """Return Legendre's polynomial of one order, 1 at x = 1."""
    return np.asarray(legendre.legval(x, [0.0] * order + [1.0]))


def _coarser(lens: Heightfield, most: int) -> Heightfield:
    """Return the same surface on at most that many cells along a side: quick, and still finer than its pixels."""
    cells = [min(axis.size - 1, most) for axis in (lens.x_mm, lens.y_mm)]
    if cells == [lens.x_mm.size - 1, lens.y_mm.size - 1]:
        return lens
    x_mm, y_mm = (np.linspace(axis[0], axis[-1], n + 1) for axis, n in zip((lens.x_mm, lens.y_mm), cells, strict=True))
    z_mm = lens.spline().jets(*np.meshgrid(x_mm, y_mm))[0]
    return Heightfield(x_mm=x_mm, y_mm=y_mm, z_mm=z_mm)


def _without_affine(before: tuple[Array, Array], after: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return `after` under the affine mapping that brings it nearest to `before`, over all rays alike."""
    stride = max(1, before[0].shape[0] // 48), max(1, before[0].shape[1] // 48)
    x, y, u, v = (one[:: stride[0], :: stride[1]].ravel() for one in (*before, *after))
    known = np.isfinite(x + y + u + v)
    middle = float(u[known].mean()), float(v[known].mean())
    frame = np.stack([np.ones(int(known.sum())), u[known] - middle[0], v[known] - middle[1]], axis=1)
    (cx, ax, bx), (cy, ay, by) = np.linalg.lstsq(frame, np.stack([x[known], y[known]], axis=1), rcond=None)[0].T
    du, dv = after[0] - middle[0], after[1] - middle[1]
    return cx + ax * du + bx * dv, cy + ay * du + by * dv
