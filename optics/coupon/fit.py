"""Fits the finish to the fringes of both halves: k0 and order with their errors, and the wall's distance.

Theory of operation. The half as milled determines how strongly wall, mill and light show the ripples (the lever and the
blur). With these, the finished half shows the remaining part of each ripple. All strips are fitted at once by the model
of `fringes`. Then each ripple separately, with the other parameters fixed, gives a point of the curve and its error.
Errors of k0 and order come from refitting the curve through resampled ripples many times, which covers the model's
errors as well as the photograph's noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares

from optics.coupon.fringes import (
    Complex,
    Finished,
    Profile,
    fringe_coefficients,
    light_profile,
    nominal_lever_mm,
)
from optics.coupon.layout import Coupon, Half
from optics.coupon.reading import Fold
from optics.finish import Finish
from optics.heightfield import Array

K0_RANGE, ORDER_RANGE = (0.3, 200.0), (0.5, 8.0)
_FLOOR, _SLOPE_FLOOR = 0.012, 0.05  # errors of the model: of the mean light, and of the contrast of fringes
_BLUR_RANGE_MM = (0.004, 0.4)
_SHIFT_MM = 0.03  # accuracy of registering a photograph with the piece
_SOFTER_SPREAD = 0.05  # spread of the ratio of both halves' blur
_LEVER_SPREAD = 0.05  # prior spread of the wall's distance
_CHOICES = 200
_OUTLIER = 6.0  # times the expected error
_LEAST_LEFT = 0.02
_LEFT = np.linspace(0.0, 1.2, 81)  # tried shares of an amplitude
_ASIDE = np.linspace(-0.045, 0.045, 7)  # mm by which a ripple may be displaced
_SEED = 5
_PRIORS = np.array(
    [1.5, 0.7]
)  # of ln k0 and ln order, around the result: for ripples that do not determine one of them


@dataclass(frozen=True, slots=True, kw_only=True)
class RippleLeft:
    """The share of one ripple's amplitude that a finish has left, and its standard error."""

    period_mm: float
    k_rad_per_mm: float
    share: float
    error: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FinishFit:
    """The result of the fit.

    k0_range, order_range : of 68 % of the trials
    throw_mm     : of the wall from Z0, by the ramp
    blur_mm      : of the photograph on the wall, standard deviation, lamp and camera together
    mill_gain    : amplitude of ripples as milled over that of the programs
    misfit       : rms of the residuals over the expected errors; about 1 if the model holds
    """

    k0_rad_per_mm: float
    order: float
    k0_range: tuple[float, float]
    order_range: tuple[float, float]
    throw_mm: float
    throw_error_mm: float
    mill_gain: float
    blur_mm: float
    misfit: float
    ripples: tuple[RippleLeft, ...]
    milled_ripples: tuple[RippleLeft, ...]


@dataclass(frozen=True, slots=True)
class _Setting:
    """The parameters of the model."""

    k0: float
    order: float
    lever: float  # relative to its nominal value
    blur_mm: float  # of the milled half
    shifts: tuple[float, float, float, float]  # at the middle, and over 10 mm of y; milled half, then finished half
    softer: float = 1.0  # blur of the finished half relative to the milled one

    @classmethod
    def of(cls, vector: Array) -> _Setting:
        k0, order, lever, blur = (math.exp(value) for value in vector[:4])
        a, b, c, d = (float(value) for value in vector[4:8])
        return cls(k0, order, lever, blur, (a, b, c, d), math.exp(vector[8]))

    @property
    def finish(self) -> Finish:
        return Finish(k0_rad_per_mm=self.k0, order=self.order)

    def vector(self) -> Array:
        logs = [math.log(value) for value in (self.k0, self.order, self.lever, self.blur_mm)]
        return np.array([*logs, *self.shifts, math.log(self.softer)])

    def shift_mm(self, y_mm: float, *, finished: bool) -> float:
        middle, tilt = self.shifts[2:] if finished else self.shifts[:2]
        return middle + tilt * (y_mm - 10.0) / 10.0


class _Model:
    """Folded light of one photograph against the programs' profiles."""

    def __init__(self, coupon: Coupon, profiles: Sequence[Profile], folds: Sequence[Fold], finished: Half) -> None:
        self.nominal_mm = nominal_lever_mm(coupon)
        of_strip = {profile.strip: profile for profile in profiles}
        fit = [fold for fold in folds if fold.is_usable]
        pixels = {half: [fold.pixel_mm for fold in folds if fold.half == half] for half in ("left", "right")}
        other = "left" if finished == "right" else "right"
        self.softer = float(np.mean(pixels[finished]) / np.mean(pixels[other]))  # if the blur comes from the camera
        self.milled = [(of_strip[fold.strip], fold) for fold in fit if fold.half != finished]
        self.finished = [(of_strip[fold.strip], fold) for fold in fit if fold.half == finished]
        # Of a setting and its neighbours in k0, order and lever: those in the other parameters have the same light.
        self.light = lru_cache(maxsize=4 * max(1, len(self.finished)))(self._light)

    def harmonics(self, profile: Profile, setting: _Setting, *, finished: bool) -> Callable[[float], Complex]:
        """Return a strip's light c_0 ... c_m with all its heights scaled by this factor."""
        if not finished:
            return lambda scale: fringe_coefficients(profile, scale * setting.lever)
        strip = Finished.of(profile, setting.finish.transfer)
        return lambda scale: strip.light(scale * setting.lever * self.nominal_mm)

    def _light(self, profile: Profile, k0: float, order: float, lever: float) -> Complex:
        """Return the light of a finished strip, which depends on no other parameter of a setting."""
        transfer = Finish(k0_rad_per_mm=k0, order=order).transfer
        return Finished.of(profile, transfer).light(lever * self.nominal_mm)

    def residuals(
        self,
        profile: Profile,
        fold: Fold,
        harmonics: Complex,
        setting: _Setting,
        finished: bool,
        aside_mm: float | Array = 0.0,
    ) -> Array:
        """Return (bins,) residuals of one strip, in units of the expected error; 0 where nothing is known. (n, bins)
        for n displacements.

        The strip's brightness is free. In the half as milled, the rows' marks carry light from neighbouring strips, so
        there the fringes may also be paler, down to a third.
        """
        strip = profile.strip
        shift = setting.shift_mm(strip.middle_mm, finished=finished) + aside_mm
        blur = setting.blur_mm * (setting.softer if finished else 1.0)
        light = light_profile(harmonics, strip.k_rad_per_mm, fold.phase, blur_mm=blur, shift_mm=shift)
        fringe = light - 1.0
        expected = np.sqrt(fold.error**2 + _FLOOR**2 + (_SLOPE_FLOOR * fringe) ** 2)
        weight = np.where(np.isfinite(expected), 1.0 / expected, 0.0)
        seen = np.where(weight > 0, fold.light, 0.0)
        w2 = weight**2
        if not finished:
            lit = w2 * fringe
            ones, cross, both = _sums(w2), _sums(lit), _sums(lit * fringe)
            plain, shown = _sums(w2 * seen), _sums(lit * seen)
            determinant = np.maximum(ones * both - cross**2, 1e-12)
            level = np.maximum((both * plain - cross * shown) / determinant, 1e-9)
            share = np.clip((ones * shown - cross * plain) / determinant / level, 1 / 3, 1.0)
            light = 1.0 + share * fringe
        level = _sums(w2 * seen * light) / np.maximum(_sums(w2 * light**2), 1e-12)
        return np.asarray(weight * (seen - light * np.maximum(level, 1e-9)))

    def of_half(self, setting: _Setting, *, finished: bool) -> list[Array]:
        def light(profile: Profile) -> Complex:
            if finished:
                return self.light(profile, setting.k0, setting.order, setting.lever)
            return fringe_coefficients(profile, setting.lever)

        pairs = self.finished if finished else self.milled
        return [self.residuals(profile, fold, light(profile), setting, finished) for profile, fold in pairs]

    def all(self, vector: Array) -> Array:
        setting = _Setting.of(vector)
        parts = self.of_half(setting, finished=False) + self.of_half(setting, finished=True)
        return np.concatenate([*parts, self.priors(vector)])

    def priors(self, vector: Array) -> Array:
        """Return the priors as residuals; they count more than bins, which are not independent of one another."""
        setting = _Setting.of(vector)
        softer = math.log(setting.softer / self.softer) / (_SOFTER_SPREAD + 0.5 * abs(math.log(self.softer)))
        shifts = (one / _SHIFT_MM for one in setting.shifts)
        return 3.0 * np.array([math.log(setting.lever) / _LEVER_SPREAD, *shifts, softer])


def fit_finish(coupon: Coupon, profiles: Sequence[Profile], folds: Sequence[Fold], *, finished: Half) -> FinishFit:
    """Return the finish of that half. Raises ValueError if no strip of either half can be used.

    profiles : of all strips as the programs make them; folds : of all strips in both halves
    """
    model = _Model(coupon, profiles, folds, finished)
    if not model.milled or not model.finished:
        raise ValueError("no strip of the photograph can be used")
    start = _search_setting(model)
    low, high = _bounds()
    inside = np.clip(start.vector(), low + 1e-6, high - 1e-6)
    found = least_squares(model.all, inside, bounds=(low, high), loss="soft_l1", x_scale=0.1, max_nfev=60)
    setting = _Setting.of(found.x)
    left = tuple(_find_ripples_left(model, setting, finished=True))
    milled = tuple(_find_ripples_left(model, setting, finished=False))
    k0_range, order_range = _find_ranges(setting, left)
    lever, lever_error = _fit_lever(model, setting)
    throw = lever * model.nominal_mm / (coupon.refractive_index - 1) + coupon.flat_mm
    residual = np.concatenate(model.of_half(setting, finished=False) + model.of_half(setting, finished=True))
    return FinishFit(
        k0_rad_per_mm=setting.k0,
        order=setting.order,
        k0_range=k0_range,
        order_range=order_range,
        throw_mm=throw,
        throw_error_mm=lever_error * throw,
        mill_gain=setting.lever / lever,
        blur_mm=setting.blur_mm,
        misfit=float(np.sqrt(np.mean(residual[residual != 0.0] ** 2))) if (residual != 0.0).any() else 0.0,
        ripples=left,
        milled_ripples=milled,
    )


def misfit_as_milled(coupon: Coupon, profiles: Sequence[Profile], folds: Sequence[Fold], half: Half) -> float:
    """Return the misfit of a half with the milled form: rms of the residuals over the expected errors, outliers cut
    off.

    About 1 for a half as milled, several for a finished one; inf if nothing is usable.
    """
    model = _Model(coupon, profiles, folds, "left" if half == "right" else "right")
    if not model.milled:
        return math.inf
    setting = _fit_as_milled(model)
    left = np.concatenate(model.of_half(setting, finished=False))
    left = np.minimum(np.abs(left[left != 0.0]), _OUTLIER)
    return float(np.sqrt(np.mean(left**2))) if left.size else math.inf


def _bounds() -> tuple[Array, Array]:
    logs = np.log([K0_RANGE, ORDER_RANGE, (0.7, 1.4), _BLUR_RANGE_MM])
    shifts, softer = np.full(4, 0.15), math.log(3.0)
    return np.array([*logs[:, 0], *-shifts, -softer]), np.array([*logs[:, 1], *shifts, softer])


def _sums(values: Array) -> Array:
    """Return the sums over the bins, one for each displacement."""
    return values.sum(axis=-1, keepdims=True)


def _cost(parts: Sequence[Array]) -> float:
    """Return the cost of residuals, with outliers counted less."""
    return float(sum((np.sqrt(1.0 + part**2) - 1.0).sum() for part in parts))


def _search_setting(model: _Model) -> _Setting:
    """Return the best of many settings: the milled half alone, then the finish. Fringes that cross have other
    minima.
    """
    first = _fit_as_milled(model)
    best, least = first, math.inf
    for k0 in np.geomspace(1.0, 60.0, 22):
        for order in (1.0, 2.0, 4.0):
            setting = replace(first, k0=float(k0), order=order)
            cost = _cost(model.of_half(setting, finished=True))
            if cost < least:
                best, least = setting, cost
    return best


def _fit_as_milled(model: _Model) -> _Setting:
    """Return the setting with which the milled half fits best: of a grid, then from there."""
    best, least = _Setting(5.0, 2.0, 1.0, 0.05, (0.0, 0.0, 0.0, 0.0)), math.inf
    for lever in np.linspace(0.88, 1.12, 13):
        for blur in (0.02, 0.04, 0.08, 0.16):
            for shift in (-0.04, 0.0, 0.04):
                setting = _Setting(5.0, 2.0, float(lever), blur, (shift, 0.0, shift, 0.0))
                cost = _cost(model.of_half(setting, finished=False))
                if cost < least:
                    best, least = setting, cost
    start, (low, high) = best.vector(), _bounds()
    own = slice(2, 6)  # of the parameters: those of the finish and of the finished half's place are not involved

    def misses(part: Array) -> Array:
        vector = np.concatenate([start[:2], part, start[6:]])
        return np.concatenate([*model.of_half(_Setting.of(vector), finished=False), model.priors(vector)])

    found = least_squares(misses, start[own], bounds=(low[own], high[own]), loss="soft_l1", x_scale=0.1, max_nfev=40)
    lever, blur, middle, tilt = np.concatenate([np.exp(found.x[:2]), found.x[2:]]).tolist()
    return _Setting(best.k0, best.order, lever, blur, (middle, tilt, middle, tilt), model.softer)


def _find_ripples_left(model: _Model, setting: _Setting, *, finished: bool) -> list[RippleLeft]:
    """Yield the best share of each ripple's amplitude, with the other parameters fixed."""
    out = []
    for profile, fold in model.finished if finished else model.milled:
        strip = profile.strip
        if strip.kind != "ripple":
            continue
        nominal, curve = 1.0, setting
        if finished:
            nominal = float(setting.finish.transfer(np.array(strip.k_rad_per_mm)))
        if nominal < _LEAST_LEFT:  # a ripple that has vanished cannot be scaled up: assume that this much is left
            nominal = _LEAST_LEFT
            k0 = strip.k_rad_per_mm / (-math.log(_LEAST_LEFT)) ** (1 / setting.order)
            curve = replace(setting, k0=k0)
        light = model.harmonics(profile, curve, finished=finished)

        def cost(share: float, pair: tuple[Profile, Fold] = (profile, fold), full: float = nominal,
                 light: Callable[[float], Complex] = light) -> float:  # fmt: skip
            left = model.residuals(*pair, light(share / full), setting, finished, aside_mm=_ASIDE[:, None])
            return float(((np.sqrt(1.0 + left**2) - 1.0).sum(axis=1) + (_ASIDE / _SHIFT_MM) ** 2).min())

        costs = np.array([cost(share) for share in _LEFT])
        share, error = _find_minimum(costs, max(1.0, 2.0 * costs.min() / max(fold.usable_bins - 3, 1)))
        out.append(RippleLeft(period_mm=strip.period_mm, k_rad_per_mm=strip.k_rad_per_mm, share=share, error=error))
    return out


def _find_minimum(costs: Array, scale: float) -> tuple[float, float]:
    """Return the minimum of half a sum of squares, and the distance at which it has grown by one standard deviation."""
    best = int(costs.argmin())
    near = costs - costs[best] <= 2.0 * scale
    below, above = best, best
    while below > 0 and near[below - 1]:
        below -= 1
    while above < costs.size - 1 and near[above + 1]:
        above += 1
    step = float(_LEFT[1] - _LEFT[0])
    share = float(_LEFT[best])
    if 0 < best < costs.size - 1:
        bend = costs[best - 1] - 2 * costs[best] + costs[best + 1]
        share += 0.5 * step * float((costs[best - 1] - costs[best + 1]) / bend) if bend > 0 else 0.0
    return share, max(0.005, 0.25 * step * (above - below + 1))  # two deviations on either side


def _find_ranges(setting: _Setting, left: Sequence[RippleLeft]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges that hold 68 % of the curves through ripples drawn at random, with their errors, around the
    result.
    """
    k = np.array([one.k_rad_per_mm for one in left])
    share = np.array([one.share for one in left])
    error = np.hypot([one.error for one in left], 0.02)
    rng = np.random.default_rng(_SEED)
    found = np.array([math.log(setting.k0), math.log(setting.order)])
    trials = []
    for _ in range(_CHOICES):
        chosen = rng.integers(0, k.size, k.size)
        noisy = share[chosen] + error[chosen] * rng.standard_normal(k.size)
        trials.append(_curve_through(k[chosen], noisy, error[chosen], found))
    around = np.exp(np.array(trials))
    spread = np.quantile(around, (0.16, 0.84), axis=0)
    k0, order = ((min(spread[0, i], math.exp(found[i])), max(spread[1, i], math.exp(found[i]))) for i in range(2))
    return (float(k0[0]), float(k0[1])), (float(order[0]), float(order[1]))


def _curve_through(k: Array, share: Array, error: Array, start: Array) -> Array:
    """Return ln k0 and ln order of the curve nearest to the shares; weak priors hold them where the shares do not
    determine them.
    """
    at = start.copy()
    for _ in range(12):
        power = (k / math.exp(at[0])) ** math.exp(at[1])
        made = np.exp(-np.minimum(power, 50.0))
        steep = np.where(power < 50.0, made * power * math.exp(at[1]), 0.0)
        error_now = error * np.hypot(1.0, (share - made) / (3.0 * error))  # a misread ripple counts little
        rows = np.stack([steep, -steep * np.log(k / math.exp(at[0]))], axis=1) / error_now[:, None]
        miss = np.append((share - made) / error_now, (start - at) / _PRIORS)
        step = np.linalg.lstsq(np.vstack([rows, np.diag(1 / _PRIORS)]), miss, rcond=None)[0]
        at = at + np.clip(step, -0.3, 0.3)
        at = np.clip(at, np.log([K0_RANGE[0], ORDER_RANGE[0]]), np.log([K0_RANGE[1], ORDER_RANGE[1]]))
    return np.asarray(at)


def _fit_lever(model: _Model, setting: _Setting) -> tuple[float, float]:
    """Return the distance to the wall over the nominal one, from the ramp as milled, and its error."""
    for profile, fold in model.milled:
        if profile.strip.kind != "ramp":
            continue
        levers = np.linspace(0.7, 1.4, 141)
        costs = np.empty(levers.size)
        for number, lever in enumerate(levers):
            tried = replace(setting, lever=float(lever))
            harmonics = model.harmonics(profile, tried, finished=False)(1.0)
            costs[number] = _cost([model.residuals(profile, fold, harmonics, tried, False)])
        best = int(costs.argmin())
        near = np.flatnonzero(costs - costs[best] <= 2.0 * max(1.0, 2.0 * costs[best] / max(fold.usable_bins - 3, 1)))
        lever = float(levers[best])
        if 0 < best < levers.size - 1:
            bend = costs[best - 1] - 2 * costs[best] + costs[best + 1]
            lever += 0.0025 * float((costs[best - 1] - costs[best + 1]) / bend) if bend > 0 else 0.0
        return lever, max(0.002, float(np.ptp(levers[near])) / 4)
    return setting.lever, _LEVER_SPREAD
