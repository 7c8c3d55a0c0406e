"""How far a milled surface departs from its lens, cell by cell: what a finish levels.

Theory of operation. The surface is the lowest of all balls on their ways. A ball cuts near its contact with the lens
only, within `reach_of` it, so each chord lowers the few places around its contact; a place of the aperture that no
contact comes near (a valley where the ball does not fit) is asked for again with twice the reach. A cell is the mean of
four places, each anywhere in its quarter by lot: on a lattice of places the grooves of rows would beat against it and
make long waves where there are none; so they make a little noise between neighbouring cells, which a finish levels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from cam.as_milled.facets import slopes_at_contact
from cam.as_milled.surface import reach_of
from cam.as_milled.tracks import Tracks
from cam.moves import Array
from optics.heightfield import Heightfield, spline_jet

_PER_CELL = 2  # places along a side
_STRIPS = 8  # of rows of cells; a fixed number
_THREADS = 2
_LEAST_REACH, _MOST_REACH = 0.1, 2.0  # in radii of the largest ball; where a lens is tight the contact is not sharp
_LONGEST_MM = 0.5  # of a chord whose contact is looked up once


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepartureMap:
    """departure_mm (ny, nx): mean height of each cell over the lens, 0 where nothing is cut; cells stand on a grid
    `finer` times as fine as the lens's vertices, and `beyond_cells` more of them around the aperture. cut_share: of the
    aperture.
    """

    departure_mm: Array
    finer: int
    beyond_cells: int
    cut_share: float


class _Places(NamedTuple):
    """Where places are: place (j, i) lies in the rectangle of sides (dx, dy) whose corner is (x0 + i dx, y0 + j dy)."""

    x0: float
    y0: float
    dx: float
    dy: float


def map_departure(
    tracks: Sequence[Tracks],
    heightfield: Heightfield,
    *,
    pitch_mm: float,
    error_mm: float = 0.0,
    finer: int = 2,
    beyond_mm: float = 0.0,
) -> DepartureMap:
    """Of one program or several, up to beyond_mm around the aperture; pitch_mm, error_mm as for `MilledSurface`."""
    dy, dx = heightfield.dy_mm / finer, heightfield.dx_mm / finer
    beyond = math.ceil(beyond_mm / min(dx, dy))
    ny, nx = ((axis.size - 1) * finer + 1 + 2 * beyond for axis in (heightfield.y_mm, heightfield.x_mm))
    radius_mm = max(one.radius_mm for one in tracks)
    lens = heightfield.spline_with_run_out(beyond_mm + radius_mm + 1.0).kernel_arguments
    corner = (float(heightfield.x_mm[0]) - (beyond + 0.5) * dx, float(heightfield.y_mm[0]) - (beyond + 0.5) * dy)
    places = _Places(*corner, dx / _PER_CELL, dy / _PER_CELL)
    chords = [one.divided(_LONGEST_MM) for one in tracks]
    reach_mm = max(reach_of(radius_mm, pitch_mm=pitch_mm, error_mm=error_mm), _LEAST_REACH * radius_mm)
    bounds = np.linspace(0, ny, _STRIPS + 1).astype(int)
    departure, is_cut = np.zeros((ny, nx)), np.zeros((ny, nx), dtype=np.bool_)
    inner = slice(beyond * _PER_CELL, (nx - beyond) * _PER_CELL)

    def strip(number: int) -> None:
        first, last = int(bounds[number]), int(bounds[number + 1])
        low = np.full(((last - first) * _PER_CELL, nx * _PER_CELL), np.inf)
        rows = slice(max(0, (beyond - first) * _PER_CELL), max(0, (ny - beyond - first) * _PER_CELL))
        reach = reach_mm
        while True:
            wanted = np.isinf(low)
            for one in chords:
                _lower(one.tips_mm, one.joined, one.radius_mm, lens, reach, places, first * _PER_CELL, wanted, low)
            reach *= 2.0
            if reach > _MOST_REACH * radius_mm or np.isfinite(low[rows, inner]).all():
                break
        _subtract_lens(low, lens, places, first * _PER_CELL)
        cells = low.reshape(last - first, _PER_CELL, nx, _PER_CELL).mean(axis=(1, 3))
        is_cut[first:last] = np.isfinite(cells)
        departure[first:last] = np.where(is_cut[first:last], cells, 0.0)

    with ThreadPoolExecutor(max_workers=_THREADS) as pool:
        list(pool.map(strip, range(_STRIPS)))
    aperture = is_cut[beyond : ny - beyond, beyond : nx - beyond]
    return DepartureMap(departure_mm=departure, finer=finer, beyond_cells=beyond, cut_share=float(aperture.mean()))


@njit(cache=True, nogil=True)
def _lot(j, i):  # type: ignore[no-untyped-def]
    """Two numbers from 0 to 1, the same for the same place (a finaliser of hashes, after Mueller)."""
    h = np.uint64(j) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(i)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    h = h ^ (h >> np.uint64(31))
    return float(h & np.uint64(0xFFFFFFFF)) / 4294967296.0, float(h >> np.uint64(32)) / 4294967296.0


@njit(cache=True, nogil=True)
def _lower(tips, joined, radius, lens, reach, places, first, wanted, low):  # type: ignore[no-untyped-def]
    """Lower places, of rows from `first` on, to the ball on its way; only where wanted."""
    ny, nx = low.shape
    px = py = 0.0
    steps = 8
    for k in range(1, joined.size):
        if not joined[k]:
            steps = 8
            continue
        ax, ay, az = tips[k - 1, 0], tips[k - 1, 1], tips[k - 1, 2]
        bx, by, bz = tips[k, 0], tips[k, 1], tips[k, 2]
        margin = reach + radius
        j_most = (max(ay, by) + margin - places.y0) / places.dy - first
        j_least = (min(ay, by) - margin - places.y0) / places.dy - first
        if j_most < 0.0 or j_least > ny:
            steps = 8
            continue
        x, y = 0.5 * (ax + bx), 0.5 * (ay + by)
        if steps == 8:
            px, py = x, y
        px, py, _, _ = slopes_at_contact(lens, x, y, radius, px, py, steps)
        steps = 3
        sx, sy = px - x, py - y
        length = math.hypot(bx - ax, by - ay)
        ex, ey, slope = (bx - ax) / length, (by - ay) / length, (bz - az) / length
        q = math.sqrt(1.0 + slope * slope)
        tilt = slope / q
        j0 = max(0, int(math.floor((min(ay, by) + sy - reach - places.y0) / places.dy)) - first)
        j1 = min(ny - 1, int(math.floor((max(ay, by) + sy + reach - places.y0) / places.dy)) - first)
        i0 = max(0, int(math.floor((min(ax, bx) + sx - reach - places.x0) / places.dx)))
        i1 = min(nx - 1, int(math.floor((max(ax, bx) + sx + reach - places.x0) / places.dx)))
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                if not wanted[j, i]:
                    continue
                lot_x, lot_y = _lot(first + j, i)
                dx = places.x0 + (i + lot_x) * places.dx - ax
                dy = places.y0 + (first + j + lot_y) * places.dy - ay
                u, w = dx * ex + dy * ey, dx * ey - dy * ex
                rho2 = radius * radius - w * w
                if rho2 <= 0.0:
                    continue
                s = u - math.sqrt(rho2) * tilt
                if s <= 0.0:
                    r2, z = rho2 - u * u, az
                elif s >= length:
                    r2, z = rho2 - (u - length) * (u - length), bz
                else:
                    r2, z = rho2 * q * q, az + slope * u
                if r2 > 0.0:
                    low[j, i] = min(low[j, i], z + radius - math.sqrt(r2))


@njit(cache=True, nogil=True)
def _subtract_lens(low, lens, places, first):  # type: ignore[no-untyped-def]
    for j in range(low.shape[0]):
        for i in range(low.shape[1]):
            lot_x, lot_y = _lot(first + j, i)
            x, y = places.x0 + (i + lot_x) * places.dx, places.y0 + (first + j + lot_y) * places.dy
            low[j, i] -= spline_jet(lens[0], lens[1], lens[2], lens[3], lens[4], x, y)[0]
