"""The contour strategy: one unbroken path along the contours of the surface, from field to tips.

Field -> level lines at the density that its spacing asks for -> strokes over what they leave -> one tour. Up to here
the path is drawn in the plane, its vertices on the raster on which x and y are written, chords within a hundredth of
the pitch of the level line. Last, each vertex gets its height by exact contact, and chords are cut until slope and sag
keep the rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numba import njit

from cam.contact import Ball, touch
from cam.contour.field import ContourField
from cam.contour.strokes import without_holes
from cam.contour.tour import Room, toured, turn_radius_mm
from cam.contour.tracer import trace
from cam.entries import RAMP_STRETCH_MM
from cam.moves import Array
from cam.passes import PassSpec
from cam.raster import on_ticks, ordered
from cam.tool_surface import ToolSurface
from cam.vertices import TICKS_PER_MM, VertexRule
from optics.heightfield import Heightfield, spline_jet

PIECE_VERTICES = 50_000
SHORTEST_MM = 0.014
"""Chords of less than twice this are not cut: turns are drawn in such, and a mill slows down on shorter ones."""

SAG_SHARE = 0.7
"""Of the rule's sag that equal parts may have on average: curvature changes along a chord."""

TRACED, CLOSED, JOINED = 0.2, 0.5, 0.6
"""Shares of the work done when a step is."""


def contour_path(
    heightfield: Heightfield,
    surface: ToolSurface,
    spec: PassSpec,
    rule: VertexRule,
    *,
    on_progress: Callable[[float], None] | None = None,
) -> Iterator[Array]:
    """Pieces (n, 3) of one unbroken polyline of tips; the first begins with a straight along X, for the ramp down."""
    report = on_progress or (lambda done: None)
    xy = _divided(plan_path(heightfield, surface, spec, on_progress=report), 2 * rule.probe_mm)
    starts = range(0, len(xy) - 1, PIECE_VERTICES)

    def piece(first: int) -> Array:
        chosen = xy[first : first + PIECE_VERTICES + 1]
        tips = _tips(surface.kernel, rule, chosen)
        return tips if first == 0 else tips[1:]

    for done, tips in enumerate(ordered(piece, starts), start=1):
        yield tips
        report(JOINED + (1 - JOINED) * done / len(starts))


def plan_path(
    heightfield: Heightfield, surface: ToolSurface, spec: PassSpec, *, on_progress: Callable[[float], None]
) -> Array:
    """(n, 2) the path from above."""
    width, height, pitch = heightfield.width_mm, heightfield.height_mm, spec.pitch_mm
    field = ContourField.over(heightfield, surface, pitch_mm=pitch)
    tracks = trace(field, pitch_mm=pitch)
    on_progress(TRACED)
    tracks = without_holes(tracks, field, width_mm=width, height_mm=height, pitch_mm=pitch)
    on_progress(CLOSED)
    ring = 0.98 * spec.radius_mm
    radius = min(turn_radius_mm(pitch, max(width, height)), 0.6 * spec.radius_mm)
    room = Room(x_from=-ring, x_to=width + ring, y_from=-ring, y_to=height + ring, radius=radius)
    straight = min(RAMP_STRETCH_MM, width / 2)
    lead_in = np.array([[width / 4, -ring / 2], [width / 4 + straight, -ring / 2]])
    path = toured(tracks, room, (*lead_in[1], 0.0), pitch_mm=pitch)
    on_progress(JOINED)
    xy = on_ticks(np.concatenate([lead_in[:1], path]))
    moved = np.any(np.diff(xy, axis=0) != 0, axis=1)
    return xy[np.concatenate([[True], moved])]


def _divided(xy: Array, longest_mm: float) -> Array:
    """Long chords in even parts: a transit crosses hills that its ends and its middle do not show."""
    length = np.hypot(*np.diff(xy, axis=0).T)
    parts = np.maximum(1, np.ceil(length / longest_mm)).astype(np.int64)
    k = np.repeat(np.arange(length.size), parts)
    share = (np.arange(k.size) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[k]
    return np.concatenate([on_ticks(xy[k] + share[:, None] * (xy[k + 1] - xy[k])), xy[-1:]])


def _tips(ball: Ball, rule: VertexRule, xy: Array) -> Array:
    chords = np.hypot(*np.diff(xy, axis=0).T)
    out = np.empty((xy.shape[0] + int(np.sum(chords // SHORTEST_MM)), 3))
    return out[: _cut_chords(ball, rule, xy, out)].copy()


@njit(cache=True, nogil=True)
def _touch(b, x, y, px, py, ux, uy):  # type: ignore[no-untyped-def]
    """(px, py, tip, slope along u) with the tip at (x, y): its surface has the slope of the lens at the contact."""
    px, py, tip = touch(b, x, y, px, py)[:3]
    jet = spline_jet(b.coefs, b.x0, b.y0, b.inv_dx, b.inv_dy, px, py)
    return px, py, tip, jet[1] * ux + jet[2] * uy


@njit(cache=True, nogil=True)
def _cut_chords(b, rule, xy, out):  # type: ignore[no-untyped-def]
    """Vertices with heights into out (n, 3); returns n.

    A chord's error in slope is read at its ends and its middle, its sag at the middle; n parts have an n-th of the one
    and an n^2-th of the other.
    """
    x, y = xy[0, 0], xy[0, 1]
    px, py, z = touch(b, x, y, x, y)[:3]
    out[0, 0], out[0, 1], out[0, 2] = x, y, z
    count = 1
    for k in range(1, xy.shape[0]):
        nx, ny = xy[k, 0], xy[k, 1]
        length = math.hypot(nx - x, ny - y)
        ux, uy = (nx - x) / length, (ny - y) / length
        slope_a = _touch(b, x, y, px, py, ux, uy)[3]
        mx, my, mz, slope_m = _touch(b, (x + nx) / 2, (y + ny) / 2, px + (nx - x) / 2, py + (ny - y) / 2, ux, uy)
        qx, qy, nz, slope_b = _touch(b, nx, ny, 2 * mx - px, 2 * my - py, ux, uy)
        chord = (nz - z) / length
        off = max(abs(slope_a - chord), abs(slope_b - chord), abs(slope_m - chord))
        sag = max(abs(mz - (z + nz) / 2), off * length / 4)
        wanted = max(off / rule.slope_rad, math.sqrt(sag / (SAG_SHARE * rule.sag_mm)))
        parts = max(1, min(int(math.ceil(wanted - 1e-6)), int(length / SHORTEST_MM)))
        for part in range(1, parts):
            t = part / parts
            tx = math.floor((x + t * (nx - x)) * TICKS_PER_MM + 0.5) / TICKS_PER_MM
            ty = math.floor((y + t * (ny - y)) * TICKS_PER_MM + 0.5) / TICKS_PER_MM
            out[count, 0], out[count, 1] = tx, ty
            out[count, 2] = touch(b, tx, ty, px + t * (qx - px), py + t * (qy - py))[2]
            count += 1
        out[count, 0], out[count, 1], out[count, 2] = nx, ny, nz
        count += 1
        x, y, z, px, py = nx, ny, nz, qx, qy
    return count
