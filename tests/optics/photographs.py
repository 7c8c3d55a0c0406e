"""Photographs of light on a wall, made by a pinhole camera: what the tests of registration look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from optics.spline import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """photo (h, w): linear light as an 8 bit sRGB file keeps it; homography: (x, y) of the light picture's unit square
    (from its upper left corner) -> pixels of the photo, centres at halves.
    """

    photo: Array
    homography: Array

    def places(self, across: int = 9) -> tuple[Array, Array]:
        """(n, 2) points of the unit square, and where they are in the photo."""
        x, y = np.meshgrid(np.linspace(0.05, 0.95, across), np.linspace(0.05, 0.95, across))
        points = np.stack([x.ravel(), y.ravel()], axis=1)
        return points, moved(self.homography, points)


def moved(homography: Array, points: Array) -> Array:
    """Images of (n, 2) points."""
    u = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(u[:, :2] / u[:, 2:])


def camera(
    *, aside_deg: float, above_deg: float = 0.0, roll_deg: float = 0.0, quarter_turns: int = 0, aspect: float = 1.0,
    shape: tuple[int, int] = (600, 800), filling: float = 0.5,
) -> Array:  # fmt: skip
    """Homography of a camera that looks at the middle of the picture (1 wide, 1 / aspect high) from aside."""
    a, b = np.radians([aside_deg, above_deg])
    yaw = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    pitch = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    r = np.radians(roll_deg + 90.0 * quarter_turns)
    roll = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    distance = 1.8
    focal = filling * max(shape) * distance
    to_centre = np.array([[1, 0, -0.5], [0, 1 / aspect, -0.5 / aspect], [0, 0, 1]])
    turn = roll @ pitch @ yaw
    pose = np.column_stack([turn[:, 0], turn[:, 1], [0.02, -0.01, distance]])
    lens = np.array([[focal, 0, shape[1] / 2], [0, focal, shape[0] / 2], [0, 0, 1]])
    found = lens @ pose @ to_centre
    return np.asarray(found / found[2, 2])


def photographed(
    light: Array,
    homography: Array,
    *,
    margin: float = 0.0,
    shape: tuple[int, int] = (600, 800),
    stops: float = 0.0,
    blur_px: float = 2.0,
    noise: float = 0.01,
    background: float = 0.01,
    shading: float = 0.0,
    gamma: float = 1.0,
    mirrored: bool = False,
    seed: int = 0,
) -> Shot:
    """A photograph of `light` (row 0 on top), of which `margin` of the picture's size on each side lies beyond it.

    stops : 0 puts the brightest hundredth at 0.8 of white; blur_px: of the photo; shading: darker in the corners by;
    gamma : of the camera's own, unknown tones
    """
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    back = np.linalg.inv(homography)
    seen = np.zeros(shape)
    for du, dv in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        u = np.stack([columns + du, rows + dv, np.ones(shape)])
        x, y, w = np.tensordot(back, u, 1)
        before = w * np.sign(np.linalg.det(back)) > 0
        x, y = np.where(before, x / w, -9.0), np.where(before, y / w, -9.0)
        x = 1.0 - x if mirrored else x
        at = [
            (value + margin) / (1 + 2 * margin) * size - 0.5
            for value, size in ((y, light.shape[0]), (x, light.shape[1]))
        ]
        seen += map_coordinates(light, at, order=1, mode="constant") / 4
    seen *= 0.8 / np.quantile(light, 0.99) * 2.0**stops
    radius2 = ((rows / shape[0] - 0.5) ** 2 + (columns / shape[1] - 0.5) ** 2) / 0.5
    seen = gaussian_filter((seen + background) * (1.0 - shading * radius2), blur_px)
    generator = np.random.default_rng(seed)
    seen = seen + noise * np.sqrt(np.clip(seen, 0.02, None)) * generator.standard_normal(shape)
    return Shot(photo=as_stored(np.clip(seen, 0.0, 1.0) ** gamma), homography=homography)


def as_stored(linear: Array) -> Array:
    """What is left of linear light in 8 bit sRGB."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    levels = np.rint(255 * encoded) / 255
    return np.asarray(np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4))
