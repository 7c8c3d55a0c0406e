"""The optical path's kernels for any beam: find the surface point and the face point from which a screen point is lit.

phase(X) + R = c(q) with X = (q, H) - R (s, s_z), s = grad c. For one direction d this has a closed form:

    R = (n d . ((q, H) - centre) - c) / (n d . s - 1)

For a point source it is solved by Newton's method, d/dR = 1 - n d . s. Areas are measured on the face, because no light
is lost between there and the surface.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from optics.light import Beam, meet, strength_on_face
from optics.spline import Array

_NEWTON_STEPS = 30
_CLOSE_ENOUGH_MM = 1e-4  # last Newton step: it converges quadratically, so the error is less than 1e-10 mm


@njit(cache=True, nogil=True, error_model="numpy")
def trace_back(
    beam: Beam, qx: float, qy: float, throw: float, c: float, sx: float, sy: float, guess: float
) -> tuple[float, float, float, float, float, float]:
    """Return (R, px, py, t, face_x, face_y) of the ray that arrives at q along s; NaN where no light could be sent that
    way.

    guess : of R, for a point source; NaN if there is none
    """
    nothing = (math.nan, math.nan, math.nan, math.nan, math.nan, math.nan)
    sz2 = 1.0 - sx * sx - sy * sy
    if sz2 <= 0.0:
        return nothing
    sz = math.sqrt(sz2)
    if not beam.is_point:
        n = beam.refractive_index
        away = 1.0 - n * (beam.x * sx + beam.y * sy + beam.z * sz)
        if away >= 0.0 and not beam.is_mirror:
            return nothing
        ray = (c - n * (beam.x * (qx - beam.centre_x) + beam.y * (qy - beam.centre_y) + beam.z * throw)) / away
    else:
        ray = _ray_from_point(beam, qx, qy, throw, c, sx, sy, sz, guess)
    px, py, t = qx - ray * sx, qy - ray * sy, throw - ray * sz
    _, _, _, _, face_x, face_y = meet(beam, px, py, t)
    return ray, px, py, t, face_x, face_y


@njit(cache=True, nogil=True, error_model="numpy")
def _ray_from_point(
    beam: Beam, qx: float, qy: float, throw: float, c: float, sx: float, sy: float, sz: float, guess: float
) -> float:
    """Return R of phase(X) + R = c: convex in R, so Newton's method overshoots at most once."""
    ray = throw / sz if math.isnan(guess) else guess
    for _ in range(_NEWTON_STEPS):
        dx, dy, dz, phase, _, _ = meet(beam, qx - ray * sx, qy - ray * sy, throw - ray * sz)
        slope = 1.0 - beam.refractive_index * (dx * sx + dy * sy + dz * sz)
        if not beam.is_mirror and slope >= 0.0:
            return math.nan
        step = (phase + ray - c) / slope
        ray -= step
        if abs(step) < _CLOSE_ENOUGH_MM:
            return ray
    return math.nan


@njit(cache=True, nogil=True, error_model="numpy")
def fill_face_areas(
    row_lo: int, row_hi: int, c: Array, rim_x: Array, rim_y: Array, beam: Beam,
    throw: float, left: float, bottom: float, dx: float, dy: float, unit_x: float, unit_y: float,
    across: Array, along: Array, mixed: Array, light: Array, top: Array,
) -> None:  # fmt: skip
    """Compute even_light.preimage_areas on the face for any beam; light (ny, nx) is its strength at the quad's middle.

    c (ny + 2, nx + 2)     : with ghosts that continue it by its slope on the frame
    rim_x (2, ny, 3), rim_y (2, nx, 3) : (face_x, face_y, t) where the frame's pixel edges come from
    """
    nx = across.shape[1]
    west, east = np.empty((nx + 1, 2)), np.empty((2, nx, 2))
    south, north = east[0], east[1]
    _fill_horizontal_edges(row_lo, c, rim_y, beam, throw, left, bottom, dx, dy, south)
    for r in range(row_lo, row_hi):
        qy = bottom + (r + 0.5) * dy
        highest, ray = -math.inf, math.nan
        for k in range(nx + 1):
            if k == 0 or k == nx:
                side = 0 if k == 0 else 1
                west[k, 0], west[k, 1], t = rim_x[side, r, 0], rim_x[side, r, 1], rim_x[side, r, 2]
            else:
                sx = (c[r + 1, k + 1] - c[r + 1, k]) / dx
                sy = (c[r + 2, k + 1] + c[r + 2, k] - c[r, k + 1] - c[r, k]) / (4.0 * dy)
                mid = 0.5 * (c[r + 1, k + 1] + c[r + 1, k])
                ray, _, _, t, west[k, 0], west[k, 1] = trace_back(beam, left + k * dx, qy, throw, mid, sx, sy, ray)
            highest = t if math.isnan(t) else max(highest, t)
        top[r] = highest
        _fill_horizontal_edges(r + 1, c, rim_y, beam, throw, left, bottom, dx, dy, north)
        for k in range(nx):
            across[r, k] = (west[k + 1, 0] - west[k, 0]) * unit_x
            along[r, k] = (north[k, 1] - south[k, 1]) * unit_y
            mixed[r, k] = (west[k + 1, 1] - west[k, 1]) * (north[k, 0] - south[k, 0]) * unit_x * unit_y
            light[r, k] = strength_on_face(
                beam,
                0.25 * (west[k, 0] + west[k + 1, 0] + south[k, 0] + north[k, 0]),
                0.25 * (west[k, 1] + west[k + 1, 1] + south[k, 1] + north[k, 1]),
            )
        south, north = north, south


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_horizontal_edges(
    e: int, c: Array, rim_y: Array, beam: Beam,
    throw: float, left: float, bottom: float, dx: float, dy: float, out: Array,
) -> None:  # fmt: skip
    """Compute face points out (nx, 2) of the middles of the pixel edges on line e, counted from the frame's lower
    one.
    """
    nx = out.shape[0]
    if e == 0 or e == c.shape[0] - 2:
        out[:] = rim_y[0 if e == 0 else 1, :, :2]
        return
    ray = math.nan
    for k in range(nx):
        sy = (c[e + 1, k + 1] - c[e, k + 1]) / dy
        sx = (c[e + 1, k + 2] + c[e, k + 2] - c[e + 1, k] - c[e, k]) / (4.0 * dx)
        mid = 0.5 * (c[e + 1, k + 1] + c[e, k + 1])
        qx, qy = left + (k + 0.5) * dx, bottom + e * dy
        ray, _, _, _, out[k, 0], out[k, 1] = trace_back(beam, qx, qy, throw, mid, sx, sy, ray)


@njit(cache=True, nogil=True, error_model="numpy")
def fill_corner_points(
    row_lo: int, row_hi: int, c: Array, beam: Beam,
    throw: float, left: float, bottom: float, dx: float, dy: float, px: Array, py: Array,
) -> None:  # fmt: skip
    """Compute the lens points px, py (ny + 1, nx + 1) from which the corners of pixels are lit, from c with ghosts."""
    for r in range(row_lo, row_hi):
        ray = math.nan
        for k in range(px.shape[1]):
            sw, se, nw, ne = c[r, k], c[r, k + 1], c[r + 1, k], c[r + 1, k + 1]
            sx = (se + ne - sw - nw) / (2.0 * dx)
            sy = (nw + ne - sw - se) / (2.0 * dy)
            mid = 0.25 * (sw + se + nw + ne)
            ray, px[r, k], py[r, k], _, _, _ = trace_back(beam, left + k * dx, bottom + r * dy, throw, mid, sx, sy, ray)


@njit(cache=True, nogil=True, error_model="numpy")
def fill_heights(
    row_lo: int, row_hi: int, path: Array, qx: Array, qy: Array, x: Array, y: Array, throw: float, beam: Beam, t: Array
) -> None:
    """Solve phase(p, t) + |(q, H) - (p, t)| = path for t (my, mx) at p = (x[k], y[r]); q and path are (my, mx).

    For one direction, with m = n d_z, w = path - n (d_x, d_y) . (p - centre), a = m^2 - 1, b = m w - H and e = w^2 - |q
    - p|^2 - H^2: a t^2 - 2 b t + e = 0, so that t = e / (b +- sqrt(b^2 - a e)) with the sign of b.
    """
    for r in range(row_lo, row_hi):
        for k in range(x.size):
            shift2 = (qx[r, k] - x[k]) ** 2 + (qy[r, k] - y[r]) ** 2
            if beam.is_point:
                guess = t[r, k - 1] if k > 0 else 0.0
                t[r, k] = _height_on_point_beam(beam, x[k], y[r], path[r, k], shift2, throw, guess)
                continue
            n = beam.refractive_index
            m, w = n * beam.z, path[r, k] - n * (beam.x * (x[k] - beam.centre_x) + beam.y * (y[r] - beam.centre_y))
            b, e = m * w - throw, w * w - shift2 - throw * throw
            a, root = m * m - 1.0, math.sqrt(b * b - (m * m - 1.0) * e)
            # a lens deeper than about 2/3 of the throw has b < 0, and keeps the smaller root
            t[r, k] = (b - root) / a if a > 0.0 and b < 0.0 else e / (b + math.copysign(root, b))


@njit(cache=True, nogil=True, error_model="numpy")
def _height_on_point_beam(
    beam: Beam, x: float, y: float, path: float, shift2: float, throw: float, guess: float
) -> float:
    """Return the same for a point source by Newton's method: d/dt = n d_z - (H - t) / ray."""
    t = guess
    for _ in range(_NEWTON_STEPS):
        _, _, dz, phase, _, _ = meet(beam, x, y, t)
        ray = math.sqrt(shift2 + (throw - t) ** 2)
        step = (phase + ray - path) / (beam.refractive_index * dz - (throw - t) / ray)
        t -= step
        if abs(step) < _CLOSE_ENOUGH_MM:
            return t
    return math.nan
