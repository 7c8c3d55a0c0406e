"""The picture that a grid of heights makes, and which way each height should move: what polish descends on."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np

from optics.bench import Bench
from optics.caustic import aim_at, find_covered_cells
from optics.heightfield import Heightfield
from optics.light import Beam
from optics.spline import Array
from optics.threads import run_on_rows, thread_count
from optics.tubes.gradient import pull_tubes
from optics.tubes.lattice import fill_light, is_even, trace_rows
from optics.tubes.rays import fit_transposed
from optics.tubes.spread import spread_tubes

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
        self.aim = aim_at(bench, pixels)
        self.beams = bench.bundle(beams)
        self.spline = lens.spline()
        self.lights = self._lights()
        self.hits: tuple[Array, Array] | None = None  # of the one beam, where there is one

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

    def seen_from_vertices(self, irradiance: Array) -> Array:
        """Return (vertices) irradiance (ny, nx) of the pixel that each one lights, or of the nearest, at the last
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
