"""Witness marks: ripples beside the lens that show in raking light how far a finish by contact has come.

Theory of operation. A finish leaves H(k) = exp(-dose (k / k0)^order) of a ripple, where the dose is relative to the
planned one and k0 is that of the plan. Raking light shows a ripple a cos(kx) while its slope a k H is above
VISIBLE_SLOPE_RAD. So each ripple disappears at one dose, and a few of them bracket the dose.

A ripple is as high as the pad allows. A pad touches everywhere while the relief reduces its pressure by less than the
mean: a < depth (k0 / k)^order, with the mean removal at the planned dose. Then H is exact. The ball makes a ripple in
rows along its ridge, each at one height in whole steps of the mill. So the mill's steps are a known part of the ripple,
and no move changes its height within a row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from optics.finish import Finish
from optics.heightfield import Array

VISIBLE_SLOPE_RAD = 1e-3
"""Slope of a ripple from which a lamp held almost flat along the surface shows it."""

SHARES = (0.6, 0.8, 1.0, 1.25, 2.0)
"""Shares of the planned dose at which marks disappear. The last mark stays, for comparison and for photographs."""

_LESS_NEEDED = (2.0, 0.6)  # left out in this order if a strip is short
_ROWS = 6  # in a period
_LEAST_PERIODS, _MOST_PERIODS, _LEAST_FIELD_MM = 4, 24, 5.0
GAP_MM, LEAD_MM = 1.2, 2.0  # flat between two marks, and before the first and after the last
_OF_CONTACT = 0.75  # of the amplitude at which a pad loses contact
_MOST_OF_CONTACT = 1.02  # of that amplitude: limit of a ripple in whole steps
_OF_CURVATURE = 0.5  # of the ball's
_MOST_MM = 0.02
_LEAST_SEEN = 3.0  # least initial slope of a mark, in visible slopes
_MOST_NOISE = 0.15  # of an amplitude, by errors of rows
_SAMPLES = 120  # in a period
_TRIED = np.geomspace(0.2, 30.0, 600)  # k / k0
_FLAT_CUSP_MM = 0.001

Obstacle = Literal["steps", "noise", "slope", "room"]


class NoMarksError(ValueError):
    """No witness marks can be made; obstacle names the reason: the mill's steps, its errors of rows, a finish that
    cannot wear a visible ripple away, or too little room.
    """

    def __init__(self, obstacle: Obstacle) -> None:
        super().__init__(obstacle)
        self.obstacle: Obstacle = obstacle


@dataclass(frozen=True, slots=True, kw_only=True)
class Mill:
    """The ball that cuts the marks, the mill's steps in height (0: none), and its error from row to row."""

    radius_mm: float
    step_mm: float
    noise_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """A ripple that disappears at a share of the planned dose.

    amplitude_mm : of its first harmonic, as milled
    tips_mm      : heights of the ball's tip in the rows of one period
    """

    share: float
    period_mm: float
    periods: int
    amplitude_mm: float
    tips_mm: tuple[float, ...]

    @property
    def k_rad_per_mm(self) -> float:
        return 2 * math.pi / self.period_mm

    @property
    def width_mm(self) -> float:
        return self.periods * self.period_mm

    def slope_rad(self, finish: Finish, dose: float) -> float:
        """Return the slope that remains after that share of the planned dose."""
        left = math.exp(-dose * (self.k_rad_per_mm / finish.k0_rad_per_mm) ** finish.order)
        return self.k_rad_per_mm * self.amplitude_mm * left


@dataclass(frozen=True, slots=True, kw_only=True)
class Strip:
    """Marks side by side along u, the first to disappear first; flat before, between and after them."""

    marks: tuple[Mark, ...]
    radius_mm: float

    @property
    def length_mm(self) -> float:
        return sum(mark.width_mm for mark in self.marks) + GAP_MM * (len(self.marks) - 1) + 2 * LEAD_MM

    @property
    def begins_mm(self) -> tuple[float, ...]:
        """Where along the strip each mark begins."""
        begins, u = [], LEAD_MM
        for mark in self.marks:
            begins.append(u)
            u += mark.width_mm + GAP_MM
        return tuple(begins)

    def rows(self) -> tuple[Array, Array]:
        """Return places u (n,) and tip heights (n,) of all rows [mm]; flat rows have height 0."""
        places: list[float] = []
        tips: list[float] = []
        at = 0.0
        for begin, mark in zip((*self.begins_mm, self.length_mm), (*self.marks, None), strict=True):
            flat = _even_places(at, begin, self.radius_mm)
            places += flat
            tips += [0.0] * len(flat)
            if mark is None:
                break
            pitch = mark.period_mm / len(mark.tips_mm)
            places += [begin + (k + 0.5) * pitch for k in range(mark.periods * len(mark.tips_mm))]
            tips += list(mark.tips_mm) * mark.periods
            at = begin + mark.width_mm
        return np.array(places), np.array(tips)


def choose_strip(finish: Finish, depth_mm: float, mill: Mill, *, room_mm: float) -> Strip:
    """Return the marks for a finish by contact that removes depth_mm, in a strip of at most room_mm.

    Raises NoMarksError.
    """
    for left_out in range(len(_LESS_NEEDED) + 1):
        shares = [share for share in SHARES if share not in _LESS_NEEDED[:left_out]]
        marks = tuple(_choose_mark(finish, depth_mm, mill, share) for share in shares)
        strip = Strip(marks=marks, radius_mm=mill.radius_mm)
        if strip.length_mm <= room_mm:
            return strip
    raise NoMarksError("room")


def envelope_mm(places_mm: Array, tips_mm: Array, radius_mm: float, u_mm: Array) -> Array:
    """Return the heights (n,) that a ball leaves at u (n,), from its rows in order."""
    nearest = np.searchsorted(places_mm, u_mm)
    heights = np.full(u_mm.shape, np.inf)
    for aside in range(-2 * _ROWS, 2 * _ROWS):
        row = np.clip(nearest + aside, 0, places_mm.size - 1)
        away = np.minimum(np.abs(u_mm - places_mm[row]), radius_mm)
        heights = np.minimum(heights, tips_mm[row] + radius_mm - np.sqrt(radius_mm**2 - away**2))
    return heights


def _even_places(begin: float, end: float, radius_mm: float) -> list[float]:
    pitch = math.sqrt(8 * radius_mm * _FLAT_CUSP_MM)
    count = max(1, math.ceil((end - begin) / pitch))
    return [begin + (k + 0.5) * (end - begin) / count for k in range(count)]


def _choose_mark(finish: Finish, depth_mm: float, mill: Mill, share: float) -> Mark:
    k = finish.k0_rad_per_mm * _TRIED
    lost_mm = depth_mm / _TRIED**finish.order
    wanted_mm = np.minimum(np.minimum(_OF_CONTACT * lost_mm, _OF_CURVATURE / (mill.radius_mm * k**2)), _MOST_MM)
    left = wanted_mm * k * np.exp(-share * _TRIED**finish.order)
    enough = np.flatnonzero((left >= VISIBLE_SLOPE_RAD) & (wanted_mm * k >= _LEAST_SEEN * VISIBLE_SLOPE_RAD))
    if not enough.size:
        raise NoMarksError("slope")
    begin = int(enough[-1])
    tips = _round_tips(float(wanted_mm[begin]), mill.step_mm, most_mm=_MOST_OF_CONTACT * float(lost_mm[begin]))
    k_rad_per_mm = _solve_wave(tips, finish, mill, share, near=float(k[begin]))
    period_mm = 2 * math.pi / k_rad_per_mm
    amplitude_mm = _first_harmonic_mm(tips, period_mm, mill.radius_mm)
    if amplitude_mm > _MOST_OF_CONTACT * depth_mm * (finish.k0_rad_per_mm / k_rad_per_mm) ** finish.order:
        raise NoMarksError("steps")  # in whole steps it is too high for the pad
    against_noise = 2 / _ROWS * (mill.noise_mm / (_MOST_NOISE * amplitude_mm)) ** 2  # the mean of all periods of a mark
    periods = max(_LEAST_PERIODS, math.ceil(_LEAST_FIELD_MM / period_mm), math.ceil(against_noise))
    if periods > _MOST_PERIODS:
        raise NoMarksError("noise")
    return Mark(share=share, period_mm=period_mm, periods=periods, amplitude_mm=amplitude_mm, tips_mm=tips)


def _round_tips(amplitude_mm: float, step_mm: float, *, most_mm: float) -> tuple[float, ...]:
    """Return tip heights of one period in whole steps: around a whole level or half a step, whichever is closer."""
    wave = np.cos(2 * np.pi * (np.arange(_ROWS) + 0.5) / _ROWS)
    if step_mm == 0.0:
        return tuple(float(tip) for tip in amplitude_mm * wave)
    found: list[tuple[float, Array]] = []
    for aside in (0.0, 0.5):
        tips = np.rint(amplitude_mm * wave / step_mm + aside) * step_mm + 0.0  # no -0
        first = 2 * abs(float(np.mean(tips * wave)))
        if 0.0 < first <= most_mm:
            found.append((abs(first - amplitude_mm), tips))
    if not found:
        raise NoMarksError("steps")
    return tuple(float(tip) for tip in min(found, key=lambda one: one[0])[1])


def _solve_wave(tips_mm: Sequence[float], finish: Finish, mill: Mill, share: float, *, near: float) -> float:
    """Return the wave number at which a ripple with those tips disappears at that share of the dose."""

    def excess(k: float) -> float:
        amplitude_mm = _first_harmonic_mm(tips_mm, 2 * math.pi / k, mill.radius_mm)
        worn = share * (k / finish.k0_rad_per_mm) ** finish.order
        return math.log(max(amplitude_mm, 1e-12) * k / VISIBLE_SLOPE_RAD) - worn

    low, high = near / 2, near * 2
    if excess(low) < 0 or excess(high) > 0:  # rounding to steps has made a different ripple
        raise NoMarksError("slope")
    for _ in range(40):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return math.sqrt(low * high)


def _first_harmonic_mm(tips_mm: Sequence[float], period_mm: float, radius_mm: float) -> float:
    count = len(tips_mm)
    places = (np.arange(-count, 2 * count) + 0.5) * period_mm / count
    u = (np.arange(_SAMPLES) + 0.5) * period_mm / _SAMPLES
    heights = envelope_mm(places, np.tile(tips_mm, 3), radius_mm, u)
    return float(2 * abs(np.mean(heights * np.exp(-2j * np.pi * u / period_mm))))
