"""Rounds heights to a mill's steps for a lens that will be finished: later tracks compensate for each error.

Sanding or polishing is a low pass on heights. Rounding errors must therefore be high in frequency, not small: an axis
can only stand on whole steps, so where the lens is nearly level all tracks step at the same place and leave a terrace,
one step high and as wide as a step over the slope, which no finish removes. As in a delta-sigma converter, the error of
each track is stored and the next tracks aim higher or lower by it, so that their mean is right and the error alternates
from track to track. The order of the tracks does not matter, so this works for rows and contours alike.

Memory: a plane of cells that keep error times length, read with a Gaussian that is wide across the track and narrow
along it. The errors include the axis's whole steps within a move (`Tracks` omits these: for a lens as milled only
slopes matter, see `as_milled.stepping`; for a finished one, heights). They also include the effect of the ball: of two
tracks at distance p and height difference d, the higher one loses R d^2 / 2p of its volume to the lower one, and all
but a ridge if d is above p^2 / 2R. So a track that is higher than its neighbours counts less; a second plane, with the
error of the last track at each place, serves to compute that.

A track is at most one step below the lens: half a step by its aim, half by rounding. Memory grows with the region, not
with the path.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from cam.moves import Array, Path
from cam.rows.rounding import LOWEST_DIGITS, Rounding, choose_vertices, on_raster

AIM_DIGITS = 0.5
"""How far the aim may be off the path; with `LOWEST_DIGITS` the most that a vertex is below it."""

ACROSS_MM, ALONG_MM = 0.25, 0.15
"""Sigma of the Gaussian. Errors alternate within some ACROSS_MM, well under the periods that a finish leaves."""

CELL_MM = 0.1
LONGEST_MM = 0.15
"""Longest move before vertices are chosen: on a flat lens, moves of a millimetre leave no places for steps."""

_DETAIL_MM = 0.1  # two errors this close along a track cancel: sets the weight of a vertex's height against its slope
_SAMPLE_MM = 0.02  # spacing along a track at which its error is stored
_FARTHEST = 2.2  # sigmas
_PER_SQUARE = 512  # entries of the Gaussian, for each square of a sigma
_GAUSSIAN = np.exp(-0.5 * (np.arange(math.ceil(_FARTHEST**2) * _PER_SQUARE) + 0.5) / _PER_SQUARE)
_NEIGHBOUR_CELL_MM = 0.035
_CELLS_ASIDE = math.sqrt(2.0)  # at this distance sideways, another cell begins in any direction
_TURN_RAD = math.pi / 4  # a track that has turned this far may soon run beside itself
_MOST_AT_ONCE = 1024
_UNKNOWN = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapedRegion:
    """Where the tracks run, from low_mm to high_mm (x, y), and the ball that runs them."""

    low_mm: tuple[float, float]
    high_mm: tuple[float, float]
    radius_mm: float


class ErrorMemory(NamedTuple):
    """The memory in the form of the kernels.

    owed (ny, nx)  : error of height times length of track, by cells of CELL_MM from (x0, y0) [mm^2]
    last (my, mx)  : error of the last track in each cell of `beside / sqrt 2` [mm]; _UNKNOWN where none has been
    beside, hidden : sideways distance at which the neighbouring track is looked up; p^2 / 2R [mm]
    step           : of Z [mm]
    """

    owed: Any
    last: Any
    x0: float
    y0: float
    beside: float
    hidden: float
    step: float

    @classmethod
    def over(cls, region: ShapedRegion, rounding: Rounding) -> ErrorMemory:
        low, high = np.array(region.low_mm) - CELL_MM, np.array(region.high_mm) + CELL_MM
        beside_mm = max(rounding.pitch_mm, _CELLS_ASIDE * _NEIGHBOUR_CELL_MM)
        columns, rows = np.ceil((high - low) / CELL_MM).astype(int)
        fine_columns, fine_rows = np.ceil((high - low) / (beside_mm / _CELLS_ASIDE)).astype(int)
        return cls(
            owed=np.zeros((rows, columns)),
            last=np.full((fine_rows, fine_columns), _UNKNOWN, dtype=np.float32),
            x0=float(low[0]),
            y0=float(low[1]),
            beside=beside_mm,
            hidden=rounding.pitch_mm**2 / (2 * region.radius_mm),
            step=rounding.digits.z_mm,
        )


def shape_heights(paths: Iterable[Path], rounding: Rounding, region: ShapedRegion) -> Iterator[Path]:
    """Yield the same cuts with every vertex on the raster and errors that a finish removes; rapids as `on_raster`."""
    return on_raster(paths, rounding, partial(_place, ErrorMemory.over(region, rounding), rounding))


def _place(memory: ErrorMemory, rounding: Rounding, line: Array, start: Array) -> Array:
    xy_mm = rounding.digits.xy_mm
    divided = _divide(line, xy_mm)
    out = np.empty((len(divided), 4))
    return out[: _follow(memory, divided, start, xy_mm, rounding.aside_mm, out), :3]


def _divide(line: Array, shortest_mm: float) -> Array:
    """Divide the line (n, 3) into moves of at most LONGEST_MM, with no points closer together than the raster can
    state: between two such points the aim may jump, and the height of a place that is rounded past both would be
    undefined.
    """
    kept = np.zeros(len(line), dtype=np.bool_)
    _keep_apart(line, shortest_mm, kept)
    line = line[kept]
    runs = np.hypot(*np.diff(line[:, :2], axis=0).T)
    parts = np.maximum(1, np.ceil(runs / LONGEST_MM - 1e-9)).astype(np.int64)
    k = np.repeat(np.arange(parts.size), parts)
    share = (np.arange(k.size) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[k]
    return np.concatenate([line[k] + share[:, None] * (line[k + 1] - line[k]), line[-1:]])


@njit(cache=True, nogil=True)
def _keep_apart(line, shortest_mm, kept):  # type: ignore[no-untyped-def]
    """Mark the first point, the last, and those between that lie far enough apart."""
    last, end = 0, line.shape[0] - 1
    kept[0] = kept[end] = True
    for k in range(1, end):
        far = math.hypot(line[k, 0] - line[last, 0], line[k, 1] - line[last, 1])
        left = math.hypot(line[end, 0] - line[k, 0], line[end, 1] - line[k, 1])
        if far >= shortest_mm and left >= shortest_mm:
            kept[k] = True
            last = k


@njit(cache=True, nogil=True)
def _error_owed(m, x, y, ux, uy):  # type: ignore[no-untyped-def]
    """Sum the errors of the tracks around (x, y), each weighted by its distance from a track in direction (ux, uy)
    [mm].
    """
    reach = int(math.ceil(_FARTHEST * max(ACROSS_MM, ALONG_MM) / CELL_MM))
    column, row = int((x - m.x0) / CELL_MM), int((y - m.y0) / CELL_MM)
    total = 0.0
    for j in range(max(0, row - reach), min(m.owed.shape[0], row + reach + 1)):
        dy = m.y0 + (j + 0.5) * CELL_MM - y
        for i in range(max(0, column - reach), min(m.owed.shape[1], column + reach + 1)):
            dx = m.x0 + (i + 0.5) * CELL_MM - x
            along, across = (dx * ux + dy * uy) / ALONG_MM, (dy * ux - dx * uy) / ACROSS_MM
            square = along * along + across * across
            if square < _FARTHEST**2:
                total += m.owed[j, i] * _GAUSSIAN[int(square * _PER_SQUARE)]
    return total / (math.sqrt(2.0 * math.pi) * ALONG_MM)


@njit(cache=True, nogil=True)
def _take_error(m, error, x, y, ux, uy):  # type: ignore[no-untyped-def]
    """Return the effective error of a track after the mutual cutting with its neighbours; store it as the last one
    here.
    """
    cell = m.beside / _CELLS_ASIDE
    left = error
    for side in (-1.0, 1.0):
        column = int((x - side * uy * m.beside - m.x0) / cell)
        row = int((y + side * ux * m.beside - m.y0) / cell)
        if 0 <= column < m.last.shape[1] and 0 <= row < m.last.shape[0] and m.last[row, column] < _UNKNOWN:
            apart = abs(error - m.last[row, column])
            left -= 0.25 * apart**2 / m.hidden if apart < m.hidden else 0.5 * apart - 0.25 * m.hidden
    column, row = int((x - m.x0) / cell), int((y - m.y0) / cell)
    if 0 <= column < m.last.shape[1] and 0 <= row < m.last.shape[0]:
        m.last[row, column] = error
    return left


@njit(cache=True, nogil=True)
def _remember(m, line, made, count):  # type: ignore[no-untyped-def]
    """Store the errors of a line (n, 3) that was made as `count` vertices (n, 4), the first at its beginning."""
    k, begin, way = 0, 0.0, 0.5 * _SAMPLE_MM
    for i in range(line.shape[0] - 1):
        dx, dy = line[i + 1, 0] - line[i, 0], line[i + 1, 1] - line[i, 1]
        run = math.hypot(dx, dy)
        while way < begin + run:
            while k < count - 2 and made[k + 1, 3] <= way:
                k += 1
            part, share = (way - begin) / run, (way - made[k, 3]) / (made[k + 1, 3] - made[k, 3])
            height = made[k, 2] + min(1.0, share) * (made[k + 1, 2] - made[k, 2])
            stands = math.floor(height / m.step + 0.5) * m.step  # the axis, within the move
            error = stands - line[i, 2] - part * (line[i + 1, 2] - line[i, 2])
            x, y = line[i, 0] + part * dx, line[i, 1] + part * dy
            left = _take_error(m, error, x, y, dx / run, dy / run)
            column, row = int((x - m.x0) / CELL_MM), int((y - m.y0) / CELL_MM)
            if 0 <= column < m.owed.shape[1] and 0 <= row < m.owed.shape[0]:
                m.owed[row, column] += _SAMPLE_MM * left
            way += _SAMPLE_MM
        begin += run


@njit(cache=True, nogil=True)
def _place_nearest(line, xy_mm, z_mm, out):  # type: ignore[no-untyped-def]
    way = 0.0
    for i in range(1, line.shape[0]):
        way += math.hypot(line[i, 0] - line[i - 1, 0], line[i, 1] - line[i - 1, 1])
        out[i - 1, 0] = math.floor(line[i, 0] / xy_mm + 0.5) * xy_mm
        out[i - 1, 1] = math.floor(line[i, 1] / xy_mm + 0.5) * xy_mm
        out[i - 1, 2] = math.floor(line[i, 2] / z_mm + 0.5) * z_mm
        out[i - 1, 3] = way
    return line.shape[0] - 1


@njit(cache=True, nogil=True)
def _follow(m, line, start, xy_mm, aside_mm, out):  # type: ignore[no-untyped-def]
    """Write vertices of line (n, 3) after its first point, which stands at start, into out (n, 4); return their number.

    It works piece by piece, so that a track that turns back finds its own earlier errors in the memory.
    """
    n, count, first = line.shape[0], 0, 0
    aim, made = np.empty((_MOST_AT_ONCE + 1, 3)), np.empty((_MOST_AT_ONCE + 2, 4))
    at = start.copy()
    while first < n - 1:
        heading = math.atan2(line[first + 1, 1] - line[first, 1], line[first + 1, 0] - line[first, 0])
        last = first + 1
        while last < n - 1 and last - first < _MOST_AT_ONCE:
            way = math.atan2(line[last + 1, 1] - line[last, 1], line[last + 1, 0] - line[last, 0])
            if abs((way - heading + math.pi) % (2.0 * math.pi) - math.pi) > _TURN_RAD:
                break
            last += 1
        size = last - first + 1
        for i in range(size):
            k = first + i
            before, after = max(k - 1, first), min(k + 1, last)
            dx, dy = line[after, 0] - line[before, 0], line[after, 1] - line[before, 1]
            run = math.hypot(dx, dy)
            off = -_error_owed(m, line[k, 0], line[k, 1], dx / run, dy / run)
            aim[i] = line[k]
            aim[i, 2] += min(max(off, -AIM_DIGITS * m.step), AIM_DIGITS * m.step)
        lowest, weight = -LOWEST_DIGITS * m.step - 1e-9, 2.0 / _DETAIL_MM**2
        found = choose_vertices(aim[:size], at, xy_mm, m.step, weight, lowest, aside_mm, made[1:])
        if found == 0:  # moves too short for the raster of X and Y
            found = _place_nearest(aim[:size], xy_mm, m.step, made[1:])
        made[0, 0], made[0, 1], made[0, 2], made[0, 3] = at[0], at[1], at[2], 0.0
        _remember(m, line[first : last + 1], made, found + 1)
        for i in range(1, found + 1):
            out[count] = made[i]
            count += 1
        at[:] = made[found, :3]
        first = last
    return count
