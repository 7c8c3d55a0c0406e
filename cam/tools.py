"""The end mills of a shop as data: dimensions, speeds on a mill, and how deep each may cut."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi, sqrt

from cam.cutters import BALL, cutter_shape
from cam.materials import Material
from cam.passes import Direction, PassSpec, Strategy


@dataclass(frozen=True, slots=True, kw_only=True)
class Tool:
    """An end mill: a ball, or a flat one, which only roughs.

    flute_length_mm : length of the cutting edges, from the tip
    shank_radius_mm : of the shank above the flutes
    stick_out_mm    : from its tip to the chuck
    max_rpm         : fastest speed its maker allows
    cost_class      : 1 cheap, 2 usual, 3 dear; of two equally good ones the cheaper is taken
    corner_radius_mm : 0 of a flat end mill, less than radius_mm of a bull-nose; None: a ball
    number          : in the mill's tool table; None: not stated
    """

    name: str
    radius_mm: float
    flutes: int
    flute_length_mm: float
    shank_radius_mm: float
    stick_out_mm: float
    max_rpm: float
    cost_class: int
    corner_radius_mm: float | None = None
    number: int | None = None

    @property
    def is_ball(self) -> bool:
        return cutter_shape(self.radius_mm, self.corner_radius_mm) is BALL

    def reaches(self, depth_mm: float) -> bool:
        """Return whether the tool can cut that deep beside a wall: a shank thicker than the ball must stay above the
        block.
        """
        return self.shank_radius_mm <= self.radius_mm or depth_mm <= self.flute_length_mm


@dataclass(frozen=True, slots=True, kw_only=True)
class Speeds:
    """Spindle and feeds of one tool in one material on one mill."""

    spindle_rpm: float
    feed_mm_per_min: float
    plunge_mm_per_min: float
    step_down_mm: float
    chip_mm: tuple[float, float]

    @classmethod
    def of(
        cls,
        tool: Tool,
        material: Material,
        *,
        spindle_rpm: tuple[float, float],
        max_rate_mm_per_min: tuple[float, float, float],
        finishes: bool = False,
        carried_mm_per_min: float = inf,
        reached_mm_per_min: float = inf,
    ) -> Speeds:
        """Return the material's start values within the limits of tool, mill and link. Feeds are proportional to the
        fastest speed and to the number of flutes; then the speed follows the feed (`CuttingData.choose_rpm`).

        spindle_rpm         : slowest and fastest of the mill
        max_rate_mm_per_min : of its axes X, Y, Z
        carried_mm_per_min  : feed for which the link delivers lines fast enough
        reached_mm_per_min  : mean speed of the mill however high the feed
        """
        start = material.start_values(tool.radius_mm)
        slowest, fastest = spindle_rpm[0], max(min(tool.max_rpm, spindle_rpm[1]), spindle_rpm[0])
        part = min(1.0, fastest / start.spindle_rpm) * tool.flutes / start.flutes
        feed = _whole(min(part * start.feed_mm_per_min, *max_rate_mm_per_min[:2], carried_mm_per_min))
        reached, spindle = min(feed, reached_mm_per_min), (slowest, fastest)
        return cls(
            spindle_rpm=start.choose_rpm(reached, tool.flutes, finishes=finishes, spindle_rpm=spindle),
            feed_mm_per_min=feed,
            plunge_mm_per_min=_whole(min(part * start.plunge_mm_per_min, max_rate_mm_per_min[2], feed)),
            step_down_mm=start.step_down_mm,
            chip_mm=start.chip_mm,
        )


def _whole(feed_mm_per_min: float) -> float:
    return max(1.0, float(round(feed_mm_per_min)))


def contact_speed_m_per_min(radius_mm: float, spindle_rpm: float, slope: float) -> float:
    """Return the speed of the cutting edge where a ball touches a surface of that slope; 0 at the tip."""
    return 2 * pi * spindle_rpm * radius_mm * slope / sqrt(1 + slope * slope) / 1000


def tool_pass(
    name: str,
    tool: Tool,
    speeds: Speeds,
    *,
    pitch_mm: float,
    leaves_mm: float,
    step_down_mm: float,
    direction: Direction = "x",
    strategy: Strategy = "raster",
) -> PassSpec:
    """Return a pass with this tool at these speeds."""
    return PassSpec(
        name=name,
        strategy=strategy,
        direction=direction,
        radius_mm=tool.radius_mm,
        pitch_mm=pitch_mm,
        stock_to_leave_mm=leaves_mm,
        step_down_mm=step_down_mm,
        feed_mm_per_min=speeds.feed_mm_per_min,
        plunge_mm_per_min=speeds.plunge_mm_per_min,
        spindle_rpm=speeds.spindle_rpm,
        flutes=tool.flutes,
        chip_mm=speeds.chip_mm,
        tool_name=tool.name,
        tool_number=tool.number,
        flute_length_mm=tool.flute_length_mm,
        shank_radius_mm=tool.shank_radius_mm,
        stick_out_mm=tool.stick_out_mm,
        corner_radius_mm=tool.corner_radius_mm,
    )
