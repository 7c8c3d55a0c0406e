"""The milled surface as a whole: parts that can be made one by one, in any order, by any thread.

If there are too many facets and only a height map is needed, the heights are computed on a grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from cam.as_milled.facets import facets_of
from cam.as_milled.stepping import Spread, measure_spread
from cam.as_milled.tracks import Chords, Tracks, sort_chords
from cam.checking.removal import RemovalGrid
from cam.moves import Array
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield

CHORDS_PER_PART = 20_000
_LONGEST_MM = 0.2  # a pixel of 512 on 100 mm; half as long changes the light by 63 dB
_BOX_MM = 0.03  # smaller ones cost more memory than they save time
_SIGMAS = 3.0
_CROSSED = 1 / 6  # of the pitch: parts of a strip that other tracks cross


def reach_of(radius_mm: float, *, pitch_mm: float, error_mm: float) -> float:
    """Return how far from its contact a ball cuts surface that no neighbouring ball cuts deeper.

    error_mm : standard deviation of the tips' heights. A tip that lies d deeper hides others within sqrt(2 R d). (Half
    as far again changes the light of rows of a 4 mm ball, 0.03 mm apart and off by 1.5 um, by 60 dB, and takes twice as
    long.)
    """
    return 1.5 * pitch_mm + math.sqrt(2.0 * radius_mm * _SIGMAS * error_mm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MilledSurface:
    """What finishing programs leave, as facets: `part(0)` .. `part(parts - 1)`.

    reach_mm   : balls farther apart than this do not affect each other's cut
    crossed_mm : greatest length of a facet where another track crosses
    steps_within : the spread of slopes that steps within moves add
    """

    chords: Chords
    lens: tuple[Array, float, float, float, float]
    reach_mm: float
    crossed_mm: float
    steps_within: Spread

    @classmethod
    def of_tracks(
        cls,
        tracks: Sequence[Tracks],
        heightfield: Heightfield,
        *,
        pitch_mm: float,
        error_mm: float = 0.0,
        step_mm: float = 0.0,
    ) -> MilledSurface:
        """Make the surface of one program or several: a point belongs to the ball that went deepest there.

        pitch_mm : the widest distance between neighbouring tracks
        error_mm : standard deviation of the tips' heights
        step_mm  : of the mill's axes, within moves
        """
        radius = max(one.radius_mm for one in tracks)
        reach = reach_of(radius, pitch_mm=pitch_mm, error_mm=error_mm)
        return cls(
            chords=sort_chords([one.divide(_LONGEST_MM) for one in tracks], side_mm=max(0.5 * reach, _BOX_MM)),
            lens=heightfield.spline_with_run_out(radius + 1.0).kernel_arguments,
            reach_mm=reach,
            crossed_mm=_CROSSED * pitch_mm,
            steps_within=measure_spread(tracks, heightfield, step_mm=step_mm, reach_mm=reach),
        )

    @property
    def parts(self) -> int:
        return math.ceil(self.chords.joined.size / CHORDS_PER_PART)

    def part(self, number: int) -> Array:
        """Return (n, 4, 5) facets: corners in order around, each x, y, z [mm] and slopes in x and y."""
        first = number * CHORDS_PER_PART
        last = min(first + CHORDS_PER_PART, self.chords.joined.size)
        lengths_mm = self.reach_mm, _LONGEST_MM, self.crossed_mm
        return np.asarray(facets_of(self.chords, first, last, self.lens, *lengths_mm, self.steps_within))


_SHARES = 2
_AT_ONCE = 20_000  # moves between two updates of the stock's height


def mill_heights(tracks: Sequence[Tracks], before: StockGrid) -> StockGrid:
    """Return the stock that the balls of these tracks leave, exact at the centres of its cells.

    before : heights only a little above the surface are fastest: the balls then have less stock to scan
    """
    stock = before
    with ThreadPoolExecutor(max_workers=_SHARES) as pool:
        for one in tracks:
            for chain in _chains(one):
                grid = RemovalGrid(stock, radius_mm=one.radius_mm, shares=_SHARES)
                for first in range(0, len(chain) - 1, _AT_ONCE):
                    batch = _batch(chain[first : first + _AT_ONCE + 1])
                    grid.refresh()
                    list(pool.map(grid.sweep, [batch] * _SHARES, range(_SHARES)))
                    grid.finish_batch(batch)
                grid.cut_at_rest()
                stock = replace(before, top_mm=grid.top_mm)
    return stock


def _chains(tracks: Tracks) -> list[Array]:
    """Return the tips of each unbroken path."""
    begins = np.flatnonzero(~tracks.joined)
    return [chain for chain in np.split(tracks.tips_mm, begins[begins > 0]) if len(chain) > 1]


def _batch(tips_mm: Array) -> MoveBatch:
    count = len(tips_mm) - 1
    return MoveBatch(
        points_mm=np.ascontiguousarray(tips_mm),
        is_rapid=np.zeros(count, dtype=np.bool_),
        feed_mm_per_min=np.ones(count),
        line=np.arange(1, count + 1, dtype=np.int64),
        spindle_rpm=np.full(count, 1e4),
        pause_s=np.full(count, -1.0),
        lines_read=0,
        bytes_read=0,
        ended=False,
    )
