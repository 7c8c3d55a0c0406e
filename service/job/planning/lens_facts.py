"""Facts of a lens that decide whether it can be milled: relief, steepest slope, tightest hollow."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, degrees, inf

import numpy as np

from cam.surface.stock_touch import concave_curvature
from optics.heightfield import Array, Heightfield

_ROWS_AT_ONCE = 128
_PERCENTILES = (50.0, 90.0, 99.0, 99.9, 100.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LensFacts:
    """Balls that the curvature allows; such a ball may still not reach a place between two close slopes.

    min_concave_radius_mm                  : largest ball that fits everywhere; inf if nothing is concave
    radius_for_99_mm, radius_for_999_mm    : largest ball for 99 % and 99.9 % of the aperture
    curvature                              : (n,) greatest principal curvature, positive in a hollow [1/mm]
    curvature_per_mm                       : percentiles of it over the area; negative for a bulge
    """

    relief_mm: float
    max_slope_deg: float
    min_concave_radius_mm: float
    radius_for_99_mm: float
    radius_for_999_mm: float
    curvature: Array
    curvature_per_mm: dict[str, float]

    def reached_share(self, radius_mm: float) -> float:
        """Return the share of the aperture whose curvature a ball of this radius fits."""
        return float(np.count_nonzero(self.curvature <= 1.0 / radius_mm)) / self.curvature.size


def measure_lens(heightfield: Heightfield) -> LensFacts:
    """Measure curvature on a lattice twice as fine as the vertices, slope at the vertices; both of the C2 spline."""
    curvature = concave_curvature(heightfield).ravel()
    found = np.percentile(curvature, _PERCENTILES)
    percentiles = {f"p{share:g}": float(value) for share, value in zip(_PERCENTILES, found, strict=True)}
    return LensFacts(
        relief_mm=heightfield.relief_mm,
        max_slope_deg=degrees(atan(_steepest(heightfield))),
        min_concave_radius_mm=_radius(percentiles["p100"]),
        radius_for_99_mm=_radius(percentiles["p99"]),
        radius_for_999_mm=_radius(percentiles["p99.9"]),
        curvature=curvature,
        curvature_per_mm=percentiles,
    )


def _steepest(heightfield: Heightfield) -> float:
    spline, steepest = heightfield.spline(), 0.0
    for top in range(0, heightfield.y_mm.size, _ROWS_AT_ONCE):
        rows = heightfield.y_mm[top : top + _ROWS_AT_ONCE, None]
        _, p, q, *_ = spline.jets(heightfield.x_mm[None, :], rows)
        steepest = max(steepest, float(np.hypot(p, q).max()))
    return steepest


def _radius(curvature: float) -> float:
    return 1.0 / curvature if curvature > 1e-9 else inf
