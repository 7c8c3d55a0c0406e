"""A path with what lies within a tolerance of what is drawn already left out: rows denser than can be seen.

Theory of operation: the path is taken in short stretches, in order. One is drawn unless all of it runs close beside
earlier ones: those have marked the cells around them with their height. So rows stay evenly apart whichever way they
run, none is chopped into less than a stretch, and where a path comes back at another depth it is drawn again.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from optics.heightfield import Array
from service.job.page_data.points import HIDDEN, Points

# In tolerances. A sample is at most 0.5 + 0.36 from a drawn one over the plan, 0.35 in height; between samples, 0.25.
_CELL, _REACH, _HEIGHT, _SAMPLE = 0.5, 0.5, 0.35, 0.25
_SCALE = 0.85
_STRETCH = 40.0
_NOWHERE = np.float32(1e9)


class Thinner:
    """bounds_mm: (2, 2) lowest and highest x and y."""

    def __init__(self, tolerance_mm: float, bounds_mm: Array) -> None:
        self._unit_mm = _SCALE * tolerance_mm
        self._corner_mm = bounds_mm[0] - self._unit_mm
        size = (bounds_mm[1] + self._unit_mm - self._corner_mm) / (_CELL * self._unit_mm)
        self._heights = np.full((int(size[1]) + 2, int(size[0]) + 2), _NOWHERE, dtype=np.float32)
        self._last: Points | None = None
        self._left_out = False

    def add(self, points: Points) -> Points:
        """Add the next points of the path; return those drawn, and in `unseen` the ends of what is left out."""
        if not len(points):
            return points
        first, last = self._last is None, self._last
        held = points if last is None else Points.joined([last, points])
        ends = stretch_ends(held.mm, _STRETCH * self._unit_mm)
        drawn = np.empty(len(ends), dtype=np.bool_)
        _decide(held.mm, held.kind, ends, self._heights, self._corner_mm, self._unit_mm, drawn)
        kept, hidden = np.zeros(len(held), dtype=np.bool_), np.zeros(len(held), dtype=np.uint8)
        kept[1:] = np.repeat(drawn, np.diff(ends, prepend=0))
        before = ends[:-1][drawn[1:] & ~drawn[:-1]]  # from here on it is drawn again
        kept[before], hidden[before] = True, HIDDEN
        if first:
            kept[0] = True
        elif self._left_out and drawn.size and drawn[0]:
            kept[0], hidden[0] = True, HIDDEN
        if drawn.size:
            self._left_out = not drawn[-1]
        self._last = held[-1:]
        return _unseen(held[kept], hidden[kept])

    def rest(self) -> Points:
        """Return where the path ends, at its time."""
        if self._last is None or not self._left_out:
            return Points.none()
        return _unseen(self._last, np.full(1, HIDDEN, dtype=np.uint8))


def _unseen(points: Points, hidden: np.ndarray) -> Points:
    return Points(mm=points.mm, time_s=points.time_s, line=points.line, kind=points.kind | hidden)


def stretch_ends(mm: Array, longest_mm: float) -> np.ndarray:
    """Return the last points of stretches of about that length; the last of all is the last point."""
    if len(mm) < 2:
        return np.empty(0, dtype=np.int64)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(mm, axis=0), axis=1))])
    number = np.floor(along / longest_mm)
    ends = np.flatnonzero(np.diff(number) > 0) + 1
    return np.unique(np.append(ends, len(mm) - 1))


@njit(cache=True, nogil=True)
def _decide(mm, kind, ends, heights, corner, unit, drawn):  # type: ignore[no-untyped-def]
    start = 0
    for s in range(len(ends)):
        end = ends[s]
        drawn[s] = not _is_covered(mm, kind, start, end, heights, corner, unit)
        if drawn[s]:
            _mark(mm, kind, start, end, heights, corner, unit)
        start = end


@njit(cache=True, nogil=True)
def _samples(mm, k, unit):  # type: ignore[no-untyped-def]
    """Return how many samples the move to point k has."""
    square = 0.0
    for d in range(3):
        square += (mm[k, d] - mm[k - 1, d]) ** 2
    return int(np.ceil(np.sqrt(square) / (_SAMPLE * unit))) + 1


@njit(cache=True, nogil=True)
def _place(mm, k, f, corner, cell):  # type: ignore[no-untyped-def]
    """Return where the share f of the move to point k ends: x and y in cells from the corner, z."""
    x = (mm[k - 1, 0] + f * (mm[k, 0] - mm[k - 1, 0]) - corner[0]) / cell
    y = (mm[k - 1, 1] + f * (mm[k, 1] - mm[k - 1, 1]) - corner[1]) / cell
    return x, y, mm[k - 1, 2] + f * (mm[k, 2] - mm[k - 1, 2])


@njit(cache=True, nogil=True)
def _is_covered(mm, kind, start, end, heights, corner, unit):  # type: ignore[no-untyped-def]
    cell = _CELL * unit
    for k in range(start + 1, end + 1):
        if kind[k] & HIDDEN:
            continue
        n = _samples(mm, k, unit)
        for s in range(n + 1):
            x, y, z = _place(mm, k, s / n, corner, cell)
            if abs(z - heights[int(y), int(x)]) > _HEIGHT * unit:
                return False
    return True


@njit(cache=True, nogil=True)
def _mark(mm, kind, start, end, heights, corner, unit):  # type: ignore[no-untyped-def]
    cell = _CELL * unit
    for k in range(start + 1, end + 1):
        if kind[k] & HIDDEN:
            continue
        n = _samples(mm, k, unit)
        for s in range(n + 1):
            x, y, z = _place(mm, k, s / n, corner, cell)
            for j in range(max(0, int(y) - 1), min(heights.shape[0], int(y) + 2)):
                for i in range(max(0, int(x) - 1), min(heights.shape[1], int(x) + 2)):
                    if (i + 0.5 - x) ** 2 + (j + 0.5 - y) ** 2 <= (_REACH / _CELL) ** 2:
                        heights[j, i] = z
