"""The kernels of `ToolSurface`: find where a ball rests on the spline.

Theory. The ball's centre above (cx, cy) touches the surface at p where p + R N_xy(p) = c, N the unit normal pointing
up; the centre stands at h(p) + R N_z. Newton solves this in one or two steps from a neighbour's p. Newton is local: if
f(p) = h(p) + sqrt(R^2 - |p - c|^2) has more than one maximum inside the footprint the ball rests on the highest. If the
largest eigenvalue of the Hessian of h stays below 1/R all over the footprint (the ball's own is at least 1/R), f is
concave and has only one maximum. Elsewhere ("guarded") Newton climbs f from every lattice node that could lie below the
highest maximum, and the highest is taken. The lattice resolves f for slopes below about 1.5; beyond that f is too
peaked for it.

With an allowance a the ball is R + a large and the centre is kept: exactly a is left along the normal.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from optics.heightfield import spline_jet

CLOSE_MM = 2e-5
"""Residual at which Newton's method stops: its effect on the height is of second order, below 1e-9 mm."""


TILE = 4
"""Nodes along a side that are left out together where none of them can be on top."""


class Ball(NamedTuple):
    """The inputs of the kernels: spline, ball, lattice of heights, and where Newton's method alone is not reliable."""

    coefs: Any  # (ny + 2, nx + 2)
    x0: float
    y0: float
    inv_dx: float
    inv_dy: float
    radius: float  # of the ball with its allowance [mm]
    below: float  # from its centre down to the tip of the real cutter [mm]
    node_z: Any  # (my, mx) heights on a square lattice
    node_x0: float
    node_y0: float
    node_step: float
    guarded: Any  # (my, mx) bool
    slack: Any  # (my, mx) the most a maximum beside a node can lie above f there [mm]
    tile_top: Any  # (ty, tx) the highest of node_z + slack in TILE x TILE nodes


@njit(cache=True, nogil=True)
def _newton(b, cx, cy, px, py):  # type: ignore[no-untyped-def]
    """Solve for the contact of centre (cx, cy) from p -> (found, px, py, tip, slope_x, curvature_x, dpx/dcx, dpy/dcx).

    The cutter-location surface has the slope of the lens at the contact, so its curvature is [H J^-1]_xx with
    J = I + R dN_xy/dp. The height is corrected for the last residual r by grad h . r.
    """
    for _ in range(16):
        z, zx, zy, zxx, zxy, zyy = spline_jet(b.coefs, b.x0, b.y0, b.inv_dx, b.inv_dy, px, py)
        w = 1.0 / math.sqrt(1.0 + zx * zx + zy * zy)
        rw = b.radius * w
        rx = cx - px + rw * zx
        ry = cy - py + rw * zy
        qx = rw * w * w * (zx * zxx + zy * zxy)
        qy = rw * w * w * (zx * zxy + zy * zyy)
        j11 = 1.0 - rw * zxx + qx * zx
        j12 = -rw * zxy + qy * zx
        j21 = -rw * zxy + qx * zy
        j22 = 1.0 - rw * zyy + qy * zy
        det = j11 * j22 - j12 * j21
        if det <= 0.0 or j11 + j22 <= 0.0:
            break
        inv = 1.0 / det
        px += (j22 * rx - j12 * ry) * inv
        py += (j11 * ry - j21 * rx) * inv
        if rx * rx + ry * ry < CLOSE_MM * CLOSE_MM:
            tip = z + rw - b.below + zx * rx + zy * ry
            return True, px, py, tip, zx, (zxx * j22 - zxy * j21) * inv, j22 * inv, -j21 * inv
    return False, px, py, 0.0, 0.0, 0.0, 1.0, 0.0


@njit(cache=True, nogil=True)
def _climb(b, cx, cy, px, py, top, tx, ty):  # type: ignore[no-untyped-def]
    """Climb to a local maximum of f from p by safeguarded Newton: never downhill, never out of the footprint -> (f, px,
    py).

    Given up, with f = -inf, as soon as it heads for the known maximum `top` at (tx, ty), if any, or for a lower one.
    """
    near = 0.05 * b.node_step
    r2 = b.radius * b.radius
    ux, uy = px - cx, py - cy
    z, zx, zy, zxx, zxy, zyy = spline_jet(b.coefs, b.x0, b.y0, b.inv_dx, b.inv_dy, px, py)
    r = math.sqrt(r2 - ux * ux - uy * uy)
    f = z + r
    for _ in range(60):
        gx, gy = zx - ux / r, zy - uy / r
        hxx, hxy, hyy = (zxx - (1.0 + ux * ux / (r * r)) / r, zxy - ux * uy / r**3, zyy - (1.0 + uy * uy / (r * r)) / r)
        det = hxx * hyy - hxy * hxy
        if hxx < 0.0 and det > 0.0:
            sx, sy = (hxy * gy - hyy * gx) / det, (hxy * gx - hxx * gy) / det
            known = top > -np.inf and math.hypot(cx + ux + sx - tx, cy + uy + sy - ty) < near
            if known or f + gx * sx + gy * sy < top:
                return -np.inf, px, py  # the quadratic's gain is half of g . s
        else:
            sx, sy = r * gx, r * gy
        length = math.hypot(sx, sy)
        if length < 1e-9 * b.radius:
            break
        scale = min(1.0, 0.25 * b.radius / length)
        moved = False
        while scale * length > 1e-10 * b.radius:
            vx, vy = ux + scale * sx, uy + scale * sy
            left = r2 - vx * vx - vy * vy
            if left > 1e-6 * r2:
                z, zx, zy, zxx, zxy, zyy = spline_jet(b.coefs, b.x0, b.y0, b.inv_dx, b.inv_dy, cx + vx, cy + vy)
                if z + math.sqrt(left) >= f:
                    moved = True
                    break
            scale *= 0.5
        if not moved:
            break
        ux, uy, r = vx, vy, math.sqrt(left)
        f = z + r
    return f, cx + ux, cy + uy


@njit(cache=True, nogil=True)
def _nodes_on_top(b, cx, cy, level, rows, columns, f):  # type: ignore[no-untyped-def]
    """Find nodes (rows, columns) of the footprint that may lie beside the highest maximum, and f there; return how
    many.

    level : a value that f is known to reach somewhere
    """
    r2 = b.radius * b.radius * 0.999
    my, mx = b.node_z.shape
    i0 = max(int((cx - b.radius - b.node_x0) / b.node_step), 0)
    i1 = min(int((cx + b.radius - b.node_x0) / b.node_step) + 1, mx - 1)
    j0 = max(int((cy - b.radius - b.node_y0) / b.node_step), 0)
    j1 = min(int((cy + b.radius - b.node_y0) / b.node_step) + 1, my - 1)
    count = 0
    side = (TILE - 1) * b.node_step
    for tj in range(j0 // TILE, j1 // TILE + 1):
        low_y = b.node_y0 + tj * TILE * b.node_step - cy
        off_y = max(low_y, -low_y - side, 0.0)
        for ti in range(i0 // TILE, i1 // TILE + 1):
            low_x = b.node_x0 + ti * TILE * b.node_step - cx
            off_x = max(low_x, -low_x - side, 0.0)
            left = b.radius * b.radius - off_x * off_x - off_y * off_y
            if left <= 0.0 or b.tile_top[tj, ti] + math.sqrt(left) < level:
                continue
            for j in range(max(tj * TILE, j0), min(tj * TILE + TILE, j1 + 1)):
                dy = b.node_y0 + j * b.node_step - cy
                for i in range(max(ti * TILE, i0), min(ti * TILE + TILE, i1 + 1)):
                    dx = b.node_x0 + i * b.node_step - cx
                    left = r2 - dx * dx - dy * dy
                    if left <= 0.0:
                        continue
                    here = b.node_z[j, i] + math.sqrt(left)
                    level = max(level, here)
                    if here + b.slack[j, i] >= level and count < rows.size:
                        rows[count], columns[count], f[count] = j, i, here
                        count += 1
    return count


@njit(cache=True, nogil=True)
def _level(b, cx, cy, px, py):  # type: ignore[no-untyped-def]
    """Return f at p, or at the centre if p lies outside the footprint."""
    left = b.radius * b.radius * 0.999 - (px - cx) ** 2 - (py - cy) ** 2
    if left <= 0.0:
        px, py, left = cx, cy, b.radius * b.radius
    return spline_jet(b.coefs, b.x0, b.y0, b.inv_dx, b.inv_dy, px, py)[0] + math.sqrt(left)


@njit(cache=True, nogil=True)
def _highest(b, cx, cy, px, py):  # type: ignore[no-untyped-def]
    """Find the highest contact in the whole footprint; return the values of `_newton` except `found`. A good guess p
    saves looking at most of the nodes, and changes nothing else.

    Climbs start from every node that may lie below the true maximum, not from lattice maxima only: two true maxima a
    few steps apart, at the end of a crease, show as one.
    """
    room = (2 * int(math.ceil(b.radius / b.node_step)) + 3) ** 2
    rows, columns, f = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room)
    count = _nodes_on_top(b, cx, cy, _level(b, cx, cy, px, py), rows, columns, f)
    if count == 0:  # a guess off the lattice's end
        count = _nodes_on_top(b, cx, cy, -np.inf, rows, columns, f)
    first = 0
    for m in range(count):
        if f[m] > f[first]:
            first = m
    top, px, py = -np.inf, cx, cy
    for m in range(-1, count):  # the best node first: most others are then given up at once
        k = first if m < 0 else m
        if f[k] + b.slack[rows[k], columns[k]] < f[first] or m == first:
            continue
        qx, qy = b.node_x0 + columns[k] * b.node_step, b.node_y0 + rows[k] * b.node_step
        t, qx, qy = _climb(b, cx, cy, qx, qy, top, px, py)
        if t > top:
            top, px, py = t, qx, qy
    found, qx, qy, tip, slope, curvature, dpx, dpy = _newton(b, cx, cy, px, py)
    if found and tip >= top - b.below - 1e-9:
        return qx, qy, tip, slope, curvature, dpx, dpy
    slope = spline_jet(b.coefs, b.x0, b.y0, b.inv_dx, b.inv_dy, px, py)[1]
    return px, py, top - b.below, slope, 0.0, 1.0, 0.0


@njit(cache=True, nogil=True)
def touch(b, cx, cy, px, py):  # type: ignore[no-untyped-def]
    """Find the contact of the ball with its centre above (cx, cy), guessed to touch near p.

    returns (px, py, tip, slope_x, curvature_x, dpx, dpy): contact point, height of the tip, slope and curvature along
    X of the cutter-location surface, and how the contact point moves when cx does
    """
    my, mx = b.guarded.shape
    i = min(max(int((cx - b.node_x0) / b.node_step + 0.5), 0), mx - 1)
    j = min(max(int((cy - b.node_y0) / b.node_step + 0.5), 0), my - 1)
    if not b.guarded[j, i]:
        found, qx, qy, tip, slope, curvature, dpx, dpy = _newton(b, cx, cy, px, py)
        if found:
            return qx, qy, tip, slope, curvature, dpx, dpy
    return _highest(b, cx, cy, px, py)


@njit(cache=True, nogil=True)
def touch_points(b, x, y, out):  # type: ignore[no-untyped-def]
    """Compute contact x, y and tip height, out (n, 3), for centres x (n,), y (n,), each from the last one's contact."""
    px, py = x[0], y[0]
    for k in range(x.size):
        if k:
            px += x[k] - x[k - 1]
            py += y[k] - y[k - 1]
        px, py, tip = touch(b, x[k], y[k], px, py)[:3]
        out[k, 0] = px
        out[k, 1] = py
        out[k, 2] = tip


@njit(cache=True, nogil=True)
def touch_rows(b, x, y, out):  # type: ignore[no-untyped-def]
    """Compute tip heights out (ny, nx) over the rows y (ny,) and columns x (nx,); each row starts without a guess."""
    for j in range(y.size):
        px, py, dpx, dpy = x[0], y[j], 1.0, 0.0
        for i in range(x.size):
            if i:
                px += dpx * (x[i] - x[i - 1])
                py += dpy * (x[i] - x[i - 1])
            px, py, tip, _, _, dpx, dpy = touch(b, x[i], y[j], px, py)
            out[j, i] = tip
