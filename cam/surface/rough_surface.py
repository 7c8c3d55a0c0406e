"""The surface on which a flat or bull-nose end mill travels so that it leaves at least an allowance on the lens.

Such a cutter is a ball of its corner's radius, moved over a disc: its tip is as high as the highest that the ball's
would be within that disc. Heights are kept on a lattice, from a disc that is grown by what lies between its nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, floor, sqrt

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates, maximum_filter1d

from cam.moves import Array
from cam.passes import PassSpec
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield

_NODES = 32  # a radius of the cutter
_FEW_NODES = 12  # for what a pass leaves: `camera`, 100 mm, Ø 6 mm with corners of 1 mm: hours are off by a thousandth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoughSurface:
    """Tip heights (ny, nx) of one cutter over one lens, node [0, 0] at (x0_mm, y0_mm); made by `over`.

    lowest_mm, highest_mm : bounds of all tips that may be asked for
    """

    radius_mm: float
    allowance_mm: float
    lowest_mm: float
    highest_mm: float
    node_step_mm: float
    x0_mm: float
    y0_mm: float
    height_mm: Array

    @classmethod
    def over(cls, heightfield: Heightfield, spec: PassSpec, *, nodes: int = _NODES) -> RoughSurface:
        """Compute the surface for tips up to one radius outside the aperture; nodes: of the lattice, a radius."""
        radius_mm, allowance_mm = spec.radius_mm, spec.stock_to_leave_mm
        flat_mm, corner_mm = spec.shape.flat_mm(radius_mm), spec.shape.corner_mm(radius_mm)
        step = radius_mm / nodes
        around, wide = ceil((radius_mm + step) / step), ceil(flat_mm / step) + 2
        reach_mm = (around + wide) * step
        x, y = (
            np.arange(-around - wide, ceil(size / step) + around + wide + 1, dtype=np.float64) * step
            for size in (heightfield.width_mm, heightfield.height_mm)
        )
        if corner_mm > 0:
            ball = ToolSurface.over(
                heightfield, radius_mm=corner_mm, allowance_mm=allowance_mm, run_out_mm=reach_mm + step
            )
            tips = ball.tip_rows_mm(x, y)
        else:
            spline = heightfield.spline_with_run_out(reach_mm + step)
            z, p, q, *_ = spline.jets(*np.meshgrid(x, y))
            tips = z + allowance_mm * np.sqrt(1.0 + p * p + q * q)
        height_mm = find_highest(tips, flat_mm / step + sqrt(2) * nodes / _NODES)[wide:-wide, wide:-wide]
        return cls(
            radius_mm=radius_mm,
            allowance_mm=allowance_mm,
            lowest_mm=float(height_mm.min()),
            highest_mm=float(height_mm.max()),
            node_step_mm=step,
            x0_mm=float(x[wide]),
            y0_mm=float(y[wide]),
            height_mm=np.ascontiguousarray(height_mm),
        )

    def tip_heights_mm(self, x_mm: ArrayLike, y_mm: ArrayLike) -> Array:
        """Return (n,) tip heights for tips at x (n,), y (n,), bilinear between nodes."""
        x, y = (np.ravel(a) for a in np.broadcast_arrays(np.asarray(x_mm), np.asarray(y_mm)))
        places = (y - self.y0_mm) / self.node_step_mm, (x - self.x0_mm) / self.node_step_mm
        return np.asarray(map_coordinates(self.height_mm, places, order=1, mode="nearest"))

    def tip_rows_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Return (ny, nx) tip heights on rows y (ny,) at x (nx,)."""
        return self.tip_heights_mm(x_mm[None, :], y_mm[:, None]).reshape(y_mm.size, x_mm.size)


Surface = ToolSurface | RoughSurface


def surface_under(heightfield: Heightfield, spec: PassSpec) -> Surface:
    """Return the surface of the pass's cutter, for tips up to one radius outside the aperture."""
    if spec.is_ball:
        return ToolSurface.over(heightfield, radius_mm=spec.radius_mm, allowance_mm=spec.stock_to_leave_mm)
    return RoughSurface.over(heightfield, spec)


def left_by_flat(lens: Heightfield, spec: PassSpec) -> Array:
    """Return heights (ny, nx) at the lens's vertices that a pass of a flat cutter leaves: where its end comes, and on
    slopes stairs.
    """
    surface = RoughSurface.over(lens, spec, nodes=_FEW_NODES)
    lowest = -find_highest(-surface.height_mm, spec.shape.flat_mm(spec.radius_mm) / surface.node_step_mm)
    slopes = np.gradient(lens.z_mm, lens.dy_mm, lens.dx_mm)
    ends = replace(surface, height_mm=lowest).tip_rows_mm(lens.x_mm, lens.y_mm)
    return np.asarray(ends + spec.pitch_mm * np.abs(slopes[0 if spec.direction == "x" else 1]))


def find_highest(heights: Array, cells: float) -> Array:
    """Return the highest within so many cells of each: a disc is as many runs along x as it has rows."""
    n = floor(cells)
    padded, rows = np.pad(heights, ((n, n), (0, 0)), mode="edge"), heights.shape[0]
    highest = np.full_like(heights, -np.inf)
    for down in range(n + 1):
        half = floor(sqrt(cells * cells - down * down))
        run = maximum_filter1d(padded, 2 * half + 1, axis=1, mode="nearest")
        for first in (n - down, n + down):
            np.maximum(highest, run[first : first + rows], out=highest)
    return highest
