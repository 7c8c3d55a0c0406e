"""How the tool comes down: by a rapid to a height over the block, at the plunge feed to just above the stock, then on a
ramp.

A ball's dead centre does not cut, so no entry goes straight down into stock: it sinks at three degrees along the path's
first stretch or, where a pocket leaves that too short, round a helix beside it. A path that covers its first stretch
again later is entered in its direction, without turning back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import ceil, pi, radians, tan

import numpy as np

from cam.moves import CLEARANCE_MM, RAPID_CLEARANCE_MM, Array, Path, cut, rapid
from cam.passes import PassSpec
from cam.rows.vertices import TICKS_PER_MM, thin_points

RAMP_DEG = 3.0
RAMP_SLOPE = tan(radians(RAMP_DEG))
RAMP_STRETCH_MM = 15.0
STRAIGHT_MM = 1e-6
"""Points this near to a straight line are not written: a leg of a ramp is one move until it meets the path."""

MOST_LEGS = 4
"""A ramp that would turn back more often than this becomes a helix, where one may be."""

_RINGS = (0.5, 0.25)  # radii of a helix, in radii of the ball: neither leaves a core
_RING_POINTS = 48


@dataclass(frozen=True, slots=True, kw_only=True)
class Pocket:
    """Where a helix may go: above the floor, within a rectangle (left, right, front, back) of tips."""

    floor_mm: Callable[[Array, Array], Array]
    region_mm: tuple[float, float, float, float]


def enter(
    polyline_mm: Array, stock_mm: float, spec: PassSpec, *, safe_z_mm: float, pocket: Pocket | None = None
) -> Iterator[Path]:
    """Yield the way from safe height to the first point of a polyline (n, 3), its first stretch cut on the way.

    stock_mm : tip height at which the ball would meet stock above the first point; at or below that point: air
    pocket   : allows a helix beside the first point, where its highest floor is not above stock_mm
    """
    x, y, z = polyline_mm[0]
    yield _over(x, y, max(stock_mm, z), safe_z_mm)
    if stock_mm <= z:
        yield cut([polyline_mm[0]], spec.plunge_mm_per_min)
        return
    start_mm = min(stock_mm + CLEARANCE_MM, safe_z_mm)
    yield cut([(x, y, start_mm)], spec.plunge_mm_per_min)
    way = None
    if pocket is not None and _legs(polyline_mm, start_mm) > MOST_LEGS:
        way = make_helix(polyline_mm, start_mm, spec, pocket)
    yield cut(make_ramp(polyline_mm, start_mm) if way is None else way, spec.plunge_mm_per_min)


def enter_onward(polyline_mm: Array, stock_mm: float, spec: PassSpec, *, safe_z_mm: float) -> Iterator[Path]:
    """Yield the way from safe height to the last point of a polyline (n, 3), without turning back if it is long enough.

    The rest of the path removes the stock above the stretch on which the tool sinks.
    """
    x, y, z = polyline_mm[0]
    start_mm = min(stock_mm + CLEARANCE_MM, safe_z_mm) if stock_mm > z else float(z)
    run = _runs(polyline_mm)[0]
    if start_mm - z > RAMP_SLOPE * run[-1]:
        yield from enter(polyline_mm, stock_mm, spec, safe_z_mm=safe_z_mm)
        yield cut(polyline_mm, spec.plunge_mm_per_min)
        return
    yield _over(x, y, max(start_mm, z), safe_z_mm)
    sunk = polyline_mm.copy()
    sunk[:, 2] += np.maximum(0.0, start_mm - z - RAMP_SLOPE * run)
    yield cut(sunk, spec.plunge_mm_per_min)


def _over(x_mm: float, y_mm: float, stock_mm: float, safe_z_mm: float) -> Path:
    """Return the rapid to a height over the block, and the move down to just above the stock."""
    over_mm = max(stock_mm, 0.0) + RAPID_CLEARANCE_MM
    above = (x_mm, y_mm, safe_z_mm)
    return rapid(above, (x_mm, y_mm, over_mm)) if over_mm < safe_z_mm else rapid(above)


def leave(x_mm: float, y_mm: float, *, safe_z_mm: float) -> Path:
    """Return the path straight up."""
    return rapid((x_mm, y_mm, safe_z_mm))


def _runs(polyline_mm: Array) -> tuple[Array, float]:
    """Return (n,) distance in plan from the first point; and how much of it a ramp may use."""
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(polyline_mm[:, :2], axis=0).T))])
    return run, min(float(run[-1]), RAMP_STRETCH_MM)


def _travel_mm(polyline_mm: Array, run: Array, longest: float, start_mm: float) -> float:
    """Return how far a ramp goes until it has come down to the lowest point of the stretch."""
    last = np.array([np.interp(longest, run, polyline_mm[:, 2])])
    return (start_mm - float(np.concatenate([polyline_mm[run <= longest, 2], last]).min())) / RAMP_SLOPE


def _legs(polyline_mm: Array, start_mm: float) -> int:
    run, longest = _runs(polyline_mm)
    return 2 * ceil(_travel_mm(polyline_mm, run, longest, start_mm) / (2 * longest))


def make_ramp(polyline_mm: Array, start_mm: float) -> Array:
    """Return (m, 3) there and back on the first stretch, sinking at RAMP_SLOPE, never below the polyline, to its start.

    Long drops over short polylines go back and forth often. Where the path is higher than the ramp the tool follows
    the path. Legs of a polyline along X or along Y are thinned to the moves they need.
    """
    run, longest = _runs(polyline_mm)
    travel = _travel_mm(polyline_mm, run, longest, start_mm)
    legs = 2 * ceil(travel / (2 * longest))
    stretch = travel / legs
    inner = run[(run > 0) & (run < stretch)]
    places = np.union1d(np.linspace(0.0, stretch, max(3, ceil(stretch / 0.25) + 1)), inner)
    path = np.column_stack([np.interp(places, run, polyline_mm[:, a]) for a in range(3)])
    straight = np.ptp(path[:, :2], axis=0) == 0  # in x, in y
    sunk: list[Array] = []
    for leg in range(legs):
        way, done = (path, places) if leg % 2 == 0 else (path[::-1], stretch - places[::-1])
        points = way.copy()
        points[:, 2] = np.maximum(way[:, 2], start_mm - RAMP_SLOPE * (leg * stretch + done))
        sunk.append(thin_points(points, STRAIGHT_MM, along=int(straight[0])) if straight.any() else points)
    sunk[-1][-1] = polyline_mm[0]
    return np.concatenate(sunk)


def make_helix(polyline_mm: Array, start_mm: float, spec: PassSpec, pocket: Pocket) -> Array | None:
    """Return (m, 3) round a circle that touches the path in its first point, sinking at RAMP_SLOPE at most, down to the
    floor.

    Of the circles beside the path the one whose floor rises least is taken, so that the tool stays in the pocket and
    does not climb its walls; None if none lies within the region. Where the floor is higher the tool follows it.
    """
    best: Array | None = None
    for share in _RINGS:
        for side in (1.0, -1.0) if spec.direction == "x" else (-1.0, 1.0):  # the climbing way first
            ring = _ring(polyline_mm, share * spec.radius_mm, side, pocket)
            if ring is not None and (best is None or ring[:, 2].max() < best[:, 2].max() - STRAIGHT_MM):
                best = ring
    if best is None or best[:, 2].max() > start_mm:
        return None
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(best[:, :2], axis=0).T))])
    drop_mm = start_mm - float(best[:, 2].min())
    turns = ceil(drop_mm / (RAMP_SLOPE * run[-1]))
    sunk: list[Array] = []
    for turn in range(turns):
        points = best[1:].copy()
        points[:, 2] = np.maximum(points[:, 2], start_mm - drop_mm * (turn + run[1:] / run[-1]) / turns)
        sunk.append(points)
    sunk[-1][-1] = polyline_mm[0]
    return np.concatenate(sunk)


def _ring(polyline_mm: Array, radius_mm: float, side: float, pocket: Pocket) -> Array | None:
    """Return (n, 3) a circle on the floor from the first point to itself, leaving it along the path; None beyond the
    region.

    side : 1 with the centre on the left of the path, -1 on its right
    """
    along = polyline_mm[1, :2] - polyline_mm[0, :2]
    along = along / np.hypot(*along)
    across = side * np.array([-along[1], along[0]])
    angle = np.linspace(0.0, 2 * pi, _RING_POINTS + 1)[:, None]
    xy = polyline_mm[0, :2] + radius_mm * (np.sin(angle) * along + (1 - np.cos(angle)) * across)
    xy = np.round(xy * TICKS_PER_MM) / TICKS_PER_MM
    left, right, front, back = pocket.region_mm
    if xy[:, 0].min() < left or xy[:, 0].max() > right or xy[:, 1].min() < front or xy[:, 1].max() > back:
        return None
    return np.column_stack([xy, pocket.floor_mm(xy[:, 0], xy[:, 1])])
