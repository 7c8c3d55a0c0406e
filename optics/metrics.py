"""Scores a caustic against its target. No fitted gain: both are in units of the mean incident light per pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

from optics.spline import Array

_BANDS = 48  # of spatial frequency, from one period across the picture to one in two pixels
_CONTRAST = 0.5
_IN_VIEW_PIXELS = 128  # along the longer side, of a picture that is looked at as a whole


@dataclass(frozen=True, slots=True, kw_only=True)
class CausticScore:
    psnr_db: float  # peak = the target's brightest pixel
    seen_db: float  # likeness as an eye sees it, `seen_db`
    ssim: float  # Gaussian window, sigma 1.5 pixels, over the same peak
    misplaced_light: float  # sum |I - T| / (2 sum T)
    dark_leak: float  # share of the flux that falls on pixels with T < 2 % of the peak


def psnr_db(irradiance: Array, target: Array) -> float:
    """Return the PSNR of irradiance (ny, nx) against a target in the same frame and units; peak = the brightest
    pixel.
    """
    peak, mse = float(target.max()), float(np.mean((irradiance - target) ** 2))
    return float(10 * np.log10(peak**2 / max(mse, 1e-300)))


def seen_db(irradiance: Array, target: Array) -> float:
    """Return how alike both (ny, nx) look at a distance from which the whole picture is in view: -10 log10(1 - r), r
    the correlation of their light over 128 pixels.

    Unlike PSNR it follows the eye. (Looked at one by one: an unmistakable logo has 20.9 dB of PSNR and 19 of this, a
    web of lines in which nobody finds the cat 19.2 and 8; blurred photographs, still recognised, have 11 to 15,
    photographs as finished, whose fine detail is off, 16 to 25.)
    """
    size = max(1, round(max(target.shape) / _IN_VIEW_PIXELS))
    ny, nx = (n // size for n in target.shape)
    ours, wanted = (
        one[: ny * size, : nx * size].reshape(ny, size, nx, size).mean((1, 3)).ravel() for one in (irradiance, target)
    )
    ours, wanted = ours - ours.mean(), wanted - wanted.mean()
    alike = float(ours @ wanted) / max(float(np.linalg.norm(ours) * np.linalg.norm(wanted)), 1e-300)
    return float(-10 * np.log10(max(1.0 - alike, 1e-12)))


def score_caustic(irradiance: Array, target: Array) -> CausticScore:
    """Return scores of a simulated irradiance (ny, nx) against a target of mean 1 in the same frame and units."""
    peak = float(target.max())
    return CausticScore(
        psnr_db=psnr_db(irradiance, target),
        seen_db=seen_db(irradiance, target),
        ssim=structural_similarity(irradiance, target, peak),
        misplaced_light=float(np.abs(irradiance - target).sum() / (2 * target.sum())),
        dark_leak=float(irradiance[target < 0.02 * peak].sum() / target.sum()),
    )


def structural_similarity(irradiance: Array, target: Array, peak: float) -> float:
    """Return the mean SSIM of two pictures (ny, nx) over windows that lie inside them (Wang et al. 2004, eq. 13).

    The window is a Gaussian of 1.5 pixels on 11; pictures that are smaller have the largest odd square that fits.
    """
    smaller = min(target.shape)
    size = min(11, smaller - 1 + smaller % 2)

    def average(picture: Array) -> Array:
        if smaller < 11:
            return uniform_filter(picture, size)
        return gaussian_filter(picture, 1.5, radius=5)

    ours, wanted = average(irradiance), average(target)
    covariance = average(irradiance * target) - ours * wanted
    variances = average(irradiance**2) - ours**2 + average(target**2) - wanted**2
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    similarity = (2 * ours * wanted + c1) * (2 * covariance + c2) / ((ours**2 + wanted**2 + c1) * (variances + c2))
    inside = tuple(slice(size // 2, n - size // 2) for n in target.shape)
    return float(similarity[inside].mean())


def blurred_psnr_db(target: Array, blur_px: tuple[float, float]) -> float:
    """Return the PSNR of a target (ny, nx) that is only blurred, by these standard deviations (y, x)."""
    return psnr_db(gaussian_filter(target, blur_px, mode="nearest"), target)


def smallest_detail_mm(irradiance: Array, target: Array, pixel_mm: float) -> float:
    """Return half the period of the finest pattern of the target (ny, nx) that keeps half of its contrast; one pixel at
    best.

    Contrast by frequency is the part of the picture that follows the target, sum I T* / sum |T|^2 over a ring of the
    spectrum (Hann window), so that grain unrelated to the target does not count.
    """
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in target.shape))
    ours, wanted = (np.fft.rfft2((one - one.mean()) * window) for one in (irradiance, target))
    down, across = np.fft.fftfreq(target.shape[0])[:, None], np.fft.rfftfreq(target.shape[1])[None, :]
    per_pixel = np.hypot(down, across).ravel()
    edges = np.geomspace(1.0 / max(target.shape), 0.5, _BANDS + 1)
    follows = np.histogram(per_pixel, edges, weights=(ours * wanted.conj()).real.ravel())[0]
    power = np.histogram(per_pixel, edges, weights=(np.abs(wanted) ** 2).ravel())[0]
    contrast = np.divide(follows, power, out=np.ones(_BANDS), where=power > 0)
    lost = np.flatnonzero(contrast < _CONTRAST)
    finest = edges[lost[0]] if lost.size else 0.5
    return float(pixel_mm / (2.0 * finest))
