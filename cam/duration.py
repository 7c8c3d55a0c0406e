"""How long a program takes on a mill: the look-ahead planner of a GRBL-like controller, not length over feed.

Each straight block gets a nominal speed, an acceleration along its direction (the weakest axis decides, as in GRBL)
and a greatest entry speed from the junction deviation. The planner sees `planner_blocks` - 1 blocks and must be able to
stop at the end of what it sees, so the entry speed of a block is the least of: its own limit; the speed that the block
before can reach; the speed from which every later limit in the window, and the stop at its end, can still be met.
Blocks cannot start before they have arrived over the line (each line takes the longer of its bytes on the wire and the
parser's time), and a line waits while the buffer is full. While the line starves the planner the window shrinks as
well; this is not modelled, because the line rate itself then sets the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

from optics.heightfield import Array

_STRAIGHT = 0.999999  # GRBL 1.1 treats corners this straight as no corner, and reversals this sharp as full stops
# Columns of a planned block.
_LENGTH, _NOMINAL2, _ACCEL, _ENTRY2, _PAUSE, _LINES, _BYTES = range(7)
_COLUMNS = 7
_NOTHING = np.empty(0)


class Moves(Protocol):
    """The part of a batch that the model uses: a cam.reading.gcode.MoveBatch, or anything with the same fields.

    A batch may also have `sent_bytes` (n,): bytes on the wire from the program's start up to and including the line.
    """

    @property
    def points_mm(self) -> Array: ...
    @property
    def is_rapid(self) -> np.ndarray: ...
    @property
    def feed_mm_per_min(self) -> Array: ...
    @property
    def line(self) -> np.ndarray: ...
    @property
    def pause_s(self) -> Array: ...
    def __len__(self) -> int: ...


class Mill(Protocol):
    """The motion of a mill as its profile states it. planner_blocks: without the slot that is always free, as `$I`
    reports
    """

    @property
    def max_rate_mm_per_min(self) -> tuple[float, float, float]: ...
    @property
    def acceleration_mm_per_s2(self) -> tuple[float, float, float]: ...
    @property
    def junction_deviation_mm(self) -> float: ...
    @property
    def planner_blocks(self) -> int: ...
    @property
    def lines_per_s(self) -> float: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Kinematics:
    """Limits of a mill's axes and its controller.

    planner_blocks : slots of the look-ahead buffer, one of which is always free (GRBL 1.1: 16)
    lines_per_s    : lines the link and the parser deliver
    bytes_per_s    : bytes the wire carries, for batches that say how many they are; None: only lines count
    """

    max_rate_mm_per_min: tuple[float, float, float]
    acceleration_mm_per_s2: tuple[float, float, float]
    junction_deviation_mm: float
    planner_blocks: int
    lines_per_s: float
    bytes_per_s: float | None = None

    @classmethod
    def of(cls, mill: Mill, *, bytes_per_s: float | None = None) -> Kinematics:
        return cls(
            max_rate_mm_per_min=mill.max_rate_mm_per_min,
            acceleration_mm_per_s2=mill.acceleration_mm_per_s2,
            junction_deviation_mm=mill.junction_deviation_mm,
            planner_blocks=mill.planner_blocks + 1,
            lines_per_s=mill.lines_per_s,
            bytes_per_s=bytes_per_s,
        )

    def __post_init__(self) -> None:
        limits = (*self.max_rate_mm_per_min, *self.acceleration_mm_per_s2, self.junction_deviation_mm, self.lines_per_s)
        if not all(math.isfinite(v) and v > 0 for v in limits) or len(limits) != 8:
            raise ValueError(f"rates, accelerations, junction deviation and line rate must be above 0: {self}")
        if self.planner_blocks < 2:
            raise ValueError(f"planner_blocks = {self.planner_blocks} is not allowed: at least 2")
        if self.bytes_per_s is not None and not self.bytes_per_s > 0:
            raise ValueError(f"bytes_per_s = {self.bytes_per_s} is not allowed: above 0, or None")


@njit(cache=True, nogil=True)
def _plan(points, rapid, feed, line, sent, pause, max_rate, max_accel, deviation, carry, blocks):  # type: ignore[no-untyped-def]
    """Plan moves -> blocks (n, 7). carry: unit vector (3), nominal speed^2, last line and bytes sent of the block
    before.

    sent : cumulative bytes on the wire by move, or empty
    """
    n = 0
    unit = np.zeros(3)
    for k in range(line.size):
        lines = line[k] - carry[4]
        carry[4] = line[k]
        arrived = 0.0
        if sent.size > 0:
            arrived = sent[k] - carry[5]
            carry[5] = sent[k]
        if pause[k] >= 0.0:
            for c in range(_COLUMNS):
                blocks[n, c] = 0.0
            blocks[n, _ACCEL] = 1.0
            blocks[n, _PAUSE] = pause[k]
            blocks[n, _LINES] = lines
            blocks[n, _BYTES] = arrived
            carry[3] = 0.0  # the buffer empties: the next block starts from rest
            n += 1
            continue
        length2 = 0.0
        for d in range(3):
            unit[d] = points[k + 1, d] - points[k, d]
            length2 += unit[d] * unit[d]
        if length2 == 0.0:
            continue
        length = math.sqrt(length2)
        rate = 1e30
        accel = 1e30
        cos = 0.0
        for d in range(3):
            unit[d] /= length
            size = abs(unit[d])
            if size > 0.0:
                rate = min(rate, max_rate[d] / size)
                accel = min(accel, max_accel[d] / size)
            cos -= carry[d] * unit[d]
        speed = rate if rapid[k] else min(rate, feed[k] / 60.0)
        nominal2 = speed * speed
        entry2 = 0.0
        if carry[3] > 0.0 and cos < _STRAIGHT:
            entry2 = min(nominal2, carry[3])
            if cos > -_STRAIGHT:
                norm2 = 0.0
                for d in range(3):
                    norm2 += (unit[d] - carry[d]) ** 2
                norm = math.sqrt(norm2)
                corner_accel = 1e30
                for d in range(3):
                    size = abs(unit[d] - carry[d]) / norm
                    if size > 0.0:
                        corner_accel = min(corner_accel, max_accel[d] / size)
                sin_half = math.sqrt(0.5 * (1.0 - cos))
                entry2 = min(entry2, corner_accel * deviation * sin_half / (1.0 - sin_half))
        for d in range(3):
            carry[d] = unit[d]
        carry[3] = nominal2
        blocks[n, _LENGTH] = length
        blocks[n, _NOMINAL2] = nominal2
        blocks[n, _ACCEL] = accel
        blocks[n, _ENTRY2] = entry2
        blocks[n, _PAUSE] = 0.0
        blocks[n, _LINES] = lines
        blocks[n, _BYTES] = arrived
        n += 1
    return n


@njit(cache=True, nogil=True)
def _entry2(blocks, k, window):  # type: ignore[no-untyped-def]
    """Return the greatest squared entry speed of block k that still allows every limit in its window, and a stop at its
    end.
    """
    best = 1e30
    gained = 0.0
    for j in range(k, min(k + window, len(blocks))):
        best = min(best, blocks[j, _ENTRY2] + gained)
        gained += 2.0 * blocks[j, _ACCEL] * blocks[j, _LENGTH]
        if gained >= best:
            return best
    return min(best, gained)


@njit(cache=True, nogil=True)
def _block_s(length, entry2, exit2, nominal2, accel):  # type: ignore[no-untyped-def]
    """Time of one trapezoid or triangle; the speeds are squared."""
    v0 = math.sqrt(entry2)
    v1 = math.sqrt(exit2)
    peak2 = 0.5 * (entry2 + exit2) + accel * length
    if peak2 <= nominal2:
        return (2.0 * math.sqrt(max(peak2, max(entry2, exit2))) - v0 - v1) / accel
    v = math.sqrt(nominal2)
    ramps = (2.0 * nominal2 - entry2 - exit2) / (2.0 * accel)
    return (2.0 * v - v0 - v1) / accel + (length - ramps) / v


@njit(cache=True, nogil=True)
def _run(blocks, count, window, line_s, byte_s, clock, ends, done):  # type: ignore[no-untyped-def]
    """Execute the first `count` blocks. clock: entry speed^2, time of the last end, last arrival, blocks done, time
    stood for lines that had not arrived.

    ends (window,) : ring of the ends of the last blocks; a line is taken when the block `window` before it is done
    done (count,)  : gets the end of each
    """
    if count > 0:
        entry2 = min(clock[0], _entry2(blocks, 0, window))
        for k in range(count):
            length = blocks[k, _LENGTH]
            reach2 = entry2 + 2.0 * blocks[k, _ACCEL] * length
            exit2 = min(reach2, _entry2(blocks, k + 1, window)) if k + 1 < len(blocks) else 0.0
            took = blocks[k, _PAUSE]
            if length > 0.0:
                took = _block_s(length, entry2, exit2, blocks[k, _NOMINAL2], blocks[k, _ACCEL])
            slot = int(clock[3]) % window
            on_the_way_s = max(blocks[k, _LINES] * line_s, blocks[k, _BYTES] * byte_s)
            clock[2] = max(clock[2] + on_the_way_s, ends[slot])
            clock[4] += max(0.0, clock[2] - clock[1])
            clock[1] = max(clock[1], clock[2]) + took
            ends[slot] = done[k] = clock[1]
            clock[3] += 1.0
            entry2 = exit2
        clock[0] = entry2


class DurationModel:
    """Time of a program, fed batch by batch; `seconds` may be asked at any time."""

    def __init__(self, kinematics: Kinematics) -> None:
        self._window = kinematics.planner_blocks - 1
        self._rate = np.array(kinematics.max_rate_mm_per_min) / 60.0
        self._accel = np.array(kinematics.acceleration_mm_per_s2, dtype=np.float64)
        self._deviation = kinematics.junction_deviation_mm
        self._line_s = 1.0 / kinematics.lines_per_s
        self._byte_s = 1.0 / kinematics.bytes_per_s if kinematics.bytes_per_s else 0.0
        self._carry = np.zeros(6)
        self._clock = np.zeros(5)
        self._ends = np.zeros(self._window)
        self._waiting = np.empty((0, _COLUMNS))

    def add(self, batch: Moves) -> None:
        self.add_batch(batch)

    def add_batch(self, batch: Moves) -> Array:
        """Add a batch; return the ends [s] of the blocks whose times are now certain, each once: see `is_block`."""
        blocks = np.empty((len(self._waiting) + len(batch), _COLUMNS))
        sent = getattr(batch, "sent_bytes", _NOTHING)
        blocks[: len(self._waiting)] = self._waiting
        n = len(self._waiting) + _plan(
            *(batch.points_mm, batch.is_rapid, batch.feed_mm_per_min, batch.line, sent, batch.pause_s),
            *(self._rate, self._accel, self._deviation, self._carry, blocks[len(self._waiting) :]),
        )
        ready = max(0, n - self._window - 1)
        done = np.empty(ready)
        _run(blocks[:n], ready, self._window, self._line_s, self._byte_s, self._clock, self._ends, done)
        self._waiting = blocks[ready:n].copy()
        return done

    @property
    def starved_s(self) -> float:
        """The part of that time in which the mill waits because the link has not delivered the next line."""
        return float(self._to_the_end()[0][4])

    def list_waiting_s(self) -> Array:
        """Return the ends of the blocks that `add_batch` has not returned yet, if the program ended here."""
        return self._to_the_end()[1]

    @property
    def seconds(self) -> float:
        """Time until the mill stands still if the program ended here."""
        return float(self._to_the_end()[0][1])

    def _to_the_end(self) -> tuple[Array, Array]:
        clock, waiting = self._clock.copy(), self._waiting
        done = np.empty(len(waiting))
        _run(waiting, len(waiting), self._window, self._line_s, self._byte_s, clock, self._ends.copy(), done)
        return clock, done


def is_block(batch: Moves) -> np.ndarray:
    """Return (n,) whether each move of a batch makes a block in the planner: all but those of zero length."""
    return (np.diff(batch.points_mm, axis=0) != 0.0).any(axis=1) | (batch.pause_s >= 0.0)
