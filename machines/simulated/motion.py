"""From planned blocks to motion: the axes execute what the segment buffer holds, one segment after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import inf

from machines.simulated.planner import PlannedBlock, Planner
from machines.simulated.segments import SegmentBuffer


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
        """Take over a position known from elsewhere (homing, start), with nothing under way."""
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
        """Brake along the path as soon as the segment buffer lets us."""
        if self.moving and not self.segments.holding:
            self.segments.hold()

    def stop_dead(self, at_s: float) -> tuple[float, float, float, PlannedBlock | None]:
        """Switch the steppers off in the middle of a motion: where it stood, and in which block. All buffers
        are gone.
        """
        x, y, z = self.where(at_s)
        b = self.executing_block
        if b is not None:
            self._on_piece(b, x, y, z, at_s, False)
        self.x, self.y, self.z = x, y, z
        self.clear()
        return x, y, z, b

    def clear(self) -> None:
        """Forget all blocks and stand where we are."""
        self.segments.clear()
        self.planner.clear()
        self.next_s = inf
        self.planner.x, self.planner.y, self.planner.z = self.x, self.y, self.z

    def starve(self) -> None:
        """Stop the axes at the end of this piece although blocks wait (a stepper that ran dry)."""
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
