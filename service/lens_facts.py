"""Facts of a lens that decide whether it can be milled: relief, steepest slope, tightest valley."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, degrees, inf

import numpy as np
from numpy.typing import NDArray

from optics.heightfield import Array, BicubicSpline, Heightfield

_ROWS_AT_ONCE = 128
_SHARES = (0.99, 0.999)


@dataclass(frozen=True, slots=True, kw_only=True)
class LensFacts:
    """min_concave_radius_mm : largest ball that touches every sampled point of the lens; inf where nothing is concave
    radius_for_99_mm, radius_for_999_mm : largest ball for 99 % and 99.9 % of the aperture
    """

    relief_mm: float
    max_slope_deg: float
    min_concave_radius_mm: float
    radius_for_99_mm: float
    radius_for_999_mm: float
    concave_curvature: NDArray[np.float32]  # sorted, 1/mm

    def unreachable_share(self, radius_mm: float) -> float:
        """Share of the aperture whose curvature is tighter than the ball: its local fit alone."""
        tight = np.searchsorted(self.concave_curvature, 1.0 / radius_mm, side="right")
        return 1.0 - float(tight) / self.concave_curvature.size


def measure_lens(heightfield: Heightfield) -> LensFacts:
    """Slope and largest principal curvature of the C2 spline, at its vertices and half-way between them."""
    spline = heightfield.spline()
    x_mm = _halved(heightfield.x_mm)
    rows = _halved(heightfield.y_mm)
    curvature = np.empty((rows.size, x_mm.size), dtype=np.float32)
    steepest = 0.0
    for top in range(0, rows.size, _ROWS_AT_ONCE):
        strip = rows[top : top + _ROWS_AT_ONCE]
        slope, curvature[top : top + strip.size] = _slope_and_curvature(spline, x_mm, strip)
        steepest = max(steepest, slope)
    ranked = np.sort(curvature, axis=None)
    return LensFacts(
        relief_mm=heightfield.relief_mm,
        max_slope_deg=degrees(atan(steepest)),
        min_concave_radius_mm=_radius(float(ranked[-1])),
        radius_for_99_mm=_radius(float(ranked[int(_SHARES[0] * (ranked.size - 1))])),
        radius_for_999_mm=_radius(float(ranked[int(_SHARES[1] * (ranked.size - 1))])),
        concave_curvature=ranked,
    )


def _slope_and_curvature(spline: BicubicSpline, x_mm: Array, y_mm: Array) -> tuple[float, Array]:
    """Steepest slope, and the larger principal curvature at each point, positive in a valley.

    With p, q the slopes and r, s, t the second derivatives: H = ((1+q^2) r - 2 p q s + (1+p^2) t) / 2 w^3,
    K = (r t - s^2) / w^4, w^2 = 1 + p^2 + q^2, and the curvature is H + sqrt(H^2 - K).
    """
    _, p, q, r, s, t = spline.jets(*np.broadcast_arrays(x_mm[None, :], y_mm[:, None]))
    w2 = 1 + p * p + q * q
    mean = ((1 + q * q) * r - 2 * p * q * s + (1 + p * p) * t) / (2 * w2**1.5)
    gauss = (r * t - s * s) / w2**2
    return float(np.sqrt(w2.max() - 1)), mean + np.sqrt(np.maximum(mean**2 - gauss, 0.0))


def _halved(axis_mm: Array) -> Array:
    return np.linspace(axis_mm[0], axis_mm[-1], 2 * axis_mm.size - 1)


def _radius(curvature: float) -> float:
    return 1.0 / curvature if curvature > 1e-9 else inf
