"""The path of a polishing bob: loops in rows over the lens, in no preferred direction.

Theory of operation. A trochoid: the tip goes around small circles whose centre moves along rows. What a steady circle
deposits has no direction; what is left of rows and loops are ripples of short period, in which the bob's contact, many
times as wide, takes off evenly. The longest ones vanish where J0(2 pi r / S) = 0 for circles of radius r in rows S
apart, and J1(2 pi r / A) = 0 for loops an advance A apart. (A random path has no such ripples but is uneven at all
periods: three rounds about a random spanning tree, 0.3 mm apart, contact of 0.95 mm, 96 um off: 1.6 um rms, 0.5 as the
finish leaves it, and light off by 86 % from pixel to pixel of 0.3 mm; loops: 0.3, 0.09 um, 18 %.) Rounds go along X and
Y in turn, each from the corner where the one before has ended.

The tip follows the surface of a ball that is smaller by the compression: its centre is that deep below where the bob
would just touch, along the normal. Dwell is planned on a lattice of places of the tip.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import map_coordinates

from cam.errors import PassValueError, SafeHeightError
from cam.moves import RAPID_CLEARANCE_MM, Array, Path, cut, rapid
from cam.passes import Stock
from cam.polish.cut import PolishCut
from cam.rows.entries import leave
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield
from phrases.phrase import Phrase

_CHORDS = 16  # of a loop
_FEED_STEP = 1.002  # ratio of two neighbouring feeds: steps of a percent of the depth would show
_SLOWEST_MM_PER_MIN = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lattice:
    """Places of the tip, evenly over the lens and around it.

    x_mm (nx,), y_mm (ny,)     : of the nodes
    near (ny, nx)              : those whose contact point lies on the lens, or within one and a half contact radii
    at_mm, tip_mm (ny, nx, ..) : contact point (2) and tip (3) at each node
    """

    x_mm: Array
    y_mm: Array
    near: np.ndarray
    at_mm: Array
    tip_mm: Array

    def spread(self, values: Array) -> Array:
        """Return (ny, nx) of values (n,) of the near nodes in order; 0 elsewhere."""
        out = np.zeros(self.near.shape)
        out[self.near] = values
        return out


def cover(task: PolishCut, lens: Heightfield) -> ToolSurface:
    """Return the surface of the bob's tips over the lens."""
    reach = task.most_reach_mm + 2 * task.loop_mm
    return ToolSurface.over(lens, radius_mm=task.radius_mm, allowance_mm=-task.compression_mm, run_out_mm=reach)


def lay_lattice(surface: ToolSurface, stock: Stock, task: PolishCut) -> Lattice:
    """Return the lattice over the aperture and the bob's reach around it."""
    beyond, reach = task.beyond_mm, task.most_reach_mm
    x, y = (_even_nodes(-reach, size + reach, task.node_mm) for size in (stock.width_mm, stock.height_mm))
    rows = np.array([surface.contacts_mm(x, np.full_like(x, row)) for row in y])
    at = rows[:, :, :2]
    near = ((at >= -beyond) & (at <= np.array([stock.width_mm, stock.height_mm]) + beyond)).all(axis=2)
    grid = np.broadcast_arrays(x[None, :], y[:, None])
    return Lattice(x_mm=x, y_mm=y, near=np.asarray(near), at_mm=at, tip_mm=np.dstack([*grid, rows[:, :, 2]]))


def count_rounds(dwell_s: Array, task: PolishCut) -> int:
    """Return the number of rounds in which the dwell (n,) of all of them can be spent within the greatest feed.

    PassValueError: not even in one: the bob takes off too much.
    """
    shortest_s = float(np.quantile(dwell_s, 0.002))
    if shortest_s < task.least_dwell_s:
        raise PassValueError(
            name="spindle_rpm",
            value=task.spindle_rpm,
            allowed=Phrase(
                "at most {most_rpm:.0f} rpm: at the greatest feed, F{feed_mm_per_min:.0f}, one round of the bob takes "
                "off {times:.2g} times what is planned; or more minutes, or a softer bob",
                most_rpm=task.spindle_rpm * shortest_s / task.least_dwell_s,
                feed_mm_per_min=task.most_feed_mm_per_min,
                times=task.least_dwell_s / shortest_s,
            ),
        )
    return int(shortest_s / task.least_dwell_s)


def polish_paths(
    surface: ToolSurface,
    lattice: Lattice,
    dwell_s: Array,
    task: PolishCut,
    *,
    rounds: int,
    top_mm: float,
    safe_z_mm: float,
) -> Iterator[Path]:
    """Yield the tip's moves, which begin and end at safe height.

    dwell_s (ny, nx) : of all rounds together; top_mm: of the highest stock
    """
    over_mm = max(top_mm, 0.0) + RAPID_CLEARANCE_MM
    if safe_z_mm < over_mm:
        raise SafeHeightError(safe_z_mm=safe_z_mm, needed_mm=over_mm)
    per_mm2 = dwell_s / (rounds * task.node_mm**2)
    corner, place = np.array([False, False]), None
    for number in range(rounds):
        for xy in _loops(lattice, task, along=number % 2, corner=corner):
            points = np.column_stack([xy, surface.tip_heights_mm(xy[:, 0], xy[:, 1])])
            if place is None:
                place, points = points[0], points[1:]
                yield rapid((place[0], place[1], safe_z_mm), (place[0], place[1], over_mm))
                yield cut([place], task.plunge_mm_per_min)
            yield from _with_feeds(np.vstack([place, points]), lattice, per_mm2, task)
            place = points[-1]
    assert place is not None
    yield leave(float(place[0]), float(place[1]), safe_z_mm=safe_z_mm)


def _loops(lattice: Lattice, task: PolishCut, *, along: int, corner: np.ndarray) -> Iterator[Array]:
    """Yield each row of a round as points (n, 2).

    along  : 0 for rows along X, 1 for rows along Y
    corner : (2,) whether it begins at the greater end of X, of Y; changed to that where it ends
    """
    axes = (lattice.x_mm, lattice.y_mm)
    near = lattice.near if along == 0 else lattice.near.T
    u, v = axes[along], axes[1 - along]
    visited = v[near.any(axis=1)]
    count = math.ceil((visited[-1] - visited[0]) / task.row_mm)
    rows = (visited[0] + visited[-1]) / 2 + task.row_mm * (np.arange(count + 1) - count / 2)
    rows = rows[::-1] if corner[1 - along] else rows
    phase, backward = 0.0, bool(corner[along])
    for row in rows:
        beside = near[np.abs(v - row) <= task.row_mm].any(axis=0)
        if not beside.any():
            continue
        ends = u[beside][[0, -1]]
        length = float(ends[1] - ends[0])
        steps = math.ceil(length / task.advance_mm * _CHORDS)
        first, last = (ends[1], ends[0]) if backward else (ends[0], ends[1])
        centre = np.linspace(first, last, steps + 1)
        angle = phase + 2 * math.pi / _CHORDS * np.arange(steps + 1)
        phase = float(angle[-1])
        pair = centre + task.loop_mm * np.cos(angle), row + task.loop_mm * np.sin(angle)
        yield np.column_stack(pair if along == 0 else pair[::-1])
        backward = not backward
    corner[along], corner[1 - along] = backward, not corner[1 - along]


def _with_feeds(points: Array, lattice: Lattice, per_mm2: Array, task: PolishCut) -> Iterator[Path]:
    """Yield the moves from the first of points (n, 3) to the others, at feeds that spend per_mm2 (ny, nx) of time on
    each area of the tip's plane, neighbours of like feed together.
    """
    middle = (points[1:] + points[:-1]) / 2
    places = (middle[:, 1] - lattice.y_mm[0]) / task.node_mm, (middle[:, 0] - lattice.x_mm[0]) / task.node_mm
    density = map_coordinates(per_mm2, places, order=1, mode="nearest")
    took_s = density * task.advance_mm * task.row_mm / _CHORDS  # the same on both sides of a loop, or rows show
    feed = 60 * np.linalg.norm(np.diff(points, axis=0), axis=1) / np.maximum(took_s, 1e-9)
    levels = np.rint(np.log(np.clip(feed, _SLOWEST_MM_PER_MIN, task.most_feed_mm_per_min)) / math.log(_FEED_STEP))
    begins = np.concatenate([[0], np.flatnonzero(np.diff(levels)) + 1, [len(levels)]]).astype(int)
    for begin, end in pairwise(begins):
        yield cut(points[1 + begin : 1 + end], round(float(_FEED_STEP ** levels[begin]), 1))


def _even_nodes(low: float, high: float, pitch: float) -> Array:
    count = math.ceil((high - low) / pitch)
    return np.asarray((low + high) / 2 + pitch * (np.arange(count + 1) - count / 2), dtype=np.float64)
