"""Forward model: the light that a heightfield throws on a screen, by flux tubes.

The aperture is cut into small triangles (tubes_per_cell x tubes_per_cell x 2 in each cell of the heightfield). The
rays through each one's corners are followed exactly, on the C2 spline, and its light is spread evenly over the triangle
that they span on the screen, by exact area overlap with the pixels. No photons, so no noise; folds add up as they do in
nature. Not followed: light that meets the surface twice, and light that a lens surface reflects instead of
transmitting.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from optics.bench import Bench
from optics.block import lower_by_back
from optics.heightfield import Heightfield
from optics.light import Beam
from optics.spline import Array, BicubicSpline
from optics.threads import thread_count
from optics.tubes.edges import polygon_coverage
from optics.tubes.lattice import Aim, follow_tubes

_STRIPS = 4  # a fixed number, so that sums do not depend on the machine's cores
BEAMS = 19  # of light from a disc; 5 of several colours: `Bench.bundle`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Caustic:
    """irradiance (ny, nx) in the work frame (row 0 = lowest y), in units of incident light / number of pixels.

    Incident is the light that meets the lens (within its outline, if it has one).
    """

    irradiance: Array
    outside_share: float  # of the incident light, beside the screen
    reflected_share: float  # of the incident light, totally reflected


def simulate_caustic(
    heightfield: Heightfield,
    bench: Bench,
    *,
    pixels: tuple[int, int],
    tubes_per_cell: int = 4,
    beams: int = BEAMS,
) -> Caustic:
    """Return the irradiance on the bench's screen from its light through the heightfield.

    pixels         : (ny, nx) of the screen
    tubes_per_cell : tubes along each side of a heightfield cell; fewer than 4 flatter the score
    beams          : number of beams for light from a disc; `Bench.bundle`
    """
    ny, nx = pixels
    light, total, reflected = _trace_light(
        heightfield,
        bench,
        find_covered_cells(heightfield, bench),
        pixels=pixels,
        tubes_per_cell=tubes_per_cell,
        beams=beams,
    )
    irradiance = bench.add_haze(light * (ny * nx / total))
    outside = 1.0 - float(irradiance.mean()) - reflected / total
    return Caustic(irradiance=irradiance, outside_share=outside, reflected_share=reflected / total)


def share_by_way_of(
    cells: Array,
    heightfield: Heightfield,
    bench: Bench,
    *,
    pixels: tuple[int, int],
    tubes_per_cell: int = 4,
    beams: int = BEAMS,
) -> Array:
    """Return (ny, nx) share of each pixel's light that comes through those cells of the heightfield; 0 if the pixel is
    dark.

    cells : (rows, columns) share of each cell that counts
    """
    cover = find_covered_cells(heightfield, bench)
    own, whole = (
        _trace_light(heightfield, bench, part, pixels=pixels, tubes_per_cell=tubes_per_cell, beams=beams)[0]
        for part in (cells * cover, cover)
    )
    return np.asarray(np.clip(np.divide(own, whole, out=np.zeros(pixels), where=whole > 0.0), 0.0, 1.0))


def _trace_light(
    heightfield: Heightfield, bench: Bench, cover: Array, *, pixels: tuple[int, int], tubes_per_cell: int, beams: int
) -> tuple[Array, float, float]:
    """Return light (ny, nx) on the screen, the light that met the lens and the part of it that was reflected, in the
    units of `_add_beam`.

    cover : share of each cell that is lens
    """
    ny, nx = pixels
    acc, spline = np.zeros((ny, nx + 1)), lower_by_back(heightfield, bench.back).spline()
    total = reflected = 0.0
    with ThreadPoolExecutor(max_workers=thread_count()) as pool:
        for beam in bench.bundle(beams):
            light, lost = _add_beam(pool, spline, beam, aim_at(bench, pixels), cover, tubes_per_cell, acc)
            total += light
            reflected += lost
    return np.cumsum(acc, axis=1)[:, :nx], total, reflected


def _add_beam(
    pool: ThreadPoolExecutor, spline: BicubicSpline, beam: Beam, aim: Aim, cover: Array, sub: int, acc: Array
) -> tuple[float, float]:
    """Add one beam's light to acc; return its amount and the amount that was reflected."""
    bounds = np.linspace(0, spline.coefs.shape[0] - 3, _STRIPS + 1).astype(int)

    def strip(number: int) -> tuple[Array, float, float]:
        part = np.zeros_like(acc)
        lo, hi = int(bounds[number]), int(bounds[number + 1])
        light, lost = follow_tubes(
            spline.coefs, spline.x0_mm, spline.y0_mm, spline.dx_mm, spline.dy_mm, lo, hi, sub, beam, aim, cover, part
        )
        return part, light, lost

    total = reflected = 0.0
    for part, light, lost in pool.map(strip, range(_STRIPS)):
        acc += part
        total += light
        reflected += lost
    return total, reflected


def aim_at(bench: Bench, pixels: tuple[int, int]) -> Aim:
    """Return the bench's screen of (ny, nx) pixels in the form of the kernels."""
    screen = bench.screen
    return Aim(
        throw=float(bench.throw_mm),
        left=float(screen.left_mm),
        bottom=float(screen.bottom_mm),
        per_mm_x=pixels[1] / screen.width_mm,
        per_mm_y=pixels[0] / screen.height_mm,
    )


def find_covered_cells(heightfield: Heightfield, bench: Bench) -> Array:
    """Return the share of each cell of the heightfield within the outline; (1, 1) of 1 without an outline."""
    if bench.outline_mm is None:
        return np.ones((1, 1))
    corner = np.array([heightfield.x_mm[0], heightfield.y_mm[0]])
    cells = (np.asarray(bench.outline_mm) - corner) / (heightfield.dx_mm, heightfield.dy_mm)
    return polygon_coverage(cells, (heightfield.y_mm.size - 1, heightfield.x_mm.size - 1))
