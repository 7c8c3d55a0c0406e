"""Selects a few of a program's moves for a drawing, from the stream of all moves and in bounded memory.

Three kinds of move are kept of each pass: rows some two millimetres apart over the whole part, everything inside a
small window at the rim, and the moves that reach farthest in x, y and z. Ten million moves go past; about a hundred
thousand stay.

Of a contour pass a few evenly scattered tracks are kept, as long as they stay clear of each other. The path is followed
once. A track is drawn from where it is at least one distance away from all drawn tracks until it comes nearer than half
of that, like lines in a drawing of a flow; but every line is a piece of the path itself. Stretches of other layers
(before the last entry into the longest stretch) are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MERGED_MM = 0.4  # moves of the whole-part panel are joined up to this length: less than two pixels
_ENTRIES_KEPT = 2000
_ACROSS = 42  # drawn tracks over the shorter side
_OWN = 4.0  # in distances: a track ignores itself this far back along the path
_SHORTEST = 2.5  # in distances: shorter pieces are not drawn
_WINDOW_PITCHES = 30
_S, _DRAWING = range(2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """A rectangle seen from above, in the work frame."""

    x0_mm: float
    y0_mm: float
    x1_mm: float
    y1_mm: float

    def meets(self, start_mm: Array, end_mm: Array) -> Mask:
        """Return (n,) which moves have a bounding box that meets the window."""
        low, high = np.minimum(start_mm[:, :2], end_mm[:, :2]), np.maximum(start_mm[:, :2], end_mm[:, :2])
        return np.asarray(
            (low[:, 0] <= self.x1_mm)
            & (high[:, 0] >= self.x0_mm)
            & (low[:, 1] <= self.y1_mm)
            & (high[:, 1] >= self.y0_mm)
        )


def square(x0_mm: float, y0_mm: float, side_mm: float) -> Window:
    """Return the window with that lower left corner."""
    return Window(x0_mm=x0_mm, y0_mm=y0_mm, x1_mm=x0_mm + side_mm, y1_mm=y0_mm + side_mm)


class PathSample:
    """The moves of one pass for toolpath.png; `add` the batches of its program in order."""

    def __init__(
        self,
        *,
        label: str,
        pitch_mm: float,
        radius_mm: float,
        width_mm: float,
        height_mm: float,
        along: str = "x",
        everywhere: bool = True,
        limit: int = 200_000,
    ) -> None:
        """Begin. along: which way the rows run; everywhere: False if only places are cut: the window shows the
        first.
        """
        self.label = label
        self.pitch_mm = pitch_mm
        side_mm = min(max(18 * pitch_mm, 0.6), 0.5 * min(width_mm, height_mm))
        rim_mm = -radius_mm - 0.12 * side_mm  # rows turn round one cutter radius outside the aperture
        middle_x_mm, middle_y_mm = 0.5 * width_mm - 0.5 * side_mm, 0.5 * height_mm - 0.5 * side_mm
        corner_mm = (rim_mm, middle_y_mm) if along == "x" else (middle_x_mm, rim_mm)
        self.window = square(*corner_mm, side_mm)
        self._window_follows = not everywhere
        apart_mm = min(width_mm, height_mm) / 50
        self.row_distance_mm = apart_mm if apart_mm > 4 * pitch_mm else pitch_mm  # few rows: all of them
        self.moves = self.rapids = self.entries = 0
        self._limit = limit
        self._axis: int | None = None  # axis of the rows' position: 1 if they run along x
        self._last_was_rapid = True
        self._cuts = Segments(limit)
        self._jumps = Segments(limit // 10)
        self._zoomed_cuts = Segments(limit)
        self._zoomed_jumps = Segments(limit // 10)
        self._entry_points: list[Array] = []
        self._entry_stride = 1
        self._extremes = np.full((2, 3), np.nan)  # lowest and highest x, y, z of the cutting moves
        self._extreme_moves = np.zeros((6, 2, 3))

    def add(self, start_mm: Array, end_mm: Array, rapid: Mask) -> None:
        """Take the next moves, straight from start (n, 3) to end (n, 3). Pauses are skipped."""
        moving = (start_mm != end_mm).any(axis=1)
        if not moving.all():
            start_mm, end_mm, rapid = start_mm[moving], end_mm[moving], rapid[moving]
        if not len(rapid):
            return
        self.moves += len(rapid)
        self.rapids += int(np.count_nonzero(rapid))
        if self._window_follows and not rapid.all():
            self._window_follows = False
            side_mm = self.window.x1_mm - self.window.x0_mm
            x_mm, y_mm, _ = start_mm[int(np.argmin(rapid))]
            self.window = square(float(x_mm) - 0.5 * side_mm, float(y_mm) - 0.12 * side_mm, side_mm)
        self._count_entries(start_mm, rapid)
        self._update_extremes(start_mm, end_mm, ~rapid)
        self._keep_rows(start_mm, end_mm, rapid)
        inside = self.window.meets(start_mm, end_mm)
        for kept, chosen in ((self._zoomed_cuts, inside & ~rapid), (self._zoomed_jumps, inside & rapid)):
            kept.add(start_mm, end_mm, chosen)
            if kept.is_full:  # the last layers matter more
                kept.keep_only(np.arange(kept.count) >= kept.count // 2)

    def bounds_mm(self) -> Array:
        """Return (2, 3) lowest and highest corner of all cutting moves, whether kept or not; NaN without any."""
        return self._extremes.copy()

    def cuts_mm(self) -> Array:
        """Return (k, 2, 3) start and end of the cutting moves kept over the whole part, in order; then the extreme
        ones.
        """
        kept = self._cuts.segments()
        return kept if np.isnan(self._extremes).any() else np.concatenate([kept, self._extreme_moves])

    def rapids_mm(self) -> Array:
        return self._jumps.segments()

    def zoom_mm(self) -> tuple[Array, Array]:
        """Return cutting and rapid moves (k, 2, 3) that meet the window; if there are very many, the last ones."""
        return self._zoomed_cuts.segments(), self._zoomed_jumps.segments()

    def entry_points_mm(self) -> Array:
        """Return (k, 3) where rapids end and cutting begins; of more than 2000, every second, fourth, ... one."""
        return np.concatenate(self._entry_points) if self._entry_points else np.zeros((0, 3))

    def _count_entries(self, start_mm: Array, rapid: Mask) -> None:
        begins = np.flatnonzero(~rapid & np.concatenate([[self._last_was_rapid], rapid[:-1]]))
        self._last_was_rapid = bool(rapid[-1])
        numbers = self.entries + np.arange(begins.size)
        self.entries += begins.size
        if begins.size:
            self._entry_points.append(start_mm[begins[numbers % self._entry_stride == 0]])
        while sum(map(len, self._entry_points)) > _ENTRIES_KEPT:
            self._entry_stride *= 2
            self._entry_points = [np.concatenate(self._entry_points)[::2]]

    def _update_extremes(self, start_mm: Array, end_mm: Array, cutting: Mask) -> None:
        chosen = np.flatnonzero(cutting)
        if not chosen.size:
            return
        for k in range(3):
            for side, (best, better) in enumerate(((np.argmin, np.less), (np.argmax, np.greater))):
                for points in (start_mm, end_mm):
                    move = chosen[best(points[chosen, k])]
                    known = self._extremes[side, k]
                    if np.isnan(known) or better(points[move, k], known):
                        self._extremes[side, k] = points[move, k]
                        self._extreme_moves[2 * k + side] = start_mm[move], end_mm[move]

    def _keep_rows(self, start_mm: Array, end_mm: Array, rapid: Mask) -> None:
        if self._axis is None:
            travel = np.abs(end_mm - start_mm)[~rapid].sum(axis=0)
            if travel[:2].sum() > 0:
                self._axis = 1 if travel[0] >= travel[1] else 0
        near = self._on_a_shown_row(start_mm, end_mm)
        self._cuts.add(start_mm, end_mm, near & ~rapid, merged_mm=_MERGED_MM)
        self._jumps.add(start_mm, end_mm, near & rapid)
        while self._cuts.is_full or self._jumps.is_full:
            self.row_distance_mm *= 2
            for kept in (self._cuts, self._jumps):
                kept.keep_only(self._on_a_shown_row(kept.starts(), kept.ends()))
                if self.row_distance_mm > 1e6:  # everything is in one row: thin that out
                    kept.keep_only(np.arange(kept.count) % 2 == 0)

    def _on_a_shown_row(self, start_mm: Array, end_mm: Array) -> Mask:
        axis = 1 if self._axis is None else self._axis
        row = 0.5 * (start_mm[:, axis] + end_mm[:, axis])
        off = np.abs(row - self.row_distance_mm * np.rint(row / self.row_distance_mm))
        return np.asarray(off <= 0.5001 * self.pitch_mm)


class Segments:
    """A growing array of moves; the owner thins it out whenever it is full."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._parts: list[Array] = []
        self.count = 0

    @property
    def is_full(self) -> bool:
        return self.count > self._limit

    def add(self, start_mm: Array, end_mm: Array, mask: Mask, *, merged_mm: float = 0.0) -> None:
        """Add the masked moves; with merged_mm, runs of them become chords of about that length."""
        index = np.flatnonzero(mask)
        if not index.size:
            return
        starts, ends = start_mm[index], end_mm[index]
        if merged_mm > 0:
            breaks = np.diff(index) != 1
            along = np.cumsum(np.linalg.norm(ends - starts, axis=1)) // merged_mm
            first = np.concatenate([[True], breaks | (np.diff(along) > 0)])
            last = np.concatenate([first[1:], [True]])
            starts, ends = starts[first], ends[last]
        self._parts.append(np.stack([starts, ends], axis=1))
        self.count += len(starts)

    def segments(self) -> Array:
        """Return (k, 2, 3) start and end of each move kept, in program order."""
        if len(self._parts) > 1:
            self._parts = [np.concatenate(self._parts)]
        return self._parts[0] if self._parts else np.zeros((0, 2, 3))

    def starts(self) -> Array:
        return self.segments()[:, 0]

    def ends(self) -> Array:
        return self.segments()[:, 1]

    def keep_only(self, mask: Mask) -> None:
        self._parts = [self.segments()[mask]]
        self.count = len(self._parts[0])


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
    """The sample of the path since the tool last came down."""

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
    """The sample of a contour pass. `row_distance_mm` is the distance between the drawn tracks."""

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
