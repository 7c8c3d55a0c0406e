"""Points of a path with the tool's time at each, and thinning of the path: by chords within a tolerance, and by leaving
out rows that are too dense to be seen.

Theory of thinning: the path is processed in short stretches, in order. A stretch is drawn unless all of it runs close
beside earlier ones, which have marked the cells around them with their height. So rows are evenly spaced in any
direction, none is cut into less than a stretch, and a path that returns at another depth is drawn again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cam.duration import DurationModel, Kinematics, is_block
from cam.reading.gcode import MoveBatch
from optics.heightfield import Array

RAPID, HIDDEN, PAUSE = 1, 2, 4
"""Of the move that ends at a point: a rapid; not drawn; a stop, where only time goes on."""

_LONGEST = 64  # moves that one chord may stand for
# In tolerances. A sample is at most 0.5 + 0.36 from a drawn one over the plan, 0.35 in height; between samples, 0.25.
_CELL, _REACH, _HEIGHT, _SAMPLE = 0.5, 0.5, 0.35, 0.25
_SCALE = 0.85
_STRETCH = 40.0
_NOWHERE = np.float32(1e9)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Points:
    """mm (n, 3), time_s (n,) never falling, line (n,) of the program, kind (n,) of the move that ends there."""

    mm: Array
    time_s: Array
    line: NDArray[np.int64]
    kind: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.kind)

    def __getitem__(self, chosen: Any) -> Points:
        return Points(mm=self.mm[chosen], time_s=self.time_s[chosen], line=self.line[chosen], kind=self.kind[chosen])

    @classmethod
    def join(cls, parts: Sequence[Points]) -> Points:
        if len(parts) == 1:
            return parts[0]
        return cls(
            mm=np.concatenate([part.mm for part in parts]),
            time_s=np.concatenate([part.time_s for part in parts]),
            line=np.concatenate([part.line for part in parts]),
            kind=np.concatenate([part.kind for part in parts]),
        )

    @classmethod
    def none(cls) -> Points:
        return cls(
            mm=np.empty((0, 3)),
            time_s=np.empty(0),
            line=np.empty(0, dtype=np.int64),
            kind=np.empty(0, dtype=np.uint8),
        )


class Chords:
    """The path as chords within the tolerance of all its points, batch by batch.

    Ends of rapids and of stops stay. The points in between run from one end of a chord to the other, so every place on
    the chord has one of them equally near.
    """

    def __init__(self, tolerance_mm: float) -> None:
        self.tolerance_mm = tolerance_mm
        self._waiting = Points.none()

    def add(self, points: Points) -> Points:
        """Add points; return those so far that are certain to stay, each once."""
        held = Points.join([self._waiting, points])
        if not len(held):
            return held
        kept = np.empty(len(held), dtype=np.int64)
        count, anchor = _choose(held.mm, held.kind, self.tolerance_mm**2, _LONGEST, kept)
        fresh = kept[:count] if len(self._waiting) else np.concatenate([[0], kept[:count]])
        self._waiting = held[anchor:]
        return held[fresh]

    def rest(self) -> Points:
        """Return the last point if it has not been returned yet."""
        waiting, self._waiting = self._waiting, Points.none()
        return waiting[-1:] if len(waiting) > 1 else Points.none()


@njit(cache=True, nogil=True)
def _choose(mm, kind, most2, longest, kept):  # type: ignore[no-untyped-def]
    """Choose the numbers of points to keep after the first, which is kept; return how many, and the last of them."""
    count = anchor = 0
    for k in range(1, len(kind)):
        if k - anchor == 1:
            continue
        if k - anchor > longest or kind[k] != kind[anchor + 1] or not _is_near(mm, anchor, k, most2):
            anchor = k - 1
            kept[count] = anchor
            count += 1
    return count, anchor


@njit(cache=True, nogil=True)
def _is_near(mm, first, last, most2):  # type: ignore[no-untyped-def]
    """Return whether every point between lies within the tolerance of the chord."""
    ux, uy, uz = mm[last, 0] - mm[first, 0], mm[last, 1] - mm[first, 1], mm[last, 2] - mm[first, 2]
    square = ux * ux + uy * uy + uz * uz
    for k in range(last - 1, first, -1):
        dx, dy, dz = mm[k, 0] - mm[first, 0], mm[k, 1] - mm[first, 1], mm[k, 2] - mm[first, 2]
        share = 0.0
        if square > 0.0:
            share = min(1.0, max(0.0, (dx * ux + dy * uy + dz * uz) / square))
        if (dx - share * ux) ** 2 + (dy - share * uy) ** 2 + (dz - share * uz) ** 2 > most2:
            return False
    return True


def no_box() -> Array:
    """Return corners (2, 3) to be widened."""
    return np.array([[np.inf] * 3, [-np.inf] * 3])


@njit(cache=True, nogil=True)
def widen(corners, mm, kind, without):  # type: ignore[no-untyped-def]
    """Extend the lowest and highest corner (2, 3) to all points that are not of this kind."""
    for k in range(len(kind)):
        if kind[k] & without == 0:
            for d in range(3):
                corners[0, d] = min(corners[0, d], mm[k, d])
                corners[1, d] = max(corners[1, d], mm[k, d])


class MovePoints:
    """Takes the batches of a program; returns points as soon as the look-ahead has determined their times.

    Moves of zero length and zero time make no point. `time_s`: of the last point returned.
    """

    def __init__(self, kinematics: Kinematics) -> None:
        self._model = DurationModel(kinematics)
        self._waiting = Points.none()
        self._begun = False

    def add(self, batch: MoveBatch) -> Points:
        if not len(batch):
            return Points.none()
        chosen = is_block(batch)
        made = Points(
            mm=batch.end_mm[chosen],
            time_s=np.empty(np.count_nonzero(chosen)),
            line=batch.line[chosen],
            kind=np.where(batch.pause_s[chosen] >= 0.0, PAUSE, batch.is_rapid[chosen] * RAPID).astype(np.uint8),
        )
        first = Points.none() if self._begun else _begin_points(batch)
        self._begun = True
        ends_s = self._model.add_batch(batch)
        held = Points.join([self._waiting, made])
        self._waiting = held[len(ends_s) :]
        return Points.join([first, _set_times(held[: len(ends_s)], ends_s)])

    def rest(self) -> Points:
        """Return the points that were waiting for further moves."""
        waiting, self._waiting = self._waiting, Points.none()
        return _set_times(waiting, self._model.list_waiting_s())

    @property
    def seconds(self) -> float:
        """Lowest and highest corner of the whole program so far."""
        return self._model.seconds


def _begin_points(batch: MoveBatch) -> Points:
    return Points(
        mm=batch.points_mm[:1], time_s=np.zeros(1), line=batch.line[:1], kind=np.full(1, RAPID, dtype=np.uint8)
    )


def _set_times(points: Points, ends_s: np.ndarray) -> Points:
    """Return the points with those times; without stops that take no time."""
    timed = Points(mm=points.mm, time_s=ends_s, line=points.line, kind=points.kind)
    stops = timed.kind == PAUSE
    if not stops.any():
        return timed
    took = np.diff(ends_s, prepend=-np.inf) > 0.0
    return timed[~stops | took]


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
        """Add the next points of the path; return those that are drawn, and in `unseen` the ends of the parts that are
        left out.
        """
        if not len(points):
            return points
        first, last = self._last is None, self._last
        held = points if last is None else Points.join([last, points])
        ends = stretch_ends(held.mm, _STRETCH * self._unit_mm)
        drawn = np.empty(len(ends), dtype=np.bool_)
        _decide(held.mm, held.kind, ends, self._heights, self._corner_mm, self._unit_mm, drawn)
        kept, hidden = np.zeros(len(held), dtype=np.bool_), np.zeros(len(held), dtype=np.uint8)
        kept[1:] = np.repeat(drawn, np.diff(ends, prepend=0))
        before = ends[:-1][drawn[1:] & ~drawn[:-1]]  # drawing begins again here
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
        """Return the end of the path with its time."""
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
    """Return the place at share f of the move to point k: x and y in cells from the corner, z."""
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
