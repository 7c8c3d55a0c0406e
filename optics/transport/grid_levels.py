"""Grids from coarse to fine for the transport solver: their shapes, targets averaged onto them, paths carried up."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from optics.bench import Bench
from optics.spline import Array

_COARSE_ENOUGH = 48


def level_shapes(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return grid shapes from about 32 pixels a side to the full one; a short side waits for the other to double."""
    shapes = [(shape[0], shape[1])]
    while max(shapes[0]) > _COARSE_ENOUGH:
        ny, nx = (-(-n // 2) if n > _COARSE_ENOUGH else n for n in shapes[0])
        shapes.insert(0, (ny, nx))
    return shapes


def average_boxes(values: Array, shape: tuple[int, int]) -> Array:
    """Return the exact means of a piecewise constant grid over a coarser one's cells (any ratio)."""
    for axis, n in enumerate(shape):
        if values.shape[axis] == n:
            continue
        total = np.insert(np.cumsum(values, axis=axis), 0, 0.0, axis=axis)
        edges = np.linspace(0, values.shape[axis], n + 1)
        low = np.minimum(edges.astype(int), values.shape[axis] - 1)
        part = np.expand_dims(edges - low, tuple(a for a in range(values.ndim) if a != axis))
        at = np.take(total, low, axis=axis) * (1 - part) + np.take(total, low + 1, axis=axis) * part
        values = np.diff(at, axis=axis) * (n / values.shape[axis])
    return values


def prolong(c: Array, shape: tuple[int, int], bench: Bench) -> Array:
    """Return c on a finer grid: base exactly, the rest by cubic interpolation with mirror images beyond the frame."""
    qx, qy = bench.pixel_centres_mm(c.shape[1], c.shape[0])
    delta = c - bench.base_path_mm(qx[None, :], qy[:, None])
    rows = (np.arange(shape[0]) + 0.5) * c.shape[0] / shape[0] - 0.5
    columns = (np.arange(shape[1]) + 0.5) * c.shape[1] / shape[1] - 0.5
    fine = map_coordinates(delta, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="reflect")
    qx, qy = bench.pixel_centres_mm(shape[1], shape[0])
    return np.asarray(fine + bench.base_path_mm(qx[None, :], qy[:, None]))
