"""What one block makes the mill do, and how far a point is from that."""

from __future__ import annotations

import math
from dataclasses import dataclass

from machines.gcode.modal import UNKNOWN, Position


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


@dataclass(slots=True)  # not frozen, as Step: one is made for every arc that is sent, in a tenth of its time
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
