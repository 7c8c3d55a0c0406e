"""What a controller remembers between two blocks of a program: the modal state, in words, as plain data, and as the
vector of floats that language.execute_block works on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

from machines.gcode import language

Position = tuple[float | None, float | None, float | None]
Spindle = Literal["M3", "M4", "M5"]

UNKNOWN: Position = (None, None, None)
_COOLANT = ("M9", "M7", "M8", "M7 M8")
_STATED = (("units", language.STATED_UNITS), ("distance", language.STATED_DISTANCE))
_SPINDLES: dict[int, Spindle] = {3: "M3", 4: "M4", 5: "M5"}


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


def vector_of(state: ModalState) -> list[float]:
    vector = [0.0] * language.STATE_SIZE
    for axis, value in enumerate(state.position_mm):
        vector[axis] = math.nan if value is None else value
    vector[language.FEED] = math.nan if state.feed_mm_per_min is None else state.feed_mm_per_min
    vector[language.SPEED] = state.spindle_rpm
    vector[language.MM] = 25.4 if state.units == "G20" else 1.0
    vector[language.ABSOLUTE] = float(state.distance == "G90")
    vector[language.MOTION] = float(round(float(state.motion[1:]) * 10))
    vector[language.PLANE] = float(state.plane[1:])
    vector[language.FEED_MODE] = float(state.feed_mode[1:])
    vector[language.WCS] = float(state.wcs[1:])
    vector[language.SPINDLE] = float(state.spindle[1:])
    vector[language.COOLANT] = float(_COOLANT.index(state.coolant))
    vector[language.TOOL] = -1.0 if state.tool is None else float(state.tool)
    vector[language.TLO] = state.tool_length_mm
    vector[language.SHIFTED] = float(state.shifted)
    vector[language.ENDED] = float(state.ended)
    vector[language.STATED] = float(sum(bit for name, bit in _STATED if name in state.stated))
    return vector


def state_of(vector: Sequence[float]) -> ModalState:
    stated = int(vector[language.STATED])
    return ModalState(
        motion=f"G{vector[language.MOTION] / 10:g}",
        plane=f"G{vector[language.PLANE]:g}",
        units="G20" if vector[language.MM] == 25.4 else "G21",
        distance="G90" if vector[language.ABSOLUTE] else "G91",
        feed_mode=f"G{vector[language.FEED_MODE]:g}",
        wcs=f"G{vector[language.WCS]:g}",
        feed_mm_per_min=_or_none(vector[language.FEED]),
        spindle=_SPINDLES[int(vector[language.SPINDLE])],
        spindle_rpm=float(vector[language.SPEED]),
        coolant=_COOLANT[int(vector[language.COOLANT])],
        tool=None if vector[language.TOOL] < 0 else int(vector[language.TOOL]),
        tool_length_mm=float(vector[language.TLO]),
        position_mm=(_or_none(vector[0]), _or_none(vector[1]), _or_none(vector[2])),
        shifted=bool(vector[language.SHIFTED]),
        stated=frozenset(name for name, bit in _STATED if stated & bit),
        ended=bool(int(vector[language.ENDED]) & language.M2_READ),
    )


def _or_none(value: float) -> float | None:
    return float(value) if value == value else None
