"""Plane perspective: 3 x 3 homographies between a picture on a wall and a photograph of it.

A picture's own coordinates run from -1 to 1 from rim to rim (x to the right, y down), so that steps of all eight
parameters are of one size; a photograph's are pixels from its upper left corner, with pixel centres at halves.
"""

from __future__ import annotations

import math

import numpy as np

from optics.spline import Array

PARAMETERS = 8


def apply_homography(homography: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Return images of points x, y (any one shape); NaN where a point lies on or behind the horizon."""
    h = homography
    below = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    below = np.where(below > 1e-9 * abs(h[2, 2]), below, np.nan)
    return (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / below, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / below


def normalise_homography(homography: Array) -> Array:
    """Return the same mapping with 1 in its last place, so that the middle of the picture lies before the horizon."""
    return np.asarray(homography / homography[2, 2])


def step_homography(step: Array) -> Array:
    """Return (3, 3) homography near the identity, of eight small parameters: to first order it moves by
    `step_fields`.
    """
    s = step
    return np.array([[1 + s[2], s[3], s[0]], [s[4], 1 + s[5], s[1]], [-s[6], -s[7], 1.0]])


def step_fields(x: Array, y: Array) -> tuple[Array, Array]:
    """Return (8, ...) each: the derivative of x and y of points by each parameter of `step_homography`."""
    zero, one = np.zeros_like(x), np.ones_like(x)
    along_x = np.stack([one, zero, x, y, zero, zero, x * x, x * y])
    along_y = np.stack([zero, one, zero, zero, x, y, x * y, y * y])
    return along_x, along_y


def homography_of_points(source: Array, image: Array) -> Array:
    """Return (3, 3) homography that takes four points (4, 2) of the source, no three in line, to those of the image (4,
    2).
    """
    rows = []
    for (x, y), (u, v) in zip(source, image, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, -u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, -v])
    scale = np.abs(image).max()
    system = np.array(rows)
    system[:, :6] *= scale
    found = np.linalg.svd(system)[2][-1]
    found[:6] *= scale
    return normalise_homography(found.reshape(3, 3))


def jacobian_at(homography: Array, x: float = 0.0, y: float = 0.0) -> Array:
    """Return (2, 2) derivative of the image by the point, at one point."""
    h = homography
    below = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    u, v = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / below, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / below
    return (
        np.array([[h[0, 0] - u * h[2, 0], h[0, 1] - u * h[2, 1]], [h[1, 0] - v * h[2, 0], h[1, 1] - v * h[2, 1]]])
        / below
    )


def rotation_rad(homography: Array, middle: tuple[float, float]) -> float:
    """Return how far a picture is turned in a photograph with that middle, clockwise, if the camera was level.

    A level camera sees vertical lines as vertical or as meeting above or below its middle, in whichever direction it
    looks. The angle is that of the line from the photograph's middle to their meeting point.
    """
    h = homography
    down = h[0, 1] - middle[0] * h[2, 1], h[1, 1] - middle[1] * h[2, 1]
    return math.atan2(-down[0], down[1])


def enclose_quadrilateral(hull: Array) -> Array:
    """Return (4, 2) corners of a small quadrilateral around a convex polygon (n, 2), n >= 4, in the polygon's order.

    Edges are removed one after the other, each time the one whose removal adds the least area when its neighbours are
    extended until they meet.
    """
    corners = [np.asarray(corner, dtype=np.float64) for corner in hull]
    while len(corners) > 4:
        best: tuple[float, int, Array] | None = None
        for k in range(len(corners)):
            a, b, c, d = (corners[(k + i - 1) % len(corners)] for i in range(4))
            found = _find_meeting(a, b, d, c)
            if found is not None and (best is None or found[0] < best[0]):
                best = found[0], k, found[1]
        if best is None:
            break
        _, k, point = best
        corners[k] = point
        del corners[(k + 1) % len(corners)]
    return np.array(corners[:4])


def _find_meeting(a: Array, b: Array, d: Array, c: Array) -> tuple[float, Array] | None:
    """Return where the extensions of a -> b and d -> c meet, and the area of the triangle that this adds at the edge b
    c; None if they do not meet.
    """
    along, back, between = b - a, c - d, c - b
    cross = along[0] * back[1] - along[1] * back[0]
    if abs(cross) < 1e-12:
        return None
    t = (between[0] * back[1] - between[1] * back[0]) / cross
    s = (between[0] * along[1] - between[1] * along[0]) / cross
    if t < 0 or s < 0:
        return None
    point = b + t * along
    return 0.5 * abs(between[0] * (point[1] - b[1]) - between[1] * (point[0] - b[0])), point
