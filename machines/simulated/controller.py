"""A controller: its state, its visible reports, and the task that carries out a line.

A line that has to wait (room in the planner, an empty buffer, a dwell, `~`) is a generator that yields what it waits
for; every event resumes it through `go_on`. Only then is its `ok` sent and the next line read.

The recording holds the real path, in physical coordinates. The probe's circuit is closed by a plane under the tool, or
by a plate on the front left corner of a block.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from math import hypot, inf
from typing import NamedTuple

from machines.simulated.interpreter import ZERO, SimulatedInterpreter, Triple
from machines.simulated.motion import Stepper
from machines.simulated.planner import PlannedBlock
from machines.simulated.traits import Traits


class CutSegment(NamedTuple):
    """One executed block, or the part of it between two stops.

    start, end : mm, physical: relative to where the tool stood at the first power-up, independent of MPos
    rapid      : G0 (homing and jogs count as rapid: they are not part of a program)
    feed       : programmed feed in mm/min as it was planned (before overrides)
    spindle_on : at the end of this segment
    line       : count of lines the firmware has received, of the line this block came from (N word if one was given)
    at_s       : simulated time of its end
    whole      : the block was executed to its end
    kind       : "program", "jog", "probe", "homing" or "slip" (steps lost in a stop without deceleration)
    """

    start: Triple
    end: Triple
    rapid: bool
    feed: float
    spindle_on: bool
    line: int
    at_s: float
    whole: bool
    kind: str


class Recording:
    """Collects cut segments in a list, and hands each to `on_block` if there is one (for long soaks: keep=False)."""

    def __init__(self, on_block: Callable[[CutSegment], None] | None = None, *, keep: bool = True) -> None:
        self.on_block = on_block
        self.keep = keep
        self.segments: list[CutSegment] = []
        self.count = 0

    def add(self, segment: CutSegment) -> None:
        self.count += 1
        if self.keep:
            self.segments.append(segment)
        if self.on_block is not None:
            self.on_block(segment)

    def cuts(self) -> list[CutSegment]:
        """Return program motion at feed, in order."""
        return [s for s in self.segments if s.kind == "program" and not s.rapid]


_NOISE_MM = 1e-10
_STEPS = 60  # halvings of the distance, down to the resolution of a double
# What the task of a line can wait for; a number is a time to wait until.
ROOM, EMPTY, NEVER = "room in the planner", "an empty buffer", "a reset"
Task = Generator[str | float, None, None]

_SUSPENDED = ("Hold", "Door", "Sleep")


def _compute_overlap_mm(traits: Traits, at_mm: Triple) -> float:
    """Return the depth of the tool in the probed surface, in physical coordinates; below 0: no contact."""
    x, y, z = at_mm
    surface_mm, corner = traits.probe_surface_mm, traits.corner_plate
    if surface_mm is None:
        return -inf
    if corner is None:
        return surface_mm - z
    outside_mm = hypot(max(corner.left_mm - x, 0.0), max(corner.front_mm - y, 0.0))
    return min(surface_mm - z, corner.tool_radius_mm - outside_mm)


def is_touching(traits: Traits, at_mm: Triple) -> bool:
    return _compute_overlap_mm(traits, at_mm) > _NOISE_MM


def find_contact(traits: Traits, start_mm: Triple, end_mm: Triple, *, shift_mm: Triple) -> Triple | None:
    """Return the place where contact begins or ends on a straight path; None if it does neither.

    shift_mm : from the coordinates of the way, and of the answer, to physical ones
    """

    def place(share: float) -> Triple:
        x, y, z = (a + share * (b - a) for a, b in zip(start_mm, end_mm, strict=True))
        return x, y, z

    def touches(share: float) -> bool:
        x, y, z = (a + b for a, b in zip(place(share), shift_mm, strict=True))
        return is_touching(traits, (x, y, z))

    if touches(0.0) is (at_end := touches(1.0)):
        return None
    low, high = 0.0, 1.0
    for _ in range(_STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if touches(middle) is at_end else (middle, high)
    return place(high)


class Controller:
    """State of the controller. `say(text)` sends a line; `write_eeprom(seconds)` shuts the receiver."""

    def __init__(
        self,
        traits: Traits,
        recording: Recording,
        say: Callable[[str], None],
        write_eeprom: Callable[[float], None],
        rx_free: Callable[[], int],
        on_restart: Callable[[], None],
    ) -> None:
        self.traits = traits
        self.recording = recording
        self.say = say
        self.write_eeprom = write_eeprom
        self.rx_free = rx_free
        self.on_restart = on_restart
        self.settings = traits.all_settings()
        self.startup = {0: "", 1: ""}
        self.interpreter = SimulatedInterpreter(mist=traits.mist)
        self.scale: Triple = (1.0, 1.0, 1.0)  # physical position = machine position x scale + shift
        self.shift: Triple = ZERO
        self.probed: Triple = ZERO
        self.probe_found = False
        self.pressed: set[str] = set()  # pins held: "D" door, limits "X" "Y" "Z"
        self.position_lost = False
        self.now_s = 0.0
        self.received = 0  # lines
        self.executed = 0  # whole blocks
        self.line = 0
        self.power_on_state()

    def power_on_state(self) -> None:
        """Begin as the processor does: only the EEPROM is known. The tool stays at its physical position."""
        self.state = "Idle"
        self.stepper = Stepper(
            self.traits.planner_blocks,
            self.settings,
            self.traits.segments,
            self.traits.segment_s,
            self._cut_piece,
            self._end_motion,
        )
        self.wco_in = self.ov_in = 0  # status reports until the next ones with WCO and Ov
        self.task: Task | None = None
        self.waiting: str | float = ROOM
        self.after_task: Callable[[], None] | None = None
        self.held = False
        self.critical = False
        self.alarm, self.alarm_until_s = 0, inf  # alarm being reported, and the time until which nothing else happens
        self.reset_pending = False
        self.jog_cancel = False
        self.soft_limit = False
        self.door_restoring = False
        self.starved = False
        self.status_pending = False
        self.spindle = "M5"
        self.spindle_rpm = 0.0
        self.spindle_paused = False
        self.feed_percent = self.rapid_percent = self.spindle_percent = 100
        self.interpreter.reset()
        self.interpreter.position = ZERO

    # -- what can be seen ------------------------------------------------------------------------------------------
    def state_word(self) -> str:
        if self.state == "Hold":
            return "Hold:0" if self.held else "Hold:1"
        if self.state == "Door":
            if self.door_restoring:
                return "Door:3"
            if not self.held:
                return "Door:2"
            return "Door:1" if "D" in self.pressed else "Door:0"
        return self.state

    def pins(self) -> str:
        pins = self.pressed | ({"P"} if is_touching(self.traits, self.physical()) else set())
        return "".join(p for p in "XYZPDHRS" if p in pins)

    def spindle_on(self) -> bool:
        return self.spindle != "M5" and not self.spindle_paused

    def spindle_now(self) -> float:
        return self.spindle_rpm * self.spindle_percent / 100 if self.spindle_on() else 0.0

    def physical(self) -> Triple:
        return self.to_physical(*self.stepper.where(self.now_s))

    def to_physical(self, x: float, y: float, z: float) -> Triple:
        """Return the tool's position in the firmware's machine coordinates."""
        (kx, ky, kz), (sx, sy, sz) = self.scale, self.shift
        return (kx * x + sx, ky * y + sy, kz * z + sz)

    def count_steps_anew(self, axis: int, before: float) -> None:
        """Apply a change of $100-$102: GRBL counts steps, so the reported position is scaled and nothing moves.

        The parser's own position stays in mm as it was: the next block moves this axis even if it does not name it.
        """
        ratio = before / self.settings[100 + axis]
        place, scale = [self.stepper.x, self.stepper.y, self.stepper.z], list(self.scale)
        place[axis] *= ratio
        scale[axis] /= ratio
        self.stepper.place(place[0], place[1], place[2])
        self.scale = (scale[0], scale[1], scale[2])

    def is_suspended(self) -> bool:
        return self.critical or self.alarm != 0 or self.state in _SUSPENDED

    def busy(self) -> bool:
        """Return whether the controller reads no lines now."""
        return self.task is not None or self.is_suspended()

    # -- the task of a line ----------------------------------------------------------------------------------------
    def begin(self, task: Task) -> None:
        self.task = task
        self.waiting = 0.0
        self.go_on()

    def go_on(self) -> None:
        """Resume the waiting task as far as possible."""
        if self.alarm and self.now_s >= self.alarm_until_s:
            self.end_alarm()
        while self.task is not None and not self.is_suspended():
            waiting = self.waiting
            if waiting is ROOM:
                if len(self.stepper.planner.blocks) >= self.stepper.planner.capacity:
                    self.start_cycle()
                    return
            elif waiting is EMPTY:
                if self.stepper.planner.blocks or self.state in ("Run", "Jog"):
                    self.start_cycle()
                    return
            elif waiting is NEVER or (isinstance(waiting, float) and waiting > self.now_s):
                return
            try:
                self.waiting = next(self.task)
            except StopIteration:
                self.task = None
                if (then := self.after_task) is not None:
                    self.after_task = None
                    then()

    def wake_s(self) -> float:
        """Return when the waiting task is due by the clock, or the report of an alarm ends."""
        if self.alarm:
            return self.alarm_until_s
        if self.task is None or not isinstance(self.waiting, float) or self.is_suspended():
            return inf
        return self.waiting

    def start_cycle(self) -> None:
        """Start the cycle if blocks wait and nothing holds them back."""
        if self.state == "Idle" and self.stepper.planner.blocks and not self.starved:
            self.state = "Run"
            self.stepper.start(self.now_s)

    def end_alarm(self) -> None:
        """End an alarm that has been reported."""
        raise NotImplementedError

    def stop_for_limit(self) -> None:
        """Stop: motion has ended because it would have left the travel."""
        raise NotImplementedError

    # -- progress of motion ----------------------------------------------------------------------------------------
    def _cut_piece(self, b: PlannedBlock, x: float, y: float, z: float, at_s: float, whole: bool) -> None:
        end, start = self.to_physical(x, y, z), self.to_physical(b.sx, b.sy, b.sz)
        b.sx, b.sy, b.sz = x, y, z
        on = self.spindle != "M5" and not self.spindle_paused
        if whole or start != end:
            self.recording.add(CutSegment(start, end, b.rapid, b.feed, on, b.line, at_s, whole, b.kind))
        if whole:
            self.executed += 1
            if self.executed == self.traits.idle_with_blocks_at:
                self._run_dry(at_s)

    def _run_dry(self, at_s: float) -> None:
        """Let the stepper find its buffer empty although blocks wait: Idle, until something starts it again."""
        self.stepper.starve()
        self.state = "Idle"
        self.starved = True

    def _end_motion(self, at_s: float) -> None:
        """Note that motion has ended."""
        self.now_s = at_s
        if self.soft_limit:
            self.soft_limit = False
            self.stop_for_limit()
        elif self.jog_cancel:
            self.jog_cancel = False
            self.stepper.clear()
            self.interpreter.position = (self.stepper.x, self.stepper.y, self.stepper.z)
            self.state = "Door" if "D" in self.pressed else "Idle"
            self.held = True
        elif self.state in _SUSPENDED:
            self.stepper.planner.replan()
            self.complete_hold()
        elif self.state != "Alarm":
            self.state = "Idle"

    def complete_hold(self) -> None:
        self.held = True
        if self.state in ("Door", "Sleep"):
            self.spindle_paused = True
            if self.state == "Sleep":
                self.spindle = "M5"
                self.interpreter.coolant.clear()
                self.say("[MSG:Sleeping]")
