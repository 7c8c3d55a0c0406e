"""The picture that a grid of heights makes, and which way each height should move: what polish descends on."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit

from optics.bench import Bench
from optics.caustic import cells_covered
from optics.heightfield import Heightfield
from optics.light import Beam, meet, strength_on_face
from optics.spline import Array, BicubicSpline
from optics.threads import over_rows, thread_count
from optics.tubes.gradient import pull_tubes, spread_tubes
from optics.tubes.rays import fit_transposed, trace_rows

_STRIPS = 4  # a fixed number, so that sums do not depend on the machine's cores


class TubePicture:
    """Irradiance of a lens of given axes under a bundle of beams, and the transpose of its derivative by the heights.

    pixels         : (ny, nx) of the screen
    tubes_per_cell : tubes along each side of a heightfield cell
    beams          : of an extended light, whose mean the picture is
    """

    def __init__(
        self, lens: Heightfield, bench: Bench, *, pixels: tuple[int, int], tubes_per_cell: int, beams: int
    ) -> None:
        self.lens, self.bench, self.pixels, self.sub = lens, bench, pixels, tubes_per_cell
        self.rows, self.columns = ((axis.size - 1) * tubes_per_cell for axis in (lens.y_mm, lens.x_mm))
        bounds = np.linspace(0, self.rows, _STRIPS + 1).astype(int)
        self.strips = [(int(lo), int(hi)) for lo, hi in pairwise(bounds)]
        self.beams = bench.bundle(beams)
        spline = lens.spline()
        self.lights = [self._light(beam, spline) for beam in self.beams]
        self.spline = spline
        self.hits: tuple[Array, Array] | None = None  # of the one beam, where there is one

    def picture(self, z_mm: Array) -> Array:
        """(ny, nx) irradiance, in units of incident light / number of pixels, of heights z_mm at the vertices."""
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
        """(vertices) sum over pixels of r dI / dz, at the heights of the last picture; r (ny, nx)."""
        summed = np.zeros((self.pixels[0], self.pixels[1] + 1))
        np.cumsum(r, axis=1, out=summed[:, 1:])
        by_coefs = np.zeros_like(self.spline.coefs)
        for beam, light in zip(self.beams, self.lights, strict=True):
            hit_x, hit_y = self._trace(beam)

            def pull(
                strip: tuple[int, int], x: Array = hit_x, y: Array = hit_y, light: Array = light, beam: Beam = beam
            ) -> Array:
                part = np.zeros_like(self.spline.coefs)
                per_mm_x, per_mm_y = self._scale
                rays = (*self._surface, self.sub, beam, self.bench.throw_mm, per_mm_x, per_mm_y)
                arguments: tuple[Any, ...] = (*strip, x, y, light, r, summed, *rays, part)
                pull_tubes(*arguments)
                return part

            for part in self._in_strips(pull):
                by_coefs += part
        return fit_transposed(by_coefs)

    def seen_from_vertices(self, irradiance: Array) -> Array:
        """(vertices) irradiance (ny, nx) of the pixel that each one lights, or of the nearest, at the last heights."""
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

    @property
    def _scale(self) -> tuple[float, float]:
        """Pixels per mm of the screen."""
        screen = self.bench.screen
        return self.pixels[1] / screen.width_mm, self.pixels[0] / screen.height_mm

    def _in_strips(self, work: Callable[[tuple[int, int]], Array]) -> list[Array]:
        with ThreadPoolExecutor(max_workers=min(thread_count(), _STRIPS)) as pool:
            return list(pool.map(work, self.strips))

    def _trace(self, beam: Beam) -> tuple[Array, Array]:
        if self.hits is not None:
            return self.hits
        hit_x, hit_y = (np.empty((self.rows + 1, self.columns + 1)) for _ in range(2))
        over_rows(
            trace_rows, self.rows + 1, *self._surface, self.sub, beam, self.bench.throw_mm,
            self.bench.screen.left_mm, self.bench.screen.bottom_mm, *self._scale, hit_x, hit_y,
        )  # fmt: skip
        if len(self.beams) == 1:
            self.hits = hit_x, hit_y
        return hit_x, hit_y

    def _light(self, beam: Beam, spline: BicubicSpline) -> Array:
        """(rows, columns) light of each lattice quad, where the mean pixel gets 1; (1, 1) where all are even."""
        share = self.pixels[0] * self.pixels[1] / len(self.beams)
        cover = cells_covered(self.lens, self.bench)
        even = not beam.is_point and beam.x == beam.y == 0.0 and beam.strength.size == 1
        if even and cover.size == 1:
            return np.full((1, 1), share / (self.rows * self.columns))
        light = np.empty((self.rows, self.columns))
        x = np.linspace(self.lens.x_mm[0], self.lens.x_mm[-1], self.columns + 1)
        y = np.linspace(self.lens.y_mm[0], self.lens.y_mm[-1], self.rows + 1)
        _light_of_quads(beam, x, y, spline.heights_mm(x[None, :], y[:, None]), light)
        if cover.size > 1:
            light *= np.kron(cover, np.ones((self.sub, self.sub)))
        return np.asarray(light * (share / light.sum()))


@njit(cache=True, nogil=True)
def _light_of_quads(beam: Beam, x: Array, y: Array, z: Array, light: Array) -> None:
    """Strength on the face times the area there of each lattice quad; any scale."""
    rows, columns = light.shape
    face_x, face_y = np.empty((2, columns + 1)), np.empty((2, columns + 1))
    for j in range(rows + 1):
        now, last = j % 2, 1 - j % 2
        for i in range(columns + 1):
            _, _, _, _, face_x[now, i], face_y[now, i] = meet(beam, x[i], y[j], z[j, i])
        if j == 0:
            continue
        for i in range(columns):
            rise_x, rise_y = face_x[now, i + 1] - face_x[last, i], face_y[now, i + 1] - face_y[last, i]
            fall_x, fall_y = face_x[now, i] - face_x[last, i + 1], face_y[now, i] - face_y[last, i + 1]
            middle_x = 0.25 * (face_x[now, i] + face_x[now, i + 1] + face_x[last, i] + face_x[last, i + 1])
            middle_y = 0.25 * (face_y[now, i] + face_y[now, i + 1] + face_y[last, i] + face_y[last, i + 1])
            area = 0.5 * (rise_x * fall_y - fall_x * rise_y)
            light[j - 1, i] = area * strength_on_face(beam, middle_x, middle_y)
