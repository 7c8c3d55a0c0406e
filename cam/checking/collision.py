"""What stands above the cutting edges: does the shank, or the end of the flutes, meet stock that is left?

The cutter is a ball, flutes as wide as the ball up to flute_length_mm above the tip, and a shank of shank_radius_mm
above them. At no move may stock within the wider of the two stand higher than the flutes reach: within the ball's
radius it would be cut by what has no edge, beyond it the shank strikes it. The stock is that of the moment, as the
simulation has it (cam.checking.sweep); only what is stated of a cutter can be checked.
"""

from __future__ import annotations

import numpy as np

from cam.checking.findings import Finding
from cam.checking.removal import Drops, RemovalGrid
from cam.checking.sweep import STRIKE, STRIKE_CELL
from cam.passes import PassSpec
from cam.reading.gcode import MoveBatch
from cam.surface.rough_surface import find_highest, surface_under
from optics.heightfield import Heightfield
from phrases.phrase import Phrase

RUB_MM = 0.01
"""A wall that the flutes have cut stands just beside the shank: rubbing this much is no collision."""

_SAMPLES = 400  # of the lens along a side, before any work


def shank_of(spec: PassSpec) -> tuple[float, float] | None:
    """Return (reach from the axis, height above the tip): no stock may stand higher there; None where nothing is
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
                "(allowed: none above flute_length_mm = {flutes_mm:g})",
                over_mm=v,
                radius_mm=spec.shank_radius_mm or spec.radius_mm,
                flutes_mm=spec.flute_length_mm,
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
    """Return how far the finished lens itself would stand above the flutes beside the cutter, at worst; known before
    any work.

    The least that can happen: stock that is still to come off only stands higher. Below 0 it is clear by at least that.
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
