"""First guesses of where a picture lies in a photograph, from the area that is lit.

Its moments give the place, the size and the foreshortening, and leave a rotation open: all of them are offered. The
quadrilateral around it gives a whole perspective, whose corners may be any four in turn.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_closing, gaussian_filter, label
from scipy.spatial import ConvexHull, QhullError

from optics.photograph.homography import enclose_quadrilateral, homography_of_points
from optics.photograph.views import Mask
from optics.spline import Array

_TURNS = 24


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
    """Return where light falls in a photograph (all of what lies close together), and how bright it is elsewhere."""
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
