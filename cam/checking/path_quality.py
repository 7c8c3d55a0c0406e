"""Measures the quality of a path of any strategy on all moves of a written program.

Only moves on the surface count: both ends within a few micrometres of where the ball touches. Measures that depend on
the stock are elsewhere (engagement, climbing, gouges: `cam.checking.check`).

Length is the tip's, in space. Along the contour: within 15 degrees of it as seen from above, at the contact of the
ball, where that lies in the aperture on a slope above 1 %. A turn over 60 degrees: between the chords before and after
a vertex, each at least a tenth of a pitch of path. The radius of a turn: half the path of two such chords of at least
half a pitch, over the angle between them; neither the spacing of vertices nor the raster they are rounded to changes
it.

The spacing of tracks of any direction is sampled at one random point (fixed seed) in each cell of the stock grid, so
that a regular raster cannot hide between regular samples. The distance in plan from each sample to the nearest track is
exact; twice the greatest of them is the width of the widest gap found. A gap of area A is missed with probability
exp(-A / cell area).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt

from cam.checking.clearance import Overlaps
from cam.checking.track_gaps import Gap, Progress, TipRegion, TrackGaps
from cam.passes import PassSpec
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Array, Heightfield, spline_jet

ON_SURFACE_MM = 0.01
"""A move that is higher above the surface than this, and than 1.5 times the stock to leave, does not form the surface.
"""

_CONTEXT = 64
"""The most moves on either side that are considered to judge a vertex."""

SLOPE_THAT_COUNTS = 0.01
ALIGNED_RAD = math.radians(15.0)
SHARP_RAD = math.radians(60.0)
TIGHT_PITCHES = 5.0
_CLOSE_MM = 1e-3  # error of the contact: the gradient changes by that times the curvature


@dataclass(frozen=True, slots=True, kw_only=True)
class PathMeasures:
    """A path on the surface of a lens.

    entries        : times it comes onto the surface after a rapid
    rapids_inside  : rapids that go across or down below the top of the block
    length_ratio   : length x pitch / area of the aperture
    aligned_share  : share of the length on slopes above 1 % that runs within 15 degrees of the contour line
    tight_turn_share : share of the length that turns with a radius below five pitches
    """

    entries: int
    rapids_inside: int
    length_mm: float
    length_ratio: float
    aligned_share: float
    turns_over_60_per_m: float
    tight_turn_share: float
    gap: Gap

    def as_report(self) -> dict[str, float]:
        """Return the figures of a contour pass for report.json, except `max_gap_mm`."""
        names = ("aligned_share", "length_ratio", "turns_over_60_per_m", "tight_turn_share")
        return {name: float(getattr(self, name)) for name in names}


class PathQuality:
    """Takes the batches of a program in order; `measures` ends it."""

    def __init__(self, heightfield: Heightfield, spec: PassSpec) -> None:
        ball_mm = spec.radius_mm + spec.stock_to_leave_mm
        self._spline = heightfield.spline_with_run_out(2 * ball_mm)
        self._size_mm = heightfield.width_mm, heightfield.height_mm
        self._ball_mm, self._pitch_mm = ball_mm, spec.pitch_mm
        self._gaps = TrackGaps(TipRegion.over(heightfield, ball_mm=ball_mm), pitch_mm=spec.pitch_mm)
        self.near_mm = ON_SURFACE_MM + 1.5 * spec.stock_to_leave_mm
        self._sums = np.zeros(5)
        self._offset = np.zeros(2)
        self._in_air = True  # since the last rapid no move was on the surface
        self._ends_on = False  # the last motion ended on the surface
        self._tail_points, self._tail_on = np.zeros((0, 2)), np.zeros(0, dtype=np.bool_)
        self._judged = 1  # first vertex of the tail that is still to be judged
        self.entries = self.rapids_inside = 0

    def add(self, batch: MoveBatch, overlaps: Overlaps) -> np.ndarray:
        """Add a batch; return which of its moves lie on the surface, (n,) bool."""
        if not len(batch):
            return np.zeros(0, dtype=np.bool_)
        on = self._on_surface(batch, overlaps)
        self._count_entries(batch.is_rapid, on)
        self._count_rapids(batch)
        self._gaps.add(batch.points_mm, on)
        add_lengths(
            *(*self._spline.kernel_arguments, *self._size_mm, batch.points_mm, on, self._ball_mm),
            *(self._offset, self._sums),
        )
        self._judge_turns(batch.points_mm, on)
        return on

    def measure(self, on_progress: Progress | None = None) -> PathMeasures:
        """Judge the remaining moves and scan the aperture."""
        add_turns(self._tail_points, self._tail_on, self._judged, self._tail_on.size, self._pitch_mm, self._sums)
        self._judged = self._tail_on.size
        length, sloped, aligned, sharp, tight = (float(value) for value in self._sums)
        return PathMeasures(
            entries=self.entries,
            rapids_inside=self.rapids_inside,
            length_mm=length,
            length_ratio=length * self._pitch_mm / (self._size_mm[0] * self._size_mm[1]),
            aligned_share=aligned / sloped if sloped else 1.0,
            turns_over_60_per_m=1000 * sharp / length if length else 0.0,
            tight_turn_share=tight / length if length else 0.0,
            gap=self._gaps.find_widest(on_progress),
        )

    def _on_surface(self, batch: MoveBatch, overlaps: Overlaps) -> np.ndarray:
        motion = ~batch.is_rapid & (batch.pause_s < 0)
        ends = overlaps.end_touch_mm > -self.near_mm
        for k in np.flatnonzero(batch.pause_s >= 0):  # it stays where it is
            ends[k] = ends[k - 1] if k else self._ends_on
        begins = np.concatenate([[self._ends_on], ends[:-1]])
        self._ends_on = bool(ends[-1])
        return np.asarray(motion & begins & ends)

    def _count_entries(self, is_rapid: np.ndarray, on: np.ndarray) -> None:
        events = np.flatnonzero(is_rapid | on)
        if not events.size:
            return
        in_air = np.concatenate([[self._in_air], is_rapid[events[:-1]]])
        self.entries += int((on[events] & in_air).sum())
        self._in_air = bool(is_rapid[events[-1]])

    def _count_rapids(self, batch: MoveBatch) -> None:
        start, end = batch.start_mm[batch.is_rapid], batch.end_mm[batch.is_rapid]
        across = (start[:, :2] != end[:, :2]).any(axis=1)
        low = np.minimum(start[:, 2], end[:, 2]) < 0
        self.rapids_inside += int((low & (across | (end[:, 2] < start[:, 2]))).sum())

    def _judge_turns(self, points_mm: Array, on: np.ndarray) -> None:
        moved = (points_mm[1:, :2] != points_mm[:-1, :2]).any(axis=1)
        fresh = points_mm[1:, :2][moved]
        first = self._tail_points if len(self._tail_points) else points_mm[:1, :2]
        points, on = np.concatenate([first, fresh]), np.concatenate([self._tail_on, on[moved]])
        last = max(self._judged, on.size - _CONTEXT)
        add_turns(points, on, self._judged, last, self._pitch_mm, self._sums)
        keep = max(0, last - _CONTEXT)
        self._tail_points, self._tail_on, self._judged = points[keep:].copy(), on[keep:].copy(), last - keep


@njit(cache=True, nogil=True)
def add_lengths(coefs, x0, y0, inv_dx, inv_dy, width, height, points, on, ball, offset, sums):  # type: ignore[no-untyped-def]
    """Add to sums: length on the surface; of it, where the slope counts in the aperture; of that, along the contour.

    offset (2,): from tip to contact, kept between calls. The contact p solves p = tip + ball grad h / q.
    """
    for k in range(on.size):
        if not on[k]:
            continue
        dx = points[k + 1, 0] - points[k, 0]
        dy = points[k + 1, 1] - points[k, 1]
        dz = points[k + 1, 2] - points[k, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        sums[0] += length
        plan = math.hypot(dx, dy)
        if plan == 0.0:
            continue
        x = 0.5 * (points[k, 0] + points[k + 1, 0])
        y = 0.5 * (points[k, 1] + points[k + 1, 1])
        hx = hy = 0.0
        for _ in range(12):
            _h, hx, hy, _xx, _xy, _yy = spline_jet(coefs, x0, y0, inv_dx, inv_dy, x + offset[0], y + offset[1])
            lean = ball / math.sqrt(1.0 + hx * hx + hy * hy)
            change = math.hypot(lean * hx - offset[0], lean * hy - offset[1])
            offset[0] = lean * hx
            offset[1] = lean * hy
            if change < _CLOSE_MM:
                break
        if not (0.0 <= x + offset[0] <= width and 0.0 <= y + offset[1] <= height):
            continue  # contour lines of the run-out have no meaning
        slope = math.hypot(hx, hy)
        if slope > SLOPE_THAT_COUNTS:
            sums[1] += length
            if abs(dx * hx + dy * hy) <= math.sin(ALIGNED_RAD) * slope * plan:
                sums[2] += length


@njit(cache=True, nogil=True)
def _chords(points, on, k, least):  # type: ignore[no-untyped-def]
    """Return the angle between the chords before and after vertex k, of the first vertices at least that far away, and
    half the length of path they span.
    """
    i = k
    way = 0.0
    while i > 0 and on[i - 1] and way < least:
        i -= 1
        way += math.hypot(points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1])
    before = way
    j = k
    way = 0.0
    while j < on.size and on[j] and way < least:
        j += 1
        way += math.hypot(points[j, 0] - points[j - 1, 0], points[j, 1] - points[j - 1, 1])
    ux, uy = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1]
    vx, vy = points[j, 0] - points[k, 0], points[j, 1] - points[k, 1]
    return abs(math.atan2(ux * vy - uy * vx, ux * vx + uy * vy)), 0.5 * (before + way)


@njit(cache=True, nogil=True)
def add_turns(points, on, first, last, pitch, sums):  # type: ignore[no-untyped-def]
    """Add to sums, for the vertices first..last - 1: turns over 60 degrees, and length that turns tightly.

    points (n + 1, 2) without repeated ones, on (n,). A vertex stands for half of either move beside it.
    """
    for k in range(max(first, 1), min(last, on.size)):
        if not (on[k - 1] and on[k]):
            continue
        if _chords(points, on, k, 0.1 * pitch)[0] > SHARP_RAD:
            sums[3] += 1.0
        angle, length = _chords(points, on, k, 0.5 * pitch)
        if angle * TIGHT_PITCHES * pitch > length:
            before = math.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
            after = math.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
            sums[4] += 0.5 * (before + after)


@njit(cache=True, nogil=True)
def _lower_distances(nearest2, jitter, x0, y0, cell, points, counts, reach):  # type: ignore[no-untyped-def]
    """Lower the squared distance of every sample within reach of a move that counts."""
    ny, nx = nearest2.shape
    for k in range(counts.size):
        if not counts[k]:
            continue
        ax, ay = points[k, 0], points[k, 1]
        bx, by = points[k + 1, 0], points[k + 1, 1]
        j0 = max(0, int(math.floor((min(ay, by) - reach - y0) / cell)))
        j1 = min(ny - 1, int(math.floor((max(ay, by) + reach - y0) / cell)))
        i0 = max(0, int(math.floor((min(ax, bx) - reach - x0) / cell)))
        i1 = min(nx - 1, int(math.floor((max(ax, bx) + reach - x0) / cell)))
        ex = bx - ax
        ey = by - ay
        length2 = max(ex * ex + ey * ey, 1e-30)
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                dx = x0 + (i + jitter[j, i, 0]) * cell - ax
                dy = y0 + (j + jitter[j, i, 1]) * cell - ay
                t = min(max((dx * ex + dy * ey) / length2, 0.0), 1.0)
                d2 = (dx - t * ex) ** 2 + (dy - t * ey) ** 2
                if d2 < nearest2[j, i]:
                    nearest2[j, i] = d2


class Coverage:
    """Distance from sample points to the tracks of a pass. Changes with every batch."""

    def __init__(self, grid: StockGrid, *, pitch_mm: float) -> None:
        shape = grid.top_mm.shape
        self._origin = grid.x0_mm, grid.y0_mm, grid.cell_mm
        self._reach_mm = 1.5 * pitch_mm
        self._jitter = np.random.default_rng(20140511).random((*shape, 2), dtype=np.float32)
        self._nearest2 = np.full(shape, np.inf, dtype=np.float32)

    def add(self, batch: MoveBatch, counts: np.ndarray) -> None:
        """Add moves. counts (n,) bool: those that are tracks, near enough to the surface to make it."""
        _lower_distances(self._nearest2, self._jitter, *self._origin, batch.points_mm, counts, self._reach_mm)

    def widest_gap_mm(self, wanted: np.ndarray) -> tuple[float, float, float]:
        """Return (gap, x, y) of the sample farthest from all tracks among the wanted cells (ny, nx) bool.

        Beyond three pitches the gap is read from the cells without a track near them: good to two cells.
        """
        if not wanted.any():
            return 0.0, math.nan, math.nan
        distance: Array = np.sqrt(np.where(wanted, self._nearest2, 0.0)).astype(np.float64)
        far = np.isinf(distance)
        if far.any():
            inside = distance_transform_edt(far) * self._origin[2]
            distance = np.where(far, self._reach_mm + inside, distance)
        j, i = divmod(int(distance.argmax()), distance.shape[1])
        x0, y0, cell = self._origin
        x, y = x0 + (i + self._jitter[j, i, 0]) * cell, y0 + (j + self._jitter[j, i, 1]) * cell
        return 2.0 * float(distance[j, i]), float(x), float(y)
