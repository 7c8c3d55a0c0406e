"""The field whose level sets are the tracks: they run along the contours of the surface, nearly evenly spaced.

Theory. Contours of the heights themselves lie close on slopes and far apart on flats. The field f keeps their direction
and evens out their spacing: grad f is as near as it can be to n, the unit gradient of the heights, or to n stretched by
up to STRETCH where that turns it less (a Poisson problem with weights, solved again with the same factors). Weights
vanish where the surface is flat, so f continues the direction of the surroundings across plateaus; a flat surface gives
rows.

|grad f| is not even: level sets one step apart are 1 / |grad f| steps apart. How many more are needed is the density
class c, rising by 1 for every factor RATIO. It is raised over short dips, so that tracks do not end and begin again,
and has steps with ramps between them, on which the tracks of one class glide to their places in the next (levels.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from cam.moves import Array
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import BicubicSpline, Heightfield

RATIO = 1.07
"""Ratio of the numbers of tracks from class to class."""

FREE_PITCHES, FREE_SHARE = 0.3, 0.1
"""Room for turns at the border of the ring on which a tool may go: in pitches, but no more than that share of the ring.
"""

REACH_PITCHES = 0.485
"""Greatest distance of a place from the nearest track: half a pitch, less the pixel error of cover.py."""

LEAST_GRADIENT = 0.2
"""Share of the greatest gradient: flatter spots of f, around summits and saddles, are left to holes.py."""

FLAT_SLOPE = 0.02
FAINT = 1e-3
"""Weight of a surface without slope, and of the pull along y."""

STRETCH, COARSE_STRETCH = 1.5, 2.0
STRETCHINGS = 12
SMOOTH_MM = 0.6
NODES = 400
"""Of the longer side, for the solve."""

CELLS = 1500
"""Of the longer side, at least, where a quarter of a pitch is not finer still: tracks end where cells do."""

DIP_MM, DIP_PITCHES, DIPS_ACROSS = 3.0, 100.0, 4.0
DIP_BELOW = 0.8
"""Dips are filled up to the class that this share of the lens does with, not to that of a summit nearby: those up to
3 mm or 100 pitches across, as turns at the ends of tracks grow with the pitch; on a small lens up to a quarter of it.
(Lens of `astronaut`, 100 mm, R 3, pitch 0.1: 95.2 % along the contours where 3 mm give 92.9; 0.4 % longer.)
"""

RAMP, LONGEST_RAMP, RAMP_PITCHES = 0.3, 1.0, 75.0
"""Share of a class step that is a ramp; on a lens only so many pitches wide all of it. Tracks glide by up to half a
pitch on a ramp: on one of some pitches that would leave the contour, and holes beside it.
"""

FINE_ACROSS, COARSE_ACROSS = 1000.0, 400.0
"""Pitches across the lens. On a fine lens turns are a small share of the path, and its length counts; on a coarse one
they are a large share, and tracks must be as long, and follow the contours as closely, as they can. (Lens of
`astronaut`, 100 mm, R 6, pitch 0.56: 95.5 % along the contours where ramps and stretch of a fine lens give 92.4; 3 %
longer.)
"""

Mask = NDArray[np.bool_]


def coarseness(pitch_mm: float, side_mm: float) -> float:
    """Return 0 on a lens that is many pitches wide, 1 on one that is few."""
    fine, coarse = side_mm / FINE_ACROSS, side_mm / COARSE_ACROSS
    return min(max((pitch_mm - fine) / (coarse - fine), 0.0), 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContourField:
    """Nodes [j, i] at (x0_mm + i step_mm, y0_mm + j step_mm).

    f (ny, nx)        : its level sets are tracks [mm]
    density (ny, nx)  : class, 0 at the greatest gradient
    level_mm          : between the levels of class 0: two reaches where the gradient is greatest
    wanted (ny - 1, nx - 1) : cells with places that must lie near a track: the aperture, and where the ball touches it
    traced (ny - 1, nx - 1) : cells in which tracks may run: those, and cells so near that their tracks reach them
    ring_mm : how far outside the aperture tracks may end
    """

    x0_mm: float
    y0_mm: float
    step_mm: float
    f: Array
    density: Array
    level_mm: float
    wanted: Mask
    traced: Mask
    ring_mm: float

    @classmethod
    def over(cls, heightfield: Heightfield, surface: ToolSurface, *, pitch_mm: float) -> ContourField:
        width_mm, height_mm = heightfield.width_mm, heightfield.height_mm
        coarse = coarseness(pitch_mm, max(width_mm, height_mm))
        step = min(2.5 * pitch_mm, 0.2, surface.radius_mm / 8)
        step = min(step, max(pitch_mm / 4, max(width_mm, height_mm) / CELLS))
        pad = ceil(surface.radius_mm / step)
        ring_mm = surface.radius_mm - min(FREE_PITCHES * pitch_mm, FREE_SHARE * surface.radius_mm)
        dip_mm = min(max(DIP_MM, DIP_PITCHES * pitch_mm), max(width_mm, height_mm) / DIPS_ACROSS)
        x, y = (np.arange(-pad, ceil(side / step) + pad + 1.0) * step for side in (width_mm, height_mm))
        spline = _solve_field(heightfield, surface, STRETCH + coarse * (COARSE_STRETCH - STRETCH))
        jets = _jets(spline, x, y)
        nodes = _mask_wanted(surface, x, y, width_mm, height_mm, _rim_tips(heightfield, surface, step))
        gradient = np.hypot(jets[1], jets[2])
        near = ndimage.minimum_filter(gradient, 3)
        greatest = float(np.quantile(gradient[nodes], 0.999))
        ramp = min(max(RAMP, RAMP_PITCHES * pitch_mm / max(width_mm, height_mm)), LONGEST_RAMP)
        needed = np.log(greatest / np.clip(near, LEAST_GRADIENT * greatest, greatest)) / log(RATIO)
        return cls(
            x0_mm=float(x[0]),
            y0_mm=float(y[0]),
            step_mm=step,
            f=jets[0],
            density=_density(needed, float(np.quantile(needed[nodes], DIP_BELOW)), dip_mm / step, ramp),
            level_mm=greatest * 2 * REACH_PITCHES * pitch_mm,
            wanted=nodes[:-1, :-1] & nodes[:-1, 1:] & nodes[1:, :-1] & nodes[1:, 1:],
            ring_mm=ring_mm,
            traced=_mask_traced(nodes, x, y, (width_mm, height_mm), ring_mm, REACH_PITCHES * pitch_mm),
        )


def _jets(spline: BicubicSpline, x: Array, y: Array) -> Array:
    """Return (3, ny, nx) value and gradient."""
    out = np.empty((3, y.size, x.size))
    for j in range(y.size):
        out[:, j] = spline.jets(x, y[j])[:3]
    return out


def _rim_tips(heightfield: Heightfield, surface: ToolSurface, step: float) -> Array:
    """Return (2, n) the tips that touch the rim of the aperture, twice as dense as the nodes."""
    width_mm, height_mm = heightfield.width_mm, heightfield.height_mm
    x, y = (np.linspace(0.0, side, 2 * ceil(side / step) + 1) for side in (width_mm, height_mm))
    rim_x = np.concatenate([x, x, np.zeros_like(y), np.full_like(y, width_mm)])
    rim_y = np.concatenate([np.zeros_like(x), np.full_like(x, height_mm), y, y])
    _, hx, hy = heightfield.spline().jets(rim_x, rim_y)[:3]
    lean = (surface.radius_mm + surface.allowance_mm) / np.sqrt(1 + hx**2 + hy**2)
    return np.stack([rim_x - lean * hx, rim_y - lean * hy])


def _mask_wanted(surface: ToolSurface, x: Array, y: Array, width_mm: float, height_mm: float, rim: Array) -> Mask:
    """Return the aperture and, around it, the places from which the ball touches it; and the nodes beside these.

    So all corners of a cell with such a place are wanted. A corner of the lens may be so acute, seen from the tip, that
    no node lies in its end; the tips of the rim (2, n) cover it in any case.
    """
    slack = 1e-6
    inside = ((y >= -slack) & (y <= height_mm + slack))[:, None] & ((x >= -slack) & (x <= width_mm + slack))
    wanted = inside.copy()
    j, i = np.nonzero(~inside)
    touched_x, touched_y = surface.contacts_mm(x[i], y[j])[:, :2].T
    wanted[j, i] = (touched_x >= 0) & (touched_x <= width_mm) & (touched_y >= 0) & (touched_y <= height_mm)
    at = np.rint((rim - [[x[0]], [y[0]]]) / (x[1] - x[0])).astype(np.int64)
    wanted[np.clip(at[1], 0, y.size - 1), np.clip(at[0], 0, x.size - 1)] = True
    return np.asarray(ndimage.binary_dilation(wanted, np.ones((3, 3))))


def _mask_traced(
    nodes: Mask, x: Array, y: Array, sides_mm: tuple[float, float], ring_mm: float, reach_mm: float
) -> Mask:
    """Return cells within the reach of a wanted one, none beyond the ring on which a tool may go."""
    by = ceil(reach_mm / (x[1] - x[0]))
    near = ndimage.binary_dilation(nodes, np.ones((3, 3)), iterations=by)
    slack = 1e-6
    allowed = [
        (a >= -ring_mm - slack) & (a <= side + ring_mm + slack) for a, side in zip((y, x), sides_mm[::-1], strict=True)
    ]
    near &= np.outer(*allowed)
    return np.asarray(near[:-1, :-1] & near[:-1, 1:] & near[1:, :-1] & near[1:, 1:])


def _density(needed: Array, usual: float, dip: float, ramp: float) -> Array:
    """Return (ny, nx) class, whole part at least `needed`: without short dips below the usual class, in steps with
    ramps.

    dip  : length of a dip that is short, in steps of the grid
    ramp : share of a class step
    """
    size = max(3, 2 * round(dip / 2) + 1)
    raised = np.maximum(needed, ndimage.grey_closing(np.minimum(needed, usual), size))
    blur = max(1, round(dip / 10))
    raised = ndimage.gaussian_filter(ndimage.maximum_filter(raised, 2 * blur + 1), blur / 2, truncate=2.0)
    whole = np.ceil(raised)
    return np.asarray(whole + np.clip(1 + (raised - whole) / ramp, 0.0, 1.0))


def _solve_field(heightfield: Heightfield, surface: ToolSurface, stretch: float) -> BicubicSpline:
    """Return f over the aperture, continued by its slope around it as far as the ball runs out."""
    width_mm, height_mm = heightfield.width_mm, heightfield.height_mm
    spacing = max(max(width_mm, height_mm) / NODES, 0.05)
    nx, ny = (max(8, round(side / spacing)) + 1 for side in (width_mm, height_mm))
    x, y = np.linspace(0, width_mm, nx), np.linspace(0, height_mm, ny)
    dx, dy = x[1], y[1]
    contacts = surface.contacts_mm(*np.meshgrid(x, y))  # the tip's surface has the slope of the lens at the contact
    touched = np.clip(contacts[:, 0], 0, width_mm), np.clip(contacts[:, 1], 0, height_mm)
    slopes = heightfield.spline().jets(*touched)[1:3].reshape(2, ny, nx)
    zx, zy = (ndimage.gaussian_filter(slope, (SMOOTH_MM / dy, SMOOTH_MM / dx), mode="nearest") for slope in slopes)
    f = _along(zx, zy, dx, dy, stretch)
    by_x, by_y = ceil(surface.radius_mm / dx) + 3, ceil(surface.radius_mm / dy) + 3
    f = _beyond(_beyond(f, by_y, 0), by_x, 1)
    return BicubicSpline.through(f, x0_mm=-by_x * dx, y0_mm=-by_y * dy, dx_mm=dx, dy_mm=dy)


def _beyond(f: Array, rows: int, axis: int) -> Array:
    """Return f with more rows at both ends of an axis, as a continuation of the slope there."""
    f = np.moveaxis(f, axis, 0)
    far = np.arange(1, rows + 1)[:, None]
    before = f[0] + far[::-1] * (f[0] - f[1])
    after = f[-1] + far * (f[-1] - f[-2])
    return np.moveaxis(np.concatenate([before, f, after]), 0, axis)


def _along(zx: Array, zy: Array, dx: float, dy: float, most: float) -> Array:
    """Return f (ny, nx) with grad f along (zx, zy): least squares over the edges of the grid, each weighted.

    A flat surface is only affected by a weak pull along y, which has no effect where there are other weights.
    """
    ny, nx = zx.shape
    slope2 = zx**2 + zy**2
    weight = slope2 / (slope2 + FLAT_SLOPE**2)
    length = np.sqrt(slope2) + 1e-9
    along_x, along_y = _differences(nx, dx), _differences(ny, dy)
    slopes = sparse.vstack([sparse.kron(sparse.eye(ny), along_x), sparse.kron(along_y, sparse.eye(nx))]).tocsr()
    strength = _on_edges(weight, weight)
    matrix = (slopes.T @ sparse.diags(strength + FAINT) @ slopes).tocsc()
    matrix[0, 0] *= 2  # f is free up to a constant
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
    pull = _on_edges(np.zeros_like(zx), np.full_like(zy, FAINT))
    stretch = np.ones_like(zx)
    for _ in range(STRETCHINGS):
        toward = _on_edges(stretch * zx / length, stretch * zy / length)
        f = factors.solve(slopes.T @ (strength * toward + pull)).reshape(ny, nx)
        fy, fx = np.gradient(f, dy, dx)
        stretch = np.clip((fx * zx + fy * zy) / length, 1.0, most)
    return np.asarray(f)


def _differences(n: int, spacing: float) -> sparse.dia_matrix:
    """Return (n - 1, n) slopes between neighbours."""
    return sparse.diags([-1 / spacing, 1 / spacing], [0, 1], shape=(n - 1, n))


def _on_edges(x: Array, y: Array) -> Array:
    """Return means over the edges along x, of x (ny, nx), then over those along y, of y (ny, nx)."""
    return np.concatenate([((x[:, :-1] + x[:, 1:]) / 2).ravel(), ((y[:-1] + y[1:]) / 2).ravel()])
