"""What a rectified photograph of the test piece shows: each strip's light over one period, in either half."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optics.coupon.fringes import ACROSS
from optics.coupon.layout import Coupon, Half, Strip, window_mm
from optics.heightfield import Array

BINS = 48
_INSET_MM = 0.8  # of the window's ends: the ripple fades out beyond them, and a finish carries that inwards
_MOST_CLIPPED = 0.02  # of a bin's pixels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rectified:
    """Light on the wall over the piece's own screen, in the work frame: row 0 at the lowest y, any unit.

    light (ny, nx)  : linear; what is dark around the piece is 0
    usable (ny, nx) : seen, and neither white nor black in the photograph
    """

    x_mm: Array
    y_mm: Array
    light: Array
    usable: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fold:
    """Light of a strip by phase of its period, in units of the mean of what is usable.

    light, error (BINS,) : means and their standard errors; error is inf where a bin cannot be used
    clipped              : share of the strip's pixels that are not usable
    """

    strip: Strip
    half: Half
    phase: Array
    light: Array
    error: Array
    clipped: float

    @property
    def usable_bins(self) -> int:
        return int(np.isfinite(self.error).sum())

    @property
    def is_usable(self) -> bool:
        """Whether enough of the period is known to compare it with a model."""
        return self.usable_bins >= BINS // 3

    @property
    def fringe(self) -> float:
        """Standard deviation of the light over the period."""
        known = np.isfinite(self.error)
        return float(self.light[known].std()) if known.any() else 0.0


def fold_strip(picture: Rectified, strip: Strip, half: Half) -> Fold:
    """The light of whole periods near the middle of the window, laid over one another."""
    begin, end = window_mm(half)
    period = strip.period_mm
    spare = int(np.ceil(_INSET_MM / period)) * period
    columns = (picture.x_mm >= begin + spare) & (picture.x_mm < end - spare)
    across = ACROSS * (strip.high_mm - strip.low_mm)
    rows = np.abs(picture.y_mm - strip.middle_mm) <= across
    light, usable = picture.light[np.ix_(rows, columns)], picture.usable[np.ix_(rows, columns)]
    x = picture.x_mm[columns] - begin
    values = np.where(usable, light, 0.0)
    count, total = usable.sum(axis=0).astype(float), values.sum(axis=0)
    number = (np.mod(x / period, 1.0) * BINS).astype(int) % BINS
    trend = _trend(x / period, np.divide(total, count, out=np.zeros_like(total), where=count > 0), count)
    values, total = values / trend, total / trend
    sums = np.bincount(number, weights=total, minlength=BINS)
    counts = np.bincount(number, weights=count, minlength=BINS)
    squares = np.bincount(number, weights=(values**2).sum(axis=0), minlength=BINS)
    pixels = np.bincount(number, minlength=BINS) * len(light)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = sums / counts
        spread = np.sqrt(np.maximum(squares / counts - mean**2, 0.0) / np.maximum(counts - 1, 1))
    fit = (counts >= 4) & (counts >= (1.0 - _MOST_CLIPPED) * pixels)
    scale = float(mean[counts > 0].mean()) if (counts > 0).any() else 1.0
    scale = scale if scale > 0 else 1.0
    return Fold(
        strip=strip,
        half=half,
        phase=2 * np.pi * (np.arange(BINS) + 0.5) / BINS,
        light=np.where(fit, mean, 0.0) / scale,
        error=np.where(fit, spread / scale, np.inf),
        clipped=1.0 - float(usable.mean()) if usable.size else 1.0,
    )


def fold_all(picture: Rectified, coupon: Coupon) -> tuple[Fold, ...]:
    """Of all strips with a period, left halves first."""
    halves: tuple[Half, Half] = ("left", "right")
    strips = [strip for strip in coupon.strips if strip.cycles]
    return tuple(fold_strip(picture, strip, half) for half in halves for strip in strips)


def _trend(cycle: Array, light: Array, count: Array) -> Array:
    """(columns,) slow change of the lamp's light along x, around 1: a line through the means of the periods."""
    number = np.floor(cycle - cycle[0] + 1e-9).astype(int)
    weights = np.bincount(number, weights=count)
    seen = weights > 0.5 * weights.max()
    if seen.sum() < 3:
        return np.ones_like(light)
    means = np.bincount(number, weights=light * count)[seen] / weights[seen]
    places = np.flatnonzero(seen)
    slope, level = np.polyfit(places, means, 1)
    whole = level + slope * (cycle - cycle[0] - 0.5)
    return np.asarray(np.clip(whole / max(level + slope * places.mean(), 1e-12), 0.3, 3.0))
