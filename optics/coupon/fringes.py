"""The light of one strip of the test piece as harmonics of its period: as milled, and behind a finish.

Theory of operation. A ray that leaves the piece at (x, y) arrives at (x, y) + lever grad z, the lever being the way to
the wall times (n - 1): exact for small slopes, whether rays cross or not. In the observed window, over part of the
strip's height, the light over the period is c_0 + 2 Re sum c_m exp(i m k x), with c_m the sum of exp(-i m k X)
over all rays that arrive there (of one even ripple of strength m c_1 is the Bessel function J_1(m)). Blur of standard
deviation s reduces c_m by the factor exp(-(m k s)^2 / 2).

As milled c_m is summed over the heights that the programs leave, marks of the rows and neighbours included, for many
levers: a table. Behind a finish rows are gone, and a strip is the mean of its rows, z = Re sum A_n exp(i n k x) times
its share over y; the finish filters each harmonic in two dimensions, at sqrt((n k)^2 + ky^2).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.coupon.layout import Coupon, Half, Strip, share_of_strip, window_mm
from optics.heightfield import Array
from optics.threads import thread_count

Complex = NDArray[np.complex128]
Transfer = Callable[[Array], Array]
"""(...,) share of a height's amplitude that is left, from its spatial frequency [rad/mm]."""

ACROSS = 0.27
"""Share of a strip's height, on either side of its middle, in which the light is observed."""

LEVERS = np.linspace(0.05, 1.45, 57)
"""Levers of the table as milled, relative to the nominal one."""

_MOST = 20
_SHARPEST_MM = 0.015  # least expected blur of a photograph: higher harmonics vanish
_SAMPLES = 256  # in a period
_BINS = 4096  # of a period, for harmonics to a few millionths
_ENOUGH, _MOST_SKIPPED = 40, 5  # columns of a period as milled; at most one of this many is used
_Y_STEP_MM, _Y_HALF, _Y_STRIDE = 1 / 32, 128, 2
_BEYOND_MM = 1.2  # of a strip: light from farther away belongs to others
_SOFT_MM = 0.05  # of the window's borders, against the grid of samples


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Profile:
    """A strip as milled by the programs; phases count from the window's left end.

    harmonics_mm (n,)     : amplitudes of the harmonics 1, 2, ... of its mean row
    milled (levers, m + 1): c_0 ... c_m of its light as milled, for LEVERS
    """

    strip: Strip
    harmonics_mm: Complex
    milled: Complex


def profiles_of_heights(coupon: Coupon, x_mm: Array, y_mm: Array, z_mm: Array) -> tuple[Profile, ...]:
    """Return the profiles of all strips with a period, from heights (ny, nx) of the milled right half.

    The grid must be fine: short ripples of a coarse mill have edges, and 0.02 mm instead of 0.01 mm costs a tenth of
    their fringes.
    """
    half: Half = "right"
    begin, end = window_mm(half)
    inside = (x_mm >= begin - 1e-9) & (x_mm < end + 1e-9)
    x, step_x, step_y = x_mm[inside], float(x_mm[1] - x_mm[0]), float(y_mm[1] - y_mm[0])
    lever_mm = nominal_lever_mm(coupon)
    found = []
    for strip in coupon.strips:
        if not strip.cycles:
            continue
        core = (y_mm >= strip.low_mm + strip.fade_mm) & (y_mm <= strip.high_mm - strip.fade_mm)
        mean = z_mm[np.ix_(core, inside)].mean(axis=0)[:-1]
        count = max(1, min(_MOST, int(strip.period_mm / (5.0 * step_x))))
        waves = np.arange(1, count + 1)[:, None] * strip.k_rad_per_mm
        harmonics = 2 * np.exp(-1j * waves * (x[:-1] - begin)) @ mean / mean.size
        near = (y_mm >= strip.low_mm - _BEYOND_MM) & (y_mm <= strip.high_mm + _BEYOND_MM)
        z = z_mm[np.ix_(near, inside)]
        along, across = np.diff(z, axis=1) / step_x, np.diff(z, axis=0) / step_y
        slope_x, slope_y = (along[1:] + along[:-1]) / 2, (across[:, 1:] + across[:, :-1]) / 2  # in the cells' middles
        period = ((x[1:] + x[:-1]) / 2 - begin) / strip.period_mm
        every = max(1, min(_MOST_SKIPPED, int(strip.period_mm / (_ENOUGH * step_x))))
        slope_x, slope_y, period = (np.ascontiguousarray(values[..., ::every]) for values in (slope_x, slope_y, period))
        away = (y_mm[near][1:] + y_mm[near][:-1]) / 2 - strip.middle_mm
        scale = step_y / (period.size * 2 * _across_mm(strip))

        def light(lever: float, strip: Strip = strip, parts: tuple[Array, ...] = (slope_x, slope_y, period, away)
                  ) -> Complex:  # fmt: skip
            bins = _bin_rays(parts, lever, lever / strip.period_mm, _across_mm(strip))
            m = np.arange(_harmonics_of(strip) + 1)
            return np.asarray(np.fft.rfft(bins)[: m.size] / np.sinc(m / _BINS) ** 2)

        with ThreadPoolExecutor(max_workers=thread_count()) as pool:
            table: Complex = scale * np.stack(list(pool.map(light, LEVERS * lever_mm)))
        found.append(Profile(strip=strip, harmonics_mm=harmonics, milled=table))
    return tuple(found)


def nominal_lever_mm(coupon: Coupon) -> float:
    """Return the way to the wall, where it should stand, times (n - 1)."""
    return (coupon.throw_mm - coupon.flat_mm) * (coupon.refractive_index - 1)


def fringe_coefficients(profile: Profile, lever: float) -> Complex:
    """Return (m + 1,) c_0 ... c_m as milled at that lever over the nominal one; beyond LEVERS as at their ends."""
    place = np.clip((lever - LEVERS[0]) / (LEVERS[1] - LEVERS[0]), 1.0, LEVERS.size - 2.001)
    k = int(place)
    t = float(place) - k
    a, b, c, d = profile.milled[k - 1 : k + 3]  # Catmull-Rom
    return np.asarray(b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Finished:
    """A strip behind a finish: slopes along and across (ny, samples in a period) at places y_mm (ny,), from its middle
    up: the part below is their mirror image. counts (ny,): number of rows that each represents.
    """

    strip: Strip
    y_mm: Array
    counts: Array
    slope_x: Array
    slope_y: Array

    @classmethod
    def of(cls, profile: Profile, transfer: Transfer) -> Finished:
        strip = profile.strip
        number = np.arange(1, profile.harmonics_mm.size + 1)
        y: Array = strip.middle_mm + _Y_STEP_MM * np.arange(-_Y_HALF, _Y_HALF, dtype=np.float64)
        spectrum = np.fft.rfft(share_of_strip(strip, y))
        ky = 2 * np.pi * np.fft.rfftfreq(y.size, _Y_STEP_MM)
        left = spectrum * transfer(np.hypot(ky, number[:, None] * strip.k_rad_per_mm))
        near = np.flatnonzero(np.abs(y - strip.middle_mm) <= (strip.high_mm - strip.low_mm) / 2 + _BEYOND_MM)
        near = near[::_Y_STRIDE]
        near = near[near >= _Y_HALF]
        share = np.fft.irfft(left, n=y.size)[:, near].T
        change = np.fft.irfft(1j * ky * left, n=y.size)[:, near].T
        phase = 2 * np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        waves = np.exp(1j * number[:, None] * phase)
        return cls(
            strip=strip,
            y_mm=y[near],
            counts=np.where(near > _Y_HALF, 2.0, 1.0),
            slope_x=((1j * number * strip.k_rad_per_mm * profile.harmonics_mm * share) @ waves).real,
            slope_y=((profile.harmonics_mm * change) @ waves).real,
        )

    def light(self, lever_mm: float) -> Complex:
        """Return (m + 1,) c_0 ... c_m at that lever; neighbours are assumed to return evenly the light that leaves the
        strip.
        """
        strip = self.strip
        phase = 2 * np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES + strip.k_rad_per_mm * lever_mm * self.slope_x
        weight = self.counts[:, None] * _window(strip, self.y_mm[:, None] + lever_mm * self.slope_y)
        scale = _Y_STRIDE * _Y_STEP_MM / (_SAMPLES * 2 * _across_mm(strip))
        found = _sum_waves(phase, weight, _harmonics_of(strip) + 1) * scale
        found[0] = max(found[0].real, 1.0)
        return np.asarray(found)


def light_profile(
    harmonics: Complex, k_rad_per_mm: float, phase: Array, *, blur_mm: float, shift_mm: float | Array
) -> Array:
    """Return (phases,) light of a strip from c_0 ... c_m, at phases of its period, blurred and moved along x; for
    shifts (n, 1): (n, phases).
    """
    m = np.arange(1, harmonics.size)
    soft = harmonics[1:] * np.exp(-((m * k_rad_per_mm * blur_mm) ** 2) / 2 - 1j * m * k_rad_per_mm * shift_mm)
    return np.asarray(harmonics[0].real + 2.0 * (soft @ np.exp(1j * m[:, None] * phase)).real)


def _harmonics_of(strip: Strip) -> int:
    return max(1, min(_MOST, int(3.5 / (strip.k_rad_per_mm * _SHARPEST_MM))))


def _across_mm(strip: Strip) -> float:
    return ACROSS * (strip.high_mm - strip.low_mm)


def _window(strip: Strip, y_mm: Array) -> Array:
    inside = _across_mm(strip) - np.abs(y_mm - strip.middle_mm)
    return np.asarray(np.clip(0.5 + inside / (2 * _SOFT_MM), 0.0, 1.0))


@njit(cache=True, nogil=True)
def _bin_rays(parts, lever_mm, periods, across_mm):  # type: ignore[no-untyped-def]
    """Return (_BINS,) weights of the rays by where in the period they arrive, each shared by the two nearest bins.

    parts   : slope_x, slope_y (ny, nx); place in periods (nx,); mm from the strip's middle (ny,)
    periods : by which a slope of 1 moves a ray along
    """
    slope_x, slope_y, period, away_mm = parts
    bins = np.zeros(_BINS + 2)
    for j in range(slope_x.shape[0]):
        for i in range(slope_x.shape[1]):
            weight = 0.5 + (across_mm - abs(away_mm[j] + lever_mm * slope_y[j, i])) / (2 * _SOFT_MM)
            if weight > 0.0:
                place = period[i] + periods * slope_x[j, i]
                place = (place - np.floor(place)) * _BINS
                n = int(place)
                part = place - n
                bins[n] += min(weight, 1.0) * (1.0 - part)
                bins[n + 1] += min(weight, 1.0) * part
    bins[:2] += bins[_BINS:]
    return bins[:_BINS]


@njit(cache=True, nogil=True)
def _sum_waves(phase, weight, count):  # type: ignore[no-untyped-def]
    """Return (count,) sums of weight exp(-i m phase) for m = 0, 1, ...; phase, weight (ny, nx)."""
    out = np.zeros(count, np.complex128)
    for j in range(phase.shape[0]):
        for i in range(phase.shape[1]):
            w = weight[j, i]
            if w > 0.0:
                once = complex(np.cos(phase[j, i]), -np.sin(phase[j, i]))
                power = complex(w, 0.0)
                for m in range(count):
                    out[m] += power
                    power *= once
    return out
