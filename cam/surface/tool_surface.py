"""The surface on which the tool tip travels so that the ball touches the lens, or leaves an even allowance on it.

A flat or bull-nose end mill is a ball of its corner's radius, moved over a disc: its tip height is the greatest tip
height of that ball within the disc. It leaves at least the allowance. Heights are kept on a lattice, from a disc that
is enlarged by the distance between its nodes.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import ceil, floor, sqrt

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.ndimage import map_coordinates, maximum_filter1d

from cam.moves import Array
from cam.passes import PassSpec
from cam.surface.contact import TILE, Ball, touch_points, touch_rows
from optics.heightfield import Heightfield, spline_jet

GUARD_SHARE = 0.6
"""Below this share of 1/R, Newton's method alone is reliable: the Hessian is only sampled, and det(J) must stay well
away from 0.
"""

_RIM = 0.995  # of the radius: the ball's own bend grows without bound towards its equator


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ToolSurface:
    """Tip heights of one ball over one lens, in and around the aperture; made by `over`.

    lowest_mm, highest_mm : bounds of all tips that may be asked for; a tip is never below the surface under it
    """

    radius_mm: float
    allowance_mm: float
    lowest_mm: float
    highest_mm: float
    kernel: Ball

    @classmethod
    def over(
        cls,
        heightfield: Heightfield,
        *,
        radius_mm: float,
        allowance_mm: float = 0.0,
        run_out_mm: float | None = None,
        row_mm: float | None = None,
        nodes: int = 8,
    ) -> ToolSurface:
        """Compute the surface for tips up to run_out_mm (default: one radius) outside the aperture.

        row_mm : Y of the only row in which tips are asked for; None: tips are asked for everywhere
        nodes  : of the lattice, a radius
        """
        ball_mm = radius_mm + allowance_mm
        run_out_mm = radius_mm if run_out_mm is None else run_out_mm
        spline = heightfield.spline_with_run_out(run_out_mm + ball_mm + 2 * ball_mm / nodes)
        step = min(heightfield.dx_mm, heightfield.dy_mm, ball_mm / nodes)
        beside = ball_mm + step
        reach = run_out_mm + beside
        low, high = -reach, heightfield.height_mm + reach
        if row_mm is not None:
            low, high = row_mm - heightfield.y_mm[0] - beside, row_mm - heightfield.y_mm[0] + beside
        x = np.arange(-reach, heightfield.width_mm + reach + step, step) + heightfield.x_mm[0]
        y = np.arange(low, high + step, step) + heightfield.y_mm[0]
        heights, most, bend = (np.empty((y.size, x.size)) for _ in range(3))

        def fill(rows: slice) -> None:
            out = heights[rows], most[rows], bend[rows]
            _fill_lattice(*spline.kernel_arguments, x, y[rows], ball_mm, step / np.sqrt(2), *out)

        if row_mm is None:
            with ThreadPoolExecutor(2) as pool:  # fetch the results, so that an error in a thread is raised here
                list(pool.map(fill, (slice(0, y.size // 2), slice(y.size // 2, None))))
        else:
            fill(slice(None))
        guarded = _grow(most > GUARD_SHARE / ball_mm, beside / step)
        sides = ((y, heightfield.y_mm), (x, heightfield.x_mm))
        tips = [(a >= rim[0] - run_out_mm - step) & (a <= rim[-1] + run_out_mm + step) for a, rim in sides]
        slack = ndimage.maximum_filter(bend, size=3) * step**2 / 4
        kernel = Ball(
            *spline.kernel_arguments,
            radius=ball_mm,
            below=radius_mm,
            node_z=heights,
            node_x0=float(x[0]),
            node_y0=float(y[0]),
            node_step=step,
            guarded=guarded,
            slack=slack,
            tile_top=_tile_tops(heights + slack),
        )
        return cls(
            radius_mm=radius_mm,
            allowance_mm=allowance_mm,
            lowest_mm=float(heights[np.ix_(*tips)].min()) + allowance_mm,
            highest_mm=float(heights.max()) + allowance_mm,
            kernel=kernel,
        )

    @property
    def node_step_mm(self) -> float:
        """Distance between the nodes of the lattice."""
        return float(self.kernel.node_step)

    def contacts_mm(self, x_mm: ArrayLike, y_mm: ArrayLike) -> Array:
        """Return (n, 3) contact x, contact y and tip height for tips at x (n,), y (n,); quick if neighbours are
        close.
        """
        x, y = (np.ascontiguousarray(a, dtype=np.float64).ravel() for a in np.broadcast_arrays(x_mm, y_mm))
        out = np.empty((x.size, 3))
        if x.size:
            touch_points(self.kernel, x, y, out)
        return out

    def tip_heights_mm(self, x_mm: ArrayLike, y_mm: ArrayLike) -> Array:
        """Return (n,) tip heights for tips at x (n,), y (n,)."""
        return self.contacts_mm(x_mm, y_mm)[:, 2]

    def tip_rows_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Return (ny, nx) tip heights on rows y (ny,) at x (nx,)."""
        out = np.empty((y_mm.size, x_mm.size))
        touch_rows(self.kernel, x_mm, y_mm, out)
        return out


@njit(cache=True, nogil=True)
def _fill_lattice(coefs, x0, y0, inv_dx, inv_dy, x, y, radius, aside, heights, most, bend):  # type: ignore[no-untyped-def]
    """Compute on the lattice x (nx,), y (ny,): heights, the largest eigenvalue of the Hessian, and how fast lens and
    ball together bend down at most where the ball touches no farther than `aside` from there.
    """
    for j in range(y.size):
        for i in range(x.size):
            z, zx, zy, zxx, zxy, zyy = spline_jet(coefs, x0, y0, inv_dx, inv_dy, x[i], y[j])
            mean = 0.5 * (zxx + zyy)
            spread = np.sqrt(0.25 * (zxx - zyy) ** 2 + zxy * zxy)
            steep = zx * zx + zy * zy
            out = min(np.sqrt(steep / (1.0 + steep)) + aside / radius, _RIM)  # of the ball's radius
            heights[j, i] = z
            most[j, i] = mean + spread
            bend[j, i] = max(0.0, spread - mean) + 1.0 / (radius * (1.0 - out * out) ** 1.5)


def _tile_tops(values: np.ndarray) -> np.ndarray:
    """Return the highest of each TILE x TILE values; those at the far sides may be fewer."""
    rows, columns = (-(-count // TILE) for count in values.shape)
    whole = np.full((rows * TILE, columns * TILE), -np.inf)
    whole[: values.shape[0], : values.shape[1]] = values
    return np.ascontiguousarray(whole.reshape(rows, TILE, columns, TILE).max(axis=(1, 3)))


def _grow(mask: np.ndarray, by: float) -> np.ndarray:
    """Return the mask and everything within `by` cells of it."""
    if not mask.any():
        return mask
    return ndimage.distance_transform_edt(~mask) <= ceil(by)


_NODES = 32  # a radius of the cutter
_FEW_NODES = 12  # for the stock of a pass: `camera`, 100 mm, Ø 6 mm, corners of 1 mm: hours are off by a thousandth


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


def compute_left_by_flat(lens: Heightfield, spec: PassSpec) -> Array:
    """Return heights (ny, nx) at the lens's vertices that a pass of a flat cutter leaves: where its flat end reaches,
    and stairs on slopes.
    """
    surface = RoughSurface.over(lens, spec, nodes=_FEW_NODES)
    lowest = -find_highest(-surface.height_mm, spec.shape.flat_mm(spec.radius_mm) / surface.node_step_mm)
    slopes = np.gradient(lens.z_mm, lens.dy_mm, lens.dx_mm)
    ends = replace(surface, height_mm=lowest).tip_rows_mm(lens.x_mm, lens.y_mm)
    return np.asarray(ends + spec.pitch_mm * np.abs(slopes[0 if spec.direction == "x" else 1]))


def find_highest(heights: Array, cells: float) -> Array:
    """Return the highest value within that many cells of each: a disc is a set of runs along x, one for each of its
    rows.
    """
    n = floor(cells)
    padded, rows = np.pad(heights, ((n, n), (0, 0)), mode="edge"), heights.shape[0]
    highest = np.full_like(heights, -np.inf)
    for down in range(n + 1):
        half = floor(sqrt(cells * cells - down * down))
        run = maximum_filter1d(padded, 2 * half + 1, axis=1, mode="nearest")
        for first in (n - down, n + down):
            np.maximum(highest, run[first : first + rows], out=highest)
    return highest
