"""Facing, witness marks and cutting out as data: the cutter and the cuts of each."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, radians, sqrt, tan
from typing import Literal

from cam.cutters import CUTTERS, CutterShape
from cam.errors import PassValueError
from phrases.phrase import Phrase

FLANK_SLOPE = tan(radians(30.0))
"""Slope of the ramps up onto a tab and down from it."""

BESIDE_MM = 1.0
"""Distance between the block and a cutter that comes down beside it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Facing:
    """The stock's raw top taken down to Z0, in rows along X over the whole block.

    above_mm : the most that the raw top stands above Z0
    shape    : of the cutter, one of CUTTERS
    pitch_mm : distance of rows
    """

    above_mm: float
    shape: str
    radius_mm: float
    pitch_mm: float
    step_down_mm: float
    feed_mm_per_min: float
    plunge_mm_per_min: float
    spindle_rpm: float

    def __post_init__(self) -> None:
        _require_positive(
            self, "above_mm", "radius_mm", "step_down_mm", "feed_mm_per_min", "plunge_mm_per_min", "spindle_rpm"
        )
        if self.shape not in CUTTERS:
            raise PassValueError(name="shape", value=self.shape, allowed=Phrase("{names}", names=", ".join(CUTTERS)))
        most_mm = self.cutter.widest_pitch_mm(self.radius_mm)
        if not 0.01 <= self.pitch_mm <= most_mm:
            raise PassValueError(
                name="pitch_mm",
                value=self.pitch_mm,
                allowed=Phrase("{least_mm} to {most_mm:g} mm", least_mm=0.01, most_mm=most_mm),
            )

    @property
    def cutter(self) -> CutterShape:
        return CUTTERS[self.shape]

    @property
    def cusp_mm(self) -> float:
        """Height of the stock left above Z0 between two rows."""
        return self.cutter.cusp_mm(self.radius_mm, self.pitch_mm)

    @property
    def levels_mm(self) -> tuple[float, ...]:
        """Heights of the tip from the first layer down to Z0."""
        count = ceil(self.above_mm / self.step_down_mm - 1e-9)
        return tuple(self.above_mm * (count - k) / count for k in range(1, count + 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class CutOut:
    """The lens cut out of the block along its outline by a flat end mill, except for tabs that hold it.

    tab_height_mm : of the tabs, from the block's bottom; tab_width_mm: along the outline, at their tops
    through_mm    : deeper than the block is thick
    """

    radius_mm: float
    tabs: int
    tab_width_mm: float
    tab_height_mm: float
    through_mm: float
    step_down_mm: float
    feed_mm_per_min: float
    plunge_mm_per_min: float
    spindle_rpm: float

    def __post_init__(self) -> None:
        _require_positive(
            self, "radius_mm", "tab_width_mm", "tab_height_mm", "step_down_mm", "feed_mm_per_min", "plunge_mm_per_min",
            "spindle_rpm",
        )  # fmt: skip
        if self.tabs < 0:
            raise PassValueError(name="tabs", value=self.tabs, allowed=Phrase("0 or more"))
        if not self.through_mm >= 0:
            raise PassValueError(name="through_mm", value=self.through_mm, allowed=Phrase("0 or more"))

    def tab_centres_mm(self, length_mm: float) -> tuple[float, ...]:
        """Return the places of the tabs along a closed path of this length: evenly spaced, none at its start."""
        return tuple(length_mm * (k + 0.5) / self.tabs for k in range(self.tabs))

    def tab_foot_mm(self) -> float:
        """Return the distance of the cutter's axis from the middle of a tab to the foot of its ramp."""
        return self.tab_width_mm / 2 + self.radius_mm + (self.tab_height_mm + self.through_mm) / FLANK_SLOPE


@dataclass(frozen=True, slots=True, kw_only=True)
class WitnessCut:
    """Rows of a ball, each at one height, side by side in the margin: the witness marks of a finish.

    along             : axis along which the rows follow one another; each runs along the other one
    places_mm         : of the rows' axes on it, rising; tips_mm: heights of the tip in each
    across_mm         : from the outer end of a row, near the block's edge, to the end near the lens
    """

    radius_mm: float
    along: Literal["x", "y"]
    places_mm: tuple[float, ...]
    tips_mm: tuple[float, ...]
    across_mm: tuple[float, float]
    step_down_mm: float
    feed_mm_per_min: float
    plunge_mm_per_min: float
    spindle_rpm: float

    def __post_init__(self) -> None:
        _require_positive(self, "radius_mm", "step_down_mm", "feed_mm_per_min", "plunge_mm_per_min", "spindle_rpm")
        if not -self.radius_mm < min(self.tips_mm) <= max(self.tips_mm) < 0:
            raise PassValueError(name="tips_mm", value=max(self.tips_mm), allowed=Phrase("under Z0, above one radius"))

    @property
    def lowest_mm(self) -> float:
        return min(self.tips_mm)

    @property
    def box_mm(self) -> tuple[float, float, float, float]:
        """Return left, right, front and back of the area that the ball cuts in the block's top."""
        depth_mm = -self.lowest_mm
        beside_mm = sqrt(depth_mm * (2 * self.radius_mm - depth_mm))
        along = (self.places_mm[0] - beside_mm, self.places_mm[-1] + beside_mm)
        across = (min(self.across_mm) - beside_mm, max(self.across_mm) + beside_mm)
        return (*along, *across) if self.along == "x" else (*across, *along)


def _require_positive(spec: object, *names: str) -> None:
    for name in names:
        if not 0 < (value := getattr(spec, name)) < float("inf"):
            raise PassValueError(name=name, value=value, allowed=Phrase("above {least:g}", least=0))
