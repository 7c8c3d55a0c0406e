"""The lens's outline within its aperture: a rectangle, or the polygon that the block is cut to.

The frame goes onto the rim of the outline's convex hull. The area between an outline that is not convex (a star, a
crescent) and its hull gets little light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.spatial import ConvexHull

from optics.bench import Bench
from optics.light import Beam
from optics.spline import Array

_SAMPLES = 2049
_BLEND = 5.0  # margins over which the surface outside becomes smooth
_MASK = 257  # nodes along a side of the mask of an outline that the frame does not fit
_SHALLOW = 0.001  # of the hull: notches that do not count
_COARSEST, _DIM_AT_COARSEST, _DIMMEST = 32, 0.3, 0.03


@dataclass(frozen=True, slots=True, eq=False)
class RimCurves:
    """Left and right rim x_of_y (2, m), bottom and top rim y_of_x (2, m), at even positions over the aperture."""

    x_of_y: Array
    y_of_x: Array
    cells_per_mm_x: float  # of positions along x, so of y_of_x
    cells_per_mm_y: float


def rim_curves(bench: Bench) -> RimCurves:
    """Return the rim of the outline's convex hull; without an outline, of the aperture."""
    width, height = bench.width_mm, bench.height_mm
    if bench.outline_mm is None:
        return _curves_of(np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]), bench)
    return _curves_of(_hull(bench), bench)


def _curves_of(corners: Array, bench: Bench) -> RimCurves:
    width, height = bench.width_mm, bench.height_mm
    x_of_y, y_of_x = _extremes(corners[:, ::-1], height), _extremes(corners, width)
    return RimCurves(
        x_of_y=x_of_y,
        y_of_x=y_of_x,
        cells_per_mm_x=(y_of_x.shape[1] - 1) / width,
        cells_per_mm_y=(x_of_y.shape[1] - 1) / height,
    )


def _extremes(corners: Array, size: float) -> Array:
    """Return the extreme second coordinates (2, m) of a closed polygon (k, 2) at even positions of the first."""
    at = np.linspace(0.0, size, _SAMPLES)
    low, high = np.full(_SAMPLES, np.inf), np.full(_SAMPLES, -np.inf)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if x0 == x1:
            continue
        inside = (at >= min(x0, x1)) & (at <= max(x0, x1))
        y = y0 + (at[inside] - x0) * (y1 - y0) / (x1 - x0)
        low[inside] = np.minimum(low[inside], y)
        high[inside] = np.maximum(high[inside], y)
    known = np.isfinite(low)
    return np.stack([np.interp(at, at[known], low[known]), np.interp(at, at[known], high[known])])


def is_inside(outline_mm: Array, x_mm: Array, y_mm: Array) -> Array:
    """Return (my, mx) whether the points (x_mm[i], y_mm[j]) are in the polygon (k, 2): edges to their left are odd."""
    inside = np.zeros((y_mm.size, x_mm.size), dtype=bool)
    corners = np.asarray(outline_mm, dtype=np.float64)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        rows = np.flatnonzero((y_mm >= min(y0, y1)) & (y_mm < max(y0, y1)))
        at = x0 + (y_mm[rows] - y0) * (x1 - x0) / (y1 - y0) if y0 != y1 else np.empty(0)
        inside[rows] ^= x_mm[None, :] > at[:, None]
    return inside


def lower_outside(t: Array, bench: Bench, x_mm: Array, y_mm: Array, *, margin_mm: float) -> Array:
    """Return heights (my, mx) that are smooth outside the outline, and nowhere above the greatest height inside and
    around it.

    Places that the map does not reach are cut away; if one of them were the highest, the lens would lie deeper than
    designed. A margin stays, because it affects the spline inside.
    """
    if bench.outline_mm is None:
        return t
    cells = max(1, round(margin_mm / float(x_mm[1] - x_mm[0])))
    outside = distance_transform_edt(np.logical_not(is_inside(_hull(bench), x_mm, y_mm)))  # in cells
    highest = t[outside <= cells].max()
    share = np.clip((outside - cells) / (_BLEND * cells), 0.0, 1.0) ** 2
    smooth = gaussian_filter(t, 2.0 * cells, mode="nearest")  # run-outs of single rays are ridges, useless to a cutter
    return np.asarray(np.where(outside <= cells, t, np.minimum(t + share * (smooth - t), highest)))


def _hull(bench: Bench) -> Array:
    """Return corners (k, 2) of the convex hull of the bench's outline."""
    corners = np.asarray(bench.outline_mm, dtype=np.float64)
    return np.asarray(corners[ConvexHull(corners).vertices])


def share_notched(bench: Bench) -> float:
    """Return the share of the outline's convex hull that the outline leaves out: 0 for a convex outline."""
    if bench.outline_mm is None:
        return 0.0
    share = 1.0 - _area(np.asarray(bench.outline_mm)) / _area(_hull(bench))
    return share if share > _SHALLOW else 0.0


def _area(corners: Array) -> float:
    x, y = corners[:, 0], corners[:, 1]
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def dim_outside(beam: Beam, bench: Bench, *, pixels: int) -> Beam:
    """Return the beam, dimmed inside the frame but outside the outline: the finer the grid, the dimmer.

    Only for outlines that are not convex. With no light there the solution would be undetermined, so a few per cent
    stay; the corrections see the true outline and compensate.
    """
    if share_notched(bench) == 0.0:
        return beam
    x, y = np.linspace(0.0, bench.width_mm, _MASK), np.linspace(0.0, bench.height_mm, _MASK)
    mask = is_inside(np.asarray(bench.outline_mm), x, y).astype(np.float64)
    mask = gaussian_filter(mask, max(1.0, 0.7 * _MASK / pixels), mode="nearest")
    left = max(_DIMMEST, _DIM_AT_COARSEST * _COARSEST / pixels)
    strength = np.ones((_MASK, _MASK))
    if beam.strength.size > 1:
        my, mx = beam.strength.shape
        rows, columns = np.meshgrid(np.linspace(0, my - 1, _MASK), np.linspace(0, mx - 1, _MASK), indexing="ij")
        strength = map_coordinates(beam.strength, [rows, columns], order=1, mode="nearest")
    return beam._replace(
        strength=np.ascontiguousarray(strength * (left + (1.0 - left) * mask)),
        cells_per_mm_x=(_MASK - 1) / bench.width_mm,
        cells_per_mm_y=(_MASK - 1) / bench.height_mm,
    )
