"""Estimates the set-up from a registered photograph: wall, light and the lens's own low-order error.

Theory of operation: a photograph determines the picture on the wall up to a perspective, eight numbers that belong to
the camera. Anything beyond a perspective shows in the positions *within the picture*, and in the brightness: a wall too
far by s moves the light of each ray by s times its slope, which is a different distortion for each lens; a tilted wall
does so more on one side; an error of the surface deflects rays by its slopes. All of these are computed exactly, ray by
ray, and fitted together with perspective, exposure (with a camera's shading of second order), tone and blur, by
Gauss-Newton steps on the photograph itself. Each quantity has an expected spread (`_PRIORS`), as wide as in a workshop.
A quantity that the photograph does not determine stays near zero, and its deviation stays near that spread. A wall off
by 1 % is, to first order, a surface that is higher by 1 % everywhere; the spread of surface errors, some micrometres,
separates the two.

The model is the light of the designed lens, as soft as the predicted picture, plus the smooth part of their difference:
of a mill's grain only the blur can be predicted, because each block has a different grain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, laplace

from optics.bench import Bench
from optics.heightfield import Heightfield
from optics.irradiance import ViewedFrom, flip_between_picture_and_work_frame
from optics.photograph.following import Fit, blur, columns_of, residual_of, robust_scale, smooth, take_step
from optics.photograph.homography import PARAMETERS, normalise_homography
from optics.photograph.rays import ORDERS, SETTINGS, WallRays, surface_mode
from optics.photograph.registering import Registration
from optics.photograph.views import Mask, Photograph, View, area_average
from optics.spline import Array
from optics.threads import thread_count

_SIDES = (88, 88, 176, 176)  # pixels of the view along its longer side, one step of the fit each
_WAVES, _SHADING = 5, 0.1  # waves of shading along each side at most; relative, of camera, lamp and wall
_CAUTION = 3.0  # in trials with a mill's grain, variances exceeded those from residuals alone by this factor
_UNFORESEEN, _UNFORESEEN_PX2 = (
    0.02,
    16.0,
)  # relative to the light's spread: the unmodelled part; and the area over which it is alike
_TONE = 0.15
_ODD = np.array([1.0, 1.0, 0.5, 0.5, 0.5])  # pixels squared; the last: to the fourth
_THROW, _TILT_RAD, _ASLANT_RAD, _SURFACE_UM = 0.05, math.radians(3.0), math.radians(1.0), 8.0
_WIDTH = 0.003  # relative error of a person's measurement of a picture on a wall
_HUBER = 2.0
_GRAINLESS_PX = 2.0  # averaged over this, a mill's grain is small compared with the systematic effect of milling
_GRAIN = 0.4  # share of the unmodelled part that is also present in the dark
_LAGS = 6  # pixels
_OPEN = 0.02  # clipped share of a pixel up to which its brightness is used


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A value, its standard deviation, and the spread that was expected before the photograph."""

    value: float
    deviation: float
    expected: float

    @property
    def is_determined(self) -> bool:
        """Whether the photograph determines the value: it narrows the expected spread to less than half."""
        return self.deviation < 0.5 * self.expected

    def exceeds(self, deviations: float) -> bool:
        """Return whether it is determined and farther from zero than this number of its deviations."""
        return self.is_determined and abs(self.value) > deviations * self.deviation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WallFit:
    """Deviations from the prediction; all zero: as predicted.

    throw_mm          : distance of the wall beyond that for which the lens was made
    wall_tilt_rad     : angles by which the wall leans away towards +x and towards +y
    light_tilt_rad    : tilt of the light towards +x and +y
    surface_um        : for each of ORDERS, height of the surface over the lens, as the Legendre polynomial's factor
    blur_mm           : standard deviation on the wall by which the photograph is softer than predicted; < 0: sharper
    predicted_blur_mm : standard deviation of the blur that makes the predicted picture softer than the design's light
    correlation       : of the photograph with the fit, and `before` with the predicted set-up
    """

    throw_mm: Estimate
    wall_tilt_rad: tuple[Estimate, Estimate]
    light_tilt_rad: tuple[Estimate, Estimate]
    surface_um: tuple[Estimate, ...]
    blur_mm: float
    predicted_blur_mm: float
    correlation: float
    before: float


def fit_wall(
    photo: Array,
    registration: Registration,
    heightfield: Heightfield,
    bench: Bench,
    predicted: Array,
    *,
    viewed_from: ViewedFrom = "lens",
    picture_width_mm: float | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> WallFit:
    """Fit the set-up to a photograph in which `register` has found `predicted`.

    photo (h, w)      : as register takes it
    predicted (ny, nx) : irradiance on the bench's screen, work frame, mean about 1
    picture_width_mm  : width of the lit rectangle on the wall, if it was measured
    """
    fit = _WallFit(photo, registration, heightfield, bench, predicted, viewed_from, picture_width_mm)
    return fit.run(on_progress or (lambda _: None))


def surface_error_um(
    estimates: tuple[Estimate, ...], x: Array, y: Array, shape: float, *, deviations: float = 0.0
) -> Array:
    """Return the height error at points of the aperture, -1 to 1 from rim to rim, of all terms that are determined.

    estimates : for each of ORDERS
    shape     : height / width of the aperture
    """
    height_um = np.zeros(np.broadcast(x, y).shape)
    for order, one in zip(ORDERS, estimates, strict=True):
        if one.exceeds(deviations):
            height_um += one.value * surface_mode(order, x, y, shape)
    return height_um


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _State:
    """One state of the fit: place, exposure, tone and blur; the set-up for `WallRays`; factors of shading and of odd
    blur.
    """

    fit: Fit
    setting: Array
    shade: Array
    odd_blur: Array


class _Scene:
    """The photograph and the known facts about its light, at one size."""

    def __init__(
        self,
        photograph: Photograph,
        lens: Heightfield,
        bench: Bench,
        predicted: Array,
        viewed_from: ViewedFrom,
        side: int,
    ) -> None:
        ny, nx = predicted.shape
        self.share = min(1.0, side / max(ny, nx))
        shape = max(8, round(ny * self.share)), max(8, round(nx * self.share))
        self._photograph, self._viewed_from = photograph, viewed_from
        self.view = View.of(np.zeros((ny, nx)), max(shape), dark_surround=True).without_rim()
        rim = self.view.inner[0].start
        shape = self.view.picture[self.view.inner].shape
        self.rays = WallRays(lens, bench, (shape[0], shape[1]), rim)
        self._plain = self._flip_to_viewer(np.zeros(SETTINGS))
        self.known = np.ones(self._plain.shape, dtype=bool)
        known = np.isfinite(predicted)
        self.known[self.view.inner] = area_average(known.astype(np.float64), shape) > 0.999
        inside = area_average(np.where(known, predicted, 0.0), shape)
        inner = self.view.inner
        self.softness_px = _fit_softness(self._plain[inner], inside, self.known[inner])
        self._soft = self._soften(self._plain)
        self._milled = np.zeros(self._plain.shape)
        difference = np.where(self.known[inner], inside - self._soft[inner], 0.0)
        self._milled[inner] = gaussian_filter(difference, _GRAINLESS_PX) if any(self.softness_px) else difference
        self._shades = _shades(self.view)

    def light(self, setting: Array) -> Array:
        """Return the light as the viewer sees it, as soft as predicted."""
        soft = self._soften(self._flip_to_viewer(setting)) if setting.any() else self._soft
        return np.maximum(soft + self._milled, 0.0)

    def make_view(self, state: _State, light: Array | None = None) -> View:
        light = self.light(state.setting) if light is None else light
        shading = 1.0 + np.tensordot(state.shade, self._shades, 1)
        return replace(self.view, picture=light * np.maximum(shading, 0.2))

    def residual(self, state: _State, view: View) -> tuple[Array, Array, Array, Array]:
        """Return photograph minus model, model, its open share, and the weight of each pixel, 0 where it does not
        count.

        The unmodelled part, above all a mill's grain, grows with the light.
        """
        off, model, is_open, clipped = residual_of(self._photograph, view, state.fit)
        odd = np.tensordot(state.odd_blur, _odd_blurs(view, state.fit), 1) * is_open
        off, model = off - odd, model + odd
        counts = np.isfinite(off) & self.known & (clipped < _OPEN) & (is_open > 1 - _OPEN)
        light = np.maximum(model - state.fit.offset, 0.0)
        grain = _GRAIN + (1 - _GRAIN) * light / max(float(light[counts].mean()) if counts.any() else 1.0, 1e-12)
        return np.where(counts, off, 0.0), model, is_open, counts / grain**2

    def columns(self, state: _State, view: View, model: Array, is_open: Array, steps: Array) -> Array:
        """Return (k, ...): place, gain, offset, tone, blur; the shades; the settings, by differences over `steps`."""
        fit = state.fit
        along = self.view.fields()
        lit = np.maximum(blur(view.picture, fit), 1e-6)
        by_light = is_open * fit.gain * fit.tone * lit ** (fit.tone - 1.0)
        light = self.light(state.setting)
        shading = view.picture / np.maximum(light, 1e-9)
        shades = [smooth(by_light * blur(light * one, fit)) for one in self._shades]

        def change(number: int) -> Array:
            moved = state.setting.copy()
            moved[number] += steps[number]
            return smooth(by_light * blur((self.light(moved) - light) * shading, fit)) / steps[number]

        with ThreadPoolExecutor(max_workers=thread_count()) as pool:
            settings = list(pool.map(change, range(SETTINGS)))
        own = columns_of(view, fit, model, is_open, along, fit_tone=True, fit_blur=True)
        return np.concatenate([own, is_open * _odd_blurs(view, fit), np.stack(shades + settings)])

    def correlation(self, state: _State) -> float:
        """Return the correlation of the photograph with the model over the pixels that count inside the picture."""
        off, model, _, counts = self.residual(state, self.make_view(state))
        chosen = np.zeros(counts.shape, dtype=bool)
        chosen[self.view.inner] = counts[self.view.inner] > 0
        if chosen.sum() < 20 or not model[chosen].std() > 0:
            return 0.0
        return float(np.corrcoef((off + model)[chosen], model[chosen])[0, 1])

    def _flip_to_viewer(self, setting: Array) -> Array:
        return flip_between_picture_and_work_frame(self.rays.light(setting), self._viewed_from)

    def _soften(self, light: Array) -> Array:
        return gaussian_filter(light, self.softness_px) if any(self.softness_px) else light


class _WallFit:
    """The steps from the registration's place to the whole fit."""

    def __init__(
        self,
        photo: Array,
        registration: Registration,
        lens: Heightfield,
        bench: Bench,
        predicted: Array,
        viewed_from: ViewedFrom,
        width_mm: float | None,
    ) -> None:
        self._bench, self._viewed_from = bench, viewed_from
        self._width = None if width_mm is None else width_mm / bench.screen.width_mm
        self._predicted = flip_between_picture_and_work_frame(predicted, viewed_from)
        self._photograph = Photograph.of(photo)
        self._lens = lens
        self._registration = registration
        self._expected = np.concatenate(
            [[_THROW * bench.throw_mm], [_TILT_RAD] * 2, [_ASLANT_RAD] * 2, [_SURFACE_UM] * len(ORDERS)]
        )
        self._steps = np.concatenate([0.1 * self._expected[:5], 0.5 * self._expected[5:]])

    def run(self, report: Callable[[float], None]) -> WallFit:
        scene = self._scene(_SIDES[0])
        state, deviation = self._begin(scene), self._expected
        for number, side in enumerate(_SIDES):
            if number and side != _SIDES[number - 1]:
                finer = self._scene(side)
                spread = state.fit.spread_px2 * (finer.share / scene.share) ** 2
                scene, state = finer, replace(state, fit=replace(state.fit, spread_px2=spread))
            state, deviation = self._improve(scene, state)
            report((number + 1) / len(_SIDES))
        return self._make_result(scene, state, deviation, scene.correlation(self._begin(scene)))

    def _scene(self, side: int) -> _Scene:
        return _Scene(self._photograph, self._lens, self._bench, self._predicted, self._viewed_from, side)

    def _begin(self, scene: _Scene) -> _State:
        r, (ny, nx) = self._registration, self._predicted.shape
        to_pixels = np.array([[nx / 2, 0, nx / 2], [0, ny / 2, ny / 2], [0, 0, 1.0]])
        fit = Fit(
            homography=normalise_homography(r.homography @ to_pixels),
            gain=r.gain,
            offset=r.offset,
            tone=r.tone,
            spread_px2=math.copysign((r.blur_px * scene.share) ** 2, r.blur_px),
        )
        return _State(fit=fit, setting=np.zeros(SETTINGS), shade=np.zeros(SHADES), odd_blur=np.zeros(_ODD.size))

    def _improve(self, scene: _Scene, state: _State) -> tuple[_State, Array]:
        """Take one Gauss-Newton step, halved until it helps; return it and the deviations of the settings there."""
        view = scene.make_view(state)
        off, model, is_open, counts = scene.residual(state, view)
        spread, root = (float(model[counts > 0].std()) if counts.any() else 1.0), np.sqrt(counts)
        scale = max(robust_scale(np.where(counts > 0, off * root, np.nan)), _UNFORESEEN * spread)
        weight = counts * np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(off * root), 1e-12))
        alike = _area_of_correlation(off * np.sqrt(weight), (counts > 0).astype(np.float64))
        certainty = 1.0 / (_CAUTION * scale**2 * max(alike, _UNFORESEEN_PX2))
        columns = scene.columns(state, view, model, is_open, self._steps).reshape(-1, off.size)
        normal = certainty * ((columns * weight.ravel()) @ columns.T)
        right = certainty * ((columns * weight.ravel()) @ off.ravel())
        precision, pull = self._prior(state, len(columns))
        normal[np.diag_indices_from(normal)] += precision
        right += pull
        if self._width is not None:
            row, short = self._width_row(scene, state, len(columns))
            normal += np.outer(row, row) / _WIDTH**2
            right += row * short / _WIDTH**2
        balance = 1.0 / np.sqrt(np.diag(normal))
        inverse = np.linalg.inv(normal * np.outer(balance, balance) + 1e-9 * np.eye(len(normal)))
        inverse *= np.outer(balance, balance)
        step = inverse @ right
        deviation = np.sqrt(np.diag(inverse)[-SETTINGS:])
        now = self._loss(scene, state, view, scale, certainty)
        for factor in (1.0, 0.5, 0.25, 0.1):
            trial = self._move(state, factor * step)
            if self._loss(scene, trial, scene.make_view(trial), scale, certainty) < now:
                return trial, deviation
        return state, deviation

    def _prior(self, state: _State, count: int) -> tuple[Array, Array]:
        """Return the precisions of all parameters, and their expected values."""
        precision, at = np.full(count, 1e-12), np.zeros(count)
        tone = PARAMETERS + 2
        precision[tone], at[tone] = 1 / _TONE**2, 1.0 - state.fit.tone
        shades = slice(-SETTINGS - SHADES, -SETTINGS)
        precision[shades], at[shades] = 1 / _SHADING_EXPECTED**2, -state.shade
        odd = slice(shades.start - _ODD.size, shades.start)
        precision[odd], at[odd] = 1 / _ODD**2, -state.odd_blur
        precision[-SETTINGS:], at[-SETTINGS:] = 1 / self._expected**2, -state.setting
        return precision, precision * at

    def _width_row(self, scene: _Scene, state: _State, count: int) -> tuple[Array, float]:
        """Return the derivative of the lit width by each parameter, and the shortfall from the measured width."""
        assert self._width is not None
        now, row = scene.rays.width(state.setting), np.zeros(count)
        for number in range(SETTINGS):
            moved = state.setting.copy()
            moved[number] += self._steps[number]
            row[number - SETTINGS] = (scene.rays.width(moved) - now) / self._steps[number]
        return row, self._width - now

    def _loss(self, scene: _Scene, state: _State, view: View, scale: float, certainty: float) -> float:
        off, _, _, counts = scene.residual(state, view)
        r = np.abs(off) * np.sqrt(counts) / scale
        loss = np.where(r <= _HUBER, 0.5 * r * r, _HUBER * (r - 0.5 * _HUBER))
        data = float(loss[counts > 0].mean() if counts.any() else np.inf) * counts.size * certainty * scale**2
        prior = float(((state.setting / self._expected) ** 2).sum() + ((state.shade / _SHADING_EXPECTED) ** 2).sum())
        prior += float(((state.odd_blur / _ODD) ** 2).sum()) + ((state.fit.tone - 1.0) / _TONE) ** 2
        if self._width is not None:
            prior += ((self._width - scene.rays.width(state.setting)) / _WIDTH) ** 2
        return data + 0.5 * prior

    def _move(self, state: _State, step: Array) -> _State:
        own, odd, shade, setting = np.split(step, np.cumsum([PARAMETERS + 4, _ODD.size, SHADES]))
        most = 2.0 * self._expected
        return _State(
            fit=take_step(state.fit, own, fit_tone=True, fit_blur=True),
            setting=state.setting + np.clip(setting, -most, most),
            shade=state.shade + shade,
            odd_blur=state.odd_blur + odd,
        )

    def _make_result(self, scene: _Scene, state: _State, deviation: Array, before: float) -> WallFit:
        found = [
            Estimate(value=float(v), deviation=float(d), expected=float(e))
            for v, d, e in zip(state.setting, deviation, self._expected, strict=True)
        ]
        view, fit = scene.make_view(state), state.fit
        pixel_mm = self._bench.screen.width_mm / view.picture[view.inner].shape[1]
        predicted_px = math.sqrt((scene.softness_px[0] ** 2 + scene.softness_px[1] ** 2) / 2)
        return WallFit(
            throw_mm=found[0],
            wall_tilt_rad=(found[1], found[2]),
            light_tilt_rad=(found[3], found[4]),
            surface_um=tuple(found[5:]),
            blur_mm=math.copysign(math.sqrt(abs(fit.spread_px2)) * pixel_mm, fit.spread_px2),
            predicted_blur_mm=predicted_px * pixel_mm,
            correlation=scene.correlation(state),
            before=before,
        )


_ORDERS_OF_SHADES = [(a, b) for a in range(_WAVES + 1) for b in range(_WAVES + 1) if 0 < a + b <= _WAVES]
SHADES = len(_ORDERS_OF_SHADES)
_SHADING_EXPECTED = np.array([_SHADING / (a + b) ** 1.5 for a, b in _ORDERS_OF_SHADES])


def _shades(view: View) -> Array:
    """Return (SHADES, ...) cosines over the picture, level beyond it."""
    along, down = (np.pi * (np.clip(one, -1.0, 1.0) + 1.0) / 2 for one in (view.x, view.y))
    return np.stack([np.cos(a * along) * np.cos(b * down) for a, b in _ORDERS_OF_SHADES])


def _odd_blurs(view: View, fit: Fit) -> Array:
    """Return (5, ...) the effects of a blur that is stronger across than along, stronger along a diagonal, stronger on
    the right, stronger at the bottom, and tailed.

    An oblique camera that is out of focus causes the first four; no blur is exactly Gaussian.
    """
    light = fit.gain * np.maximum(blur(view.picture, fit), 1e-6) ** fit.tone
    across, down, aslant = (gaussian_filter(light, 0.8, order=order) for order in ((0, 2), (2, 0), (1, 1)))
    all_round = (across + down) / 2
    return np.stack([(across - down) / 2, aslant, view.x * all_round, view.y * all_round, laplace(all_round) / 4])


def _fit_softness(sharp: Array, predicted: Array, known: Mask) -> tuple[float, float]:
    """Return standard deviations (down, across) [pixels] of the Gaussian that makes `sharp` most like `predicted`."""
    tried = [0.0, *np.geomspace(0.3, 12.0, 20)]

    def loss(down: float, across: float) -> float:
        one = gaussian_filter(sharp, (down, across))[known]
        frame = np.stack([one, np.ones_like(one)], axis=1)
        found = np.linalg.lstsq(frame, predicted[known], rcond=None)[0]
        return float(((frame @ found - predicted[known]) ** 2).sum())

    both = min(tried, key=lambda sigma: loss(sigma, sigma))
    down = min(tried, key=lambda sigma: loss(sigma, both))
    return down, min(tried, key=lambda sigma: loss(down, sigma))


def _area_of_correlation(off: Array, counts: Array) -> float:
    """Return the number of pixels that share one error: the area under the residuals' autocorrelation."""
    spectrum = np.abs(np.fft.rfft2(off, [2 * n for n in off.shape])) ** 2
    pairs = np.abs(np.fft.rfft2(counts, [2 * n for n in off.shape])) ** 2
    both, number = (np.fft.irfft2(one, [2 * n for n in off.shape]) for one in (spectrum, pairs))
    ratio = both / np.maximum(number, 1.0)
    lags = np.arange(-_LAGS, _LAGS + 1)
    patch = ratio[np.ix_(lags, lags)] / max(float(ratio[0, 0]), 1e-30)
    return max(1.0, float(np.maximum(patch, 0.0).sum()))
