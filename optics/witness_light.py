"""Light of the witness marks: predicts it for a dose, and finds the dose from a photograph of it.

Theory of operation. The strip alone is lit, straight from behind, and its light falls on paper WALL_MM away, where a
ripple a cos(kx) makes fringes of the same period, of strength m = lever k^2 a, where lever is the distance to the paper
times (n - 1). The photograph shows a bright quadrilateral. Its corners give the perspective; along the ridges it is
averaged. What remains are the fringes of each mark against its flat. They are compared with those of the milled strip,
levelled by a dose. Errors of rows are not modelled: they are noise, averaged over all periods of a mark. The
photograph's blur weakens short fringes more (as k^2) than a finish of order 1 does, so the fit can separate the two;
for order 2 it cannot, and a prior fixes the blur.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import fft
from scipy.ndimage import binary_closing, gaussian_filter, label, map_coordinates
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull, QhullError

from optics.finish import Finish
from optics.heightfield import Array
from optics.photograph.homography import apply_homography, enclose_quadrilateral, homography_of_points
from optics.witness import Strip, envelope_mm

WALL_MM = 20.0
"""From the strip to the paper, as for the test piece."""

DOSE_RANGE = (0.2, 4.0)

CELL_MM = 0.02
_BEYOND_MM = 12.0  # of the strip: flat, and long enough for the reach of a finish
_SAMPLES_PER_MM, _ACROSS = 40, 48
_BORDER = 0.3  # of the strip's width at either rim that is left out
_WHITE, _MOST_WHITE = 0.97, 0.02
_STARTS = 24
_COVERED_MM = np.linspace(-0.25, 1.0, 6)  # of either end of the strip that tape may cover
_LEAST_BLUR_MM, _BLUR_SPREAD = 0.01, 0.2  # of the logarithm of the blur that the strip's ends show
_EDGE_MM = 0.8  # of the light at either end, from which its blur is taken
_LEVER_SPREAD = 0.05
_FLOOR = 0.004  # error of the model, as a share of the mean light
_OFF = 0.05  # the same for the fringes
_BESIDE = (0.55, 1.45, 1.6)  # times a mark's wave number: frequencies at which no signal is expected
_LEAST_LIT = 0.02  # of the camera's white
_LEAST_PIXELS_PER_MM = 8.0


Refusal = Literal["no_light", "too_dark", "too_bright", "too_small"]


class StripNotFoundError(ValueError):
    """A photograph without a readable strip of marks; code names the reason."""

    def __init__(self, code: Refusal) -> None:
        super().__init__(code)
        self.code: Refusal = code


@dataclass(frozen=True, slots=True, kw_only=True)
class DoseReading:
    """dose: share of the planned one; error: its standard deviation; blur_mm: of the photograph, on the paper."""

    dose: float
    error: float
    blur_mm: float
    misfit: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StripLight:
    """Light (n,) along the strip from end to end, its values around 1; its blur, standard deviation; pixels_per_mm: of
    the photograph.
    """

    light: Array
    blur_mm: float
    pixels_per_mm: float


def strip_heights_mm(strip: Strip) -> tuple[Array, Array]:
    """Return u (n,) and heights (n,) of the strip as milled, with flat around it."""
    places, tips = strip.rows()
    u = np.arange(-_BEYOND_MM, strip.length_mm + _BEYOND_MM, CELL_MM)
    heights = envelope_mm(places, tips, strip.radius_mm, np.clip(u, 0.0, strip.length_mm))
    return u, heights


def finish_strip(heights_mm: Array, finish: Finish, dose: float) -> Array:
    """Return heights (n,) after that share of the planned dose, uniform across; the strip is flat at its ends."""
    k = math.pi * np.arange(heights_mm.size, dtype=np.float64) / ((heights_mm.size - 1) * CELL_MM)
    return np.asarray(fft.idct(fft.dct(heights_mm, type=1) * finish.after(dose).compute_kept(k), type=1))


def fringes_of(strip: Strip, u_mm: Array, heights_mm: Array, lever_mm: float) -> Array:
    """Return the strength of each mark's fringes (n,): the light's amplitude at its period over its mean, unblurred."""
    slope = np.gradient(heights_mm, CELL_MM)
    arrive = u_mm + lever_mm * slope
    found = []
    for begin, mark in zip(strip.begins_mm, strip.marks, strict=True):
        window = _window(arrive - begin, mark.width_mm)
        wave = np.exp(-1j * mark.k_rad_per_mm * (arrive - begin))
        found.append(2 * (window @ wave) / window.sum())
    return np.abs(found)


def read_strip(photo: Array, strip: Strip) -> StripLight:
    """Return the light along the strip of a photograph (h, w), linear, 1 the camera's white.

    Raises StripNotFoundError.
    """
    corners, level, dark = _find_corners(photo)
    sides = [math.dist(a, b) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    if sides[0] + sides[2] < sides[1] + sides[3]:
        corners, sides = np.roll(corners, -1, axis=0), [*sides[1:], sides[0]]
    pixels_per_mm = min(sides[0], sides[2]) / strip.length_mm
    if pixels_per_mm < _LEAST_PIXELS_PER_MM:
        raise StripNotFoundError("too_small")
    count, beyond = round(strip.length_mm * _SAMPLES_PER_MM), round(_EDGE_MM * _SAMPLES_PER_MM)
    u = (np.arange(-beyond, count + beyond) + 0.5) / count
    v = _BORDER + (1 - 2 * _BORDER) * (np.arange(_ACROSS) + 0.5) / _ACROSS
    to_photo = homography_of_points(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), corners)
    x, y = apply_homography(to_photo, *np.broadcast_arrays(u, v[:, None]))
    seen = map_coordinates(photo, [y - 0.5, x - 0.5], order=1, mode="nearest")
    if np.mean(seen > _WHITE) > _MOST_WHITE:
        raise StripNotFoundError("too_bright")
    if level - dark < _LEAST_LIT:
        raise StripNotFoundError("too_dark")
    light = (seen - dark).mean(axis=0)
    inside = slice(beyond, beyond + count)
    trend = np.polynomial.Polynomial.fit(u[inside], light[inside], 2)(u)  # the lamp's light, the camera's vignetting
    light /= trend
    blur_mm = float(
        np.sqrt(_edge_variance_mm2(light[: 2 * beyond]) * _edge_variance_mm2(light[: -2 * beyond - 1 : -1])) ** 0.5
    )
    return StripLight(light=light[inside], blur_mm=max(blur_mm, _LEAST_BLUR_MM), pixels_per_mm=pixels_per_mm)


def _edge_variance_mm2(light: Array) -> float:
    """Return the variance of the blur of an edge, from dark to bright, from the distance of its quarters."""
    rise = np.maximum.accumulate(light)
    low, high = (float(np.interp(share, rise, np.arange(rise.size))) for share in (0.25, 0.75))
    return ((high - low) / (2 * 0.6745) / _SAMPLES_PER_MM) ** 2


def fit_dose(seen: StripLight, strip: Strip, finish: Finish, *, refractive_index: float) -> DoseReading:
    """Return the share of the planned dose that the light shows; the strip may be photographed either way round."""
    ways = [_align_fringes(strip, seen.light[::way]) for way in (1, -1)]
    fits = [_fit(*way, seen.blur_mm, strip, finish, (refractive_index - 1) * WALL_MM) for way in ways]
    return min(fits, key=lambda one: one.misfit)


def _fit(measured: Array, error: Array, blur_mm: float, strip: Strip, finish: Finish, lever_mm: float) -> DoseReading:
    u, heights = strip_heights_mm(strip)
    waves = np.array([mark.k_rad_per_mm for mark in strip.marks])

    def misses(at: Array) -> Array:
        dose, blur, lever = np.exp(at)
        model = fringes_of(strip, u, finish_strip(heights, finish, dose), lever_mm * lever)
        model *= np.exp(-((waves * blur) ** 2) / 2)
        off = (measured - model) / error
        priors = [(at[1] - math.log(blur_mm)) / _BLUR_SPREAD, at[2] / _LEVER_SPREAD]
        return np.concatenate([off, priors])

    starts = [np.array([math.log(dose), math.log(blur_mm), 0.0]) for dose in np.geomspace(*DOSE_RANGE, _STARTS)]
    start = min(starts, key=lambda at: float((misses(at) ** 2).sum()))
    low, high = np.log([DOSE_RANGE[0], blur_mm / 3, 0.8]), np.log([DOSE_RANGE[1], blur_mm * 3, 1.25])
    best = least_squares(misses, np.clip(start, low + 1e-6, high - 1e-6), bounds=(low, high), max_nfev=30)
    spread = np.linalg.pinv(best.jac.T @ best.jac)
    dose = float(math.exp(best.x[0]))
    return DoseReading(
        dose=dose,
        error=dose * float(math.sqrt(max(spread[0, 0], 0.0))),
        blur_mm=float(math.exp(best.x[1])),
        misfit=float(2 * best.cost),
    )


def _align_fringes(strip: Strip, light: Array) -> tuple[Array, Array]:
    """Return the result of `_measure_fringes` for the strip within the lit part: tape is laid by hand, so part of the
    strip may be hidden.
    """
    covered = [(before, after) for before in _COVERED_MM for after in _COVERED_MM]
    tried = (_measure_fringes(strip, light, before, after) for before, after in covered)
    return max(tried, key=lambda one: float((one[0] ** 2).sum()))


def _measure_fringes(strip: Strip, light: Array, before_mm: float, after_mm: float) -> tuple[Array, Array]:
    """Return the strength of each mark's fringes (n,), and its error: the signal beside its frequency.

    before_mm, after_mm : of the strip, not in the light, at either end
    """
    found, errors = [], []
    place_mm = before_mm + (np.arange(light.size) + 0.5) * (strip.length_mm - before_mm - after_mm) / light.size
    for begin, mark in zip(strip.begins_mm, strip.marks, strict=True):
        away = place_mm - begin
        window = _window(away, mark.width_mm)
        fringe = window * (light / ((window @ light) / window.sum()) - 1.0)
        times = np.array([1.0, *_BESIDE])[:, None]
        seen = 2 * np.abs(np.exp(-1j * times * mark.k_rad_per_mm * away) @ fringe) / window.sum()
        noise = float(np.sqrt(np.mean(seen[1:] ** 2)))
        found.append(math.sqrt(max(float(seen[0]) ** 2 - noise**2, 0.0)))
        errors.append(math.hypot(_FLOOR, noise, _OFF * float(seen[0])))
    return np.array(found), np.array(errors)


def _window(away_mm: Array, width_mm: float) -> Array:
    """Return weights (n,) of whole periods in the middle of a mark, falling off as a cosine toward its ends."""
    share = np.clip(away_mm / width_mm, 0.0, 1.0)
    return np.asarray(np.sin(math.pi * share) ** 2)


def _find_corners(photo: Array) -> tuple[Array, float, float]:
    """Return corners (4, 2) of the lit part, as places in pixels, its light and that of the dark around it."""
    soft = gaussian_filter(photo, 1.5)
    dark, level = float(np.median(soft)), float(np.quantile(soft, 0.995))
    joined, count = label(binary_closing(np.pad(soft > dark + 0.4 * (level - dark), 12), iterations=6)[12:-12, 12:-12])
    if count == 0 or level <= dark:
        raise StripNotFoundError("no_light")
    lit = joined == 1 + int(np.argmax(np.bincount(joined.ravel())[1:]))
    inside = float(np.median(soft[lit]))
    rows, columns = np.nonzero(lit & (soft > (dark + inside) / 2))
    points = np.concatenate([np.stack([columns + dx, rows + dy], axis=1) for dx in (0, 1) for dy in (0, 1)])
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        raise StripNotFoundError("no_light") from None
    around = enclose_quadrilateral(points[hull.vertices])
    if len(around) < 4:
        raise StripNotFoundError("no_light")
    return np.asarray(around, dtype=np.float64), inside, dark
