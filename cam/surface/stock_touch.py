"""Undersides of end mills: how low the tip may go before it meets the remaining stock, and the largest ball that fits a
surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import inf

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from cam.cutters import BALL, CutterShape
from cam.errors import PassValueError
from cam.moves import Array
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield
from phrases.phrase import Phrase

NEARLY_EVERYWHERE = 0.999


def rise_mm(shape: CutterShape, radius_mm: float, away_mm: ArrayLike) -> Array:
    """Return the height of the underside above the tip at that distance from the axis, at most that at the rim."""
    corner_mm = shape.corner_mm(radius_mm)
    beyond = np.clip(np.asarray(away_mm) - shape.flat_mm(radius_mm), 0.0, corner_mm)
    return np.asarray(corner_mm - np.sqrt(corner_mm**2 - beyond**2))


def slot_section_mm2(shape: CutterShape, radius_mm: float, depth_mm: ArrayLike) -> Array:
    """Return the section of a slot in a plane, its walls upright above the corner."""
    corner_mm, depth = shape.corner_mm(radius_mm), np.asarray(depth_mm)
    rise = np.clip(corner_mm - depth, 0.0, corner_mm)
    segment = corner_mm**2 * np.arccos(rise / max(corner_mm, 1e-12)) - rise * np.sqrt(corner_mm**2 - rise**2)
    return np.asarray(
        segment + 2 * corner_mm * np.maximum(depth - corner_mm, 0.0) + 2 * shape.flat_mm(radius_mm) * depth
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FittingRadius:
    """Largest ball whose curvature fits the hollows: everywhere, and on 99.9 % of the area; inf without hollows."""

    everywhere_mm: float
    nearly_mm: float


def concave_curvature(heightfield: Heightfield) -> Array:
    """Return the greatest principal curvature [1/mm], positive in a hollow, on a lattice twice as fine as vertices."""
    x, y = (np.linspace(a[0], a[-1], 2 * a.size - 1) for a in (heightfield.x_mm, heightfield.y_mm))
    return heightfield.spline().concave_curvature(x, y)


def largest_fitting_radius_mm(heightfield: Heightfield) -> FittingRadius:
    """Return the largest radii that curvature allows. Such a ball may still not reach between two close slopes."""
    curvature = concave_curvature(heightfield).ravel()
    rank = int(NEARLY_EVERYWHERE * (curvature.size - 1))
    nearly = float(np.partition(curvature, rank)[rank])
    most = float(curvature.max())
    return FittingRadius(everywhere_mm=1.0 / most if most > 0 else inf, nearly_mm=1.0 / nearly if nearly > 0 else inf)


def find_reached_share(heightfield: Heightfield, radius_mm: float) -> float:
    """Return the share of the area whose curvature a ball of this radius fits."""
    return float((concave_curvature(heightfield) * radius_mm <= 1.0).mean())


AIR_MM = -1e6
"""The tip height where the whole footprint lies beside the block."""

_FIRST_ALONE = Phrase("a ball, after a pass that has cut the shape")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StockTouch:
    """Grey dilation of the stock left by the ball: D(c) = max over q of top(q) - (R - sqrt(R^2 - |q - c|^2)).

    D(c) - tip is then exactly the most stock one move takes off, measured along Z: the engagement.

    height_mm (ny, nx) : D on a lattice whose node [0, 0] stands at (x0_mm, y0_mm)
    slack_mm           : how much D can be too low, because cells and lattice only sample the ball: s^2 / 4R
    stock, radius_mm   : the inputs
    """

    x0_mm: float
    y0_mm: float
    step_mm: float
    height_mm: Array
    slack_mm: float
    flat: bool
    stock: StockGrid
    radius_mm: float

    @classmethod
    def of(cls, stock_top: StockGrid, radius_mm: float, shape: CutterShape = BALL) -> StockTouch:
        """Dilate the stock; shape: of a cutter that is not a ball, which only meets flat stock."""
        top, cell = stock_top.top_mm, stock_top.cell_mm
        stride = max(1, int(radius_mm / 10 / cell))
        step, pad = stride * cell, math.ceil(radius_mm / (stride * cell)) + 1
        nx, ny = (math.ceil(n / stride) + 2 * pad for n in (top.shape[1], top.shape[0]))
        x0 = stock_top.x0_mm + cell / 2 - pad * step
        y0 = stock_top.y0_mm + cell / 2 - pad * step
        flat = bool(np.ptp(top) == 0)
        height = np.full((ny, nx), AIR_MM)
        if flat:
            out_x = _outside(x0 + step * np.arange(nx), stock_top.x0_mm, stock_top.x0_mm + top.shape[1] * cell)
            out_y = _outside(y0 + step * np.arange(ny), stock_top.y0_mm, stock_top.y0_mm + top.shape[0] * cell)
            away = np.hypot(out_x[None, :], out_y[:, None])
            met = away < radius_mm
            height[met] = float(top[0, 0]) - rise_mm(shape, radius_mm, away[met])
        elif shape != BALL:
            raise PassValueError(name="corner_radius_mm", value=shape.corner_mm(radius_mm), allowed=_FIRST_ALONE)
        else:
            wide = math.ceil(top.shape[1] / stride) * stride
            by_column = np.full((top.shape[0], wide), AIR_MM)
            by_column[:, : top.shape[1]] = top
            phases = by_column.reshape(top.shape[0], -1, stride).transpose(2, 0, 1)
            dilate(np.ascontiguousarray(phases), cell, radius_mm, pad, height)
        return cls(
            x0_mm=x0,
            y0_mm=y0,
            step_mm=step,
            height_mm=height,
            slack_mm=0.0 if flat else step**2 / (4 * radius_mm),
            flat=flat,
            stock=stock_top,
            radius_mm=radius_mm,
        )

    def over(self, x_mm: Array, y_mm: Array) -> Array:
        """Return (ny, nx) D at the grid points x (nx,), y (ny,), bilinear between lattice nodes."""
        out = np.empty((y_mm.size, x_mm.size))
        _sample(self.height_mm, self.x0_mm, self.y0_mm, 1.0 / self.step_mm, x_mm, y_mm, out)
        return out

    def exactly(self, x_mm: Array, y_mm: Array) -> Array:
        """Return (n,) D at x (n,), y (n,) from the stock's own cells: between two nodes beside a wall, the lattice
        shows stock that the ball only passes by.
        """
        stock, out = self.stock, np.empty(x_mm.size)
        _touch(stock.top_mm, stock.x0_mm, stock.y0_mm, stock.cell_mm, self.radius_mm, x_mm, y_mm, out)
        return out

    def under(self, points_mm: Array) -> Array:
        """Return (n,) D at points (n, 2) or (n, 3)."""
        return np.array([self.at(x, y) for x, y in points_mm[:, :2]])

    def at(self, x_mm: float, y_mm: float) -> float:
        return float(self.over(np.array([x_mm]), np.array([y_mm]))[0, 0])


def _outside(values: Array, low: float, high: float) -> Array:
    """Return how far a value lies outside [low, high]."""
    result: Array = np.maximum(np.maximum(low - values, values - high), 0.0)
    return result


@njit(cache=True, nogil=True)
def dilate(phases, cell, radius, pad, out):  # type: ignore[no-untyped-def]
    """Dilate by a ball phases (stride, ny, n): columns of cells, every stride-th together, so that inner loops run
    straight.

    out (my, mx) : node [j, i] stands over cell [(j - pad) stride, (i - pad) stride]
    """
    stride, ny, n = phases.shape
    reach = int(radius / cell)
    for j in range(out.shape[0]):
        below = out[j]
        below[:] = AIR_MM
        jc = (j - pad) * stride
        for a in range(max(-reach, -jc), min(reach, ny - 1 - jc) + 1):
            for e in range(-reach, reach + 1):
                left = radius * radius - (a * a + e * e) * cell * cell
                if left <= 0.0:
                    continue
                bump = radius - np.sqrt(left)
                shift = e // stride - pad
                first, last = max(0, -shift), min(below.size, n - shift)
                row = phases[e % stride, jc + a, first + shift : last + shift]
                for i in range(row.size):
                    height = row[i] - bump
                    here = below[first + i]
                    below[first + i] = height if height > here else here


@njit(cache=True, nogil=True)
def _touch(top, x0, y0, cell, radius, x, y, out):  # type: ignore[no-untyped-def]
    ny, nx = top.shape
    for n in range(out.size):
        out[n] = AIR_MM
        column, row = (x[n] - x0) / cell - 0.5, (y[n] - y0) / cell - 0.5  # in cells, from the centre of the first
        reach = radius / cell
        for j in range(max(0, int(math.ceil(row - reach))), min(ny - 1, int(math.floor(row + reach))) + 1):
            half = math.sqrt(max(0.0, reach * reach - (j - row) ** 2))
            for i in range(max(0, int(math.ceil(column - half))), min(nx - 1, int(math.floor(column + half))) + 1):
                left = radius * radius - ((i - column) ** 2 + (j - row) ** 2) * cell * cell
                if left > 0.0:
                    out[n] = max(out[n], top[j, i] - radius + math.sqrt(left))


@njit(cache=True, nogil=True)
def _sample(height, x0, y0, inv, x, y, out):  # type: ignore[no-untyped-def]
    ny, nx = height.shape
    for b in range(y.size):
        v = (y[b] - y0) * inv
        j = int(np.floor(v))
        for a in range(x.size):
            u = (x[a] - x0) * inv
            i = int(np.floor(u))
            if i < 0 or j < 0 or i > nx - 2 or j > ny - 2:
                out[b, a] = AIR_MM
                continue
            f, g = u - i, v - j
            low = (1.0 - f) * height[j, i] + f * height[j, i + 1]
            high = (1.0 - f) * height[j + 1, i] + f * height[j + 1, i + 1]
            out[b, a] = (1.0 - g) * low + g * high
