"""Finds the widest gap between neighbouring tracks of any path. The search covers everything; it does not sample.

A gap is the widest circle without a track in it; between two long tracks its width is their distance. The gap is
measured between tracks of the TIP, seen from above, at all places where a tip makes the ball touch the aperture. On a
slope s the contact lies R s beside the tip, and in a hollow of curvature k contacts lie 1 / (1 - R k) times as far
apart as tips; but the tips' distance p determines how the ball tilts from one track to the next: cusps are as steep as
+-p / 2R and as high as p^2 / (8 R (1 - R k)), so the distance of tips is what shows in the light. Along the slope
tracks are farther apart than from above by 1 / cos of the slope across them, 2 % at 0.2; the rows of a raster are
spaced from above, too.

Theory. Tracks paint the pixels whose centres lie within half a pitch of them; a pixel is 1/80 of a pitch. The distance
to the nearest track changes by no more than the step between two places, so a place farther than half a pitch and half
a pixel's diagonal from all tracks lies in a bare pixel: gaps wider than 1.02 pitch (1.018, and 0.002 at joints) cannot
hide. From bare pixels, and from some places of every tile, an ascent with exact distances finds the true widest circle.
Tiles keep memory at a few bytes for each move.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from cam.checking.track_scan import MICRO, climb, distance_to, is_inside, occupy, scan_tiles, sort_by_tile
from optics.heightfield import Array, Heightfield

PIXELS_PER_PITCH = 80
TILE_PITCHES = 32
REACH_PITCHES = 2.0
"""Distances up to this are exact in every tile; emptier places are measured once more at the end."""

THREADS = 2
_RIM_STEP_MM = 0.02
_TRIED = 64
Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """The widest gap and the middle of its circle."""

    width_mm: float
    x_mm: float
    y_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TipRegion:
    """Where a tip makes the ball touch the aperture: its rim on each side, at start_mm + k * step_mm.

    left_mm, right_mm : x of the rim at y; bottom_mm, top_mm: y of the rim at x
    """

    left_mm: Array
    right_mm: Array
    bottom_mm: Array
    top_mm: Array
    start_mm: float
    step_mm: float

    @classmethod
    def plain(cls, width_mm: float, height_mm: float) -> TipRegion:
        """Return a rectangle from the origin: the aperture itself."""
        ends = (np.zeros(2), np.full(2, width_mm), np.zeros(2), np.full(2, height_mm))
        return cls(left_mm=ends[0], right_mm=ends[1], bottom_mm=ends[2], top_mm=ends[3], start_mm=0.0, step_mm=1.0)

    @classmethod
    def over(cls, heightfield: Heightfield, *, ball_mm: float) -> TipRegion:
        """Return the region of a lens and a ball (its radius and what it leaves): tips stand ball * grad h / q
        downhill.
        """
        width, height = heightfield.width_mm, heightfield.height_mm
        spline = heightfield.spline()
        start = -ball_mm
        at = start + _RIM_STEP_MM * np.arange(math.ceil((max(width, height) + 2 * ball_mm) / _RIM_STEP_MM) + 1)

        def rim(across: float, length: float, *, upright: bool) -> Array:
            run = np.linspace(0.0, length, math.ceil(length / _RIM_STEP_MM) + 1)
            x, y = (np.full(run.size, across), run) if upright else (run, np.full(run.size, across))
            _h, hx, hy = spline.jets(x, y)[:3]
            lean = ball_mm / np.sqrt(1 + hx**2 + hy**2)
            x, y = x - lean * hx, y - lean * hy
            along, aside = (y, x) if upright else (x, y)
            return np.interp(at, np.maximum.accumulate(along), aside)

        return cls(
            left_mm=rim(0.0, height, upright=True),
            right_mm=rim(width, height, upright=True),
            bottom_mm=rim(0.0, width, upright=False),
            top_mm=rim(height, width, upright=False),
            start_mm=start,
            step_mm=_RIM_STEP_MM,
        )

    @property
    def kernel(self) -> tuple[Array, Array, Array, Array, float, float]:
        return self.left_mm, self.right_mm, self.bottom_mm, self.top_mm, self.start_mm, self.step_mm


class TrackGaps:
    """Collects the tracks of a pass, then finds the widest gap between them."""

    def __init__(self, region: TipRegion, *, pitch_mm: float) -> None:
        self._region, self._pitch_mm = region, pitch_mm
        self._x0, self._y0 = float(region.left_mm.min()), float(region.bottom_mm.min())
        self._pixel_mm = pitch_mm / PIXELS_PER_PITCH
        width, height = float(region.right_mm.max()) - self._x0, float(region.top_mm.max()) - self._y0
        self._shape = math.ceil(height / self._pixel_mm), math.ceil(width / self._pixel_mm)
        self._longest_mm = max(width, height)
        self._points: list[np.ndarray] = []
        self._counts: list[np.ndarray] = []

    def add(self, points_mm: Array, counts: np.ndarray) -> None:
        """Add moves from points_mm[k] to points_mm[k + 1], (n + 1, 2 or 3); counts (n,) bool: those that are tracks."""
        if not counts.any():
            return
        self._points.append(np.rint(points_mm[:, :2] / MICRO).astype(np.int32))
        self._counts.append(np.append(counts, False))  # the end of one batch is not joined to the start of the next

    def find_widest(self, on_progress: Progress | None = None) -> Gap:
        """Scan all tiles on two threads."""
        if not self._points:
            return Gap(width_mm=self._longest_mm, x_mm=0.0, y_mm=0.0)
        self._points, self._counts = [np.concatenate(self._points)], [np.concatenate(self._counts)[:-1]]
        found = self._scan(on_progress or (lambda share: None))
        best = int(found[:, 0].argmax())
        distance, x, y = found[best]
        if distance > (REACH_PITCHES - 0.5) * self._pitch_mm:
            distance, x, y = self._find_emptiest()
        return Gap(width_mm=2 * float(distance), x_mm=float(x), y_mm=float(y))

    def _scan(self, report: Progress) -> Array:
        side = PIXELS_PER_PITCH * TILE_PITCHES
        down, across = (-(-n // side) for n in self._shape)
        extent = side * self._pixel_mm
        points, counts = self._points[0], self._counts[0]
        starts, order = sort_by_tile(
            points, counts, self._x0, self._y0, extent, across, down, REACH_PITCHES * self._pitch_mm
        )
        found = np.empty((down * across, 3))

        def scan(row: int) -> None:
            tiles = np.arange(row * across, (row + 1) * across)
            scan_tiles(
                *(tiles, starts, order, points, self._x0, self._y0, self._pixel_mm, PIXELS_PER_PITCH, side),
                *(self._shape, self._region.kernel, found[row * across : (row + 1) * across]),
            )

        with ThreadPoolExecutor(THREADS) as pool:
            for done, _ in enumerate(pool.map(scan, range(down)), start=1):
                report(done / down)
        return found

    def _find_emptiest(self) -> tuple[float, float, float]:
        """Return (distance, x, y) of the place farthest from all tracks, if it is more than a few pitches away.

        Some of the cells farthest from cells with tracks are tried; the ascent starts from the best.
        """
        cell = max(0.5 * self._pitch_mm, self._longest_mm / 2000)
        ny, nx = (math.ceil(n * self._pixel_mm / cell) for n in self._shape)
        taken = np.zeros((ny, nx), dtype=np.bool_)
        points, counts, rim = self._points[0], self._counts[0], self._region.kernel
        occupy(points, counts, self._x0, self._y0, cell, taken)
        apart = np.array(distance_transform_edt(~taken))
        j, i = np.nonzero(apart > apart.max() - 2)
        places = np.column_stack([self._x0 + (i + 0.5) * cell, self._y0 + (j + 0.5) * cell])
        places = places[[is_inside(rim, x, y) for x, y in places]]
        places = places[:: -(-len(places) // _TRIED)]
        distances = [distance_to(points, counts, x, y) for x, y in places]
        distance, (x, y) = max(zip(distances, places, strict=True), key=lambda found: found[0])
        starts, ends = points[:-1] * MICRO - (x, y), points[1:] * MICRO - (x, y)
        reach = distance + 9 * cell + np.hypot(*(ends - starts).T)
        near = counts & (np.minimum(np.hypot(*starts.T), np.hypot(*ends.T)) < reach)
        tracks = np.concatenate([starts[near], ends[near]], axis=1)
        distance, dx, dy = climb(tracks, len(tracks), np.empty_like(tracks), 0.0, 0.0, 8 * cell, x, y, 1.0, rim)
        return distance, x + dx, y + dy
