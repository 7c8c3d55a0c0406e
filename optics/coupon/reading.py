"""Reads a rectified photograph of the test piece: each strip's light over one period, in either half."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optics.coupon.fringes import ACROSS
from optics.coupon.layout import Coupon, Half, Strip, window_mm
from optics.heightfield import Array

BINS = 48
_INSET_MM = 0.8  # at the window's ends: the ripple fades out beyond them, and a finish spreads that inwards
_FEW_WHITE, _MEDIAN_OFF = 0.02, 0.1
_MOST_WHITE = 0.35  # share of a bin's pixels; with more white ones their median is unreliable


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rectified:
    """Light on the wall over the piece's own screen, in the work frame: row 0 at the lowest y, any unit.

    light (ny, nx)  : linear; dark surroundings of the piece are 0
    usable (ny, nx) : in the photograph and not white there
    white (ny, nx)  : in the photograph and too bright for it
    pixel_mm        : size along x of the photograph's own pixels, in the middle of the left and of the right half
    """

    x_mm: Array
    y_mm: Array
    light: Array
    usable: NDArray[np.bool_]
    white: NDArray[np.bool_]
    pixel_mm: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fold:
    """Light of a strip by phase of its period, in units of its mean over usable bins.

    light, error (BINS,) : means and their standard errors; error is inf where a bin cannot be used
    clipped              : share of the strip's pixels that are not usable
    pixel_mm             : of the photograph
    """

    strip: Strip
    half: Half
    phase: Array
    light: Array
    error: Array
    clipped: float
    pixel_mm: float

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
    """Return the light of whole periods near the middle of the window, laid over one another."""
    begin, end = window_mm(half)
    period = strip.period_mm
    spare = int(np.ceil(_INSET_MM / period)) * period
    columns = (picture.x_mm >= begin + spare) & (picture.x_mm < end - spare)
    across = ACROSS * (strip.high_mm - strip.low_mm)
    part = np.ix_(np.abs(picture.y_mm - strip.middle_mm) <= across, columns)
    usable, white = picture.usable[part], picture.white[part]
    cycle = (picture.x_mm[columns] - begin) / period
    number = (np.mod(cycle, 1.0) * BINS).astype(int) % BINS
    light = picture.light[part] / _trend(cycle, picture.light[part], usable)
    light = np.where(white, np.inf, light)  # at least that bright: this keeps it above the median
    seen = usable | white
    middle, error = np.zeros(BINS), np.full(BINS, np.inf)
    for one in range(BINS):
        of_bin = number == one
        values = light[:, of_bin][seen[:, of_bin]]
        dark = values[np.isfinite(values)]
        if dark.size < max(4, (1.0 - _MOST_WHITE) * values.size, 0.5 * seen[:, of_bin].size):
            continue
        error[one] = dark.std() / np.sqrt(dark.size)
        if dark.size >= (1.0 - _FEW_WHITE) * values.size:
            middle[one] = dark.mean()
        else:  # a median does not depend on how bright white was, but it is not a mean
            middle[one] = np.median(values)
            error[one] = np.hypot(error[one], _MEDIAN_OFF * middle[one])
    scale = float(middle[np.isfinite(error)].mean()) if np.isfinite(error).any() else 1.0
    scale = scale if scale > 0 else 1.0
    return Fold(
        strip=strip,
        half=half,
        phase=2 * np.pi * (np.arange(BINS) + 0.5) / BINS,
        light=middle / scale,
        error=error / scale,
        clipped=1.0 - float(usable.mean()) if usable.size else 1.0,
        pixel_mm=picture.pixel_mm[half == "right"],
    )


def fold_all(picture: Rectified, coupon: Coupon) -> tuple[Fold, ...]:
    """Return the folds of all strips with a period, left halves first."""
    halves: tuple[Half, Half] = ("left", "right")
    strips = [strip for strip in coupon.strips if strip.cycles]
    return tuple(fold_strip(picture, strip, half) for half in halves for strip in strips)


def _trend(cycle: Array, light: Array, usable: NDArray[np.bool_]) -> Array:
    """Return (columns,) slow change of the lamp's light along x, around 1: a line through the means of the periods."""
    count = usable.sum(axis=0).astype(np.float64)
    total = np.where(usable, light, 0.0).sum(axis=0)
    number = np.floor(cycle - cycle[0] + 1e-9).astype(int)
    weights = np.bincount(number, weights=count)
    seen = weights > 0.5 * weights.max()
    if seen.sum() < 3:
        return np.ones_like(cycle)
    means = np.bincount(number, weights=total)[seen] / weights[seen]
    places = np.flatnonzero(seen)
    slope, level = np.polyfit(places, means, 1)
    whole = level + slope * (cycle - cycle[0] - 0.5)
    return np.asarray(np.clip(whole / max(level + slope * places.mean(), 1e-12), 0.3, 3.0))
