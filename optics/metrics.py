"""How well a caustic shows its target. No fitted gain: both are in units of the mean incident light per pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from skimage.metrics import structural_similarity

from optics.spline import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class CausticScore:
    psnr_db: float  # peak = the target's brightest pixel
    ssim: float  # Gaussian window, sigma 1.5 pixels, over the same peak
    misplaced_light: float  # sum |I - T| / (2 sum T)
    dark_leak: float  # share of the flux that falls on pixels with T < 2 % of the peak


def psnr_db(irradiance: Array, target: Array) -> float:
    """Of a simulated irradiance (ny, nx) against a target in the same frame and units; peak = the brightest pixel."""
    peak, mse = float(target.max()), float(np.mean((irradiance - target) ** 2))
    return float(10 * np.log10(peak**2 / max(mse, 1e-300)))


def score_caustic(irradiance: Array, target: Array) -> CausticScore:
    """Scores of a simulated irradiance (ny, nx) against a target of mean 1 in the same frame and units."""
    peak = float(target.max())
    smaller = min(target.shape)
    window = min(11, smaller - 1 + smaller % 2)  # sigma 1.5 truncated at 3.5: 11 pixels; tiny pictures have less
    similarity = structural_similarity(
        irradiance,
        target,
        data_range=peak,
        win_size=window,
        gaussian_weights=smaller >= 11,
        sigma=1.5,
        use_sample_covariance=False,
    )
    return CausticScore(
        psnr_db=psnr_db(irradiance, target),
        ssim=float(similarity),
        misplaced_light=float(np.abs(irradiance - target).sum() / (2 * target.sum())),
        dark_leak=float(irradiance[target < 0.02 * peak].sum() / target.sum()),
    )
