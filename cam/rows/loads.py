"""Adjusts feeds to the load: the rows of layers remove about the same volume per minute everywhere; turns are slots.

The removal of a move is measured across its row. There the present stock is the lower envelope of balls at the tips of
the rows around it: as deep as their last cut where rows have been cut, as the layer above left it where they have not.
The section of the cut is the area between it and the ball; section times feed is the volume per minute. A feed is used
for at least one ball radius; it is the least that its places and the nearby ones allow, and is rounded down to one of a
few values.

Exact rows cut at the ball's full width in their turns: between two rows the tool goes a pitch on into stock that no row
has touched yet, the next row's on the one side, and stock at the wall of the run-out on the other. Such a slot is
only as long as the pitch, but every row ends in one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from itertools import pairwise
from math import ceil, inf, log, pi, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from cam.materials import LEAST_FEED, SLOT_FEED
from cam.moves import Array, Path, cut
from cam.passes import PassSpec
from cam.surface.stock_touch import slot_section_mm2

LOAD_SHARE = 0.42
"""Stock a minute, as a share of what a slot one step-down deep gives at the whole feed. At half the feed (SLOT_FEED) it
gives 0.5, and more beside a wall: `camera`, R = 3 mm, 0.5 mm, takes 45 % of that time, at 0.7 of its peak."""

MOST_FEED = 2.0
"""Share of the feed up to which it follows the load: above, chips would be thicker than in a slot, as a row's narrow
bite thins them to a half."""

SLOT_SIDES, SLOT_DEPTH_SHARE = 0.4, 0.3
"""Of a slot's section, on both sides alike, and of the step-down: from there on a cut counts as a slot."""

_STEP = 1.1  # ratio of neighbouring feeds
_BESIDE = 0.7  # in radii: how long a feed is kept before and after, because oblique walls begin earlier
_WHOLE_FROM = 10.0  # mm/min
_POINTS = 24  # across the ball
_LEFT, _RIGHT, _DEEP = range(3)

Ints = NDArray[np.int64]
Meets = Callable[[Array], Array]
"""(n, 3) tips -> (n,) tip heights at which the ball would meet stock there."""


def feed_at_load(section_mm2: ArrayLike, spec: PassSpec, steep: ArrayLike = 0.0) -> Array:
    """Return the feed for the pass's allowed removal rate. steep: slope of the path."""
    wanted = np.maximum(_removal_mm3_per_min(spec) / np.maximum(section_mm2, 1e-9), LEAST_FEED * spec.feed_mm_per_min)
    return round_feed(np.minimum(wanted, most_feed_mm_per_min(spec, steep)))


@lru_cache(maxsize=64)  # called for every link
def _removal_mm3_per_min(spec: PassSpec) -> float:
    section_mm2 = slot_section_mm2(spec.shape, spec.radius_mm, spec.step_down_mm)
    return LOAD_SHARE * float(section_mm2) * spec.feed_mm_per_min


def round_feed(feed_mm_per_min: ArrayLike) -> Array:
    """Return whole mm/min, from 10 mm/min up."""
    feed = np.asarray(feed_mm_per_min)
    return np.where(feed < _WHOLE_FROM, feed, np.floor(feed))


def most_feed_mm_per_min(spec: PassSpec, steep: ArrayLike = 0.0) -> Array:
    """Return the highest feed, for where almost nothing is cut. The axes' rates and the thickest chip limit it.

    steep : slope of the path
    """
    x, y, z = spec.max_rate_mm_per_min
    climbing = z * np.hypot(1.0, steep) / np.maximum(steep, 1e-9)
    thickest = max(spec.feed_mm_per_min, spec.chip_mm[1] * spec.flutes * spec.spindle_rpm)
    return round_feed(np.minimum(climbing, min(MOST_FEED * spec.feed_mm_per_min, thickest, x, y)))


class Runs(NamedTuple):
    """Samples first..last of rows, cut one run after the other; (m,) each.

    way  : 1 upward in x, -1 downward
    came : sample at which the run before, of the row before, ends; -1 where the tool enters anew
    """

    row: Ints
    first: Ints
    last: Ints
    way: Ints
    came: Ints

    @property
    def is_joined(self) -> NDArray[np.bool_]:
        return self.came >= 0

    @property
    def start(self) -> Ints:
        return np.where(self.way > 0, self.first, self.last)

    @property
    def counts(self) -> Ints:
        return self.last - self.first + 1

    def samples(self) -> tuple[Ints, Ints]:
        """Return rows (n,) and samples (n,) of all runs, each by x."""
        counts = self.counts
        before = np.cumsum(counts) - counts
        return np.repeat(self.row, counts), np.arange(counts.sum()) - np.repeat(before - self.first, counts)


@njit(cache=True, nogil=True)
def _measure(now, tips, y, runs, beside, radius, corner, top, bite, depth):  # type: ignore[no-untyped-def]
    """Measure the removal of runs: bite (n, 3) left, right, deepest at each sample; depth (m,): what stands at most
    within `beside` samples of the way from the row before.

    now (n rows, n samples) : tips at which the cutter would meet stock; each run lowers it to tips
    corner                  : radius of the cutter's corner
    """
    width = 2.0 * radius / _POINTS
    own, rise = np.empty(_POINTS), np.empty((_POINTS, 2 * _POINTS))
    others, met = np.empty(2 * _POINTS, np.int64), np.empty(2 * _POINTS)
    for k in range(_POINTS):
        beyond = max(0.0, abs((k + 0.5) * width - radius) - radius + corner)
        own[k] = corner - sqrt(corner * corner - beyond * beyond)
    n = 0
    for r in range(runs.row.size):
        row, first, last = runs.row[r], runs.first[r], runs.last[r]
        depth[r] = 0.0
        start, came = first if runs.way[r] > 0 else last, runs.came[r]
        if came >= 0:
            for j in range(row - 1, row + 1):
                for i in range(max(0, min(start, came) - beside), min(now.shape[1], max(start, came) + beside + 1)):
                    depth[r] = max(depth[r], now[j, i] - tips[j, i])
        low, high = row, row
        while low > 0 and abs(y[low - 1] - y[row]) < 2.0 * radius:
            low -= 1
        while high + 1 < y.size and abs(y[high + 1] - y[row]) < 2.0 * radius:
            high += 1
        stride, count = -(-(high - low + 1) // _POINTS), 0
        for other in range(low, high + 1):
            if (other - row) % stride != 0 and abs(other - row) != 1:
                continue
            others[count] = other
            for k in range(_POINTS):
                beyond = max(0.0, abs((k + 0.5) * width - radius - y[other] + y[row]) - radius + corner)
                reached = beyond < corner or beyond == 0.0
                rise[k, count] = corner - sqrt(corner * corner - beyond * beyond) if reached else inf
            count += 1
        for i in range(first, last + 1):
            bite[n] = 0.0
            for m in range(count):
                met[m] = now[others[m], i]
            for k in range(_POINTS):
                height = top
                for m in range(count):
                    height = min(height, met[m] + rise[k, m])
                deep = height - tips[row, i] - own[k]
                if deep > 0.0:
                    bite[n, _LEFT if 2 * k >= _POINTS else _RIGHT] += deep * width
                    bite[n, _DEEP] = max(bite[n, _DEEP], deep)
            n += 1
        for i in range(first, last + 1):
            now[row, i] = min(now[row, i], tips[row, i])


def measure_cuts(
    now: Array, tips_mm: Array, y_mm: Array, runs: Runs, spec: PassSpec, *, top_mm: float, beside: int = 0
) -> tuple[Array, Array]:
    """Return, sample by sample, (n, 3) sections beside a row towards greater and smaller Y [mm2] and the deepest cut;
    and (m,) how deep stock is within `beside` samples of the way to each run.

    now (n rows, n samples) : tips at which the cutter would meet stock, of rows at y_mm; lowered to tips_mm by the runs
    top_mm                  : none stands higher
    """
    bite, depth = np.empty((int(runs.counts.sum()), 3)), np.empty(runs.row.size)
    corner_mm = spec.shape.corner_mm(spec.radius_mm)
    _measure(now, tips_mm, y_mm, runs, beside, spec.radius_mm, corner_mm, top_mm, bite, depth)
    return bite, depth


def _add_descent(bite: Array, climbs: Array, spec: PassSpec) -> None:
    """Add the removal by the whole face of a flat end on a descent, on either side of its path [mm2].

    climbs (n,) : slope of the way
    """
    slot = 2 * spec.radius_mm * np.maximum(bite[:, _DEEP], 1e-9)
    share = np.minimum(1.0, (bite[:, _LEFT] + bite[:, _RIGHT]) / slot)
    flat = pi / 2 * spec.shape.flat_mm(spec.radius_mm) ** 2
    bite[:, :2] += (flat * share * np.maximum(0.0, -climbs))[:, None]


def choose_feeds(bite: Array, tips_mm: Array, runs: Runs, spec: PassSpec, *, step_mm: float) -> Array:
    """Return (n,) feeds along runs whose bite (n, 3) and tips (n,) are known at samples step_mm apart."""
    counts = runs.counts
    climbs = np.diff(tips_mm, append=0.0)
    climbs[np.cumsum(counts) - 1] = 0.0
    climbs /= step_mm
    if not spec.is_ball:
        _add_descent(bite, climbs * np.repeat(runs.way, counts), spec)
    feed = feed_at_load(bite[:, _LEFT] + bite[:, _RIGHT], spec, np.abs(climbs))
    sides = 2 * np.minimum(bite[:, _LEFT], bite[:, _RIGHT])
    in_slot = sides > SLOT_SIDES * slot_section_mm2(spec.shape, spec.radius_mm, bite[:, _DEEP])
    in_slot &= bite[:, _DEEP] > SLOT_DEPTH_SHARE * spec.step_down_mm
    feed[in_slot] = np.minimum(feed[in_slot], SLOT_FEED * spec.feed_mm_per_min)
    most = most_feed_mm_per_min(spec)
    feed = round_feed(most * _STEP ** -np.ceil(np.log(most / feed) / log(_STEP) - 1e-9))
    stretch = ceil(spec.radius_mm / step_mm) | 1
    around = stretch + 2 * ceil(_BESIDE * stretch)
    apart = np.arange(feed.size) + around * np.repeat(np.arange(counts.size), counts)  # no run affects the next
    feeds = np.full(apart[-1] + 1, inf)
    feeds[apart] = feed
    least = minimum_filter1d(feeds, around)
    feeds[:] = -inf
    feeds[apart] = least[apart]
    return np.asarray(maximum_filter1d(feeds, stretch)[apart])


def choose_link_feeds(depth_mm: Array, spec: PassSpec) -> Array:
    """Return (m,) feeds of links between runs, where there may be a wall beside a slot as deep as the surrounding stock
    (m,).
    """
    section = slot_section_mm2(spec.shape, spec.radius_mm, depth_mm) / 2 + depth_mm * spec.radius_mm
    return np.minimum(feed_at_load(section, spec), SLOT_FEED * spec.feed_mm_per_min)


def first_row(polyline_mm: Array) -> Array:
    """Return the straight beginning, up to the first turn: ramps stay on it, and stock stands on both sides of it."""
    same = polyline_mm[:, 1] == polyline_mm[0, 1]
    return polyline_mm if same.all() else polyline_mm[: int(np.argmin(same))]


def row_cuts(polyline_mm: Array, before_mm: Array, meets: Meets, spec: PassSpec) -> Iterator[Path]:
    """Yield rows and turns (n, 3) at their feeds; before_mm: where the tool stands."""
    slow = np.diff(polyline_mm[:, 1], prepend=before_mm[1]) != 0  # turns alone leave a row's y
    turning = polyline_mm[slow]
    slow[slow] = meets(turning) - turning[:, 2] > SLOT_DEPTH_SHARE * spec.step_down_mm
    edges = np.flatnonzero(np.diff(slow)) + 1
    for first, end in pairwise([0, *edges.tolist(), len(slow)]):
        yield cut(polyline_mm[first:end], spec.feed_mm_per_min * (SLOT_FEED if slow[first] else 1.0))
