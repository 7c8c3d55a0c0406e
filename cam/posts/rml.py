"""RML-1 of Roland's mills: straight moves in whole hundredths of a millimetre at a speed in mm/s, ended by `;`.

There is no rapid, no comment and no arc: rapids run at the greatest speed, and cutting stays below it. A hundredth is a
thousand times the height of a scallop; what that does to the light is for the report to say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from cam.posts.digits import Digits


@dataclass(frozen=True, slots=True, kw_only=True)
class RmlPost:
    """RML-1 as the MDX-40 branch speaks it: V in tenths of a mm/s up to 50, !RC in rpm, W in milliseconds. It has words
    neither for coolant nor for corners."""

    name: str = "rml-1"
    suffix: str = ".rml"
    unit_mm: float = 0.01
    line_end: str = "\r\n"
    coolant: Mapping[str, str] = field(default_factory=dict)
    blends: bool = False
    offsets: bool = False
    high_precision: bool = False
    traces_with_spindle_on: bool = False

    @property
    def digits(self) -> Digits:
        return Digits(xy_mm=self.unit_mm, z_mm=self.unit_mm)


RML = RmlPost()
