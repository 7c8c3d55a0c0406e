"""Undersides of end mills, and the largest ball that a surface admits."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from cam.cutters import CutterShape
from cam.moves import Array
from optics.heightfield import Heightfield

NEARLY_EVERYWHERE = 0.999


def rise_mm(shape: CutterShape, radius_mm: float, away_mm: ArrayLike) -> Array:
    """Return how high the underside stands above the tip, so far from the axis; beyond the rim as high as there."""
    corner_mm = shape.corner_mm(radius_mm)
    beyond = np.clip(np.asarray(away_mm) - shape.flat_mm(radius_mm), 0.0, corner_mm)
    return np.asarray(corner_mm - np.sqrt(corner_mm**2 - beyond**2))


def slot_section_mm2(shape: CutterShape, radius_mm: float, depth_mm: ArrayLike) -> Array:
    """Return the section of a slot in a plane, its walls upright above the corner."""
    corner_mm, depth = shape.corner_mm(radius_mm), np.asarray(depth_mm)
    rise = np.clip(corner_mm - depth, 0.0, corner_mm)
    segment = corner_mm**2 * np.arccos(rise / max(corner_mm, 1e-12)) - rise * np.sqrt(corner_mm**2 - rise**2)
    return np.asarray(
        segment + 2 * corner_mm * np.maximum(depth - corner_mm, 0.0) + 2 * shape.flat_mm(radius_mm) * depth
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FittingRadius:
    """Largest ball whose curvature fits the hollows: everywhere, and on 99.9 % of the area; inf without hollows."""

    everywhere_mm: float
    nearly_mm: float


def concave_curvature(heightfield: Heightfield) -> Array:
    """Return the greatest principal curvature [1/mm], positive in a hollow, on a lattice twice as fine as vertices."""
    x, y = (np.linspace(a[0], a[-1], 2 * a.size - 1) for a in (heightfield.x_mm, heightfield.y_mm))
    return heightfield.spline().concave_curvature(x, y)


def largest_fitting_radius_mm(heightfield: Heightfield) -> FittingRadius:
    """Return what curvature admits. A ball this large may still not reach where two slopes stand close together."""
    curvature = concave_curvature(heightfield).ravel()
    rank = int(NEARLY_EVERYWHERE * (curvature.size - 1))
    nearly = float(np.partition(curvature, rank)[rank])
    most = float(curvature.max())
    return FittingRadius(everywhere_mm=1.0 / most if most > 0 else inf, nearly_mm=1.0 / nearly if nearly > 0 else inf)


def find_reached_share(heightfield: Heightfield, radius_mm: float) -> float:
    """Return the share of the area whose curvature a ball of this radius fits."""
    return float((concave_curvature(heightfield) * radius_mm <= 1.0).mean())
