"""What a controller remembers between two blocks of a program: the modal state, in words and as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

Position = tuple[float | None, float | None, float | None]
Spindle = Literal["M3", "M4", "M5"]

UNKNOWN: Position = (None, None, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModalState:
    """Defaults are those of a program that has said nothing yet on a freshly started GRBL, but without a motion.

    motion            : "G0" "G1" "G2" "G3" "G38.2".."G38.5" "G80" (none: coordinates alone are refused)
    plane, units, distance, feed_mode, wcs : "G17" "G21" "G90" "G94" "G54" and their siblings
    feed_mm_per_min   : None until one is given, and always None in G93
    spindle           : "M3" clockwise, "M4" the other way, "M5" off
    coolant           : "M9" off, "M7" mist, "M8" flood, "M7 M8" both
    tool              : last T word; None before one
    tool_length_mm    : offset by G43.1 (0 for none)
    position_mm       : of the tool in the work frame of the program; None for an axis the program has not given yet, or
                        has sent to a place only the controller knows (G28, G30, G53, G38, another work offset)
    shifted           : the program itself moved its frame (G10, G92, G43.1)
    stated            : which of "units" and "distance" the program has said itself
    ended             : M2 or M30 was read
    """

    motion: str = "G80"
    plane: str = "G17"
    units: str = "G21"
    distance: str = "G90"
    feed_mode: str = "G94"
    wcs: str = "G54"
    feed_mm_per_min: float | None = None
    spindle: Spindle = "M5"
    spindle_rpm: float = 0.0
    coolant: str = "M9"
    tool: int | None = None
    tool_length_mm: float = 0.0
    position_mm: Position = UNKNOWN
    shifted: bool = False
    stated: frozenset[str] = frozenset()
    ended: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON: only what differs from the defaults."""
        return {
            name: sorted(value) if isinstance(value, frozenset) else list(value) if isinstance(value, tuple) else value
            for name in _NAMES
            if (value := getattr(self, name)) != getattr(_DEFAULT, name)
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> ModalState:
        values = dict(data)
        if "position_mm" in values:
            x, y, z = values["position_mm"]
            values["position_mm"] = (x, y, z)
        if "stated" in values:
            values["stated"] = frozenset(values["stated"])
        return ModalState(**values)

    def words(self, *, with_motion: bool = True) -> str:
        """Return the blocks' words that bring a controller into this state, motion and position aside: "G21 G90 G17
        ...".
        """
        modes = [self.units, self.distance, self.plane, self.feed_mode, self.wcs]
        if with_motion and self.motion in ("G0", "G1"):
            modes.append(self.motion)
        return " ".join(modes)


_DEFAULT = ModalState()
_NAMES = tuple(field.name for field in fields(ModalState))
