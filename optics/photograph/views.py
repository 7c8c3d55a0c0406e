"""A photograph at several sizes, and a predicted picture at one size, for their comparison.

A picture's own coordinates, x and y below, are those of `homography`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.photograph.homography import jacobian_at, step_fields
from optics.spline import Array

Mask = NDArray[np.bool_]

CLIPPED = 0.95  # of the camera's white: above it, noise and the camera's tone curve hide the light
_RIM = 3.0  # pixels
MARGIN = 0.12  # of the picture, beyond its rim, where no light is predicted


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Photograph:
    """A photograph and its halves, quarters ..: light (h, w), and which share of each pixel is clipped."""

    light: tuple[Array, ...]
    clipped: tuple[Array, ...]

    @classmethod
    def of(cls, photo: Array) -> Photograph:
        """Make a photograph from its grid; ValueError if its values are not finite or have no light."""
        light = np.asarray(photo, dtype=np.float64)
        if light.ndim != 2 or min(light.shape) < 8 or not np.isfinite(light).all():
            raise ValueError("a photograph is a grid of at least 8 x 8 finite values")
        if not np.ptp(light) > 0:
            raise ValueError("the photograph is the same everywhere: it shows no light")
        lights, clips = [np.clip(light, 0.0, 1.0)], [(light >= CLIPPED).astype(np.float64)]
        while min(lights[-1].shape) >= 32:
            half = lights[-1].shape[0] // 2, lights[-1].shape[1] // 2
            lights.append(area_average(lights[-1], half))
            clips.append(area_average(clips[-1], half))
        return cls(light=tuple(lights), clipped=tuple(clips))

    @property
    def shape(self) -> tuple[int, int]:
        return self.light[0].shape[0], self.light[0].shape[1]

    def small(self) -> Array:
        """Return the finest of its sizes with at most some 25 000 pixels."""
        return next((one for one in self.light if one.size <= 25_000), self.light[-1])

    def sample(self, homography: Array, x: Array, y: Array, step: tuple[float, float]) -> tuple[Array, Array, Mask]:
        """Return mean light, clipped share and being inside, over areas of sides `step` (down, across) around x, y."""
        level, _ = self._level(homography, step)
        light, clipped = self.light[level], self.clipped[level]
        return _sample(light, clipped, homography, x, y, step, self.shape)

    def sampling_blur_px2(self, homography: Array, step: tuple[float, float]) -> float:
        """Return the variance, in areas sampled, by which a sample is softer than the mean over its area.

        Four points a half apart, each read bilinearly from pixels that are means themselves.
        """
        _, pixel = self._level(homography, step)
        return 1 / 16 + pixel**2 * (1 / 12 + 1 / 6) - 1 / 12

    def _level(self, homography: Array, step: tuple[float, float]) -> tuple[int, float]:
        """Return which of the sizes to read for areas of these sides, and how wide its pixels are, in such areas."""
        across = float(np.sqrt(abs(np.linalg.det(jacobian_at(homography))) * step[0] * step[1]))
        level = int(np.clip(np.floor(np.log2(max(across / 2, 1e-9)) + 0.5), 0, len(self.light) - 1))
        return level, 2.0**level / max(across, 1e-9)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The picture at one size with a dark margin, and its pixels' coordinates.

    step     : side of a pixel in those coordinates, (down, across)
    compared : where a photograph is compared with it
    """

    picture: Array
    x: Array
    y: Array
    inner: tuple[slice, slice]
    step: tuple[float, float]
    compared: Mask

    @classmethod
    def of(cls, picture: Array, side: int, dark_surround: bool) -> View:
        share = side / max(picture.shape)
        ny, nx = (max(4, round(n * share)) for n in picture.shape)
        rim = round(MARGIN * max(ny, nx)) if dark_surround else 0
        x, y = np.meshgrid((2 * np.arange(-rim, nx + rim) + 1) / nx - 1, (2 * np.arange(-rim, ny + rim) + 1) / ny - 1)
        inner = slice(rim, rim + ny), slice(rim, rim + nx)
        return cls(
            picture=np.pad(area_average(picture, (ny, nx)), rim),
            x=x,
            y=y,
            inner=inner,
            step=(2 / ny, 2 / nx),
            compared=np.ones(x.shape, dtype=bool),
        )

    def without_rim(self) -> View:
        """Return the same view, not compared where the picture ends."""
        away = np.minimum(abs(abs(self.x) - 1) / self.step[1], abs(abs(self.y) - 1) / self.step[0])
        beside = (abs(self.x) > 1 + _RIM * self.step[1]) | (abs(self.y) > 1 + _RIM * self.step[0])
        return replace(self, compared=self.compared & ((away > _RIM) | beside))

    def fields(self) -> tuple[Array, Array]:
        """Return `homography.step_fields` at its pixels."""
        return step_fields(self.x, self.y)

    def sample(self, photograph: Photograph, homography: Array) -> tuple[Array, Array, Mask]:
        """Return the values of `Photograph.sample` in the view's pixels."""
        return photograph.sample(homography, self.x, self.y, self.step)


def area_average(picture: Array, shape: tuple[int, int]) -> Array:
    """Return the picture on a grid of another shape, each value the mean over the area that its pixel covers."""
    for axis, size in enumerate(shape):
        if picture.shape[axis] == size:
            continue
        rows = np.moveaxis(picture, axis, 0)
        summed = np.concatenate([np.zeros((1, *rows.shape[1:])), np.cumsum(rows, axis=0)])
        edges = np.linspace(0.0, len(rows), size + 1)
        low = np.minimum(edges.astype(int), len(rows) - 1)
        part = (edges - low).reshape(-1, *([1] * (rows.ndim - 1)))
        at = summed[low] + part * rows[low]
        picture = np.moveaxis(np.diff(at, axis=0) * (size / len(rows)), 0, axis)
    return np.ascontiguousarray(picture)


def pixel_noise(light: Array) -> float:
    """Return the noise from second differences along rows, which cancel smooth light (median: edges do not count)."""
    second = light[:, 2:] - 2 * light[:, 1:-1] + light[:, :-2]
    return 1.4826 * float(np.median(np.abs(second))) / np.sqrt(6.0)


@njit(cache=True, nogil=True)
def _sample(light, clipped, homography, x, y, step, shape):  # type: ignore[no-untyped-def]
    """Return `Photograph.sample` from one of its sizes: means of four points, read bilinearly; beyond the horizon the
    first pixel is read.
    """
    h, (ny, nx), (high, wide) = homography, light.shape, shape
    sums, clips, inside = np.zeros(x.shape), np.zeros(x.shape), np.ones(x.shape, np.bool_)
    for j in range(x.shape[0]):
        for i in range(x.shape[1]):
            for quarter in range(4):
                px = x[j, i] + (quarter // 2 - 0.5) * step[1] / 2
                py = y[j, i] + (quarter % 2 - 0.5) * step[0] / 2
                below = h[2, 0] * px + h[2, 1] * py + h[2, 2]
                u = v = row = column = 0.0
                if below > 1e-9 * abs(h[2, 2]):
                    u = (h[0, 0] * px + h[0, 1] * py + h[0, 2]) / below
                    v = (h[1, 0] * px + h[1, 1] * py + h[1, 2]) / below
                    row = min(max(v * (ny / high) - 0.5, 0.0), ny - 1.0)
                    column = min(max(u * (nx / wide) - 0.5, 0.0), nx - 1.0)
                inside[j, i] &= 0 < u < wide and 0 < v < high
                r, c = min(int(row), ny - 2), min(int(column), nx - 2)
                s, t = row - r, column - c
                a, b, d, e = (1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t
                sums[j, i] += a * light[r, c] + b * light[r, c + 1] + d * light[r + 1, c] + e * light[r + 1, c + 1]
                clips[j, i] += (
                    a * clipped[r, c] + b * clipped[r, c + 1] + d * clipped[r + 1, c] + e * clipped[r + 1, c + 1]
                )
    return sums / 4, clips / 4, inside
