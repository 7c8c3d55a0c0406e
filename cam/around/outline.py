"""Closed lines around the lens: traced in the air, and a cutter's radius outside for cutting the lens out."""

from __future__ import annotations

from collections.abc import Sequence
from math import acos, ceil

import numpy as np

from cam.errors import OutlineError
from cam.moves import Array, Path, cut, rapid
from cam.passes import Stock

TRACE_FEED_MM_PER_MIN = 1200.0
"""20 mm/s: an eye follows it around the block, and a hand reaches the stop."""

ALLOWANCE_MM = 0.005
"""Left on the rim of the lens, so that neither chords nor the digits of a position cut into it."""

_SAGITTA_MM = 0.002  # by which the chords of a corner's arc are inside it
_STRIDE_MM = 0.2  # between the points that are asked whether the cutter fits there
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

    outline_mm : corners of a lens that is no rectangle; empty for the aperture
    """
    lens = np.array(outline_mm, dtype=np.float64) if len(outline_mm) else aperture_corners(stock)
    paths: list[Path] = []
    for corners in (block_corners(stock), lens):
        around = np.column_stack([np.vstack([corners, corners[:1]]), np.full(len(corners) + 1, safe_z_mm)])
        paths += [rapid(around[0]), cut(around[1:], feed_mm_per_min)]
    return tuple(paths)


def offset_loop(corners_mm: Array, radius_mm: float, *, allowance_mm: float = ALLOWANCE_MM) -> Array:
    """Return the way of a cutter's axis around a closed outline, climbing: clockwise, the first point again at the end.

    corners_mm (k, 2) : counter-clockwise
    allowance_mm      : kept from the outline beside the radius; more than a digit of the positions
    returns (n, 2)    : nowhere nearer to the outline than the radius
    Where the outline is hollow and the cutter does not fit in, the way goes past. OutlineError where it cannot.
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
    """Return (n,) how near straight ways from start to end, (n, 2) each, come to a closed outline (k, 2); 0 where they
    cross.

    Of two segments that do not cross, the least distance is that of an end of one from the other.
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
