"""The contour strategy: one unbroken path along the contours of the surface, from field to tips.

Field -> level lines at the density that its spacing requires -> strokes over the gaps between them -> one tour. Up to
here the path is flat: its vertices are on the raster of written x and y, its chords within a hundredth of the pitch of
the level line. Last, each vertex gets its height by exact contact, and chords are cut until slope and sag keep the
rule.

A chord is judged by the surface at its ends and its middle, and cut into as many parts as a constant curvature would
require. Curvature is not constant, so every part is judged again: where the surface bulges over a chord the tool would
cut into it. The surface of tips bulges no more than the ball itself, so parts of some micrometres are always short
enough; for slope alone, or where a chord runs too high, parts so short that a mill slows down are not worth it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numba import njit

from cam.contour.field import ContourField
from cam.contour.holes import fill_holes
from cam.contour.tour import Room, tour_tracks, turn_radius_mm
from cam.contour.tracer import trace
from cam.moves import Array
from cam.passes import PassSpec
from cam.rows.entries import RAMP_STRETCH_MM
from cam.rows.raster import map_in_order, on_ticks
from cam.rows.vertices import TICKS_PER_MM, VertexRule
from cam.surface.contact import Ball, touch
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield, spline_jet

PIECE_VERTICES = 50_000
TRACED, CLOSED, JOINED = 0.2, 0.5, 0.6
"""Shares of the work done at the end of each step."""
SHORTEST_MM = 0.014
"""Shortest parts for slope, and where a chord runs too high; turns are made of parts of this length."""

SHORTEST_LOW_MM = 0.003
"""Shortest parts where a chord cuts too low: under a ball of 0.1 mm that is 11 nm."""

MOST_PARTS, WAITING = 64, 512
"""Most parts of one cut; most parts that wait to be judged, cut several times."""


def contour_path(
    heightfield: Heightfield,
    surface: ToolSurface,
    spec: PassSpec,
    rule: VertexRule,
    *,
    on_progress: Callable[[float], None] | None = None,
) -> Iterator[Array]:
    """Yield pieces (n, 3) of one unbroken polyline of tips; the first begins straight along X, for the ramp down."""
    report = on_progress or (lambda done: None)
    xy = _divide_chords(plan_path(heightfield, surface, spec, on_progress=report), 2 * rule.probe_mm)
    starts = range(0, len(xy) - 1, PIECE_VERTICES)

    def piece(first: int) -> Array:
        chosen = xy[first : first + PIECE_VERTICES + 1]
        tips = tips_along(surface.kernel, rule, chosen)
        return tips if first == 0 else tips[1:]

    for done, tips in enumerate(map_in_order(piece, starts), start=1):
        yield tips
        report(JOINED + (1 - JOINED) * done / len(starts))


def plan_path(
    heightfield: Heightfield, surface: ToolSurface, spec: PassSpec, *, on_progress: Callable[[float], None]
) -> Array:
    """Return (n, 2) the path from above."""
    width, height, pitch = heightfield.width_mm, heightfield.height_mm, spec.pitch_mm
    field = ContourField.over(heightfield, surface, pitch_mm=pitch)
    tracks = trace(field, pitch_mm=pitch)
    on_progress(TRACED)
    tracks = fill_holes(tracks, field, width_mm=width, height_mm=height, pitch_mm=pitch)
    on_progress(CLOSED)
    ring = spec.radius_mm
    radius = min(turn_radius_mm(pitch, max(width, height)), 0.6 * spec.radius_mm)
    room = Room(x_from=-ring, x_to=width + ring, y_from=-ring, y_to=height + ring, radius=radius)
    straight = min(RAMP_STRETCH_MM, width / 2)
    lead_in = np.array([[width / 4, -ring / 2], [width / 4 + straight, -ring / 2]])
    path = tour_tracks(tracks, room, (*lead_in[1], 0.0), pitch_mm=pitch)
    on_progress(JOINED)
    xy = on_ticks(np.concatenate([lead_in[:1], path]))
    moved = np.any(np.diff(xy, axis=0) != 0, axis=1)
    return xy[np.concatenate([[True], moved])]


def _divide_chords(xy: Array, longest_mm: float) -> Array:
    """Divide long chords evenly: a transit crosses hills that its ends and its middle do not show."""
    length = np.hypot(*np.diff(xy, axis=0).T)
    parts = np.maximum(1, np.ceil(length / longest_mm)).astype(np.int64)
    k = np.repeat(np.arange(length.size), parts)
    share = (np.arange(k.size) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[k]
    return np.concatenate([on_ticks(xy[k] + share[:, None] * (xy[k + 1] - xy[k])), xy[-1:]])


def tips_along(ball: Ball, rule: VertexRule, xy: Array) -> Array:
    """Return (m, 3) tips over the vertices (n, 2) of a path, which lie on the writing raster, and where its chords are
    cut.
    """
    chords = np.hypot(*np.diff(xy, axis=0).T)
    out = np.empty((len(xy) + int(np.sum(chords // SHORTEST_LOW_MM)), 3))
    return out[: _cut_chords(ball, rule, xy, out)].copy()


@njit(cache=True, nogil=True)
def _lie(b, x, y, px, py, tip):  # type: ignore[no-untyped-def]
    """Compute tip (7,): x, y, z, contact, gradient. The gradient of the tips' surface at (x, y) equals that of the lens
    at the contact.
    """
    px, py, z = touch(b, x, y, px, py)[:3]
    jet = spline_jet(b.coefs, b.x0, b.y0, b.inv_dx, b.inv_dy, px, py)
    tip[0], tip[1], tip[2], tip[3], tip[4], tip[5], tip[6] = x, y, z, px, py, jet[1], jet[2]


@njit(cache=True, nogil=True, inline="always")
def _share(error, allowed, power, length, shortest):  # type: ignore[no-untyped-def]
    """Return the number of parts for an error that falls with that power of the number; no part is shorter than the
    shortest.
    """
    if error <= allowed:
        return 1
    return min(math.ceil((error / allowed) ** power), math.floor(length / shortest))


@njit(cache=True, nogil=True)
def _parts(rule, a, m, b):  # type: ignore[no-untyped-def]
    """Return the number of parts for the chord from tip a to tip b, with tip m over its middle."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.hypot(dx, dy)
    chord = (b[2] - a[2]) / length
    off_a = (a[5] * dx + a[6] * dy) / length - chord
    off_b = (b[5] * dx + b[6] * dy) / length - chord
    off_m = (m[5] * dx + m[6] * dy) / length - chord
    bulge = m[2] - 0.5 * (a[2] + b[2])
    low = max(bulge, 0.25 * length * max(off_a, -off_b))
    high = max(-bulge, 0.25 * length * max(-off_a, off_b))
    steep = max(abs(off_a), abs(off_b), abs(off_m))
    return max(
        _share(steep, rule.slope_rad, 1.0, length, SHORTEST_MM),
        _share(high, rule.sag_mm, 0.5, length, SHORTEST_MM),
        _share(low, rule.sag_mm, 0.5, length, SHORTEST_LOW_MM),
        1,
    )


@njit(cache=True, nogil=True)
def _cut_chords(b, rule, xy, out):  # type: ignore[no-untyped-def]
    """Write vertices with heights into out (n, 3); return n. Ends of chords wait on a stack, the nearest on top."""
    ends = np.empty((WAITING, 7))
    here, middle = np.empty(7), np.empty(7)
    _lie(b, xy[0, 0], xy[0, 1], xy[0, 0], xy[0, 1], here)
    out[0] = here[:3]
    count = 1
    for k in range(1, xy.shape[0]):
        _lie(b, xy[k, 0], xy[k, 1], here[3] + xy[k, 0] - here[0], here[4] + xy[k, 1] - here[1], ends[0])
        top = 0
        while top >= 0:
            end = ends[top]
            mid = 0.5 * (here + end)
            _lie(b, mid[0], mid[1], mid[3], mid[4], middle)
            parts = min(_parts(rule, here, middle, end), MOST_PARTS, WAITING - top)
            for part in range(parts - 1, 0, -1):
                t = part / parts
                x = math.floor((here[0] + t * (end[0] - here[0])) * TICKS_PER_MM + 0.5) / TICKS_PER_MM
                y = math.floor((here[1] + t * (end[1] - here[1])) * TICKS_PER_MM + 0.5) / TICKS_PER_MM
                px, py = here[3] + t * (end[3] - here[3]), here[4] + t * (end[4] - here[4])
                _lie(b, x, y, px, py, ends[top + parts - part])
            if parts > 1:
                top += parts - 1
                continue
            here[:] = end
            out[count] = here[:3]
            count += 1
            top -= 1
    return count
