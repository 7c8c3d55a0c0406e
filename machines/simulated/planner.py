"""The look-ahead buffer: blocks with entry speeds, limited by corners, axes, and the stop at the end of what is known.

Facts after GRBL 1.1 (docs and behaviour): the weakest axis sets rate and acceleration along a block, the corner speed
comes from the junction deviation, a block added to an empty buffer starts from rest. mm and s throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import sqrt

MIN_SPEED = 1.0 / 60.0  # mm/s, the slowest GRBL moves
_STRAIGHT = 0.999999
_HUGE = 1e30
_NOTHING = 1e-18  # mm2; shorter than any step: no block is made


class PlannedBlock:
    """One straight move in machine coordinates. `remaining` is what has not yet gone into the segment buffer."""

    __slots__ = (
        "accel", "entry2", "feed", "gain", "junction2", "kind", "line", "max_entry2", "nominal", "programmed", "rapid",
        "rate_limit", "remaining", "sx", "sy", "sz", "tx", "ty", "tz", "ux", "uy", "uz",
    )  # fmt: skip

    tx: float
    ty: float
    tz: float
    ux: float
    uy: float
    uz: float
    sx: float  # start of the part that is not recorded yet
    sy: float
    sz: float
    remaining: float
    accel: float
    gain: float  # 2 accel remaining: speed squared gained or lost over it
    entry2: float
    max_entry2: float
    junction2: float
    rate_limit: float
    programmed: float
    nominal: float
    rapid: bool
    feed: float
    kind: str
    line: int


class Planner:
    """Blocks not yet wholly in the segment buffer, oldest first. `capacity` is usable slots."""

    def __init__(self, capacity: int, settings: Mapping[int, float], tail_changed: Callable[[], None]) -> None:
        self.capacity = capacity
        self.blocks: list[PlannedBlock] = []
        self.feed_override = 1.0
        self.rapid_override = 1.0
        self.x = self.y = self.z = 0.0  # where the last planned block ends, machine mm
        self._planned = 0
        self._ux = self._uy = self._uz = 0.0
        self._previous_nominal = 0.0
        self._tail_changed = tail_changed
        self.use_settings(settings)

    def use_settings(self, settings: Mapping[int, float]) -> None:
        self._rx, self._ry, self._rz = (settings[i] / 60.0 for i in (110, 111, 112))
        self._ax, self._ay, self._az = (settings[i] for i in (120, 121, 122))
        self._deviation = settings[11]

    def clear(self) -> None:
        self.blocks.clear()
        self._planned = 0

    def add(
        self, x: float, y: float, z: float, speed: float, rapid: bool, *, feed: float, line: int, kind: str = "program"
    ) -> PlannedBlock | None:
        """Plan a line to (x, y, z) at `speed` mm/s (rapids: as fast as the axes allow). None: nothing to move."""
        ux, uy, uz = x - self.x, y - self.y, z - self.z
        length2 = ux * ux + uy * uy + uz * uz
        if length2 < _NOTHING:
            return None
        length = sqrt(length2)
        ux /= length
        uy /= length
        uz /= length
        rate = accel = _HUGE
        if ux:
            size = ux if ux > 0.0 else -ux
            rate = self._rx / size
            accel = self._ax / size
        if uy:
            size = uy if uy > 0.0 else -uy
            if (limit := self._ry / size) < rate:
                rate = limit
            if (limit := self._ay / size) < accel:
                accel = limit
        if uz:
            size = uz if uz > 0.0 else -uz
            if (limit := self._rz / size) < rate:
                rate = limit
            if (limit := self._az / size) < accel:
                accel = limit
        b = PlannedBlock()
        b.sx, b.sy, b.sz, b.tx, b.ty, b.tz = self.x, self.y, self.z, x, y, z
        b.ux, b.uy, b.uz = ux, uy, uz
        b.remaining, b.accel, b.gain, b.rate_limit = length, accel, 2.0 * accel * length, rate
        b.rapid, b.feed, b.kind, b.line = rapid, feed, kind, line
        b.programmed = rate if rapid else speed
        blocks = self.blocks
        b.junction2 = self._corner(ux, uy, uz) if blocks else 0.0
        b.entry2 = 0.0
        self._set_nominal(b, self._previous_nominal)
        self._previous_nominal = b.nominal
        self._ux, self._uy, self._uz = ux, uy, uz
        self.x, self.y, self.z = x, y, z
        blocks.append(b)
        if len(blocks) > 1:
            self._recalculate()
        return b

    def _corner(self, ux: float, uy: float, uz: float) -> float:
        """Return the greatest speed squared around the corner between the last block and this direction."""
        px, py, pz = self._ux, self._uy, self._uz
        cos = -(px * ux + py * uy + pz * uz)
        if cos > _STRAIGHT:
            return 0.0
        if cos < -_STRAIGHT:
            return _HUGE
        jx, jy, jz = abs(ux - px), abs(uy - py), abs(uz - pz)
        norm = sqrt(jx * jx + jy * jy + jz * jz)
        accel = _HUGE
        if jx:
            accel = self._ax * norm / jx
        if jy and (limit := self._ay * norm / jy) < accel:
            accel = limit
        if jz and (limit := self._az * norm / jz) < accel:
            accel = limit
        sin_half = sqrt(0.5 * (1.0 - cos))
        return accel * self._deviation * sin_half / (1.0 - sin_half)

    def _set_nominal(self, b: PlannedBlock, previous_nominal: float) -> None:
        """Set the speed with overrides, and the entry speed that it allows."""
        if b.rapid:
            nominal = b.programmed * self.rapid_override
        else:
            nominal = b.programmed * self.feed_override
            if nominal > b.rate_limit:
                nominal = b.rate_limit
        if nominal < MIN_SPEED:
            nominal = MIN_SPEED
        b.nominal = nominal
        if nominal > previous_nominal:
            nominal = previous_nominal
        nominal *= nominal
        b.max_entry2 = nominal if nominal < b.junction2 else b.junction2

    def _recalculate(self, *, whole: bool = False) -> None:
        """Compute entry speeds: backward so that every block can stop or slow down in time, then forward for
        acceleration.

        The backward pass ends at the first block it does not change: all before it were found from the same figures.
        """
        blocks = self.blocks
        last = len(blocks) - 1
        planned = self._planned
        if last <= planned:
            return
        if planned == 0:
            self._tail_changed()
        b = blocks[last]
        entry2 = b.gain if b.gain < b.max_entry2 else b.max_entry2
        b.entry2 = entry2
        k = last - 1
        while k > planned:
            b = blocks[k]
            reach2 = entry2 + b.gain
            entry2 = reach2 if reach2 < b.max_entry2 else b.max_entry2
            if entry2 == b.entry2 and not whole:
                break
            b.entry2 = entry2
            k -= 1
        b = blocks[k]
        while k < last:
            k += 1
            after = blocks[k]
            if b.entry2 < after.entry2:
                reach2 = b.entry2 + b.gain
                if reach2 < after.entry2:
                    after.entry2 = reach2
                    planned = k
            if after.entry2 == after.max_entry2:
                planned = k
            b = after
        self._planned = planned

    def discard(self) -> None:
        """Drop the oldest block: it has gone into the segment buffer."""
        del self.blocks[0]
        if self._planned:
            self._planned -= 1

    def replan(self) -> None:
        """Recompute all entry speeds from the present state of the oldest block (after a hold)."""
        self._tail_changed()
        self._planned = 0
        self._recalculate(whole=True)

    def use_overrides(self) -> None:
        previous = _HUGE
        for b in self.blocks:
            self._set_nominal(b, previous)
            previous = b.nominal
        if self.blocks:
            self._previous_nominal = previous
            self.replan()
