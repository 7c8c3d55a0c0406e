"""Effects of a block on light in addition to its milled side: haze, and a back that is not flat.

Haze is the share of the light that leaves more than 2.5 degrees off its direction (ASTM D1003). Makers do not state how
it is spread: here it is a Gaussian of 10 degrees about each ray, of which 3 % stay within 2.5 degrees.

Where the back rises, the block is thinner by that much, and light behaves as if its milled side were lower by the same
amount: exact to the first order of the back's slopes, which are far smaller than those of a lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import ndtr

from optics.heightfield import Heightfield
from optics.spline import Array

SCATTER_RAD = math.radians(10.0)
"""Standard deviation of the directions, along either axis, of light that haze scatters."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Back:
    """The back of a block as it really is: a wave along X and one along Y, each starting from its mean at the origin.

    flatness_mm : between two parallel planes that hold it
    period_mm   : of both waves
    """

    flatness_mm: float
    period_mm: float

    def rise_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Return its height above its lowest point, at points (broadcast)."""
        k = 2.0 * math.pi / self.period_mm
        return np.asarray(self.flatness_mm / 4 * (2.0 + np.sin(k * x_mm) + np.sin(k * y_mm)))

    def slope(self, place_mm: Array) -> Array:
        """Return the slope along an axis at places on it, the same for X and Y."""
        k = 2.0 * math.pi / self.period_mm
        return np.asarray(self.flatness_mm / 4 * k * np.cos(k * place_mm))


def lower_by_back(lens: Heightfield, back: Back | None) -> Heightfield:
    """Return the lens with which a flat block would have the same effect; back None: flat."""
    if back is None:
        return lens
    return replace(lens, z_mm=lens.z_mm - back.rise_mm(lens.x_mm[None, :], lens.y_mm[:, None]))


def lower_facets_by_back(facets: Array, back: Back | None) -> Array:
    """Do the same for facets (n, 4, 5): x, y, z [mm] and slopes in x and y of their corners."""
    if back is None:
        return facets
    x, y = facets[..., 0], facets[..., 1]
    changes = np.stack([np.zeros_like(x), np.zeros_like(x), back.rise_mm(x, y), back.slope(x), back.slope(y)], axis=-1)
    return np.asarray(facets - changes)


def scatter(irradiance: Array, haze: float, sigma_px: tuple[float, float]) -> Array:
    """Return irradiance (ny, nx) of which that share is spread over a Gaussian of these standard deviations (y, x);
    light that falls past its edges is lost.
    """
    down, across = (_bell(count, sigma) for count, sigma in zip(irradiance.shape, sigma_px, strict=True))
    return np.asarray((1.0 - haze) * irradiance + haze * (down @ irradiance @ across))


@lru_cache(maxsize=4)  # a plan scatters one picture after another
def _bell(count: int, sigma_px: float) -> Array:
    """Return the share of each pixel's light that a Gaussian spreads to each other pixel of a line (count, count)."""
    away = np.subtract.outer(np.arange(count), np.arange(count))
    return np.asarray(ndtr((away + 0.5) / sigma_px) - ndtr((away - 0.5) / sigma_px))
