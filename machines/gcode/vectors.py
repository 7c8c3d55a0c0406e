"""The modal state as the vector of floats that language.block works on, and back."""

from __future__ import annotations

import math
from collections.abc import Sequence

from machines.gcode import language
from machines.gcode.modal import ModalState, Position, Spindle

_COOLANT = ("M9", "M7", "M8", "M7 M8")
_STATED = (("units", language.STATED_UNITS), ("distance", language.STATED_DISTANCE))
_SPINDLES: dict[int, Spindle] = {3: "M3", 4: "M4", 5: "M5"}


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
        feed_mm_per_min=_told(vector[language.FEED]),
        spindle=_SPINDLES[int(vector[language.SPINDLE])],
        spindle_rpm=float(vector[language.SPEED]),
        coolant=_COOLANT[int(vector[language.COOLANT])],
        tool=None if vector[language.TOOL] < 0 else int(vector[language.TOOL]),
        tool_length_mm=float(vector[language.TLO]),
        position_mm=_position(vector),
        shifted=bool(vector[language.SHIFTED]),
        stated=frozenset(name for name, bit in _STATED if stated & bit),
        ended=bool(int(vector[language.ENDED]) & language.M2_READ),
    )


def _told(value: float) -> float | None:
    return float(value) if value == value else None


def _position(vector: Sequence[float]) -> Position:
    return (_told(vector[0]), _told(vector[1]), _told(vector[2]))
