"""Feeds by load: the rows of layers take off about as much stock a minute at every place; turns are slots.

What a move takes off is measured across its row. There the stock of the moment is the lower envelope of balls standing
at the tips of the rows about it: as deep as their last cut where they have been cut, as the layer above left them where
they have not. Between it and the ball lies the section of the cut; section times feed is stock a minute. A feed holds
for a stretch as long as the ball's radius at least, is the least that its places and those near beside them allow, and
is rounded down to one of a few.

Exact rows cut at the ball's full width in their turns: between two rows the tool goes a pitch on into stock that no row
has touched yet, the next row's on the one side, what stands at the wall of the run-out on the other. That is a slot as
short as the pitch, but every row ends in one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from itertools import pairwise
from math import ceil, inf, log, pi, sqrt

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from cam.materials import SLOT_FEED
from cam.moves import Array, Path, cut
from cam.passes import PassSpec
from cam.surface.cutter import slot_section_mm2

LOAD_SHARE = 0.42
"""Stock a minute, as a share of what a slot one step-down deep gives at the whole feed. At half the feed (SLOT_FEED) it
gives 0.5, and more beside a wall: `camera`, R = 3 mm, 0.5 mm, takes 45 % of that time, at 0.7 of its peak."""

LEAST_FEED, MOST_FEED = 0.2, 2.0
"""Shares of the feed between which it follows the load: below, edges rub; above, chips would be thicker than in a slot,
as a row's narrow bite thins them to a half."""

SLOT_SIDES, SLOT_DEPTH_SHARE = 0.4, 0.3
"""Of a slot's section, on both sides alike, and of the step-down: from there on a cut counts as a slot."""

_STEP = 1.1  # from one feed to the next
_BESIDE = 0.7  # radii on which a feed holds before and after: walls aslant to a row begin earlier than across it
_WHOLE_FROM = 10.0  # mm/min
_POINTS = 24  # across the ball
_LEFT, _RIGHT, _DEEP = range(3)

Meets = Callable[[Array], Array]
"""(n, 3) tips -> (n,) tip heights at which the ball would meet stock there."""


def feed_at_load(section_mm2: ArrayLike, spec: PassSpec, steep: ArrayLike = 0.0) -> Array:
    """Return the feed at which cuts take off as much a minute as the pass may. steep: slope of the way."""
    wanted = np.maximum(_removal_mm3_per_min(spec) / np.maximum(section_mm2, 1e-9), LEAST_FEED * spec.feed_mm_per_min)
    return round_feed(np.minimum(wanted, most_feed_mm_per_min(spec, steep)))


@lru_cache(maxsize=64)  # asked at every link
def _removal_mm3_per_min(spec: PassSpec) -> float:
    section_mm2 = slot_section_mm2(spec.shape, spec.radius_mm, spec.step_down_mm)
    return LOAD_SHARE * float(section_mm2) * spec.feed_mm_per_min


def round_feed(feed_mm_per_min: ArrayLike) -> Array:
    """Return whole mm/min, from 10 mm/min up."""
    feed = np.asarray(feed_mm_per_min)
    return np.where(feed < _WHOLE_FROM, feed, np.floor(feed))


def most_feed_mm_per_min(spec: PassSpec, steep: ArrayLike = 0.0) -> Array:
    """Return the feed where next to nothing is cut, within what the axes can go; steep: slope of the way."""
    x, y, z = spec.max_rate_mm_per_min
    climbing = z * np.hypot(1.0, steep) / np.maximum(steep, 1e-9)
    return round_feed(np.minimum(climbing, min(MOST_FEED * spec.feed_mm_per_min, x, y)))


@njit(cache=True, nogil=True)
def _measure(now, tips, y, row, others, first, radius, corner, top, out):  # type: ignore[no-untyped-def]
    """Measure the cut along tips (n,), which begin at sample `first` of a row: out (n, 3) left, right, deepest.

    now (n rows, n samples) : tips at which the cutter would meet stock; corner: its corner's radius; others: rows that
                              are looked at
    """
    width = 2.0 * radius / _POINTS
    rise, own = np.full((_POINTS, others.size), inf), np.empty(_POINTS)
    for k in range(_POINTS):
        w = (k + 0.5) * width - radius
        beyond = max(0.0, abs(w) - radius + corner)
        own[k] = corner - sqrt(corner * corner - beyond * beyond)
        for m in range(others.size):
            beyond = max(0.0, abs(w - y[others[m]] + y[row]) - radius + corner)
            if beyond < corner or beyond == 0.0:
                rise[k, m] = corner - sqrt(corner * corner - beyond * beyond)
    met = np.empty(others.size)
    for i in range(tips.size):
        out[i] = 0.0
        for m in range(others.size):
            met[m] = now[others[m], first + i]
        for k in range(_POINTS):
            height = top
            for m in range(others.size):
                height = min(height, met[m] + rise[k, m])
            depth = height - tips[i] - own[k]
            if depth > 0.0:
                out[i, _LEFT if 2 * k >= _POINTS else _RIGHT] += depth * width
                out[i, _DEEP] = max(out[i, _DEEP], depth)


def measure_cut(now: Array, tips_mm: Array, y_mm: Array, row: int, first: int, spec: PassSpec, top_mm: float) -> Array:
    """Return (n, 3) sections beside a row towards greater and smaller Y [mm2] and the deepest cut, sample by sample.

    now (n rows, n samples) : tips at which the ball would meet stock, of rows at y_mm; top_mm: none stands higher
    tips_mm (n,)            : of the row, from its sample `first` on
    """
    near = np.flatnonzero(np.abs(y_mm - y_mm[row]) < 2 * spec.radius_mm)
    stride = ceil(near.size / _POINTS)
    others = near[((near - row) % stride == 0) | (np.abs(near - row) == 1)]
    out = np.empty((tips_mm.size, 3))
    corner_mm = spec.shape.corner_mm(spec.radius_mm)
    _measure(now, tips_mm, y_mm, row, others, first, spec.radius_mm, corner_mm, top_mm, out)
    return out


def measure_descent(bite: Array, heights_mm: Array, spec: PassSpec, *, step_mm: float) -> Array:
    """Return (n,) what a flat end takes off with its whole face where it goes down, on either side of its way [mm2].

    heights_mm (n,) : of the tip by X; their negatives where the way goes in -X
    """
    sinks = np.maximum(0.0, -np.diff(heights_mm, append=heights_mm[-1])) / step_mm
    slot = 2 * spec.radius_mm * np.maximum(bite[:, _DEEP], 1e-9)
    share = np.minimum(1.0, (bite[:, _LEFT] + bite[:, _RIGHT]) / slot)
    return np.asarray(pi / 2 * spec.shape.flat_mm(spec.radius_mm) ** 2 * share * sinks)


def choose_feeds(bite: Array, tips_mm: Array, spec: PassSpec, *, step_mm: float) -> Array:
    """Return (n,) feeds along a row whose bite (n, 3) and tips (n,) are known at samples step_mm apart."""
    steep = np.abs(np.diff(tips_mm, append=tips_mm[-1])) / step_mm
    feed = feed_at_load(bite[:, _LEFT] + bite[:, _RIGHT], spec, steep)
    sides = 2 * np.minimum(bite[:, _LEFT], bite[:, _RIGHT])
    in_slot = sides > SLOT_SIDES * slot_section_mm2(spec.shape, spec.radius_mm, bite[:, _DEEP])
    in_slot &= bite[:, _DEEP] > SLOT_DEPTH_SHARE * spec.step_down_mm
    feed[in_slot] = np.minimum(feed[in_slot], SLOT_FEED * spec.feed_mm_per_min)
    most = most_feed_mm_per_min(spec)
    feed = round_feed(most * _STEP ** -np.ceil(np.log(most / feed) / log(_STEP) - 1e-9))
    stretch = ceil(spec.radius_mm / step_mm) | 1
    least = minimum_filter1d(feed, stretch + 2 * ceil(_BESIDE * stretch), mode="nearest")
    return np.asarray(maximum_filter1d(least, stretch, mode="nearest"))


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
