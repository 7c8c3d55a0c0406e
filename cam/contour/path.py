"""The contour strategy: one unbroken path along the contours of the surface, from field to tips.

Field -> level lines at the density that its spacing asks for -> strokes over what they leave -> one tour. Up to here
the path is drawn in the plane, its vertices on the raster on which x and y are written, chords within a hundredth of
the pitch of the level line. Last, each vertex gets its height by exact contact, and chords are cut until slope and sag
keep the rule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from cam.contour.chords import tips_along
from cam.contour.field import ContourField
from cam.contour.holes import fill_holes
from cam.contour.tour import Room, tour_tracks, turn_radius_mm
from cam.contour.tracer import trace
from cam.moves import Array
from cam.passes import PassSpec
from cam.rows.entries import RAMP_STRETCH_MM
from cam.rows.raster import map_in_order, on_ticks
from cam.rows.vertices import VertexRule
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield

PIECE_VERTICES = 50_000
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
