"""Maps the departure of a milled surface from its lens, cell by cell. A finish levels this departure.

Theory of operation. The surface is the lower envelope of all balls along their paths. A ball cuts only near its contact
with the lens, within `reach_of` it, so each chord lowers the few places around its contact. In tight parts of the lens
the contact is not sharp, and where the ball does not fit there is none: places that stay high are computed again with
twice the reach. A cell is the mean of two places, each at random in one of two quarters of the cell that touch at their
corners. On a regular lattice of places, the grooves of rows would beat against the lattice and make false long waves;
random places instead make a little noise between neighbouring cells, which a finish levels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from cam.as_milled.facets import slopes_at_contact
from cam.as_milled.surface import reach_of
from cam.as_milled.tracks import Tracks
from cam.moves import Array
from optics.heightfield import Heightfield, spline_jet

_PER_CELL = 2  # places
_STRIPS = 4  # of rows of cells; a fixed number
_THREADS = 2
_MOST_REACH = 2.0  # in radii of the largest ball
_TALL = 4.0  # standard deviations; places that stay higher are computed again
_LONGEST_MM = 0.5  # longest chord for which one contact point is computed
_BLOCK_MM = 1.0  # of chords that are skipped together


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepartureMap:
    """departure_mm (ny, nx): mean height of each cell over the lens, 0 where nothing is cut; cells stand on a grid
    `finer` times as fine as the lens's vertices, and `beyond_cells` more of them around the aperture.
    """

    departure_mm: Array
    finer: int
    beyond_cells: int


class _Places(NamedTuple):
    """The lattice of places: place (j, i) lies in the rectangle of sides (dx, dy) whose corner is (x0 + i dx, y0 + j
    dy).
    """

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
    """Map one program or several, up to beyond_mm around the aperture; pitch_mm, error_mm as for `MilledSurface`."""
    dy, dx = heightfield.dy_mm / finer, heightfield.dx_mm / finer
    beyond = math.ceil(beyond_mm / min(dx, dy))
    ny, nx = ((axis.size - 1) * finer + 1 + 2 * beyond for axis in (heightfield.y_mm, heightfield.x_mm))
    radius_mm = max(one.radius_mm for one in tracks)
    lens = heightfield.spline_with_run_out(beyond_mm + radius_mm + 1.0).kernel_arguments
    corner = (float(heightfield.x_mm[0]) - (beyond + 0.5) * dx, float(heightfield.y_mm[0]) - (beyond + 0.5) * dy)
    places = _Places(*corner, dx / _PER_CELL, dy)
    chords = [one.divide(_LONGEST_MM) for one in tracks]
    reach_mm = reach_of(radius_mm, pitch_mm=pitch_mm, error_mm=error_mm)
    tall_mm = _TALL * error_mm + pitch_mm**2 / radius_mm
    bounds = np.linspace(0, ny, _STRIPS + 1).astype(int)
    departure = np.zeros((ny, nx))
    inner = slice(beyond * _PER_CELL, (nx - beyond) * _PER_CELL)

    def map_strip(number: int) -> None:
        first, last = int(bounds[number]), int(bounds[number + 1])
        low = np.full((last - first, nx * _PER_CELL), np.inf)
        lots = np.empty((*low.shape, 2), dtype=np.float32)
        _draw_lots(first, lots)
        rows = slice(max(0, beyond - first), max(0, ny - beyond - first))
        base = np.empty(low.shape)
        _draw_lens(lens, places, first, lots, base)
        reach, wanted = reach_mm, np.ones(low.shape, dtype=np.bool_)
        while True:
            onward = _find_next(wanted)
            for one in chords:
                near = _blocks_near(wanted, places, first, reach + one.radius_mm + _LONGEST_MM)
                _lower(one.tips_mm, one.joined, one.radius_mm, lens, reach, places, first, lots, near, onward, low)
            wanted &= low - base > tall_mm
            reach *= 2.0
            if reach > _MOST_REACH * radius_mm or not wanted[rows, inner].any():
                break
        low -= base
        cells = low.reshape(last - first, nx, _PER_CELL).mean(axis=2)
        departure[first:last] = np.where(np.isfinite(cells), cells, 0.0)

    with ThreadPoolExecutor(max_workers=_THREADS) as pool:
        list(pool.map(map_strip, range(_STRIPS)))
    return DepartureMap(departure_mm=departure, finer=finer, beyond_cells=beyond)


class _Blocks(NamedTuple):
    """near[row, column]: whether a wanted place is near that block of side `side`; blocks from (x0, y0) on."""

    near: NDArray[np.bool_]
    x0: float
    y0: float
    side: float


def _blocks_near(wanted: NDArray[np.bool_], places: _Places, first: int, margin_mm: float) -> _Blocks:
    """Return the blocks up to margin_mm from places wanted (ny, nx), rows from `first` on, and an unwanted ring
    around.
    """
    rows, columns = np.nonzero(wanted)
    ring = math.ceil(margin_mm / _BLOCK_MM) + 1
    at = [
        (index * step / _BLOCK_MM).astype(np.int64) + ring for index, step in ((rows, places.dy), (columns, places.dx))
    ]
    shape = [
        int(n * step / _BLOCK_MM) + 1 + 2 * ring for n, step in zip(wanted.shape, (places.dy, places.dx), strict=True)
    ]
    near = np.zeros(shape, dtype=np.bool_)
    near[at[0], at[1]] = True
    return _Blocks(
        near=maximum_filter(near, 2 * ring - 1, mode="constant"),
        x0=places.x0 - ring * _BLOCK_MM,
        y0=places.y0 + first * places.dy - ring * _BLOCK_MM,
        side=_BLOCK_MM,
    )


@njit(cache=True, nogil=True)
def _find_next(wanted):  # type: ignore[no-untyped-def]
    """Return (ny, nx + 1) the first column from each place on that is wanted, nx where there is none."""
    ny, nx = wanted.shape
    out = np.empty((ny, nx + 1), dtype=np.int32)
    for j in range(ny):
        out[j, nx] = nx
        for i in range(nx - 1, -1, -1):
            out[j, i] = i if wanted[j, i] else out[j, i + 1]
    return out


@njit(cache=True, nogil=True)
def _draw_lots(first, lots):  # type: ignore[no-untyped-def]
    """Draw random places in their halves of cells, from 0 to 1 in x and y (ny, nx, 2), rows from `first` on. They are
    the same for the same place (a hash finaliser, after Mueller), alternately in the lower and in the upper quarter.
    """
    for j in range(lots.shape[0]):
        for i in range(lots.shape[1]):
            h = np.uint64(first + j) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(i)
            h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            h = h ^ (h >> np.uint64(31))
            lots[j, i, 0] = float(h & np.uint64(0xFFFFFFFF)) / 4294967296.0
            upper = (i + i // 2 + first + j) % 2
            lots[j, i, 1] = 0.5 * (upper + float(h >> np.uint64(32)) / 4294967296.0)


@njit(cache=True, nogil=True)
def _lower(tips, joined, radius, lens, reach, places, first, lots, blocks, onward, low):  # type: ignore[no-untyped-def]
    """Lower places, of rows from `first` on, to the ball along its path; only those met in the direction `onward`."""
    ny, nx = low.shape
    px = py = 0.0
    steps = 8
    for k in range(1, joined.size):
        if not joined[k]:
            steps = 8
            continue
        ax, ay, az = tips[k - 1, 0], tips[k - 1, 1], tips[k - 1, 2]
        bx, by, bz = tips[k, 0], tips[k, 1], tips[k, 2]
        x, y = 0.5 * (ax + bx), 0.5 * (ay + by)
        row, column = int((y - blocks.y0) / blocks.side), int((x - blocks.x0) / blocks.side)
        if not (0 <= row < blocks.near.shape[0] and 0 <= column < blocks.near.shape[1] and blocks.near[row, column]):
            steps = 8
            continue
        px, py = (x, y) if steps == 8 else (px + bx - ax, py + by - ay)
        px, py, _, _ = slopes_at_contact(lens, x, y, radius, px, py, steps)
        steps = 2
        sx, sy = px - x, py - y
        length = math.hypot(bx - ax, by - ay)
        ex, ey, slope = (bx - ax) / length, (by - ay) / length, (bz - az) / length
        q = math.sqrt(1.0 + slope * slope)
        tilt = slope / q
        lowest, bulge = min(az, bz), 0.5 / radius
        j0 = max(0, int(math.floor((min(ay, by) + sy - reach - places.y0) / places.dy)) - first)
        j1 = min(ny - 1, int(math.floor((max(ay, by) + sy + reach - places.y0) / places.dy)) - first)
        low_y, high_y = min(ay, by) + sy, max(ay, by) + sy
        for j in range(j0, j1 + 1):
            y = places.y0 + (first + j + 0.5) * places.dy
            aside = max(0.0, low_y - y, y - high_y)
            half = math.sqrt(max(0.0, reach * reach - aside * aside))
            i0 = max(0, int(math.floor((min(ax, bx) + sx - half - places.x0) / places.dx)))
            i1 = min(nx - 1, int(math.floor((max(ax, bx) + sx + half - places.x0) / places.dx)))
            i = i0 - 1
            while i < i1:
                i = onward[j, i + 1]
                if i > i1:
                    break
                dx = places.x0 + (i + lots[j, i, 0]) * places.dx - ax
                dy = places.y0 + (first + j + lots[j, i, 1]) * places.dy - ay
                u, w = dx * ex + dy * ey, dx * ey - dy * ex
                off = max(0.0, -u, u - length)
                if lowest + bulge * (w * w + off * off) >= low[j, i]:
                    continue  # a ball lies above its parabola
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
def _draw_lens(lens, places, first, lots, out):  # type: ignore[no-untyped-def]
    """Fill in the heights of the lens (ny, nx) at the places, rows from `first` on."""
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            x = places.x0 + (i + lots[j, i, 0]) * places.dx
            y = places.y0 + (first + j + lots[j, i, 1]) * places.dy
            out[j, i] = spline_jet(lens[0], lens[1], lens[2], lens[3], lens[4], x, y)[0]
