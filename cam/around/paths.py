"""Paths around the lens: facing the block, witness marks in its margin, cutting the lens out, and a trace in the air.

Facing: the cutter comes down beside the block and cuts in from the side, so it never plunges into stock. The first row
goes along the block's front edge, half over it, so no row is a slot. Between rows the cutter turns beside the block.

Witness marks: rows side by side in the margin, in one path; each at its own height.

Cutting out: around the outline layer by layer, each entered by a ramp, up and down over the tabs. The axis moves on a
closed line; places on it are lengths along it. The cutter sinks along it at the slope of all ramps, goes once around
and over the ramp again, and sinks on from where it is. Over a tab the height is the larger of the layer's and the
tab's: a plateau as wide as the tab and the cutter, with flanks. The larger of two straight pieces is convex, so chords
between the requested places never go below it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import acos, ceil

import numpy as np

from cam.around.specs import BESIDE_MM, FLANK_SLOPE, CutOut, Facing, WitnessCut
from cam.errors import OutlineError, PassValueError, SafeHeightError
from cam.moves import CLEARANCE_MM, RAPID_CLEARANCE_MM, Array, Path, cut, rapid
from cam.passes import Stock
from cam.rows.entries import RAMP_SLOPE, leave, make_ramp
from cam.surface.stock_grid import StockGrid
from phrases.phrase import Phrase

TRACE_FEED_MM_PER_MIN = 1200.0
"""20 mm/s: an eye follows it around the block, and a hand reaches the stop."""

ALLOWANCE_MM = 0.005
"""Left on the rim of the lens, so that neither chords nor the digits of a position cut into it."""

_SAGITTA_MM = 0.002  # how far the chords of a corner's arc lie inside it
_STRIDE_MM = 0.2  # between the points at which the fit of the cutter is tested
_STRAIGHT = 1e-9


def aperture_corners(stock: Stock) -> Array:
    """Return (4, 2) corners of the aperture, counter-clockwise."""
    return np.array([[0.0, 0.0], [stock.width_mm, 0.0], [stock.width_mm, stock.height_mm], [0.0, stock.height_mm]])


def block_corners(stock: Stock) -> Array:
    """Return (4, 2) corners of the block, counter-clockwise."""
    low, right, back = -stock.margin_mm, stock.width_mm + stock.margin_mm, stock.height_mm + stock.margin_mm
    return np.array([[low, low], [right, low], [right, back], [low, back]])


def trace_paths(
    stock: Stock, outline_mm: Sequence[Sequence[float]], *, safe_z_mm: float, feed_mm_per_min: float
) -> tuple[Path, ...]:
    """Return the paths around the block, then around the lens, all at the safe height.

    outline_mm : corners of a lens that is not a rectangle; empty for the aperture
    """
    lens = np.array(outline_mm, dtype=np.float64) if len(outline_mm) else aperture_corners(stock)
    paths: list[Path] = []
    for corners in (block_corners(stock), lens):
        around = np.column_stack([np.vstack([corners, corners[:1]]), np.full(len(corners) + 1, safe_z_mm)])
        paths += [rapid(around[0]), cut(around[1:], feed_mm_per_min)]
    return tuple(paths)


def offset_loop(corners_mm: Array, radius_mm: float, *, allowance_mm: float = ALLOWANCE_MM) -> Array:
    """Return the path of a cutter's axis around a closed outline: climb milling, clockwise, the first point repeated at
    the end.

    corners_mm (k, 2) : counter-clockwise
    allowance_mm      : kept from the outline in addition to the radius; more than a digit of the positions
    returns (n, 2)    : never nearer to the outline than the radius
    The path goes past hollows into which the cutter does not fit. Raises OutlineError if that is impossible.
    """
    away_mm = radius_mm + allowance_mm
    points = _around_each_corner(np.asarray(corners_mm, dtype=np.float64), away_mm)
    fits = _distances(points, corners_mm) >= away_mm - _SAGITTA_MM
    way = _without_straight_points(points[fits])[::-1]
    way = np.vstack([way, way[:1]])
    nearest = float(segment_distances(way[:-1], way[1:], corners_mm).min())
    if nearest < radius_mm:
        raise OutlineError(radius_mm=radius_mm, nearest_mm=nearest)
    return way


def _around_each_corner(corners: Array, away_mm: float) -> Array:
    """Return points beside every side and around every corner that points outward, counter-clockwise."""
    sides = np.roll(corners, -1, axis=0) - corners
    length = np.hypot(sides[:, 0], sides[:, 1])
    along = sides / length[:, None]
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    step = 2 * acos(1 - _SAGITTA_MM / away_mm)
    pieces = []
    for k in range(len(corners)):
        before = outward[k - 1]
        turn = np.arctan2(before[0] * outward[k, 1] - before[1] * outward[k, 0], before @ outward[k])
        if turn > _STRAIGHT:
            first = np.arctan2(before[1], before[0])
            angles = first + np.linspace(0.0, turn, ceil(turn / step) + 1)
            pieces.append(corners[k] + away_mm * np.column_stack([np.cos(angles), np.sin(angles)]))
        way = np.linspace(0.0, length[k], ceil(length[k] / _STRIDE_MM) + 1)
        pieces.append(corners[k] + away_mm * outward[k] + way[:, None] * along[k])
    return np.concatenate(pieces)


def _without_straight_points(points: Array) -> Array:
    """Return the same closed line without points that repeat or lie on the straight way between their neighbours."""
    points = points[np.hypot(*(points - np.roll(points, 1, axis=0)).T) > _STRAIGHT]
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    turn = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
    kept = turn > _STRAIGHT * np.hypot(*before.T) * np.hypot(*after.T)
    return points[kept]


def _distances(points: Array, corners: Array) -> Array:
    """Return (n,) distance of points (n, 2) from a closed outline (k, 2); 0 within it is not known."""
    found = np.full(len(points), np.inf)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        side = b - a
        share = np.clip(((points - a) @ side) / (side @ side), 0.0, 1.0)
        found = np.minimum(found, np.hypot(*(points - a - share[:, None] * side).T))
    return found


def segment_distances(start: Array, end: Array, corners: Array) -> Array:
    """Return (n,) the least distance of straight segments from start to end, (n, 2) each, from a closed outline (k, 2);
    0 where they cross it.

    Two segments that do not cross are nearest at an end of one of them.
    """
    found = np.minimum(_distances(start, corners), _distances(end, corners))
    step = end - start
    square = np.maximum(np.einsum("ij,ij->i", step, step), 1e-30)
    for corner in corners:
        share = np.clip(np.einsum("ij,ij->i", corner - start, step) / square, 0.0, 1.0)
        found = np.minimum(found, np.hypot(*(corner - start - share[:, None] * step).T))
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        found[_cross(start, end, a, b)] = 0.0
    return found


def _cross(p: Array, q: Array, a: Array, b: Array) -> np.ndarray:
    """Return (n,) whether the segments p-q (n, 2) cross the segment a-b."""

    def side(base: Array, tip: Array, point: Array) -> Array:
        along, to = tip - base, point - base
        return np.asarray(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])

    apart = side(a, b, p) * side(a, b, q) < 0
    return np.asarray(apart & (side(p, q, a) * side(p, q, b) < 0))


_ROOM_SHARE = 0.9  # share of the way between two tabs that their feet may take


def make_facing_paths(facing: Facing, stock: Stock, *, safe_z_mm: float) -> Iterator[Path]:
    """Yield the tip's moves, which begin and end at safe height; the last layer is at Z0."""
    over_mm = facing.above_mm + RAPID_CLEARANCE_MM
    if safe_z_mm < over_mm:
        raise SafeHeightError(safe_z_mm=safe_z_mm, needed_mm=over_mm)
    beside_mm = stock.margin_mm + facing.radius_mm + BESIDE_MM
    left, right = -beside_mm, stock.width_mm + beside_mm
    front, back = -stock.margin_mm, stock.height_mm + stock.margin_mm
    rows = np.linspace(front, back, ceil((back - front) / facing.pitch_mm - 1e-9) + 1)
    x = np.where(np.arange(rows.size)[:, None] % 2 == 0, [left, right], [right, left])
    way = np.column_stack([x.ravel(), np.repeat(rows, 2), np.zeros(2 * rows.size)])
    for z_mm in facing.levels_mm:
        yield rapid((left, front, safe_z_mm), (left, front, over_mm))
        yield cut([(left, front, z_mm)], facing.plunge_mm_per_min)
        yield cut(way[1:] + np.array([0.0, 0.0, z_mm]), facing.feed_mm_per_min)
        yield leave(way[-1, 0], way[-1, 1], safe_z_mm=safe_z_mm)


def make_witness_paths(task: WitnessCut, *, top_mm: float, safe_z_mm: float) -> Iterator[Path]:
    """Yield the tip's moves, which begin and end at safe height: down a ramp along the first row, then back and forth.

    top_mm : of the highest stock there
    """
    over_mm = max(top_mm, 0.0) + RAPID_CLEARANCE_MM
    if safe_z_mm < over_mm:
        raise SafeHeightError(safe_z_mm=safe_z_mm, needed_mm=over_mm)
    outer, inner = task.across_mm
    across = np.where(np.arange(len(task.places_mm))[:, None] % 2 == 0, [outer, inner], [inner, outer])
    way = np.column_stack([np.repeat(task.places_mm, 2), across.ravel(), np.repeat(task.tips_mm, 2)])
    if task.along == "y":
        way = way[:, [1, 0, 2]]
    x, y, _ = way[0]
    start_mm = max(top_mm, 0.0) + CLEARANCE_MM
    yield rapid((x, y, safe_z_mm), (x, y, over_mm))
    yield cut([(x, y, start_mm)], task.plunge_mm_per_min)
    yield cut(make_ramp(way[:2], start_mm), task.plunge_mm_per_min)
    yield cut(way[1:], task.feed_mm_per_min)
    yield leave(way[-1, 0], way[-1, 1], safe_z_mm=safe_z_mm)


def make_cut_out_paths(
    cut_out: CutOut, stock: Stock, loop_mm: Array, *, top_mm: float, safe_z_mm: float
) -> Iterator[Path]:
    """Yield the tip's moves, which begin and end at safe height.

    loop_mm (n, 2) : closed path of the axis, as `offset_loop` gives it; top_mm: of the stock along it
    """
    over_mm = max(top_mm, 0.0) + RAPID_CLEARANCE_MM
    if safe_z_mm < over_mm:
        raise SafeHeightError(safe_z_mm=safe_z_mm, needed_mm=over_mm)
    way = _ClosedWay(loop_mm, cut_out, stock.thickness_mm)
    depth_mm = top_mm + stock.thickness_mm + cut_out.through_mm
    count = ceil(depth_mm / cut_out.step_down_mm - 1e-9)
    levels = [top_mm + CLEARANCE_MM, *(top_mm - depth_mm * k / count for k in range(1, count + 1))]
    x, y = loop_mm[0]
    yield rapid((x, y, safe_z_mm), (x, y, over_mm))
    yield cut([(x, y, levels[0])], cut_out.plunge_mm_per_min)
    at_mm = 0.0
    for above_mm, level_mm in pairwise(levels):
        ramp_mm = (above_mm - level_mm) / RAMP_SLOPE
        points = way.points(at_mm, at_mm + ramp_mm + way.length_mm, ramp_mm=ramp_mm, from_mm=above_mm, to_mm=level_mm)
        yield from _with_feeds(points, cut_out)
        at_mm = (at_mm + ramp_mm) % way.length_mm
        x, y = points[-1, :2]
    yield leave(x, y, safe_z_mm=safe_z_mm)


def find_highest_along(loop_mm: Array, radius_mm: float, top: StockGrid) -> float:
    """Return the height of the highest stock that a cutter may meet along its path."""
    highest = [
        top.highest_mm(
            *(min(a[0], b[0]) - radius_mm, max(a[0], b[0]) + radius_mm),
            *(min(a[1], b[1]) - radius_mm, max(a[1], b[1]) + radius_mm),
        )
        for a, b in pairwise(loop_mm)
    ]
    return max(height for height in highest if height is not None)


class _ClosedWay:
    """A closed path and the tabs on it; places on it are given as the length from its beginning."""

    def __init__(self, loop_mm: Array, cut_out: CutOut, thickness_mm: float) -> None:
        self._run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(loop_mm, axis=0).T))])
        self._loop = loop_mm
        self.length_mm = float(self._run[-1])
        self._centres = np.array(cut_out.tab_centres_mm(self.length_mm))
        self._half_mm = cut_out.tab_width_mm / 2 + cut_out.radius_mm
        self._tab_mm = cut_out.tab_height_mm - thickness_mm
        room_mm = _ROOM_SHARE * self.length_mm / max(1, cut_out.tabs)
        if cut_out.tabs and 2 * cut_out.tab_foot_mm() > room_mm:
            most = int(_ROOM_SHARE * self.length_mm / (2 * cut_out.tab_foot_mm()))
            raise PassValueError(
                name="tabs",
                value=cut_out.tabs,
                allowed=Phrase(
                    "at most {most}: each tab, its flanks and the cutter take {each_mm:.1f} mm of the "
                    "{around_mm:.1f} mm around the lens",
                    most=most,
                    each_mm=2 * cut_out.tab_foot_mm(),
                    around_mm=self.length_mm,
                ),
            )

    def points(self, begin_mm: float, end_mm: float, *, ramp_mm: float, from_mm: float, to_mm: float) -> Array:
        """Return (n, 3) points from one length to another, without the first: sinking, then level, never into a tab."""
        turns = np.arange(int(end_mm // self.length_mm) + 1) * self.length_mm
        corners = (self._run[:-1] + turns[:, None]).ravel()
        tabs = (self._tab_places(to_mm) + turns[:, None]).ravel()
        places = np.unique(np.concatenate([corners, tabs, [begin_mm, begin_mm + ramp_mm, end_mm]]))
        places = places[(places >= begin_mm) & (places <= end_mm)]
        level = np.maximum(from_mm - (from_mm - to_mm) * (places - begin_mm) / ramp_mm, to_mm)
        around = places % self.length_mm
        xy = [np.interp(around, self._run, self._loop[:, axis]) for axis in (0, 1)]
        points = np.column_stack([*xy, np.maximum(level, self._tab_heights(around))])
        return points[1:]

    def _tab_places(self, level_mm: float) -> Array:
        """Return where the height bends: ends of plateaus, and feet of flanks on a level."""
        foot_mm = max(0.0, self._tab_mm - level_mm) / FLANK_SLOPE
        beside = [-self._half_mm - foot_mm, -self._half_mm, self._half_mm, self._half_mm + foot_mm]
        return np.asarray((self._centres[:, None] + beside).ravel() % self.length_mm)

    def _tab_heights(self, around_mm: Array) -> Array:
        heights = np.full(around_mm.shape, -np.inf)
        for centre in self._centres:
            away = np.abs((around_mm - centre + self.length_mm / 2) % self.length_mm - self.length_mm / 2)
            flank = self._tab_mm - FLANK_SLOPE * np.maximum(0.0, away - self._half_mm)
            heights = np.maximum(heights, flank)
        return heights


def _with_feeds(points: Array, cut_out: CutOut) -> Iterator[Path]:
    """Yield level pieces at the feed and all others at the plunge feed. The first piece is a ramp."""
    slanted = np.concatenate([[True], np.abs(np.diff(points[:, 2])) > 1e-9])
    begins = np.flatnonzero(np.concatenate([[True], slanted[1:] != slanted[:-1]]))
    for begin, end in pairwise([*begins, len(points)]):
        yield cut(points[begin:end], cut_out.plunge_mm_per_min if slanted[begin] else cut_out.feed_mm_per_min)
