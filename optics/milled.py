"""Simulates light through a milled surface of many small facets, each facet's light separately.

A facet is a small plane or curved quadrilateral, given by place and slope at its corners. The rays through its corners
are followed exactly; its light is spread evenly over the polygon that they span on the screen, by exact coverage of the
pixels. The light of neighbouring facets across a track lands far apart (a groove of radius R throws light over pitch /
R x the distance to the wall), so points would give noise, while areas are exact. Facets are cut off at the aperture's
rectangle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit

from optics.bench import Bench
from optics.block import lower_facets_by_back
from optics.caustic import Caustic, aim_at, find_covered_cells
from optics.heightfield import Heightfield
from optics.light import Beam, leave, meet, strength_on_face
from optics.spline import Array
from optics.threads import thread_count
from optics.tubes.edges import add_edge, add_point
from optics.tubes.lattice import Aim
from optics.tubes.spread import POINT_AREA

_STRIPS = 8  # a fixed number, so that sums do not depend on the machine's cores
_BEAMS = 7  # for light from a disc: grooves spread it more than that
_MOST_CORNERS = 8  # of a quadrilateral cut by a rectangle


def simulate_milled(
    part: Callable[[int], Array],
    parts: int,
    heightfield: Heightfield,
    bench: Bench,
    *,
    pixels: tuple[int, int],
    on_progress: Callable[[float], None] | None = None,
) -> Caustic:
    """Return the irradiance on the screen from the bench's light through the facets part(0) .. part(parts - 1).

    part        : (n, 4, 5) corners in order around, each x, y, z [mm] and slopes in x and y
    heightfield : the ideal lens, for the aperture and its outline
    """
    aim, bundle, cover = aim_at(bench, pixels), bench.bundle(_BEAMS), find_covered_cells(heightfield, bench)
    cells = (heightfield.dx_mm, heightfield.dy_mm) if cover.size > 1 else (1.0, 1.0)
    bounds = np.linspace(0, parts, _STRIPS + 1).astype(int)
    done = [0] * _STRIPS

    def strip(number: int) -> tuple[Array, float, float]:
        acc = np.zeros((pixels[0], pixels[1] + 1))
        total = lost = 0.0
        for index in range(int(bounds[number]), int(bounds[number + 1])):
            facets = lower_facets_by_back(part(index), bench.back)
            for beam in bundle:
                light, reflected = _paint(facets, bench.width_mm, bench.height_mm, beam, aim, cover, *cells, acc)
                total += light
                lost += reflected
            done[number] += 1
            if on_progress is not None:
                on_progress(sum(done) / parts)
        return acc, total, lost

    with ThreadPoolExecutor(max_workers=thread_count()) as pool:
        strips = list(pool.map(strip, range(_STRIPS)))
    total, reflected = sum(light for _, light, _ in strips), sum(lost for _, _, lost in strips)
    nx = pixels[1]
    light = np.cumsum(sum(acc for acc, _, _ in strips), axis=1)[:, :nx] * (pixels[0] * nx / total)
    irradiance = bench.add_haze(light)
    outside = 1.0 - float(irradiance.mean()) - reflected / total
    return Caustic(irradiance=irradiance, outside_share=outside, reflected_share=reflected / total)


@njit(cache=True, nogil=True)
def _cut(corners, count, axis, sign, limit, out):  # type: ignore[no-untyped-def]
    """Return the part of a convex polygon (count, 5) with sign * coordinate <= sign * limit; its number of corners."""
    kept = 0
    for k in range(count):
        n = k + 1 if k + 1 < count else 0
        a = sign * (corners[k, axis] - limit)
        b = sign * (corners[n, axis] - limit)
        if a <= 0.0:
            for d in range(5):
                out[kept, d] = corners[k, d]
            kept += 1
        if (a < 0.0 < b) or (b < 0.0 < a):
            share = a / (a - b)
            for d in range(5):
                out[kept, d] = corners[k, d] + share * (corners[n, d] - corners[k, d])
            kept += 1
    return kept


@njit(cache=True, nogil=True)
def _within(corners, count, width, height, spare):  # type: ignore[no-untyped-def]
    """Return a polygon cut to the aperture, in place; its number of corners."""
    inside = True
    for k in range(count):
        x, y = corners[k, 0], corners[k, 1]
        inside = inside and 0.0 <= x <= width and 0.0 <= y <= height
    if inside:
        return count
    for axis in range(2):
        count = _cut(corners, count, axis, -1.0, 0.0, spare)
        count = _cut(spare, count, axis, 1.0, height if axis else width, corners)
    return count


@njit(cache=True, nogil=True)
def polygon_area(x, y, count):  # type: ignore[no-untyped-def]
    twice = 0.0
    for k in range(count):
        n = k + 1 if k + 1 < count else 0
        twice += (x[k] - x[0]) * (y[n] - y[0]) - (x[n] - x[0]) * (y[k] - y[0])
    return 0.5 * twice


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(acc, x, y, area, light):  # type: ignore[no-untyped-def]
    """Spread light evenly over a polygon of that signed area, or onto a point if the area is zero."""
    if abs(area) < POINT_AREA:
        add_point(acc, x[0], y[0], light)
        return
    for k in range(x.size):
        n = k + 1 if k + 1 < x.size else 0
        add_edge(acc, x[k], y[k], x[n], y[n], light / area)


@njit(cache=True, nogil=True, error_model="numpy")
def spread_polygon(acc, x, y, count, light):  # type: ignore[no-untyped-def]
    """Spread light evenly over a polygon on the screen [pixels]; False if a corner is NaN: no light arrives.

    A quadrilateral whose sides cross is spread as its two triangles, half of the light each: its own area would cancel.
    """
    area = polygon_area(x, y, count)
    if math.isnan(area):
        return False
    first = polygon_area(x, y, 3)
    if count == 4 and first * (area - first) < 0.0:
        _spread(acc, x[:3], y[:3], first, 0.5 * light)
        x[1], y[1] = x[0], y[0]
        _spread(acc, x[1:4], y[1:4], area - first, 0.5 * light)
    else:
        _spread(acc, x[:count], y[:count], area, light)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _paint(
    facets: Array, width: float, height: float, beam: Beam, aim: Aim, cover: Array, dx: float, dy: float, acc: Array
) -> tuple[float, float]:
    """Add one beam's light through the facets to acc; return its amount and the part of it that was reflected."""
    room = 2 * _MOST_CORNERS
    corners, spare = np.empty((room, 5)), np.empty((room, 5))
    hit_x, hit_y, face_x, face_y = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
    four = facets.shape[1]  # a plain 4 is another type for numba: all would be compiled twice
    total = lost = 0.0
    for f in range(facets.shape[0]):
        for k in range(4):
            for d in range(5):
                corners[k, d] = facets[f, k, d]
        count = _within(corners, four, width, height, spare)
        if count < 3:
            continue
        strength = 0.0
        for k in range(count):
            x, y, z = corners[k, 0], corners[k, 1], corners[k, 2]
            tx, ty, tz, _, face_x[k], face_y[k] = meet(beam, x, y, z)
            tx, ty, tz = leave(tx, ty, tz, corners[k, 3], corners[k, 4], beam.refractive_index, beam.is_mirror)
            reach = (aim.throw - z) / tz
            hit_x[k] = (x + reach * tx - aim.left) * aim.per_mm_x
            hit_y[k] = (y + reach * ty - aim.bottom) * aim.per_mm_y
            strength += strength_on_face(beam, face_x[k], face_y[k])
        light = strength / count * abs(polygon_area(face_x, face_y, count))
        if cover.size > 1:
            i = min(max(int(0.5 * (corners[0, 0] + corners[2, 0]) / dx), 0), cover.shape[1] - 1)
            j = min(max(int(0.5 * (corners[0, 1] + corners[2, 1]) / dy), 0), cover.shape[0] - 1)
            light *= cover[j, i]
        if light == 0.0:
            continue
        total += light
        if not spread_polygon(acc, hit_x, hit_y, count, light):
            lost += light
    return total, lost
