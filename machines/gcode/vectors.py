"""The modal state as the vector of floats that language.block works on, and back."""

from __future__ import annotations

import math
from collections.abc import Sequence

from machines.gcode import language as at
from machines.gcode.modal import ModalState, Position, Spindle

_COOLANT = ("M9", "M7", "M8", "M7 M8")
_SPINDLES: dict[int, Spindle] = {3: "M3", 4: "M4", 5: "M5"}


def vector_of(state: ModalState) -> list[float]:
    vector = [0.0] * at.STATE_SIZE
    for axis, value in enumerate(state.position_mm):
        vector[axis] = math.nan if value is None else value
    vector[at.FEED] = math.nan if state.feed_mm_per_min is None else state.feed_mm_per_min
    vector[at.SPEED] = state.spindle_rpm
    vector[at.MM] = 25.4 if state.units == "G20" else 1.0
    vector[at.ABSOLUTE] = float(state.distance == "G90")
    vector[at.MOTION] = float(round(float(state.motion[1:]) * 10))
    vector[at.PLANE] = float(state.plane[1:])
    vector[at.FEED_MODE] = float(state.feed_mode[1:])
    vector[at.WCS] = float(state.wcs[1:])
    vector[at.SPINDLE] = float(state.spindle[1:])
    vector[at.COOLANT] = float(_COOLANT.index(state.coolant))
    vector[at.TOOL] = -1.0 if state.tool is None else float(state.tool)
    vector[at.TLO] = state.tool_length_mm
    vector[at.SHIFTED] = float(state.shifted)
    vector[at.ENDED] = float(state.ended)
    vector[at.STATED] = at.STATED_UNITS * ("units" in state.stated) + at.STATED_DISTANCE * ("distance" in state.stated)
    return vector


def state_of(vector: Sequence[float]) -> ModalState:
    stated = int(vector[at.STATED])
    names = (("units", at.STATED_UNITS), ("distance", at.STATED_DISTANCE))
    return ModalState(
        motion=f"G{vector[at.MOTION] / 10:g}",
        plane=f"G{vector[at.PLANE]:g}",
        units="G20" if vector[at.MM] == 25.4 else "G21",
        distance="G90" if vector[at.ABSOLUTE] else "G91",
        feed_mode=f"G{vector[at.FEED_MODE]:g}",
        wcs=f"G{vector[at.WCS]:g}",
        feed_mm_per_min=_told(vector[at.FEED]),
        spindle=_SPINDLES[int(vector[at.SPINDLE])],
        spindle_rpm=float(vector[at.SPEED]),
        coolant=_COOLANT[int(vector[at.COOLANT])],
        tool=None if vector[at.TOOL] < 0 else int(vector[at.TOOL]),
        tool_length_mm=float(vector[at.TLO]),
        position_mm=_position(vector),
        shifted=bool(vector[at.SHIFTED]),
        stated=frozenset(name for name, bit in names if stated & bit),
        ended=bool(int(vector[at.ENDED]) & at.M2_READ),
    )


def _told(value: float) -> float | None:
    return float(value) if value == value else None


def _position(vector: Sequence[float]) -> Position:
    return (_told(vector[0]), _told(vector[1]), _told(vector[2]))
