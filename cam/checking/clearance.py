"""Checks the ball against the design surface, move by move: how far a move cuts below the lens, also between the cells.

The ball's centre C and the surface point q nearest to it decide: the ball's underside at q is below the surface
exactly where |C - q| < R. Every point tried is a true witness (the stock there is gone after the move), so a search
that stops early can only miss a gouge, never report a false one; cells (`removal`) find the rest without any search.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from cam.passes import PassSpec
from cam.reading.gcode import MoveBatch
from cam.surface.stock_touch import rise_mm
from optics.heightfield import Array, Heightfield, spline_jet

_SAMPLE_MM = 0.1  # at most this far apart along a move, and always its middle and its end
_CLOSE_MM = 1e-5  # a Newton step this short changes the overlap by its square over R
_TRIES = 12
_RINGS, _SPOKES, _RIM_SHARE = 6, 24, 0.999  # places on the underside of a flat cutter; the rim, just inside
_OTHER_STARTS = ((0.0, 0.0), (0.6, 0.0), (-0.6, 0.0), (0.0, 0.6), (0.0, -0.6))  # in radii, if the usual one is clear


@njit(cache=True, nogil=True)
def _find_overlap(coefs, x0, y0, inv_dx, inv_dy, width, height, cx, cy, tip, radius, offset):  # type: ignore[no-untyped-def]
    """Return the greatest (overlap, x, y, with run-out) of the surface over the ball's underside near tip (cx, cy).

    Newton on (q - C) perpendicular to the surface, from q = tip + offset; offset is updated. Points beyond the aperture
    are moved to its rim before they count, except for the last value. -inf where the ball reaches no such point.
    """
    best = anywhere = -math.inf
    best_x = best_y = math.nan
    cz = tip + radius
    x = cx + offset[0]
    y = cy + offset[1]
    for _ in range(_TRIES):
        h, hx, hy, hxx, hxy, hyy = spline_jet(coefs, x0, y0, inv_dx, inv_dy, x, y)
        px = min(max(x, 0.0), width)
        py = min(max(y, 0.0), height)
        hp = h
        r2 = radius * radius - (x - cx) ** 2 - (y - cy) ** 2
        if r2 > 0.0:
            anywhere = max(anywhere, h - cz + math.sqrt(r2))
        if px != x or py != y:
            hp = spline_jet(coefs, x0, y0, inv_dx, inv_dy, px, py)[0]
        r2 = radius * radius - (px - cx) ** 2 - (py - cy) ** 2
        if r2 > 0.0:
            overlap = hp - cz + math.sqrt(r2)
            if overlap > best:
                best = overlap
                best_x = px
                best_y = py
        lift = h - cz
        fx = x - cx + lift * hx
        fy = y - cy + lift * hy
        a = 1.0 + hx * hx + lift * hxx
        b = hx * hy + lift * hxy
        d = 1.0 + hy * hy + lift * hyy
        det = a * d - b * b
        if det > 1e-3 and a > 0.0:
            sx = -(d * fx - b * fy) / det
            sy = -(a * fy - b * fx) / det
        else:  # not a minimum here: descend the distance
            sx = -0.3 * fx
            sy = -0.3 * fy
        step = math.hypot(sx, sy)
        if step > 0.5 * radius:
            sx *= 0.5 * radius / step
            sy *= 0.5 * radius / step
        x += sx
        y += sy
        away = math.hypot(x - cx, y - cy)
        if away > 0.98 * radius:  # the contact of a ball lies under its own lower half
            x = cx + (x - cx) * 0.98 * radius / away
            y = cy + (y - cy) * 0.98 * radius / away
        if step < _CLOSE_MM:
            break
    offset[0] = x - cx
    offset[1] = y - cy
    return best, best_x, best_y, anywhere


@njit(cache=True, nogil=True)
def _fill_overlaps(  # type: ignore[no-untyped-def]
    coefs, x0, y0, inv_dx, inv_dy, width, height, points, rapid, pause, radius, near, offset, depth, place, touch, rest
):
    """Compute depth (n,), place (n, 2), touch and rest (n,) of every move.

    offset (2,): from tip to last contact, kept between calls
    """
    trial = np.zeros(2)
    for k in range(depth.size):
        depth[k] = touch[k] = rest[k] = -math.inf
        if rapid[k] or pause[k] >= 0.0:
            continue
        dx = points[k + 1, 0] - points[k, 0]
        dy = points[k + 1, 1] - points[k, 1]
        dz = points[k + 1, 2] - points[k, 2]
        pieces = 2 * max(1, int(math.ceil(math.hypot(dx, dy) / (2.0 * _SAMPLE_MM))))
        for j in range(1, pieces + 1):
            t = j / pieces
            x = points[k, 0] + t * dx
            y = points[k, 1] + t * dy
            if x < -radius or y < -radius or x > width + radius or y > height + radius:
                continue
            tip = points[k, 2] + t * dz
            found, px, py, any_place = _find_overlap(
                coefs, x0, y0, inv_dx, inv_dy, width, height, x, y, tip, radius, offset
            )
            touch[k] = max(touch[k], any_place)
            if j == pieces:
                rest[k] = any_place
            if found > depth[k]:
                depth[k] = found
                place[k, 0] = px
                place[k, 1] = py
        if rest[k] > -near or touch[k] == -math.inf:
            continue
        for start_x, start_y in _OTHER_STARTS:  # the ball may touch another flank than the one that was followed
            trial[0] = start_x * radius
            trial[1] = start_y * radius
            x, y, tip = points[k + 1, 0], points[k + 1, 1], points[k + 1, 2]
            found, px, py, any_place = _find_overlap(
                coefs, x0, y0, inv_dx, inv_dy, width, height, x, y, tip, radius, trial
            )
            if found > depth[k]:
                depth[k] = found
                place[k, 0] = px
                place[k, 1] = py
            rest[k] = max(rest[k], any_place)
            if any_place > touch[k]:
                touch[k] = any_place
                offset[0] = trial[0]
                offset[1] = trial[1]


@njit(cache=True, nogil=True)
def _fill_flat_overlaps(  # type: ignore[no-untyped-def]
    coefs, x0, y0, inv_dx, inv_dy, width, height, points, rapid, pause, places, step, most, depth, place, touch, rest
):
    """Compute the same of every move, for an underside known at places (m, 3) beside and above its tip.

    most: greatest height of the surface within reach above its height under the axis; tips higher than that are skipped
    """
    for k in range(depth.size):
        depth[k] = touch[k] = rest[k] = -math.inf
        if rapid[k] or pause[k] >= 0.0:
            continue
        dx = points[k + 1, 0] - points[k, 0]
        dy = points[k + 1, 1] - points[k, 1]
        dz = points[k + 1, 2] - points[k, 2]
        pieces = max(1, int(math.ceil(math.hypot(dx, dy) / step)))
        for j in range(1, pieces + 1):
            t = j / pieces
            rest[k] = -math.inf
            middle = spline_jet(coefs, x0, y0, inv_dx, inv_dy, points[k, 0] + t * dx, points[k, 1] + t * dy)[0]
            if points[k, 2] + t * dz > middle + most:
                continue
            for m in range(places.shape[0]):
                x = points[k, 0] + t * dx + places[m, 0]
                y = points[k, 1] + t * dy + places[m, 1]
                h = spline_jet(coefs, x0, y0, inv_dx, inv_dy, x, y)[0]
                over = h - points[k, 2] - t * dz - places[m, 2]
                rest[k] = max(rest[k], over)
                if over > depth[k] and 0.0 <= x <= width and 0.0 <= y <= height:
                    depth[k] = over
                    place[k, 0] = x
                    place[k, 1] = y
            touch[k] = max(touch[k], rest[k])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlaps:
    """Per move: greatest height of the surface above the ball's underside; > 0 gouges, < 0 is clear by that much.

    depth_mm (n,)    : in the aperture; -inf for rapids, pauses and moves beyond its reach
    place_mm (n, 2)  : where that is
    touch_mm (n,)    : the same with the run-out, on which a large ball may ride while its tip is over the aperture
    end_touch_mm (n,): that where the move ends
    """

    depth_mm: Array
    place_mm: Array
    touch_mm: Array
    end_touch_mm: Array


class SurfaceWitness:
    """Watches one pass against one lens; keeps the last contact as the next start.

    near_mm : a move farther than this above the surface is checked again from other starts
    """

    def __init__(self, heightfield: Heightfield, *, radius_mm: float, near_mm: float) -> None:
        self._surface = heightfield.spline_with_run_out(2 * radius_mm)
        self._size = heightfield.width_mm, heightfield.height_mm
        self._radius_mm, self._near_mm = radius_mm, near_mm
        self._offset = np.zeros(2)

    def overlaps(self, batch: MoveBatch) -> Overlaps:
        depth, touch, rest = np.empty(len(batch)), np.empty(len(batch)), np.empty(len(batch))
        place = np.full((len(batch), 2), np.nan)
        _fill_overlaps(
            *(*self._surface.kernel_arguments, *self._size, batch.points_mm, batch.is_rapid, batch.pause_s),
            *(self._radius_mm, self._near_mm, self._offset, depth, place, touch, rest),
        )
        return Overlaps(depth_mm=depth, place_mm=place, touch_mm=touch, end_touch_mm=rest)


class FlatWitness:
    """Watches one pass of a flat cutter: its underside is tested at some places, on every stretch of a move."""

    def __init__(self, heightfield: Heightfield, spec: PassSpec, *, near_mm: float) -> None:
        radius_mm, shape = spec.radius_mm, spec.shape
        self._most_mm = radius_mm * heightfield.steepest + near_mm
        self._surface = heightfield.spline_with_run_out(2 * radius_mm)
        self._size = heightfield.width_mm, heightfield.height_mm
        shares = np.concatenate([np.arange(1, _RINGS) / _RINGS, [_RIM_SHARE]])
        away = np.unique(np.concatenate([shape.flat_mm(radius_mm) * shares[shares < 1], radius_mm * shares]))
        turns = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
        x, y = (np.concatenate([[0.0], np.outer(away, trace(turns)).ravel()]) for trace in (np.cos, np.sin))
        self._places = np.column_stack([x, y, rise_mm(shape, radius_mm, np.hypot(x, y))])
        self._step_mm = radius_mm / _RINGS

    def overlaps(self, batch: MoveBatch) -> Overlaps:
        depth, touch, rest = np.empty(len(batch)), np.empty(len(batch)), np.empty(len(batch))
        place = np.full((len(batch), 2), np.nan)
        _fill_flat_overlaps(
            *(*self._surface.kernel_arguments, *self._size, batch.points_mm, batch.is_rapid, batch.pause_s),
            *(self._places, self._step_mm, self._most_mm, depth, place, touch, rest),
        )
        return Overlaps(depth_mm=depth, place_mm=place, touch_mm=touch, end_touch_mm=rest)


def witness_of(heightfield: Heightfield, spec: PassSpec, *, near_mm: float) -> SurfaceWitness | FlatWitness:
    """Return the witness for the pass's cutter. near_mm: see `SurfaceWitness`."""
    if spec.is_ball:
        return SurfaceWitness(heightfield, radius_mm=spec.radius_mm, near_mm=near_mm)
    return FlatWitness(heightfield, spec, near_mm=near_mm)
