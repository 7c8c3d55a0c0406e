"""Registers a photograph of light on a wall with the predicted light.

Theory of operation: the photograph is linear light, clipped at the camera's white. Its model is min(gain * (prediction,
blurred)^tone + offset, 1), seen in perspective. First guesses come from the lit area of the photograph: its moments,
which leave a rotation open, and the quadrilateral around it, whose corners may be any four in turn. All of them are
tried on a picture of some 30 pixels, the best are followed by Gauss-Newton steps on finer and finer pictures, with
weights that reduce the influence of foreign objects, and the best fit is kept. Mirrored guesses are tried too: if one
fits clearly better, the picture is mirrored. Nothing here depends on lenses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_closing, gaussian_filter, label
from scipy.spatial import ConvexHull, QhullError

from optics.irradiance import ViewedFrom, flip_between_picture_and_work_frame, picture_from_irradiance
from optics.photograph.following import Fit, blur, correlation_of, follow, likeness_of, promise_of
from optics.photograph.homography import (
    enclose_quadrilateral,
    homography_of_points,
    jacobian_at,
    normalise_homography,
    rotation_rad,
)
from optics.photograph.views import Mask, Photograph, View, pixel_noise
from optics.spline import Array

_COARSEST, _FINEST = 28, 320  # pixels along the longer side
_KEPT, _KEPT_FINER = 8, 3
_STRANGE, _ALIKE = 0.5, 0.75  # greatest likeness of a photograph of another picture, and least of one of this picture
_MIRRORED = 0.6  # largest misfit of a mirrored fit, relative to the upright one, for it to be accepted
_TURNS = 24


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """The place of the prediction in the photograph, and the photograph's light there.

    homography (3, 3)   : (x, y, 1) in pixels of the predicted *picture* (as the viewer sees it, row 0 on top; from its
                          upper left corner, pixel centres at halves) -> pixels of the photograph, counted likewise
    rectified (ny, nx)  : the photograph in the prediction's place and units, work frame; NaN beyond the photograph
    usable (ny, nx)     : where that is light and neither clipped nor beyond the photograph
    gain, offset, tone  : photograph = gain * irradiance^tone + offset
    blur_px             : standard deviation of the Gaussian, in pixels of the prediction, by which the photograph is
                          softer; negative: sharper
    residual            : rms of rectified less the prediction, blurred alike, over the prediction's standard deviation
    correlation         : of the photograph with the fit, inside the picture
    likeness            : geometric mean of that and of the correlation of the picture's details
    confidence          : 0 to 1: that this is a photograph of the prediction; below 0.5 the rest is not reliable
    overlap             : share of the prediction inside the photograph
    clipped_share       : of the prediction's pixels that lie inside the photograph: too bright for it
    noise               : standard deviation from pixel to pixel, in units of the camera's white
    pixels_per_pixel    : pixels of the photograph along one of the prediction
    rotation_rad        : of the picture in the photograph, clockwise, if the camera was level
    mirrored            : the photograph shows the prediction with left and right exchanged
    converged           : the last steps made no change
    """

    homography: Array
    rectified: Array
    usable: Mask
    gain: float
    offset: float
    tone: float
    blur_px: float
    residual: float
    correlation: float
    likeness: float
    confidence: float
    overlap: float
    clipped_share: float
    noise: float
    pixels_per_pixel: float
    rotation_rad: float
    mirrored: bool
    converged: bool


def register(
    photo: Array,
    predicted: Array,
    *,
    viewed_from: ViewedFrom = "lens",
    fit_tone: bool = False,
) -> Registration:
    """Find the predicted light in a photograph.

    photo (h, w)       : linear light, 1 = the camera's white, row 0 on top
    predicted (ny, nx) : irradiance in the work frame (row 0 at the lowest y), any units
    viewed_from        : from which side the photograph was taken
    fit_tone           : the camera's tones are uncertain: fit an exponent too

    ValueError for a photograph or a prediction without light.
    """
    picture = picture_from_irradiance(np.asarray(predicted, dtype=np.float64), viewed_from=viewed_from)
    photograph = Photograph.of(photo)
    scale = float(picture.mean())
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError("the prediction holds no light")
    picture = picture / scale
    views = [View.of(picture, side, dark_surround=True) for side in _sides(max(picture.shape))]
    upright = _choose_fit(photograph, views, first_guesses(photograph.small(), picture, turned_over=False))
    mirrored = _choose_fit(photograph, views[:2], first_guesses(photograph.small(), picture, turned_over=True))
    level = min(1, len(views) - 1)
    rivals = [likeness_of(photograph, views[level], one) for one in (upright, mirrored)]
    is_mirrored = rivals[1] > (_STRANGE + _ALIKE) / 2 and 1.0 - rivals[1] < _MIRRORED * (1.0 - rivals[0])
    found = mirrored if is_mirrored else upright
    for view in views[2:] if is_mirrored else ():
        found = follow(photograph, view, found)
    found = follow(photograph, views[-1], found, fit_tone=fit_tone, fit_blur=True)
    return _registration(photograph, picture, scale, views[-1], found, viewed_from, is_mirrored)


def _sides(longest: int) -> list[int]:
    """Return the sides of the views, coarse to fine."""
    sides, last = [min(_COARSEST, longest)], min(longest, _FINEST)
    while sides[-1] * 2 <= last:
        sides.append(sides[-1] * 2)
    return sides if sides[-1] > 0.8 * last else [*sides, last]


def _choose_fit(photograph: Photograph, views: list[View], starts: list[Array]) -> Fit:
    """Return the best start, followed through all the views, but without its blur and tone."""
    high, wide = photograph.shape
    to_photo = np.diag([wide, high, 1.0])
    fits = [Fit(homography=normalise_homography(to_photo @ one)) for one in starts if abs(one[2, 2]) > 1e-12]
    ranked = sorted(fits, key=lambda one: -promise_of(photograph, views[0], one))[:_KEPT]
    tried = [follow(photograph, views[0], one) for one in ranked]
    for view in views[1:2]:
        tried = sorted(tried, key=lambda one: -correlation_of(photograph, views[0], one))[:_KEPT_FINER]
        tried = [follow(photograph, view, one) for one in tried]
    best = max(tried, key=lambda one: correlation_of(photograph, views[min(1, len(views) - 1)], one))
    for view in views[2:]:
        best = follow(photograph, view, best)
    return best


def _registration(
    photograph: Photograph,
    picture: Array,
    scale: float,
    view: View,
    fit: Fit,
    viewed_from: ViewedFrom,
    mirrored: bool,
) -> Registration:
    """Return the fit in the prediction's own pixels, units and frame."""
    ny, nx = picture.shape
    whole = View.of(picture, max(ny, nx), dark_surround=False)
    light, clipped, inside = whole.sample(photograph, fit.homography)
    finer = max(picture.shape) / max(view.picture[view.inner].shape)
    spread = (fit.spread_px2 - photograph.sampling_blur_px2(fit.homography, view.step)) * finer**2
    fitted = blur(picture, replace(fit, spread_px2=spread))
    rectified = np.clip((light - fit.offset) / fit.gain, 0.0, None) ** (1 / fit.tone)
    usable = inside & (clipped < 0.02)
    off = (rectified - fitted)[usable]
    likeness = likeness_of(photograph, view, fit)
    believed = float(np.clip((likeness - _STRANGE) / (_ALIKE - _STRANGE), 0.0, 1.0))
    to_own = np.array([[2 / nx, 0, -1], [0, 2 / ny, -1], [0, 0, 1.0]])
    overlap = float(inside.mean())

    def own(seen: Array) -> Array:
        return flip_between_picture_and_work_frame(seen, viewed_from)

    return Registration(
        homography=normalise_homography(fit.homography @ to_own),
        rectified=own(np.where(inside, rectified, np.nan) * scale),
        usable=own(usable.astype(np.float64)) > 0,
        gain=fit.gain / scale**fit.tone,
        offset=fit.offset,
        tone=fit.tone,
        blur_px=float(np.sign(spread) * np.sqrt(abs(spread))),
        residual=float(np.sqrt(np.mean(off**2)) / max(picture.std(), 1e-12)) if off.size else np.inf,
        correlation=correlation_of(photograph, view, fit),
        likeness=likeness,
        confidence=believed * min(1.0, overlap / 0.8),
        overlap=overlap,
        clipped_share=float(clipped[inside].mean()) if inside.any() else 0.0,
        noise=pixel_noise(photograph.light[0]),
        pixels_per_pixel=float(np.sqrt(abs(np.linalg.det(jacobian_at(fit.homography))) * 4 / (nx * ny))),
        rotation_rad=rotation_rad(fit.homography, (photograph.shape[1] / 2, photograph.shape[0] / 2)),
        mirrored=mirrored,
        converged=fit.settled,
    )


def first_guesses(small: Array, picture: Array, *, turned_over: bool) -> list[Array]:
    """Return the first guesses in coordinates of the small photograph scaled to 1 x 1."""
    lit, level = _find_lit(small)
    flip = np.diag([-1.0, 1.0, 1.0]) if turned_over else np.eye(3)
    own = _clip_glare(picture)
    guesses = []
    middle, root = _moments(np.where(lit, np.sqrt(np.clip(small - level, 0.0, None)), 0.0))
    own_middle, own_root = _moments(np.sqrt(own))
    ny, nx = picture.shape
    to_pixels = np.array([[nx / 2, 0, nx / 2], [0, ny / 2, ny / 2], [0, 0, 1.0]])
    for turn in range(_TURNS):
        a = 2 * np.pi * turn / _TURNS
        turned = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        mirror = flip[:2, :2]
        linear = root @ turned @ np.linalg.inv(mirror @ own_root @ mirror) @ mirror
        affine = np.eye(3)
        affine[:2, :2], affine[:2, 2] = linear, middle - linear @ own_middle
        guesses.append(affine @ to_pixels)
    corners, own_corners = _corners(lit), _corners(own > 0.05 * np.quantile(own, 0.98))
    if corners is not None and own_corners is not None:
        own_corners = 2 * own_corners / (nx, ny) - 1
        for first in range(4):
            order = np.roll(np.arange(4), first)
            image = corners[order[::-1]] if turned_over else corners[order]
            guesses.append(homography_of_points(own_corners, image))
    high, wide = small.shape
    return [np.diag([1 / wide, 1 / high, 1.0]) @ one for one in guesses]


def _clip_glare(picture: Array) -> Array:
    """Return the picture without the glare of a few pixels."""
    return np.clip(picture, 0.0, np.quantile(picture, 0.98))


def _find_lit(small: Array) -> tuple[Mask, float]:
    """Return the lit area of a photograph (everything that is close together), and the brightness elsewhere."""
    smooth = gaussian_filter(small, 1.0)
    dark, bright = float(np.quantile(smooth, 0.05)), float(np.quantile(smooth, 0.995))
    histogram, edges = np.histogram(smooth, bins=64, range=(dark, max(bright, dark + 1e-9)))
    crowded = int(np.argmax(histogram[:24]))
    level = float(edges[crowded] + edges[crowded + 1]) / 2 if histogram[crowded] > 0.15 * small.size else dark
    over = smooth > level + 0.08 * (bright - level)
    joined, count = label(binary_closing(np.pad(over, 6), iterations=4)[6:-6, 6:-6])
    if count == 0:
        return np.ones(small.shape, dtype=bool), level
    sums = np.bincount(joined.ravel(), weights=np.clip(small - level, 0.0, None).ravel())[1:]
    return joined == 1 + int(np.argmax(sums)), level


def _moments(weight: Array) -> tuple[Array, Array]:
    """Return the centre (2,) and root of the covariance (2, 2) of a weighted grid [pixels]."""
    total = max(float(weight.sum()), 1e-12)
    y, x = (np.arange(n) + 0.5 for n in weight.shape)
    across, down = weight.sum(axis=0) / total, weight.sum(axis=1) / total
    middle = np.array([across @ x, down @ y])
    dx, dy = x - middle[0], y - middle[1]
    mixed = float(dy @ weight @ dx) / total
    values, axes = np.linalg.eigh(np.array([[across @ dx**2, mixed], [mixed, down @ dy**2]]) + 1e-6 * np.eye(2))
    return middle, np.asarray(axes @ np.diag(np.sqrt(values)) @ axes.T)


def _corners(lit: Mask) -> Array | None:
    """Return (4, 2) corners around the lit pixels, clockwise as seen, from the one nearest the upper left; None: no
    area.
    """
    rows, columns = np.nonzero(lit)
    points = np.concatenate([np.stack([columns + dx, rows + dy], axis=1) for dx in (0, 1) for dy in (0, 1)])
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    around = enclose_quadrilateral(points[hull.vertices])  # scipy's order: counter-clockwise where y points up
    if len(around) < 4:
        return None
    return np.asarray(np.roll(around, -int(np.argmin(around.sum(axis=1))), axis=0), dtype=np.float64)
