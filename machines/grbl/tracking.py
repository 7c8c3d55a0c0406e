"""Finds what has certainly been executed, and whether the mill is where the program can have brought it.

`ok` means parsed and queued: the controller may still hold that line in its planner and in its segment buffer. A line
counts as executed only when
(a) enough *blocks of motion* were answered after it, so that no buffer can still hold it. Lines that move nothing take
no place in any buffer and prove nothing; or (b) a line was answered that always waits for all motion before it: a
dwell, M2, M30. M5, M3, M9 and G54 do not count: they wait only if they change something, which only the controller
knows; or (c) a reported position lies on no earlier line than the next one; if it fits several, the earliest is
assumed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum
from itertools import islice

from machines.driver import Triple
from machines.gcode.modal import Position, Step

# Beside the planner's blocks there is one whose end is already cut into segments: measured 17 in all on 1.1
# (reference/machines.md, 1).
LONG_BLOCKS_BEYOND_PLANNER = 2
# Every segment belongs to one block and lasts at most 10 ms: each segment of short blocks, and one to spare, may hold a
# separate block. Segments by source: 1.1 has 6, grblHAL 10, FluidNC 6 to 20 by its configuration.
SEGMENTS = {"grbl": 6, "grblhal": 10, "fluidnc": 20}
# A block is short if it lasts less than this times the segments; twice 10 ms: override 200 %.
SHORT_S_PER_SEGMENT = 0.02
SHORT_RAPID_MM_PER_S = 500.0  # 30 m/min
REMEMBERED = 64  # executed steps, for naming the nearest line and the last move
# The mill never goes back: a position may lie at the end of what is executed, a few tiny steps back, not further.
BEHIND = 4


class Place(Enum):
    """The relation of a reported position to the path."""

    ON_PATH = "on the path"
    UNTOLD = "no step to compare with"
    OFF_PATH = "off the path"
    UNANSWERED = "on lines that were never answered"


@dataclass(frozen=True, slots=True)
class Sight:
    """Verdict on one reported position; `line` is the nearest or matching line, `distance_mm` the way to it."""

    place: Place
    line: int = 0
    distance_mm: float = 0.0


def _apart_mm(a: Position, b: Position) -> float:
    """Return the distance along the axes that both positions have."""
    return sum((q - p) ** 2 for p, q in zip(a, b, strict=True) if p is not None and q is not None) ** 0.5


class Tracker:
    """A window of the steps sent. Lines with number 0 (re-entry) are tracked like others but never become progress."""

    __slots__ = (
        "_answered", "_answered_line", "_beyond", "_by_count", "_counted_line", "_crept_from_mm", "_distrusted",
        "_dropped", "_least_block_mm", "_recent", "_short_beyond", "_short_left", "_short_rapid_mm", "_short_s",
        "_steps", "_usual_beyond", "executed_line", "tolerance_mm",
    )  # fmt: skip

    def __init__(
        self,
        *,
        planner_blocks: int,
        tolerance_mm: float,
        segments: int = SEGMENTS["grbl"],
        least_block_mm: float = 0.02,
    ) -> None:
        """least_block_mm: a shorter move may be less than a step of every axis, and then makes no block."""
        self.executed_line = 0
        self._steps: deque[tuple[int, Step]] = deque()  # from the first not proven executed to the last sent
        self._recent: deque[tuple[int, Step]] = deque(maxlen=REMEMBERED)
        self._answered = 0  # how many of _steps, from the left, are answered
        self._by_count: deque[tuple[int, int]] = deque()  # answered blocks the buffers may hold: count of steps, line
        self._dropped = 0  # steps that are no longer in _steps
        self._answered_line = 0
        self._least_block_mm = least_block_mm
        self._crept_from_mm: Position | None = None  # start of a series of moves too short for blocks of their own
        self._counted_line = 0  # executed according to (a) and (b) alone
        self._usual_beyond = self._beyond = planner_blocks + LONG_BLOCKS_BEYOND_PLANNER
        self._short_beyond = planner_blocks + segments + 1
        self._short_s = SHORT_S_PER_SEGMENT * segments
        self._short_rapid_mm = SHORT_RAPID_MM_PER_S * self._short_s
        self._short_left = 0
        self._distrusted = False
        self.tolerance_mm = tolerance_mm

    def note_sent(self, number: int, step: Step) -> None:
        self._steps.append((number, step))

    def take_answer(self) -> None:
        """Count the oldest unanswered line as answered."""
        steps = self._steps
        number, step = steps[self._answered]
        self._answered += 1
        if number:
            self._answered_line = number
        if step.waits_for_empty_buffer and (step.pause_s > 0.0 or step.ends_program):
            self.note_all_executed()
            return
        if not step.moves or not self._makes_block(step):
            return
        feed = step.feed_mm_per_min
        if step.length_mm * 60.0 < feed * self._short_s if feed is not None else step.length_mm < self._short_rapid_mm:
            self._beyond = self._short_left = self._short_beyond
        elif self._short_left:
            self._short_left -= 1
            if not self._short_left:
                self._beyond = self._usual_beyond
        blocks = self._by_count
        blocks.append((self._dropped + self._answered, number))
        while len(blocks) > self._beyond:
            place, number = blocks.popleft()
            self._counted_line = number or self._counted_line
            if place > self._dropped:
                self._drop(place - self._dropped)

    def _makes_block(self, step: Step) -> bool:
        """Return whether this move, with the too short ones before it, has certainly moved an axis by a step."""
        if step.length_mm < self._least_block_mm:
            begin = self._crept_from_mm or step.start_mm
            if _apart_mm(begin, step.end_mm) < self._least_block_mm:
                self._crept_from_mm = begin
                return False
        self._crept_from_mm = None
        return True

    def note_all_executed(self) -> None:
        """Count everything that was answered as executed."""
        self._counted_line = self._answered_line
        self._by_count.clear()
        self._drop(self._answered)

    def distrust_positions(self) -> None:
        """From now on, let only counts prove anything: a position was off the path, and the line at which that began is
        not known.

        A damaged block may have crossed later lines by chance and been mistaken for them.
        """
        self.executed_line = min(self.executed_line, self._counted_line)
        self._distrusted = True

    def _drop(self, count: int) -> None:
        steps, recent = self._steps, self._recent
        self._answered -= count
        self._dropped += count
        for _ in range(count):
            entry = steps.popleft()
            recent.append(entry)
            if entry[0]:
                self.executed_line = entry[0]

    def take_report(self, position_mm: Triple) -> Sight:
        """Judge a position, reported in the program's work frame, of a mill that runs or stands within the program."""
        if self._distrusted:
            return Sight(Place.UNTOLD)
        tolerance_mm = self.tolerance_mm
        nearest, nearest_mm = 0, float("inf")
        for index, (number, step) in enumerate(self._steps):
            if not step.moves:
                continue
            away_mm = step.distance_mm(position_mm)
            if away_mm <= tolerance_mm:
                return self._judge_match(index, number, step, away_mm, position_mm)
            if away_mm < nearest_mm:
                nearest, nearest_mm = number, away_mm
        before = self._nearest_before(position_mm)
        if before is None and nearest_mm == float("inf"):
            return Sight(Place.UNTOLD)
        if before is not None and before.distance_mm <= tolerance_mm:
            return Sight(Place.ON_PATH, before.line, before.distance_mm)
        if before is not None and before.distance_mm < nearest_mm:
            return Sight(Place.OFF_PATH, before.line, before.distance_mm)
        return Sight(Place.OFF_PATH, nearest, nearest_mm)

    def _judge_match(self, index: int, number: int, step: Step, away_mm: float, position_mm: Triple) -> Sight:
        if index < self._answered:
            self._drop(index)
            return Sight(Place.ON_PATH, number, away_mm)
        before = self._nearest_before(position_mm)
        if before is not None and before.distance_mm <= self.tolerance_mm:
            return Sight(Place.ON_PATH, before.line, before.distance_mm)
        if before is None and not any(step.moves for step in self.unproven_answered):
            return Sight(Place.UNTOLD)  # nothing has run yet: the mill is on a later line by chance
        if index == self._answered:
            # The first unanswered line may be under way: an arc is answered when its last chord is queued.
            self._drop(index)
            return Sight(Place.ON_PATH, number, away_mm)
        return Sight(Place.UNANSWERED, number, away_mm)

    def take_standstill(self, position_mm: Triple, *, exact_mm: float) -> None:
        """Count as cut the one answered line at whose end the mill stands for good, if that place is on no other line.

        Conclude nothing if another step under way, except the one that begins there, comes near that place.
        """
        if self._distrusted:
            return
        steps = self._steps
        ends = [
            index
            for index in range(self._answered)
            if steps[index][1].moves and None not in steps[index][1].end_mm
            and _apart_mm(position_mm, steps[index][1].end_mm) <= exact_mm
        ]  # fmt: skip
        if len(ends) != 1:
            return
        (found,) = ends
        behind = next((k for k in range(found + 1, len(steps)) if steps[k][1].moves), None)
        if behind is not None and _apart_mm(position_mm, steps[behind][1].end_mm) <= self.tolerance_mm:
            return  # the mill may have come back along that step
        others = [step for index, (_, step) in enumerate(steps) if index not in (found, behind)]
        others += [step for _, step in islice(reversed(self._recent), BEHIND)]
        if not any(step.moves and step.distance_mm(position_mm) <= self.tolerance_mm for step in others):
            self._drop(found + 1)

    def _nearest_before(self, position_mm: Triple) -> Sight | None:
        """Return the nearest of the last steps already executed; None if none moved."""
        found: Sight | None = None
        looked = 0
        for number, step in reversed(self._recent):
            if not step.moves:
                continue
            looked += 1
            if looked > BEHIND:
                break
            away_mm = step.distance_mm(position_mm)
            if found is None or away_mm < found.distance_mm:
                found = Sight(Place.ON_PATH, number, away_mm)
                if away_mm <= self.tolerance_mm:
                    break
        return found

    @property
    def unproven_answered(self) -> tuple[Step, ...]:
        return tuple(step for _, step in islice(self._steps, self._answered))

    def last_sent_s(self, blocks: int, feed_percent: int) -> float:
        """Return the least time for which the last steps sent keep the mill moving; only those that fit into the
        planner count.
        """
        total_s = 0.0
        for _, step in islice(reversed(self._steps), blocks):
            feed = step.feed_mm_per_min
            speed = feed * feed_percent / 6000.0 if feed is not None else SHORT_RAPID_MM_PER_S
            total_s += step.length_mm / speed
        return total_s

    @property
    def last_move(self) -> Step | None:
        """The last answered step that moves, as far back as is remembered."""
        for _, step in reversed(list(islice(self._steps, self._answered))):
            if step.moves:
                return step
        for _, step in reversed(self._recent):
            if step.moves:
                return step
        return None
