"""The state that a controller keeps between two blocks of a program, and the effect of one block on the mill.

The modal state is kept in words, as plain data, and as the vector of floats that language.execute_block works on. A
step also says how far a point is from it.
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
    """Defaults are those of a freshly started GRBL before the program sets anything, but without a motion.

    motion            : "G0" "G1" "G2" "G3" "G38.2".."G38.5" "G80" (none: coordinates alone are refused)
    plane, units, distance, feed_mode, wcs : "G17" "G21" "G90" "G94" "G54" and their siblings
    feed_mm_per_min   : None until one is given, and always None in G93
    spindle           : "M3" clockwise, "M4" the other way, "M5" off
    coolant           : "M9" off, "M7" mist, "M8" flood, "M7 M8" both
    tool              : last T word; None before one
    tool_length_mm    : offset by G43.1 (0 for none)
    position_mm       : of the tool in the work frame of the program; None for an axis the program has not given yet, or
                        has sent to a place only the controller knows (G28, G30, G53, G38, another work offset)
    shifted           : the program itself moved its frame (G10, G92, G43.1), or took a tool's length from the control's
                        table
    stated            : which of "units" and "distance" the program has set itself
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
        """Return the words that bring a controller into this state, except motion and position: "G21 G90 G17 ..."."""
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
    vector[language.SHIFTED] = language.MOVED if state.shifted else 0.0
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


@dataclass(slots=True)
class Step:
    """One block carried out. Positions are in the work frame of the program, mm.

    kind          : "rapid", "feed", "arc", "dwell" or "none" (no motion: modes, spindle, offsets)
    start_mm, end_mm : None for an axis whose place the program does not give (not yet, G28, G53, after G38)
    feed_mm_per_min  : of cutting moves; None for rapids
    length_mm     : of the path, as far as it is known
    pause_s       : of a dwell
    waits_for_empty_buffer : the controller may answer only when all motion before it is done (G4, M3, S, M2, G10 ...);
                      where the word changes nothing it answers at once, so its answer proves nothing
    withholds_ok  : M0, M1: no answer until cycle start
    ends_program  : M2, M30
    writes_settings : G10, G28.1, G30.1: the controller writes its EEPROM; to be sent alone, never counted ahead
    probes        : G38: ends anywhere between start and end
    machine_mm    : of G53: where it goes, in machine coordinates; None for an axis that it leaves
    goes_home     : G28, G30: goes on to a place that only the controller knows
    """

    kind: str
    start_mm: Position = UNKNOWN
    end_mm: Position = UNKNOWN
    feed_mm_per_min: float | None = None
    length_mm: float = 0.0
    pause_s: float = 0.0
    waits_for_empty_buffer: bool = False
    withholds_ok: bool = False
    ends_program: bool = False
    writes_settings: bool = False
    probes: bool = False
    arc: Arc | None = None
    machine_mm: Position | None = None
    goes_home: bool = False

    @property
    def moves(self) -> bool:
        return self.kind in ("rapid", "feed", "arc")

    def distance_mm(self, point_mm: tuple[float, float, float]) -> float:
        """Return how far a point (work frame) is from this move. Axes whose place is not known do not count."""
        if self.arc is not None:
            return self.arc.distance_mm(point_mm, self.start_mm, self.end_mm)
        return math.sqrt(self._nearest(point_mm)[1])

    def fraction(self, point_mm: tuple[float, float, float]) -> float:
        """Return how far along this move (0 start, 1 end) its place nearest to the point is."""
        if self.arc is not None:
            return self.arc.fraction(point_mm)
        return self._nearest(point_mm)[0]

    def _nearest(self, point_mm: tuple[float, float, float]) -> tuple[float, float]:
        """Return fraction and squared distance of the straight move."""
        dot = length2 = 0.0
        known = []
        for start, end, point in zip(self.start_mm, self.end_mm, point_mm, strict=True):
            if start is None or end is None:
                continue
            along, offset = end - start, point - start
            known.append((along, offset))
            dot += along * offset
            length2 += along * along
        share = min(1.0, max(0.0, dot / length2)) if length2 > 0 else 1.0
        return share, sum((offset - share * along) ** 2 for along, offset in known)


@dataclass(slots=True)  # not frozen, unlike Step: one is made for every arc that is sent, in a tenth of its time
class Arc:
    """Circle or helix about an axis. u, v, w : axes 0..2 with w the helix axis; sweep > 0 turns from u toward v."""

    u: int
    v: int
    w: int
    centre_u_mm: float
    centre_v_mm: float
    radius_mm: float
    angle_rad: float
    sweep_rad: float

    def fraction(self, point_mm: tuple[float, float, float]) -> float:
        turned = math.atan2(point_mm[self.v] - self.centre_v_mm, point_mm[self.u] - self.centre_u_mm) - self.angle_rad
        full = 2 * math.pi
        along = (turned if self.sweep_rad > 0 else -turned) % full
        sweep = abs(self.sweep_rad)
        if along <= sweep:
            return along / sweep
        return 1.0 if along - sweep < full - along else 0.0

    def distance_mm(self, point_mm: tuple[float, float, float], start_mm: Position, end_mm: Position) -> float:
        """Return the distance to the nearest of: the place at the point's own angle, the start, the end."""
        shares = {self.fraction(point_mm), 0.0, 1.0}
        return min(self._distance_at(share, point_mm, start_mm, end_mm) for share in shares)

    def _distance_at(self, share: float, point_mm: tuple[float, float, float], start: Position, end: Position) -> float:
        angle = self.angle_rad + share * self.sweep_rad
        du = self.centre_u_mm + self.radius_mm * math.cos(angle) - point_mm[self.u]
        dv = self.centre_v_mm + self.radius_mm * math.sin(angle) - point_mm[self.v]
        low, high = start[self.w], end[self.w]
        dw = 0.0 if low is None or high is None else low + share * (high - low) - point_mm[self.w]
        return math.sqrt(du * du + dv * dv + dw * dw)
