"""The boundary condition: light from the rim of the lens goes to the frame of the picture, for any kind of light.

The rim is four curves, one for each side of the frame: left and right x(y), bottom and top y(x). Along a side the
surface point that the path's slope leads back to must lie on the side's curve; the slope across the frame is the root.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from optics.bench import Bench
from optics.light import Beam, meet
from optics.outline import RimCurves
from optics.spline import Array
from optics.transport.beam_path import fill_heights, trace_back

_NEWTON_STEPS = 40
_CLOSE_ENOUGH_MM = 1e-10
_MOST_LEAN = 0.35  # of the aperture: how far from the base the rim is searched; an early map may not reach an outline


@dataclass(frozen=True, slots=True, eq=False)
class Rims:
    """Slopes and surface points at the pixel edges on the frame.

    slope_x (2, ny), slope_y (2, nx)        : of c, across the left/right and the bottom/top side
    points_x (2, ny, 7), points_y (2, nx, 7) : (face_x, face_y, t, p_x, p_y, dt/dx, dt/dy) where its light comes from
    """

    slope_x: Array
    slope_y: Array
    points_x: Array
    points_y: Array

    def add_border(self, c: Array, dx: float, dy: float) -> Array:
        """Return c (ny, nx) with one ghost row and column around it, which continue it by its slope on the frame."""
        ghosts = np.pad(c, 1, mode="edge")
        for side, sign in ((0, -dx), (-1, dx)):
            ghosts[:, side] += sign * np.pad(self.slope_x[side], 1, mode="edge")
        for side, sign in ((0, -dy), (-1, dy)):
            ghosts[side] += sign * np.pad(self.slope_y[side], 1, mode="edge")
        return ghosts

    def greatest_height_around(self, bench: Bench, margin_mm: float) -> float:
        """Return the greatest height of the surface within that distance beyond the rim."""
        points = np.concatenate([self.points_x.reshape(-1, 7), self.points_y.reshape(-1, 7)])
        away = points[:, 3:5] - (bench.width_mm / 2, bench.height_mm / 2)
        rise = (points[:, 5:7] * away).sum(axis=1) / np.linalg.norm(away, axis=1)
        return float((points[:, 2] + margin_mm * np.maximum(rise, 0.0)).max())


@njit(cache=True, nogil=True, error_model="numpy")
def _on_curve(curve: Array, cells_per_mm: float, at: float) -> tuple[float, float]:
    """Return (value, slope) of a curve at even spacing from 0, linear between, constant beyond; NaN at NaN."""
    u = at * cells_per_mm
    if math.isnan(u):
        return math.nan, math.nan
    if u <= 0.0:
        return curve[0], 0.0
    if u >= curve.size - 1.0:
        return curve[-1], 0.0
    i = int(u)
    rise = curve[i + 1] - curve[i]
    return curve[i] + (u - i) * rise, rise * cells_per_mm


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_side(
    beam: Beam, throw: float, upright: bool, q_across: float, q_along: Array, edge: Array, half: float,
    tangential: Array, curve: Array, cells_per_mm: float, most: float, slope: Array, points: Array,
) -> None:  # fmt: skip
    """Solve slopes (m,) across one side of the frame, and the points (m, 7) that they lead back to; slope holds the
    first guess.

    upright : whether this is a left or right side;  half : signed way from the pixels' middles to the frame
    Newton's method: with S = (s, t, s_z), X = Q - R S and c = edge + half s,
    dR/ds = (half + n R d . S') / (1 - n d . S).
    """
    n = beam.refractive_index
    for k in range(edge.size):
        first, s, t = slope[k], slope[k], tangential[k]
        points[k, :] = math.nan
        for _ in range(_NEWTON_STEPS):
            sx, sy = (s, t) if upright else (t, s)
            qx, qy = (q_across, q_along[k]) if upright else (q_along[k], q_across)
            ray, px, py, z, fx, fy = trace_back(beam, qx, qy, throw, edge[k] + half * s, sx, sy, math.nan)
            if math.isnan(ray):
                break
            dx, dy, dz, _, _, _ = meet(beam, px, py, z)
            sz = math.sqrt(1.0 - s * s - t * t)
            points[k, 0], points[k, 1], points[k, 2], points[k, 3], points[k, 4] = fx, fy, z, px, py
            points[k, 5], points[k, 6] = (sx - n * dx) / (n * dz - sz), (sy - n * dy) / (n * dz - sz)
            p_across, p_along = (px, py) if upright else (py, px)
            rim, lean = _on_curve(curve, cells_per_mm, p_along)
            miss = p_across - rim
            if abs(miss) < _CLOSE_ENOUGH_MM:
                break
            d_across = dx if upright else dy
            change = (half + n * ray * (d_across - dz * s / sz)) / (1.0 - n * (dx * sx + dy * sy + dz * sz))
            s -= miss / (-change * s - ray + lean * change * t)
            s = min(max(s, first - most), first + most)
        slope[k] = s


def solve_rims(c: Array, bench: Bench, beam: Beam, curves: RimCurves) -> Rims:
    """Return the rims of the path c (ny, nx). They are solved twice: first with the base's slopes for c on the frame,
    then with those found.
    """
    ny, nx = c.shape
    s = bench.screen
    dx, dy = s.width_mm / nx, s.height_mm / ny
    qx, qy = bench.pixel_centres_mm(nx, ny)
    first_x, first_y = _first_slopes(bench, qx, qy)
    rims = Rims(first_x, first_y, np.empty((2, ny, 7)), np.empty((2, nx, 7)))
    most = _MOST_LEAN * min(bench.width_mm, bench.height_mm) / bench.throw_mm if bench.outline_mm is not None else 2.0
    corner_x, corner_y, _ = corner_rays(c, bench, beam)
    for _ in range(2):
        old_x, old_y = rims.slope_x.copy(), rims.slope_y.copy()
        for side, sign in ((0, -0.5), (1, 0.5)):
            at = side if bench.sign > 0 else 1 - side  # rays that cross come from the other rim
            edge = c[:, -side]
            along = _tangential(edge + sign * dx * old_x[side], corner_y[:, side], dy, bench)
            q = s.left_mm + side * s.width_mm
            _solve_side(
                beam, bench.throw_mm, True, q, qy, edge, sign * dx, along,
                curves.x_of_y[at], curves.cells_per_mm_y, most, rims.slope_x[side], rims.points_x[side],
            )  # fmt: skip
            edge = c[-side]
            along = _tangential(edge + sign * dy * old_y[side], corner_x[side], dx, bench)
            q = s.bottom_mm + side * s.height_mm
            _solve_side(
                beam, bench.throw_mm, False, q, qx, edge, sign * dy, along,
                curves.y_of_x[at], curves.cells_per_mm_x, most, rims.slope_y[side], rims.points_y[side],
            )  # fmt: skip
    return rims


def corner_rays(c: Array, bench: Bench, beam: Beam) -> tuple[Array, Array, Array]:
    """Return (s_x, s_y, t), each (2, 2), of the rays from the aperture's corners to the frame's: [top or not, right or
    not].

    Both ends are known, so the path at the corner gives the height, and the height gives the direction. The path there
    is extrapolated from the next pixel's middle by the slopes themselves.
    """
    ny, nx = c.shape
    s = bench.screen
    half = np.array([-0.5, 0.5])
    qx, qy = s.centre_x_mm + half * s.width_mm, s.centre_y_mm + half * s.height_mm
    px, py = (size * (0.5 + bench.sign * half) for size in (bench.width_mm, bench.height_mm))
    qx, qy = np.broadcast_to(qx, (2, 2)).copy(), np.broadcast_to(qy[:, None], (2, 2)).copy()
    nearest = c[np.ix_([0, -1], [0, -1])]
    t, sx, sy = np.empty((2, 2)), np.zeros((2, 2)), np.zeros((2, 2))
    for _ in range(4):
        path = nearest + half * sx * s.width_mm / nx + half[:, None] * sy * s.height_mm / ny
        fill_heights(0, 2, path, qx, qy, px, py, bench.throw_mm, beam, t)
        aside_x, aside_y = qx - px, qy - py[:, None]
        ray = np.sqrt(aside_x**2 + aside_y**2 + (bench.throw_mm - t) ** 2)
        sx, sy = aside_x / ray, aside_y / ray
    return sx, sy, t


def _tangential(edge: Array, ends_slopes: Array, step: float, bench: Bench) -> Array:
    """Return the slope along a side at its pixels, from c there and those at its two ends (2,).

    An outline has no corners, so there the pixels are used instead.
    """
    if bench.outline_mm is not None and edge.size > 2:
        return np.asarray(np.gradient(edge, step, edge_order=2))
    ends = np.concatenate([[edge[0] - ends_slopes[0] * step], edge, [edge[-1] + ends_slopes[1] * step]])
    return np.asarray((ends[2:] - ends[:-2]) / (2.0 * step))


def _first_slopes(bench: Bench, qx: Array, qy: Array) -> tuple[Array, Array]:
    """Return the base path's slopes (2, ny), (2, nx) across the frame."""
    s, h = bench.screen, 1e-3
    left_right = np.array([[s.left_mm], [s.left_mm + s.width_mm]])
    bottom_top = np.array([[s.bottom_mm], [s.bottom_mm + s.height_mm]])
    base = bench.base_path_mm
    return (
        (base(left_right + h, qy[None, :]) - base(left_right - h, qy[None, :])) / (2 * h),
        (base(qx[None, :], bottom_top + h) - base(qx[None, :], bottom_top - h)) / (2 * h),
    )
