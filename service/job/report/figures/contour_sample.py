"""A few tracks of a contour pass, for a person to look at: evenly strewn, as long as they stay clear of each other.

The path is followed once. A track is drawn from where it is at least one distance away from all that is drawn already,
until it comes nearer than half of that: the lines of a drawing of a flow, except that every one is a piece of the path
itself, and stretches of other layers (before the last entry into the longest stretch) are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from service.job.report.figures.path_sample import Array, Mask, PathSample, Segments, square

_ACROSS = 42  # drawn tracks over the shorter side
_OWN = 4.0  # distances: as far back along the path a track does not mind itself
_SHORTEST = 2.5  # distances: shorter pieces are not drawn
_WINDOW_PITCHES = 30
_S, _DRAWING = range(2)


@njit(cache=True, nogil=True)
def _is_clear(stamps, cell, x, y, radius, since):  # type: ignore[no-untyped-def]
    """Return whether no stamp is newer than `since` within radius of (x, y)."""
    ny, nx = stamps.shape
    n = int(math.ceil(radius / cell))
    i0, j0 = int(math.floor(x / cell)), int(math.floor(y / cell))
    for j in range(max(0, j0 - n), min(ny, j0 + n + 1)):
        for i in range(max(0, i0 - n), min(nx, i0 + n + 1)):
            if stamps[j, i] < since and (i - i0) ** 2 + (j - j0) ** 2 <= (radius / cell) ** 2:
                return False
    return True


@njit(cache=True, nogil=True)
def _strew(start, end, corner, cell, apart, stamps, state, chosen):  # type: ignore[no-untyped-def]
    """Choose moves to draw (n,). stamps (ny, nx): length of path at which a cell was drawn in, inf: never.

    state: length so far, 1 while a track is drawn
    """
    ny, nx = stamps.shape
    for k in range(chosen.size):
        state[_S] += math.hypot(end[k, 0] - start[k, 0], end[k, 1] - start[k, 1])
        x, y = end[k, 0] - corner[0], end[k, 1] - corner[1]
        radius = 0.5 * apart if state[_DRAWING] else apart
        clear = _is_clear(stamps, cell, x, y, radius, state[_S] - _OWN * apart)
        state[_DRAWING] = 1.0 if clear else 0.0
        if clear:
            chosen[k] = True
            i, j = int(math.floor(x / cell)), int(math.floor(y / cell))
            if 0 <= i < nx and 0 <= j < ny and stamps[j, i] == math.inf:
                stamps[j, i] = state[_S]


@dataclass(slots=True, eq=False)
class _Stretch:
    """What is kept of the path since the tool last came down."""

    stamps: Array
    state: Array
    drawn: Segments
    near: Segments
    along_mm: list[Array]
    first_mm: Array
    last_mm: Array

    @property
    def length_mm(self) -> float:
        return float(self.state[_S])


class ContourSample(PathSample):
    """Of a contour pass. `row_distance_mm` is the distance between the tracks drawn."""

    def __init__(self, *, pitch_mm: float, radius_mm: float, width_mm: float, height_mm: float, **others: Any) -> None:
        """Begin as a `PathSample`; it has no rows and always covers all: `along` and `everywhere` change nothing."""
        super().__init__(pitch_mm=pitch_mm, radius_mm=radius_mm, width_mm=width_mm, height_mm=height_mm, **others)
        self._window_follows = False
        side_mm = min(_WINDOW_PITCHES * pitch_mm, 0.5 * min(width_mm, height_mm))
        self.window = square(-0.15 * side_mm, 0.5 * height_mm - 0.5 * side_mm, side_mm)  # over the rim
        self.row_distance_mm = max(min(width_mm, height_mm) / _ACROSS, pitch_mm)
        self._cell_mm = self.row_distance_mm / 4
        self._corner_mm = np.array([-radius_mm, -radius_mm])
        self._shape = tuple(math.ceil((n + 2 * radius_mm) / self._cell_mm) for n in (height_mm, width_mm))
        self._now = self._longest = self._new_stretch(np.full(3, np.nan))

    def tracks_mm(self) -> Array:
        """Return (k, 2, 3) tracks to draw, in the order in which they are cut."""
        kept = self._longest.drawn.segments()
        if not len(kept):
            return kept
        joined = (kept[1:, 0] == kept[:-1, 1]).all(axis=1)
        piece = np.concatenate([[0], np.cumsum(~joined)])
        lengths = np.bincount(piece, weights=np.linalg.norm(kept[:, 1] - kept[:, 0], axis=1))
        return kept[lengths[piece] >= _SHORTEST * self.row_distance_mm]

    def window_tracks(self) -> tuple[Array, Array]:
        """Return every move of the path that meets the window (k, 2, 3), and at what share of the path it is cut
        (k,).
        """
        longest = self._longest
        along = np.concatenate(longest.along_mm) if longest.along_mm else np.zeros(0)
        return longest.near.segments(), along / max(longest.length_mm, 1e-12)

    def ends_mm(self) -> Array:
        """Return (2, 3) where the path begins and ends."""
        return np.stack([self._longest.first_mm, self._longest.last_mm])

    @property
    def length_mm(self) -> float:
        return self._longest.length_mm

    def _keep_rows(self, start_mm: Array, end_mm: Array, rapid: Mask) -> None:
        self._jumps.add(start_mm, end_mm, rapid)
        breaks = np.flatnonzero(rapid[1:] != rapid[:-1]) + 1
        for part in np.split(np.arange(rapid.size), breaks):
            if rapid[part[0]]:
                self._now = self._new_stretch(end_mm[part[-1]])
            else:
                self._follow(start_mm[part], end_mm[part])
        if self._jumps.is_full:
            self._jumps.keep_only(np.arange(self._jumps.count) % 2 == 0)

    def _new_stretch(self, first_mm: Array) -> _Stretch:
        return _Stretch(
            stamps=np.full(self._shape, np.inf),
            state=np.zeros(2),
            drawn=Segments(self._limit),
            near=Segments(self._limit),
            along_mm=[],
            first_mm=first_mm.copy(),
            last_mm=first_mm.copy(),
        )

    def _follow(self, start_mm: Array, end_mm: Array) -> None:
        now, chosen = self._now, np.zeros(len(start_mm), dtype=np.bool_)
        along = now.length_mm + np.cumsum(np.hypot(*(end_mm - start_mm)[:, :2].T))
        _strew(
            *(start_mm, end_mm, self._corner_mm, self._cell_mm, self.row_distance_mm),
            *(now.stamps, now.state, chosen),
        )
        now.drawn.add(start_mm, end_mm, chosen, merged_mm=0.1 * self.row_distance_mm)
        inside = self.window.meets(start_mm, end_mm)
        now.near.add(start_mm, end_mm, inside)
        now.along_mm.append(along[inside])
        now.last_mm = end_mm[-1].copy()
        if np.isnan(now.first_mm[0]):
            now.first_mm = start_mm[0].copy()
        if now.length_mm >= self._longest.length_mm:
            self._longest = now
