"""Checks collisions: of the shank or the end of the flutes with stock, and of any part of the cutter with clamps.

The cutter is a ball, flutes as wide as the ball up to flute_length_mm above the tip, and a shank of shank_radius_mm
above them. At no move may stock within the wider of the two stand higher than the flutes reach: within the ball's
radius a part without an edge would cut it, beyond it the shank strikes it. The stock is the present one of the
simulation (cam.checking.sweep); only stated dimensions of a cutter can be checked.

For clamps the cutter counts as a cylinder from its tip up, as wide as its edges or its shank, whichever is wider.
The stock is not needed: a move is near a clamp if its part below the clamp's top comes near the box,
seen from above.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from cam.checking.move_rules import Finding
from cam.checking.removal import Drops, RemovalGrid
from cam.checking.sweep import STRIKE, STRIKE_CELL
from cam.passes import Clamp, PassSpec
from cam.reading.gcode import MoveBatch
from cam.surface.tool_surface import find_highest, surface_under
from optics.heightfield import Array, Heightfield
from phrases.phrase import Phrase

RUB_MM = 0.01
"""A wall that the flutes have cut stands just beside the shank: rubbing this much is no collision."""

_SAMPLES = 400  # of the lens along a side, before any work


def shank_of(spec: PassSpec) -> tuple[float, float] | None:
    """Return (reach from the axis, height above the tip): no stock may stand higher there; None if nothing is
    stated.
    """
    if spec.flute_length_mm is None:
        return None
    return max(spec.radius_mm, spec.shank_radius_mm or 0.0) - RUB_MM, spec.flute_length_mm


class Collisions:
    """Gathers the strikes of one program, batch by batch."""

    def __init__(self, spec: PassSpec) -> None:
        self._strikes = Finding(
            says=lambda v: Phrase(
                "brings stock {over_mm:.3f} mm above the end of the flutes against a shank of radius {radius_mm:g} mm "
                "(allowed: none above flute_length_mm = {flute_length_mm:g})",
                over_mm=v,
                radius_mm=spec.shank_radius_mm or spec.radius_mm,
                flute_length_mm=spec.flute_length_mm,
            )
        )

    def add(self, batch: MoveBatch, drops: Drops, whole: RemovalGrid) -> None:
        over_mm = drops.tally[1:, STRIKE]
        guilty = over_mm > RUB_MM
        if guilty.any():
            x_mm, y_mm = whole.places_mm(drops.tally[1:, STRIKE_CELL].astype(np.int64))
            self._strikes.note_moves(guilty, over_mm, batch.line, np.column_stack([x_mm, y_mm]))

    @property
    def faults(self) -> list[Phrase]:
        return self._strikes.sentences


def lens_over_flutes_mm(heightfield: Heightfield, spec: PassSpec) -> float:
    """Return how far the finished lens itself would at worst stand above the flutes beside the cutter; known before any
    work. It is a lower bound: remaining stock only stands higher. Below 0 the lens is clear by at least that.
    """
    shank = shank_of(spec)
    if shank is None:
        return -np.inf
    reach_mm, flutes_mm = shank
    step_mm = max(max(heightfield.width_mm, heightfield.height_mm) / _SAMPLES, reach_mm / 20)
    x_mm, y_mm = (np.arange(0.0, size + step_mm / 2, step_mm) for size in (heightfield.width_mm, heightfield.height_mm))
    x_mm, y_mm = np.minimum(x_mm, heightfield.width_mm), np.minimum(y_mm, heightfield.height_mm)
    heights_mm = heightfield.spline().heights_mm(x_mm[None, :], y_mm[:, None])
    highest_mm = find_highest(heights_mm, reach_mm / step_mm)
    at_most_mm = float((highest_mm - heights_mm).max()) - flutes_mm  # no tip is below the lens
    if at_most_mm <= 0:
        return at_most_mm
    surface = surface_under(heightfield, spec)
    return float((highest_mm - surface.tip_rows_mm(x_mm, y_mm)).max()) - flutes_mm


CLEARANCE_MM = 1.0
"""Of air beside and above a clamp: it is set by hand, and its screw stands out."""


class Clamps:
    """Gathers the moves of one program that come near one of the clamps."""

    def __init__(self, clamps: tuple[Clamp, ...], *, radius_mm: float, shank_radius_mm: float | None = None) -> None:
        self._clamps, self._keep_mm = clamps, max(radius_mm, shank_radius_mm or 0.0) + CLEARANCE_MM
        self._near = [Finding(says=partial(self._say, number)) for number in range(len(clamps))]

    def _say(self, number: int, into_mm: float) -> Phrase:
        return Phrase(
            "comes {into_mm:.3f} mm too near the clamp stock.clamps.{number} (allowed: {keep_mm:g} mm from the "
            "cutter's axis, or {above_mm:g} mm above it): move the clamp or widen stock.margin_mm",
            into_mm=into_mm,
            number=number,
            keep_mm=self._keep_mm,
            above_mm=CLEARANCE_MM,
        )

    def add(self, batch: MoveBatch) -> None:
        for clamp, finding in zip(self._clamps, self._near, strict=True):
            into_mm = self._keep_mm - distances_below_mm(batch.start_mm, batch.end_mm, clamp, self._keep_mm)
            finding.note_moves(into_mm > 0, into_mm, batch.line, batch.end_mm)

    @property
    def faults(self) -> list[Phrase]:
        return [sentence for finding in self._near for sentence in finding.sentences]


def corners_mm(clamp: Clamp) -> tuple[Array, Array]:
    """Return the box's lower left and upper right corners, each (2,)."""
    low = np.array([clamp.x_mm, clamp.y_mm])
    return low, low + np.array([clamp.width_mm, clamp.depth_mm])


def distances_below_mm(start_mm: Array, end_mm: Array, clamp: Clamp, most_mm: float) -> Array:
    """Return how near each straight move (n, 3) comes to the box, seen from above, where the tip is lower than its top
    and the clearance; inf for moves that stay higher, or farther away than most_mm.
    """
    low, high = corners_mm(clamp)
    top_mm = clamp.height_mm + CLEARANCE_MM
    found = np.full(len(start_mm), np.inf)
    least, greatest = np.minimum(start_mm, end_mm), np.maximum(start_mm, end_mm)
    near = ((least[:, :2] <= high + most_mm) & (greatest[:, :2] >= low - most_mm)).all(axis=1)
    moves = np.flatnonzero(near & (least[:, 2] < top_mm))
    if moves.size:
        found[moves] = _distances_mm(*_parts_below(start_mm[moves], end_mm[moves], top_mm), low, high)
    return found


def _parts_below(start: Array, end: Array, top_mm: float) -> tuple[Array, Array]:
    """Return the ends (n, 2), seen from above, of the part of each move that lies below top_mm; there is one."""
    rise = end[:, 2] - start[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.clip((top_mm - start[:, 2]) / rise, 0.0, 1.0)
    first = np.where(start[:, 2] > top_mm, crossing, 0.0)[:, None]
    last = np.where(end[:, 2] > top_mm, crossing, 1.0)[:, None]
    way = (end - start)[:, :2]
    return start[:, :2] + first * way, start[:, :2] + last * way


def _distances_mm(start: Array, end: Array, low: Array, high: Array) -> Array:
    """Return the distance of each stretch (n, 2) from the rectangle; 0 where they meet.

    Apart, they are nearest at an end of the stretch or at a corner of the rectangle.
    """
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    ends = [np.linalg.norm(np.maximum(np.maximum(low - p, p - high), 0.0), axis=1) for p in (start, end)]
    way = end - start
    length2 = np.maximum((way**2).sum(axis=1), np.finfo(float).tiny)
    away = []
    for corner in corners:
        along = np.clip(((corner - start) * way).sum(axis=1) / length2, 0.0, 1.0)
        away.append(np.linalg.norm(start + along[:, None] * way - corner, axis=1))
    return np.where(_meet(start, way, low, high), 0.0, np.minimum.reduce(ends + away))


def _meet(start: Array, way: Array, low: Array, high: Array) -> np.ndarray:
    """Whether a stretch passes through the rectangle: it is between both pairs of sides at once."""
    still = way == 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        one, other = (low - start) / way, (high - start) / way
    inside = (start >= low) & (start <= high)
    enters = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(one, other)).max(axis=1)
    leaves = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(one, other)).min(axis=1)
    return (enters <= leaves) & (leaves >= 0.0) & (enters <= 1.0)
