"""Weights that resample one axis of a picture: exact area averages, or Catmull-Rom where it must be enlarged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_array

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Span:
    """A stretch of one axis, in source pixels from the picture's edge; it may reach beyond the picture."""

    low: float
    high: float

    @classmethod
    def centre_on(cls, middle: float, length: float) -> Span:
        return cls(middle - length / 2, middle + length / 2)


def weights_to_resample(size: int, span: Span, count: int) -> csc_array:
    """Return (count, size) sparse weights from `size` source pixels to `count` equal cells of the span.

    A cell inside the picture has weights that sum to 1. Places outside the picture count as 0 (black).
    """
    cell = (span.high - span.low) / count
    return _area_weights(size, span, count) if cell >= 1.0 else _cubic_weights(size, span, count)


def _area_weights(size: int, span: Span, count: int) -> csc_array:
    """Return the share of each cell that each source pixel covers."""
    edges = span.low + (span.high - span.low) * np.arange(count + 1) / count
    first = np.floor(edges[:-1]).astype(np.int64)
    width = int(np.ceil(edges[1:] - first).max()) + 1
    pixels = first[:, None] + np.arange(width)[None, :]
    overlap = np.minimum(pixels + 1, edges[1:, None]) - np.maximum(pixels, edges[:-1, None])
    return _sparse(np.clip(overlap, 0.0, None) / (edges[1:] - edges[:-1])[:, None], pixels, size)


def _cubic_weights(size: int, span: Span, count: int) -> csc_array:
    """Return Catmull-Rom weights at the cell centres; the picture's last pixel is repeated at its edge; outside is
    black.
    """
    centres = span.low + (span.high - span.low) * (np.arange(count) + 0.5) / count
    first = np.floor(centres - 0.5).astype(np.int64)
    t = (centres - 0.5 - first)[:, None]
    weights = np.concatenate(
        [
            -0.5 * t + t**2 - 0.5 * t**3,
            1 - 2.5 * t**2 + 1.5 * t**3,
            0.5 * t + 2 * t**2 - 1.5 * t**3,
            -0.5 * t**2 + 0.5 * t**3,
        ],
        axis=1,
    )
    inside = (centres > 0) & (centres < size)
    pixels = np.clip(first[:, None] + np.arange(-1, 3)[None, :], 0, size - 1)
    return _sparse(weights * inside[:, None], pixels, size)


def _sparse(weights: Array, pixels: npt.NDArray[np.int64], size: int) -> csc_array:
    rows = np.broadcast_to(np.arange(weights.shape[0])[:, None], weights.shape)
    kept = (weights != 0) & (pixels >= 0) & (pixels < size)
    return csc_array((weights[kept], (rows[kept], pixels[kept])), shape=(weights.shape[0], size))


def resize(picture: Array, shape: tuple[int, ...]) -> Array:
    """Return the whole picture on (ny, nx) cells: area averages, or cubic where it must be enlarged."""
    if picture.shape == tuple(shape):
        return picture
    down, across = (
        weights_to_resample(size, Span(0.0, float(size)), count)
        for size, count in zip(picture.shape, shape, strict=True)
    )
    return np.asarray((across @ (down @ picture).T).T)
