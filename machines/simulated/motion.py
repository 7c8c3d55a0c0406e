"""Executes planned blocks: the segment buffer, and the axes that execute one segment after the other.

The buffer holds the planner's oldest blocks, cut into pieces of at most 10 ms, each with its speeds. A block is freed
in the planner when its last piece enters this buffer, not when it is executed: with short blocks, as many blocks as
there are segments are still to be executed. A hold brakes only after the segments that are already in this buffer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from math import inf, sqrt

from machines.simulated.planner import PlannedBlock, Planner

_Phase = tuple[float, float, float]  # acceleration, remaining mm at its end, speed at its end


class SegmentBuffer:
    """Filled from a planner, emptied by the stepper.

    queue   : block, mm of it left at the start and at the end of the segment, seconds, speed at its end
    speed   : mm/s at the end of the segment prepared last
    freed   : a planner slot has become free since the last look
    holding : braking: takes nothing more from the planner
    """

    def __init__(self, planner: Planner, capacity: int, segment_s: float) -> None:
        self.queue: deque[tuple[PlannedBlock, float, float, float, float]] = deque()
        self.speed = 0.0
        self.freed = False
        self.holding = False
        self._planner = planner
        self._capacity = capacity
        self._segment_s = segment_s
        self._block: PlannedBlock | None = None  # being cut into segments
        self._partial = False  # the oldest block is partly in here
        self._phases: list[_Phase] = []
        self._exit = 0.0
        self._braking_into_next = False
        self._halted = False  # the last segment of a hold is in the buffer

    def begin(self) -> None:
        """Start filling again after a stop."""
        self.holding = self._halted = False
        self.fill()

    def hold(self) -> None:
        """Brake along the path after the segments that are already in the buffer."""
        self.reload()
        self.holding = True
        self.fill()

    def clear(self) -> None:
        self.queue.clear()
        self._block = None
        self._partial = self._halted = self.holding = self._braking_into_next = False
        self.speed = 0.0

    def give_back(self) -> None:
        """Return the contents of the buffer to the planner, to start from rest."""
        blocks = self._planner.blocks
        for b, start, _, _, _ in reversed(self.queue):
            b.remaining = start
            if b not in blocks:
                blocks.insert(0, b)
        for b in blocks:
            b.gain = 2.0 * b.accel * b.remaining
            b.entry2 = 0.0 if b is blocks[0] else b.entry2
        self.queue.clear()
        self._block = None
        self._partial = True
        self.speed = 0.0
        self._planner.replan()

    def reload(self) -> None:
        """Give the rest of the current block a new speed profile, because the plan beyond it has changed."""
        b = self._block
        if b is not None:
            b.entry2 = self.speed * self.speed
            self._block = None
            self._partial = True

    def fill(self) -> None:
        """Take as much from the planner as there is room for."""
        queue, blocks = self.queue, self._planner.blocks
        while len(queue) < self._capacity and not self._halted:
            b = self._block
            if b is None:
                if not blocks:
                    return
                b = blocks[0]
                if self._partial:
                    self._partial = False
                elif self.holding or self._braking_into_next:
                    b.entry2 = self._exit * self._exit
                    self._braking_into_next = False
                start = b.remaining
                if not self.holding and (took := self._take_whole(b, blocks)) >= 0.0:
                    b.remaining = 0.0
                    b.gain = 0.0
                    queue.append((b, start, 0.0, took, self._exit))
                    self.speed = self._exit
                    self._planner.discard()
                    self.freed = True
                    continue
                self.speed = sqrt(b.entry2)
                if self.holding:
                    self._brake(b)
                else:
                    self._plan_profile(b, blocks[1].entry2 if len(blocks) > 1 else 0.0)
                self._block = b
            self._cut(b)

    def _take_whole(self, b: PlannedBlock, blocks: list[PlannedBlock]) -> float:
        """Time of the whole block if it goes into one segment, else -1; sets the exit speed."""
        exit2 = blocks[1].entry2 if len(blocks) > 1 else 0.0
        entry2, accel, nominal = b.entry2, b.accel, b.nominal
        nominal2 = nominal * nominal
        if entry2 > nominal2 or exit2 > nominal2:
            return -1.0
        length = b.remaining
        if entry2 == nominal2 and exit2 == nominal2:
            took = length / nominal
            if took > self._segment_s:
                return -1.0
            self._exit = nominal
            return took
        if exit2 > entry2 + b.gain:
            exit2 = entry2 + b.gain
        peak2 = 0.5 * (entry2 + exit2) + accel * length
        v0, v1 = sqrt(entry2), sqrt(exit2)
        if peak2 <= nominal2:
            took = (2.0 * sqrt(peak2) - v0 - v1) / accel
        else:
            took = (2.0 * nominal - v0 - v1) / accel
            took += (length - (2.0 * nominal2 - entry2 - exit2) / (2.0 * accel)) / nominal
        if took > self._segment_s or peak2 < entry2:
            return -1.0
        self._exit = v1
        return took

    def _plan_profile(self, b: PlannedBlock, exit2: float) -> None:
        """Set the phases of a block longer than a segment: to its speed, along, and to its exit speed."""
        accel, length, entry2, nominal = b.accel, b.remaining, b.entry2, b.nominal
        nominal2, half = nominal * nominal, 0.5 / b.accel
        phases: list[_Phase] = []
        if entry2 > nominal2:  # an override was lowered
            until = length - half * (entry2 - nominal2)
            if until <= 0.0:
                self._exit = sqrt(max(0.0, entry2 - 2.0 * accel * length))
                self._braking_into_next = True
                self._phases = [(-accel, 0.0, self._exit)]
                return
            phases.append((-accel, until, nominal))
            peak, brake_at = nominal, half * (nominal2 - exit2)
        else:
            exit2 = min(exit2, entry2 + 2.0 * accel * length)
            peak2 = 0.5 * (entry2 + exit2) + accel * length
            peak2 = max(min(peak2, nominal2), entry2, exit2)
            peak, brake_at = sqrt(peak2), half * (peak2 - exit2)
            if peak2 > entry2:
                phases.append((accel, max(brake_at, length - half * (peak2 - entry2)), peak))
        self._exit = sqrt(exit2)
        at = phases[-1][1] if phases else length
        if at > brake_at:
            phases.append((0.0, min(brake_at, at), peak))
        if brake_at > 0.0:
            phases.append((-accel, 0.0, self._exit))
        self._phases = phases

    def _brake(self, b: PlannedBlock) -> None:
        """Brake fully; the stop is in this block if its length allows."""
        left = b.remaining - b.entry2 * 0.5 / b.accel
        if left >= 0.0:
            self._exit = 0.0
            self._phases = [(-b.accel, left, 0.0)]
        else:
            self._exit = sqrt(b.entry2 - b.gain)
            self._phases = [(-b.accel, 0.0, self._exit)]

    def _cut(self, b: PlannedBlock) -> None:
        """Put the next segment of the loaded block into the buffer."""
        start = left = b.remaining
        v = speed = self.speed
        time_left, phases = self._segment_s, self._phases
        while phases:
            accel, until, v_end = phases[0]
            total = v + v_end
            took = 2.0 * (left - until) / total if total > 0.0 else 0.0
            if took > time_left:
                left -= time_left * (v + 0.5 * accel * time_left)
                v += accel * time_left
                time_left = 0.0
                break
            time_left -= took
            left, v = until, v_end
            del phases[0]
        if phases and left <= 0.0:  # rounding
            phases.clear()
        done = not phases and (left <= 0.0 or not self.holding)
        left = 0.0 if done else left
        b.remaining = left
        b.gain = 2.0 * b.accel * left
        self.speed = v
        if start > left or done:
            self.queue.append((b, start, left, self._segment_s - time_left, v))
        if done:
            self._block = None
            self._planner.discard()
            self.freed = True
        elif not phases:
            self._halted = True  # stopped within the block
        elif left == start and v == speed:
            raise AssertionError(f"the axes make no way: block of line {b.line}, {left} mm left at {v} mm/s")


class Stepper:
    """Executes the planner's blocks in simulated time.

    on_piece(block, x, y, z, at_s, whole) : a block has been executed up to there (to its end, or to a stop within it)
    on_stop(at_s)                         : motion has ended, nothing is left to execute (or a hold is complete)
    """

    def __init__(
        self,
        capacity: int,
        settings: Mapping[int, float],
        segments: int,
        segment_s: float,
        on_piece: Callable[[PlannedBlock, float, float, float, float, bool], None],
        on_stop: Callable[[float], None],
    ) -> None:
        self.planner = Planner(capacity, settings, lambda: self.segments.reload())
        self.segments = SegmentBuffer(self.planner, segments, segment_s)
        self.x = self.y = self.z = 0.0  # machine mm, at the end of the last executed segment
        self.next_s = inf  # when the segment under way ends
        self._on_piece = on_piece
        self._on_stop = on_stop

    @property
    def moving(self) -> bool:
        return self.next_s != inf

    @property
    def speed(self) -> float:
        """mm/s, as reported: that of the segment last prepared."""
        return self.segments.speed if self.moving else 0.0

    def where(self, at_s: float) -> tuple[float, float, float]:
        """Return the machine position."""
        if not self.moving:
            return (self.x, self.y, self.z)
        b, start, end, took, _ = self.segments.queue[0]
        share = (self.next_s - at_s) / took if took > 0.0 else 0.0
        left = end + (start - end) * min(1.0, max(0.0, share))
        return (b.tx - b.ux * left, b.ty - b.uy * left, b.tz - b.uz * left)

    @property
    def executing_block(self) -> PlannedBlock | None:
        return self.segments.queue[0][0] if self.segments.queue else None

    def place(self, x: float, y: float, z: float) -> None:
        """Set a position known from elsewhere (homing, start) while nothing moves."""
        self.x, self.y, self.z = x, y, z
        self.planner.x, self.planner.y, self.planner.z = x, y, z

    def start(self, at_s: float) -> None:
        """Start the cycle: execute what the planner holds. Does nothing while moving or without blocks."""
        if self.moving:
            return
        self.segments.begin()
        if self.segments.queue:
            self.next_s = at_s + self.segments.queue[0][3]

    def hold(self) -> None:
        """Brake along the path as soon as the segment buffer allows."""
        if self.moving and not self.segments.holding:
            self.segments.hold()

    def stop_dead(self, at_s: float) -> tuple[float, float, float, PlannedBlock | None]:
        """Switch the steppers off in mid-motion; return the position and the block. All buffers are lost."""
        x, y, z = self.where(at_s)
        b = self.executing_block
        if b is not None:
            self._on_piece(b, x, y, z, at_s, False)
        self.x, self.y, self.z = x, y, z
        self.clear()
        return x, y, z, b

    def clear(self) -> None:
        """Forget all blocks and stay at the present position."""
        self.segments.clear()
        self.planner.clear()
        self.next_s = inf
        self.planner.x, self.planner.y, self.planner.z = self.x, self.y, self.z

    def starve(self) -> None:
        """Stop the axes at the end of this piece although blocks are waiting (an empty segment buffer)."""
        self.segments.give_back()
        self.next_s = inf

    def step(self) -> None:
        """End the segment under way (at `next_s`)."""
        at_s = self.next_s
        queue = self.segments.queue
        b, _, left, _, _ = queue.popleft()
        if left == 0.0:
            self.x, self.y, self.z = b.tx, b.ty, b.tz
            self._on_piece(b, b.tx, b.ty, b.tz, at_s, True)
        else:
            self.x, self.y, self.z = b.tx - b.ux * left, b.ty - b.uy * left, b.tz - b.uz * left
        if self.next_s == inf:  # the callback has stopped everything
            return
        self.segments.fill()
        if queue:
            self.next_s = at_s + queue[0][3]
            return
        self.next_s = inf
        if left != 0.0:
            self._on_piece(b, self.x, self.y, self.z, at_s, False)
        self.segments.speed = 0.0
        self._on_stop(at_s)
