"""Checks whether the tool of a finish reaches the rims of a lens: they lie in a pit, beside the wall that the cutters
leave.

Rows go one radius R beyond the rim. From there the wall rises like the cutter's flank, and is upright at 2 R: a rim
deeper than R has its wall there, however deep it is. A finish has to go on for its reach x beyond the rim, or it rounds
the rim. A round tool of radius r that stands there meets the wall at the block's top first, at the height d of the wall
and the distance w from the rim: it has room while x + sqrt(r^2 - (r - d)^2) <= w, for d < r, else x + r <= w. So tools
are limited by (a^2 + d^2) / 2d, a = w - x, where a > d, else by a; beside a low wall any tool has room. Beyond the
floor, x > R, the tool stands on the flank, and no tool has room.

The gain may justify another ball: `camera`, 100 mm, 200 mm to the wall, 85 minutes of felt, rows off by 1.2 um: 21.1
dB; with the outermost 1 / 2 / 4 mm left as milled 19.1 / 18.7 / 18.6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cam.passes import PassSpec
from cam.planning.shop import CLEAR_MM
from optics.finish import Finish
from optics.heightfield import Array, Heightfield
from phrases.phrase import Phrase

LEAST_TOOL_MM = 3.0
"""Least size of a tool: a smaller one cannot be moved evenly by hand."""

_SEEN_MM = 0.1  # least width of a rim that shows
_ALIKE = 0.9  # size relative to the usual tool; sizes are not known more exactly


@dataclass(frozen=True, slots=True, kw_only=True)
class RimRoom:
    """The room for finishing the rims of a lens in its block.

    depth_mm   : of the rims under the block's top, least and most
    wall_mm    : from the rims to the wall at the block's top, where it leaves the least room; inf if the block
                 ends before it
    beyond_mm  : how far beyond the rim the finish has to go
    pad_mm     : size of the usual tool
    largest_mm : largest round tool that reaches all rims; inf if any tool does
    """

    depth_mm: tuple[float, float]
    wall_mm: float
    beyond_mm: float
    pad_mm: float
    largest_mm: float

    @property
    def is_reached(self) -> bool:
        """Whether a hand-held tool reaches the rims."""
        return self.largest_mm >= min(self.pad_mm, LEAST_TOOL_MM)

    @property
    def tool_mm(self) -> float:
        """Size of the tool that reaches the rims."""
        return min(self.pad_mm, self.largest_mm)

    @property
    def band_mm(self) -> float:
        """Width of the band inside the rims that the usual tool does not finish: it passes over a place with its full
        width only if the wall is at least that far away.
        """
        return max(0.0, self.pad_mm - self.wall_mm)


def measure_rim_room(
    lens: Heightfield, passes: Sequence[PassSpec], finish: Finish, *, margin_mm: float
) -> RimRoom | None:
    """Return the room that passes leave around the rims of a lens in its block; None for a film, which needs none.

    margin_mm : of the block around the lens, whose top is Z0
    """
    everywhere = [spec for spec in passes if spec.where == "everywhere"]
    finishing = [spec.radius_mm for spec in everywhere if spec.finishes]
    if finish.depth_mm is None or not finishing:
        return None
    z = lens.z_mm
    depths = -np.concatenate([z[0], z[-1], z[:, 0], z[:, -1]])
    walls = np.max([_wall_mm(spec, depths) for spec in everywhere], axis=0)
    is_walled = margin_mm > max(spec.radius_mm for spec in everywhere)  # else the cut goes on to the block's edge
    room = np.maximum(walls - finish.reach_mm, 0.0)
    low = room > depths
    largest = 2.0 * np.where(low, (room**2 + depths**2) / (2.0 * depths), room)
    if not is_walled:
        walls, largest = np.full_like(walls, math.inf), np.full_like(walls, math.inf)
    elif finish.reach_mm > max(finishing) + _SEEN_MM:
        largest = np.zeros_like(largest)
    tightest = int(np.argmin(largest))
    return RimRoom(
        depth_mm=(float(depths.min()), float(depths.max())),
        wall_mm=float(walls[tightest]),
        beyond_mm=finish.reach_mm,
        pad_mm=finish.pad_mm,
        largest_mm=float(largest[tightest]),
    )


def weigh_removal(lens: Heightfield, finish: Finish, density_g_per_cm3: float) -> float:
    """Return the mass that a tool takes off the lens and its surroundings, as far as the finish goes [g]."""
    assert finish.depth_mm is not None
    width_mm, height_mm = lens.width_mm + 2 * finish.reach_mm, lens.height_mm + 2 * finish.reach_mm
    return finish.depth_mm * width_mm * height_mm * density_g_per_cm3 / 1000


def _wall_mm(spec: PassSpec, depths_mm: Array) -> Array:
    """Return the distance from rims of those depths (n,) to the wall that a pass leaves, at the block's top [mm]."""
    corner_mm = spec.shape.corner_mm(spec.radius_mm)
    deep = np.clip(depths_mm - spec.stock_to_leave_mm, 0.0, corner_mm)
    flank = np.sqrt(corner_mm**2 - (corner_mm - deep) ** 2)
    return np.asarray(spec.radius_mm + spec.shape.flat_mm(spec.radius_mm) + flank)


def warn_of_rim_room(room: RimRoom | None) -> Phrase | None:
    """Warn if no hand-held tool reaches the rims, and say how to make room."""
    if room is None or room.is_reached:
        return None
    radius_mm = math.ceil(10.0 * max(room.beyond_mm, (room.beyond_mm + LEAST_TOOL_MM / 2) / 2)) / 10.0
    return Phrase(
        "the tool of the finish does not reach the rims: they lie {least_mm:.1f} to {most_mm:.1f} mm under the "
        "block's top, the cutters leave a wall {wall_mm:.1f} mm beside them, and the finish has to go "
        "{beyond_mm:.1f} mm beyond them. A round tool of {largest_mm:.1f} mm would fit there, the usual one has "
        "{pad_mm:g} mm, and under {hand_mm:g} mm none works evenly: the outermost {band_mm:.1f} mm will keep marks "
        "of the mill. What helps: a ball of R {radius_mm:.1f} or more to finish with, and stock.margin_mm = "
        "{margin_mm:.0f} or more for it; less of this finish; a coat of lacquer, which needs no room. A thinner "
        "block or a wall farther away does not help: the ball decides where the wall stands",
        least_mm=room.depth_mm[0],
        most_mm=room.depth_mm[1],
        wall_mm=room.wall_mm,
        beyond_mm=room.beyond_mm,
        largest_mm=room.largest_mm,
        pad_mm=room.pad_mm,
        hand_mm=LEAST_TOOL_MM,
        band_mm=room.band_mm,
        radius_mm=radius_mm,
        margin_mm=math.ceil(2 * radius_mm + CLEAR_MM),
    )


def advise_on_rims(room: RimRoom | None) -> Phrase | None:
    """Advise which smaller tool the rims need and how to use it; None if the usual tool reaches them, or none does."""
    if room is None or not room.is_reached or room.tool_mm > _ALIKE * room.pad_mm:
        return None
    smaller = room.tool_mm / room.pad_mm
    return Phrase(
        "The rims lie {least_mm:.1f} to {most_mm:.1f} mm under the block's top, beside a wall {wall_mm:.1f} mm away: "
        "on the outermost {band_mm:.1f} mm, and {beyond_mm:.1f} mm beyond, work with a round tool of at most "
        "{tool_mm:.1f} mm instead of {pad_mm:g} mm, with {percent:.0f} % of the force and {times:.1f} times the "
        "minutes on the same area.",
        least_mm=room.depth_mm[0],
        most_mm=room.depth_mm[1],
        wall_mm=room.wall_mm,
        band_mm=room.band_mm,
        beyond_mm=room.beyond_mm,
        tool_mm=room.tool_mm,
        pad_mm=room.pad_mm,
        percent=100 * smaller**2,
        times=smaller**-2,
    )
