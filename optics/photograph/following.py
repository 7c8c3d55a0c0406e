"""Registers a predicted picture with a photograph by Gauss-Newton steps: place, exposure, tone and blur at once.

Large residuals count little (Huber), so that foreign objects in the photograph have little effect. Where the photograph
is clipped, so is the model, and these pixels affect neither place nor exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_laplace

from optics.photograph.homography import PARAMETERS, normalise_homography, step_homography
from optics.photograph.views import Photograph, View
from optics.spline import Array

_SMOOTH = 0.8  # pixels: both pictures are smoothed by this before they are compared
_STEPS = 14
_SETTLED = 5e-3  # pixels
_TONE_SPREAD = 0.25
_HUBER = 2.0
_DETAILS = (0.02, 0.12)  # of the picture's longer side: between these, pictures are distinguished
_LEAST_SCALE = 3e-4  # of the camera's white


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """One state of the fit. `spread_px2`: variance of the blur, in pixels of the view."""

    homography: Array
    gain: float = 1.0
    offset: float = 0.0
    tone: float = 1.0
    spread_px2: float = 0.0
    cost: float = np.inf
    settled: bool = False


def promise_of(photograph: Photograph, view: View, fit: Fit) -> float:
    """Return the correlation of the photograph at that place with the picture, clipped where the photograph is."""
    light, clipped, inside = view.sample(photograph, fit.homography)
    share = float(clipped[view.inner].mean())
    picture = np.minimum(view.picture, np.quantile(view.picture[view.inner], min(max(1 - share, 0.05), 0.98)))
    return _correlate(np.where(inside, light, 0.0), picture)


def correlation_of(photograph: Photograph, view: View, fit: Fit) -> float:
    """Return the correlation of the photograph with the fit, inside the picture."""
    return _alike(photograph, view, fit)[0]


def likeness_of(photograph: Photograph, view: View, fit: Fit) -> float:
    """Return the geometric mean of that correlation and of that of the details.

    Blobs of light of different pictures can be matched by a perspective, a tone and a blur; details between _DETAILS of
    the picture's side cannot.
    """
    return float(np.sqrt(np.prod(np.maximum(_alike(photograph, view, fit), 0.0))))


def _alike(photograph: Photograph, view: View, fit: Fit) -> tuple[float, float]:
    """Return the correlation of the whole pictures, and of their details."""
    off, model, _, _ = residual_of(photograph, view, fit)
    inner = view.inner
    known = np.isfinite(off[inner])
    if known.mean() < 0.2:
        return 0.0, 0.0
    model = model[inner]
    seen = np.where(known, off[inner] + model, model)
    fine, coarse = (share * max(model.shape) for share in _DETAILS)
    details = [gaussian_filter(one, fine) - gaussian_filter(one, coarse) for one in (seen, model)]
    return _correlate(seen[known], model[known]), _correlate(details[0][known], details[1][known])


def _correlate(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    both = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / both if both > 0 else 0.0


def smooth(picture: Array) -> Array:
    """Smooth values, like everything that is compared."""
    return gaussian_filter(picture, _SMOOTH)


def blur(picture: Array, fit: Fit) -> Array:
    return gaussian_filter(picture, np.sqrt(fit.spread_px2)) if fit.spread_px2 > 1e-3 else picture


def model_photograph(picture: Array, fit: Fit) -> tuple[Array, Array]:
    """Return the expected photograph, smoothed, and the share of each pixel that is not clipped."""
    raw = fit.gain * np.clip(blur(picture, fit), 0.0, None) ** fit.tone + fit.offset
    return smooth(np.minimum(raw, 1.0)), smooth((raw < 1.0).astype(np.float64))


def residual_of(photograph: Photograph, view: View, fit: Fit) -> tuple[Array, Array, Array, Array]:
    """Return photograph minus model (NaN where they are not compared), the model, its open share, the clipped share."""
    light, clipped, inside = view.sample(photograph, fit.homography)
    inside &= view.compared
    model, is_open = model_photograph(view.picture, fit)
    light = gaussian_filter(light, np.sqrt(_SMOOTH**2 + max(-fit.spread_px2, 0.0)))
    return np.where(inside, light - model, np.nan), model, is_open, clipped


def follow(photograph: Photograph, view: View, fit: Fit, *, fit_tone: bool = False, fit_blur: bool = False) -> Fit:
    """Run Gauss-Newton steps with Levenberg's damping from one fit, on one view.

    fit_blur : the picture's rim is left out, because the prediction ends there while the light does not
    """
    if fit_blur:
        view = view.without_rim()
    if not np.isfinite(fit.cost):
        fit = _with_tones(photograph, view, fit)
    damping, along = 1e-3, view.fields()
    now = residual_of(photograph, view, fit)
    scale = _spread_of(now)
    cost = _cost(now[0], scale)
    fit = replace(fit, cost=cost, settled=False)
    for _ in range(_STEPS):
        columns = columns_of(view, fit, now[1], now[2], along, fit_tone, fit_blur)
        step = _solve_step(now[0], columns, scale, damping, fit, fit_tone)
        trial = take_step(fit, step, fit_tone, fit_blur)
        then = residual_of(photograph, view, trial)
        worse = np.isfinite(then[0]).mean() < 0.3 or not (_cost(then[0], scale) < cost)
        moved = float(np.abs(step[:PARAMETERS]).max()) / max(view.step)
        if fit_blur:
            moved = max(moved, abs(float(step[-1])))
        if worse:
            damping *= 8
            if moved < _SETTLED or damping > 1e6:
                return replace(fit, settled=True)
            continue
        damping = max(damping / 5, 1e-6)
        now, scale = then, _spread_of(then)
        cost = _cost(then[0], scale)
        fit = replace(trial, cost=cost, settled=moved < _SETTLED)
        if fit.settled:
            break
    return fit


def _with_tones(photograph: Photograph, view: View, fit: Fit) -> Fit:
    """Return gain and offset for a given place: least squares over the pixels that are not clipped."""
    light, clipped, inside = view.sample(photograph, fit.homography)
    chosen = inside & (clipped < 0.02)
    if chosen.sum() < 20:
        chosen = inside
    if chosen.sum() < 20:
        return replace(fit, gain=float(photograph.small().max()), offset=0.0)
    picture = gaussian_filter(view.picture, _SMOOTH)[chosen]
    found, *_ = np.linalg.lstsq(np.stack([picture, np.ones_like(picture)], axis=1), light[chosen], rcond=None)
    gain = max(float(found[0]), 0.05 * float(np.ptp(light)) / max(float(np.ptp(picture)), 1e-9))
    return replace(fit, gain=gain, offset=float(light[chosen].mean() - gain * picture.mean()))


def columns_of(
    view: View, fit: Fit, model: Array, is_open: Array, along: tuple[Array, Array], fit_tone: bool, fit_blur: bool
) -> Array:
    """Return (k, ...) the decrease of the residual by each parameter: place, gain, offset, tone, blur."""
    down, across = np.gradient(model)
    place = -(along[0] * (across / view.step[1]) + along[1] * (down / view.step[0]))
    lit = np.maximum(blur(view.picture, fit), 1e-6)
    powered = gaussian_filter(lit**fit.tone, _SMOOTH)
    columns = [*place, is_open * powered, is_open]
    if fit_tone:
        columns.append(is_open * fit.gain * gaussian_filter(lit**fit.tone * np.log(lit), _SMOOTH))
    if fit_blur:
        columns.append(0.5 * gaussian_laplace(fit.gain * powered, 0.7) * is_open)
    return np.stack(columns)


def _solve_step(residual: Array, columns: Array, scale: float, damping: float, fit: Fit, fit_tone: bool) -> Array:
    """Return the damped step of all parameters that are fitted."""
    valid = np.isfinite(residual)
    r, jacobian = residual[valid], columns[:, valid]
    weight = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(r), 1e-12))
    normal = (jacobian * weight) @ jacobian.T
    right = (jacobian * weight) @ r
    if fit_tone:
        prior = (scale / _TONE_SPREAD) ** 2
        normal[PARAMETERS + 2, PARAMETERS + 2] += prior
        right[PARAMETERS + 2] += prior * (1.0 - fit.tone)
    diagonal = np.maximum(np.diag(normal), 1e-12)
    return np.asarray(np.linalg.solve(normal + np.diag(damping * diagonal + 1e-12), right))


def take_step(fit: Fit, step: Array, fit_tone: bool, fit_blur: bool) -> Fit:
    place = np.clip(step[:PARAMETERS], -0.25, 0.25)
    rest = list(step[PARAMETERS:])
    gain, offset = fit.gain + rest[0], fit.offset + rest[1]
    tone = float(np.clip(fit.tone + rest[2], 0.3, 3.0)) if fit_tone else fit.tone
    spread = fit.spread_px2 + float(np.clip(rest[-1], -2.0, 4.0)) if fit_blur else fit.spread_px2
    return replace(
        fit,
        homography=normalise_homography(fit.homography @ step_homography(place)),
        gain=max(float(gain), 0.2 * fit.gain),
        offset=float(offset),
        tone=tone,
        spread_px2=float(np.clip(spread, -9.0, 400.0)),
    )


def _spread_of(parts: tuple[Array, Array, Array, Array]) -> float:
    """Return the spread of the residuals, except those that are 0 because photograph and model are both white."""
    off, _, is_open, clipped = parts
    return robust_scale(np.where((is_open > 0.5) | (clipped < 0.5), off, np.nan))


def robust_scale(residual: Array) -> float:
    """Return the standard deviation of most residuals, but at least the rounding of a file's 8 bits."""
    values = residual[np.isfinite(residual)]
    return max(1.4826 * float(np.median(np.abs(values))), _LEAST_SCALE) if values.size else 1.0


def _cost(residual: Array, scale: float) -> float:
    """Return the mean Huber loss in units of the scale, times the scale squared."""
    r = np.abs(residual[np.isfinite(residual)]) / scale
    if r.size == 0:
        return np.inf
    return float(np.mean(np.where(r <= _HUBER, 0.5 * r * r, _HUBER * (r - 0.5 * _HUBER)))) * scale**2
