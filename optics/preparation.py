"""Prepares a picture for a wall: puts contrast and tones where detail of the attainable size is visible.

Theory of operation: three guided filters split the picture's lightness into layers (He, Sun, Tang 2010) of
growing window, 0.75, 3 and 9 times the smallest detail that shows. They smooth structure fainter than an edge and leave
strong edges in the base, so that raised layers have no visible halo. The layer above the detail is raised most; the
finer one is raised too, because the wall's blur removes most of it, and the rest makes eyes and mouths sharp. The tones
of the base are stretched where the layers are busy, at the cost of even areas (sky, wall, coat): a partial histogram
equalisation with a limited slope (Pizer 1987), weighted by structure (Ward 1997). Tones beyond black and white are then
compressed softly, because scaling everything down would cost the contrast gained. Gains, windows and limits were chosen
on blurred, grainy walls of photographs, by structural similarity to the original with its local contrast normalised, by
the contrast of faces alone, and by looking at them.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter

from optics.errors import TargetError
from optics.spline import Array
from phrases.phrase import Phrase

_WINDOWS = (0.75, 3.0, 9.0)  # of the guided filters, in details
_GAINS = (1.6, 1.8, 1.3)  # of the layers between them, finest first
_EDGE = 0.2  # lightness: fainter steps are detail
_STRETCH = 0.3  # share of the equalised tone curve, the rest leaves tones as they are
_STEEPEST = 2.5  # slope of the equalised curve, so that faint noise is not amplified
_TONES, _TONE_BLUR = 256, 6.0
_CLIPPED = 0.001  # of the pixels, brighter than white
_KNEE = 0.05  # lightness: how far from black and white tones begin to bend
_TWO_TONES = 0.93  # share of the variance between two tones: above it there are no others (logos 0.98, photos < 0.9)
_GAMMA = 2.2  # lightness = light^(1/2.2), as eyes see it and near the sRGB curve
_BLACK_ROUNDS = 20


def prepare_picture(linear: Array, detail_px: float, *, black: float = 0.0) -> Array:
    """Return the picture with its contrast raised just above the smallest detail that will show.

    linear    : (ny, nx) linear light >= 0
    detail_px : smallest detail that will show, in pixels: the full width at half maximum of the blur on the wall
    black     : light of the darkest pixels as a share of the mean; less than valleys leak anyway, so no detail there is
    visible
    returns   : (ny, nx) linear light; the same array where the picture has two tones only, which no contrast can help
    Raises TargetError if the detail is not a valid size.
    """
    if not (np.isfinite(detail_px) and detail_px > 0):
        raise TargetError(
            Phrase(
                "the smallest detail to prepare a picture for must be more than 0 pixels, not {detail_px}",
                detail_px=detail_px,
            )
        )
    lightness = _lightness(linear)
    if has_two_tones(linear):
        return linear
    sizes = [_odd(share * detail_px, min(linear.shape)) for share in _WINDOWS]
    layers = [lightness, *(_smooth_between_edges(lightness, size) for size in sizes)]
    busy = np.abs(layers[1] - layers[2]) + np.abs(layers[2] - layers[3])
    made = _stretch_tones(layers[3], uniform_filter(busy, sizes[1], mode="nearest"))
    for gain, finer, coarser in zip(_GAINS, layers[:-1], layers[1:], strict=True):
        made += gain * (finer - coarser)
    return _lift_black(_bend_ends(made) ** _GAMMA, black)


def has_two_tones(linear: Array) -> bool:
    """Return whether nearly all of the picture's variance in lightness lies between two tones (Otsu 1979)."""
    counts, edges = np.histogram(_lightness(linear), _TONES, (0.0, 1.0))
    share, tone = counts / counts.sum(), (edges[1:] + edges[:-1]) / 2
    below, moment = np.cumsum(share)[:-1], np.cumsum(share * tone)[:-1]
    mean = float(share @ tone)
    variance = float(share @ (tone - mean) ** 2)
    some = (below > 0) & (below < 1)
    between = (mean * below[some] - moment[some]) ** 2 / (below[some] * (1 - below[some]))
    return variance == 0 or bool(between.max(initial=0.0) >= _TWO_TONES * variance)


def _lightness(linear: Array) -> Array:
    white = max(float(np.quantile(linear, 1 - _CLIPPED)), 0.5 * float(linear.max()))
    return np.asarray(np.clip(linear / white, 0.0, 1.0) ** (1 / _GAMMA))


def _odd(size: float, most: int) -> int:
    """Return the nearest odd number of pixels, 3 at the least, no more than the picture has."""
    return max(3, 2 * (min(round(size), most) // 2) + 1)


def _smooth_between_edges(lightness: Array, size: int) -> Array:
    """Return the guided filter of a picture by itself: in each window a straight line, flat where the variance is
    small.
    """
    mean = uniform_filter(lightness, size, mode="nearest")
    variance = np.maximum(uniform_filter(lightness**2, size, mode="nearest") - mean**2, 0.0)
    slope = variance / (variance + _EDGE**2)
    level = uniform_filter((1.0 - slope) * mean, size, mode="nearest")
    return np.asarray(uniform_filter(slope, size, mode="nearest") * lightness + level)


def _stretch_tones(base: Array, weight: Array) -> Array:
    """Return the base with more contrast where it has structure. The order of tones, black and white stay."""
    counts, edges = np.histogram(base, _TONES, (0.0, 1.0), weights=weight)
    slope = gaussian_filter1d(counts, _TONE_BLUR, mode="reflect")
    if not slope.mean() > 0:
        return base.copy()
    slope = np.minimum(slope / slope.mean(), _STEEPEST)
    slope = (1.0 - _STRETCH) + _STRETCH * (slope + 1.0 - slope.mean())
    return np.asarray(np.interp(base, edges, np.concatenate([[0.0], np.cumsum(slope)]) / _TONES))


def _bend_ends(lightness: Array) -> Array:
    """Map any lightness into 0 to 1: unchanged except near the ends, which it approaches asymptotically."""
    below = _KNEE * np.exp(np.minimum(lightness, _KNEE) / _KNEE - 1.0)
    above = 1.0 - _KNEE * np.exp((1.0 - np.maximum(lightness, 1.0 - _KNEE)) / _KNEE - 1.0)
    return np.where(lightness < _KNEE, below, np.where(lightness > 1.0 - _KNEE, above, lightness))


def _lift_black(picture: Array, black: float) -> Array:
    """Raise pixels darker than that share of the mean, which rises with them."""
    lifted = picture
    for _ in range(_BLACK_ROUNDS if black > 0 else 0):
        lifted = np.maximum(picture, min(black, 1.0) * lifted.mean())
    return lifted
