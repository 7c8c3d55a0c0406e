"""Whether block, clamps and tools fit under a mill's head, from a few heights, before any program is planned.

The tool is a stack of cylinders about its axis: the cutter from the tip up, then nut and holder; each counts as
reaching up without an end. Table, block and clamps are boxes that stand on the table. So a tool that is clear of them
stays clear when it goes up, and these rules are enough for every motion, wherever the tool is parked: it goes up until
its collet is at the top of the travel or its tip at the safe height, goes across there, and comes down; at its lowest
tip, anywhere in its rectangle, no part of the stack meets a box.

Heights are in the work frame, Z0 on top of the block, unless they are stated over the table, where Z0 is at base +
thickness.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import hypot, inf

from cam.passes import Clamp

NOSE_CLEARANCE_MM = 2.0
"""Air between the nose (nut and holder) and anything below it at the deepest cut."""

ABOVE_CLAMPS_MM = 1.0
"""Air between rapids and the highest clamp: clamps are set by hand, and their screws stand out."""

CLAMP_GRIP_MM = 8.0
"""Width of the block's top that a clamp needs."""

USUAL_NOSE_MM = ((25.0, 25.0), (40.0, 100.0))
"""Nut and holder where a mill's are not known: as wide as those of ER32. A guess on the safe side of small mills."""

_USUAL_FLUTES = 2.0  # diameters; a guess where the flutes are not stated, which must not be clamped
_ROUNDING_MM = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """Where one program takes its tool.

    radius_mm       : of the cutter; shank_radius_mm: of the shank above its flutes; None: no thicker
    beyond_mm       : how far the axis goes beyond the aperture, along X and along Y
    strip_mm        : left, right, front and back of all that the axis goes over, where that is not the aperture's area
    lowest_mm       : of its tip
    stick_out_mm    : from tip to collet, as clamped; None: not stated, so as little as it needs
    flute_length_mm : not to be clamped; None: not stated
    """

    radius_mm: float
    beyond_mm: tuple[float, float]
    lowest_mm: float
    strip_mm: tuple[float, float, float, float] | None = None
    shank_radius_mm: float | None = None
    stick_out_mm: float | None = None
    flute_length_mm: float | None = None

    @property
    def widest_mm(self) -> float:
        return max(self.radius_mm, self.shank_radius_mm or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Envelope:
    """A block on a mill's table, under its head.

    width_mm, height_mm : of the aperture; margin_mm around it
    top_mm           : of the raw block, before it is faced
    through_mm       : how far programs go under the block
    base_mm          : from the table to the block: spoil board, sub plate, vice; None: not stated
    safe_z_mm        : height of rapids across
    travel_z_mm      : of the head
    bed_to_collet_mm : from the table to the collet's face while the head is at its top; None: not known
    gantry_mm        : from the table to the underside of the gantry; None: the mill has none
    nose_mm          : cylinders (radius, length) from the collet's face up
    """

    width_mm: float
    height_mm: float
    margin_mm: float
    thickness_mm: float
    safe_z_mm: float
    travel_z_mm: float
    top_mm: float = 0.0
    through_mm: float = 0.0
    clamps: tuple[Clamp, ...] = ()
    base_mm: float | None = None
    bed_to_collet_mm: float | None = None
    gantry_mm: float | None = None
    nose_mm: tuple[tuple[float, float], ...] = USUAL_NOSE_MM

    @property
    def highest_mm(self) -> float:
        """Return the height of the highest thing that stands on the table."""
        return max([0.0, self.top_mm, *(clamp.height_mm for clamp in self.clamps)])

    def list_steps(self) -> Iterator[tuple[float, float]]:
        """Yield (radius, height over the collet's face) of each cylinder of the nose."""
        over_mm = 0.0
        for radius_mm, length_mm in self.nose_mm or USUAL_NOSE_MM:
            yield radius_mm, over_mm
            over_mm += length_mm

    def least_stick_out_mm(self, reach: Reach) -> float:
        """Return how far a tool must stick out at least. Plans, checks and the setup sheet all use this rule.

        At its lowest the collet's face is above the block, each cylinder of the nose above the clamps that it reaches,
        and the flutes are outside the collet. Clamps that are not named, but have room on top, may be as high as rapids
        allow.
        """
        needs_mm = [max(0.0, self.top_mm)]
        if not self.clamps and self.margin_mm - max(reach.beyond_mm) - reach.radius_mm >= CLAMP_GRIP_MM:
            needs_mm.append(self.safe_z_mm - ABOVE_CLAMPS_MM - NOSE_CLEARANCE_MM)
        for clamp in self.clamps:
            away_mm = self.distance_mm(reach, clamp)
            needs_mm += [
                clamp.height_mm - over_mm
                for radius_mm, over_mm in self.list_steps()
                if away_mm < radius_mm + ABOVE_CLAMPS_MM
            ]
        flutes_mm = _USUAL_FLUTES * 2 * reach.radius_mm if reach.flute_length_mm is None else reach.flute_length_mm
        return max(max(needs_mm) + NOSE_CLEARANCE_MM - min(reach.lowest_mm, 0.0), flutes_mm)

    def stick_out_mm(self, reach: Reach) -> float:
        """Return how far a tool sticks out: as stated, or as little as it needs."""
        return self.least_stick_out_mm(reach) if reach.stick_out_mm is None else reach.stick_out_mm

    def area_mm(self, reach: Reach) -> tuple[float, float, float, float]:
        """Return left, right, front and back of what a tool's axis goes over."""
        x_mm, y_mm = reach.beyond_mm
        return reach.strip_mm or (-x_mm, self.width_mm + x_mm, -y_mm, self.height_mm + y_mm)

    def distance_mm(self, reach: Reach, clamp: Clamp) -> float:
        """Return the distance of a clamp from the rectangle that a tool's axis goes over, seen from above."""
        left, right, front, back = self.area_mm(reach)
        return hypot(
            max(clamp.x_mm - right, left - clamp.x_mm - clamp.width_mm, 0.0),
            max(clamp.y_mm - back, front - clamp.y_mm - clamp.depth_mm, 0.0),
        )

    def find_struck(self, reach: Reach) -> Iterator[tuple[int, float]]:
        """Yield (number, distance from the axis) of the clamps that the cutter or its shank comes too near to."""
        for number, clamp in enumerate(self.clamps):
            away_mm = self.distance_mm(reach, clamp)
            is_under = reach.lowest_mm < clamp.height_mm + ABOVE_CLAMPS_MM
            if is_under and away_mm < reach.widest_mm + ABOVE_CLAMPS_MM - _ROUNDING_MM:
                yield number, away_mm

    def base_range_mm(self, reaches: Iterable[Reach]) -> tuple[float, float]:
        """Return the least and the greatest height of the base under the block; no height works if the least is
        greater.

        At most: with every tool the tip comes to the safe height within the travel, and everything on the table passes
        under the gantry. At least: every tool comes down to its lowest tip within the travel, and none cuts into the
        table.
        """
        least_mm, most_mm = self.through_mm, inf
        if self.gantry_mm is not None:
            most_mm = self.gantry_mm - self.thickness_mm - self.highest_mm - ABOVE_CLAMPS_MM
        for reach in reaches:
            if self.bed_to_collet_mm is None:
                break
            under_mm = self.bed_to_collet_mm - self.thickness_mm - self.stick_out_mm(reach)
            most_mm = min(most_mm, under_mm - self.safe_z_mm)
            least_mm = max(least_mm, under_mm - self.travel_z_mm - reach.lowest_mm)
        return least_mm, most_mm
