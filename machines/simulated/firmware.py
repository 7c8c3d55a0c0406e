"""The controller's program: states, alarms, realtime commands, and the tasks that carry out one line.

A line that has to wait (room in the planner, an empty buffer, a dwell, `~`) is a generator that yields what it waits
for; everything that happens lets it go on through `go_on`. Only then is its `ok` sent and the next line looked at.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator
from math import inf

from machines.simulated import reports
from machines.simulated.arcs import chords
from machines.simulated.homing import homing_moves
from machines.simulated.interpreter import ZERO, Action, Interpreter, Move, Triple
from machines.simulated.motion import Stepper
from machines.simulated.planner import Block
from machines.simulated.recording import CutSegment, Recording
from machines.simulated.traits import Traits
from machines.simulated.words import GcodeError

# What a task can wait for; a number is a time to wait until.
ROOM, EMPTY, NEVER = "room in the planner", "an empty buffer", "a reset"
Task = Generator[str | float, None, None]

_NUMBER = rb"([-+]?(?:\d+\.?\d*|\.\d+))"
_PLAIN_MOVE = re.compile(
    rb"(?:G0?([01])(?![\d.]))?(?:X%s)?(?:Y%s)?(?:Z%s)?(?:F%s)?" % (_NUMBER, _NUMBER, _NUMBER, _NUMBER)
).fullmatch
_COMMENT = re.compile(rb"\([^)]*\)?|;.*")
_SUSPENDED = ("Hold", "Door", "Sleep")


class Firmware:
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
        self.interpreter = Interpreter(mist=traits.mist)
        self.shift: Triple = ZERO  # physical position = machine position + shift
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
        """As the processor starts: nothing known but the EEPROM. The tool stays where it physically is."""
        self.state = "Idle"
        self.stepper = Stepper(
            self.traits.planner_blocks,
            self.settings,
            self.traits.segments,
            self.traits.segment_s,
            self._piece,
            self._stopped,
        )
        self.report = reports.StatusReport()
        self.task: Task | None = None
        self.waiting: str | float = ROOM
        self.after_task: Callable[[], None] | None = None
        self.held = False
        self.critical = False
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
        probe = self.traits.probe_surface_mm
        pins = self.pressed | ({"P"} if probe is not None and self.physical()[2] < probe - 1e-9 else set())
        return "".join(p for p in "XYZPDHRS" if p in pins)

    def spindle_on(self) -> bool:
        return self.spindle != "M5" and not self.spindle_paused

    def spindle_now(self) -> float:
        return self.spindle_rpm * self.spindle_percent / 100 if self.spindle_on() else 0.0

    def physical(self) -> Triple:
        x, y, z = self.stepper.where(self.now_s)
        sx, sy, sz = self.shift
        return (x + sx, y + sy, z + sz)

    def suspended(self) -> bool:
        return self.critical or self.state in _SUSPENDED

    def busy(self) -> bool:
        """No line is read now."""
        return self.task is not None or self.critical or self.state in _SUSPENDED

    # -- one line --------------------------------------------------------------------------------------------------
    def line_received(self, raw: bytes) -> None:
        """Carry out one line (without its end). It may leave a task that waits."""
        self.received += 1
        self.line = self.received
        if (self.state == "Run" or self.state == "Idle") and not self.traits.echo and self._plain(raw):
            return
        code = raw
        if b"(" in code or b";" in code:
            code = _COMMENT.sub(b"", code)
        code = bytes(c for c in code if c > 32 and c != 47).upper()
        if self.traits.echo:
            self.say(f"[echo: {code.decode('latin-1')}]")
        if len(code) > self.traits.line_chars:
            self.say("error:11")
        elif not code or (code == b"%" and self.traits.percent_allowed):
            self.say("ok")
        else:
            self._begin(self._line_task(code))

    def _plain(self, raw: bytes) -> bool:
        """Straight moves without any other word, the millions of a program: the same as the general way, in short."""
        match = _PLAIN_MOVE(raw)
        if match is None:
            return False
        g, x, y, z, f = match.groups()
        state = self.interpreter
        modal = state.modal
        motion = modal["motion"] if g is None else "G1" if g == b"1" else "G0"
        rapid = motion == "G0"
        if not rapid and motion != "G1":
            return False
        if modal["distance"] != "G90" or modal["units"] != "G21" or modal["feed-mode"] != "G94":
            return False
        feed = state.feed if f is None else float(f)
        if (not rapid and feed <= 0.0) or feed < 0.0 or (x is None and y is None and z is None) or len(raw) > 70:
            return False
        px, py, pz = state.position
        ox, oy, oz = state.offset
        if x is not None:
            px = float(x) + ox
        if y is not None:
            py = float(y) + oy
        if z is not None:
            pz = float(z) + oz
        target = (px, py, pz)
        if self.settings[20] and self._out_of_travel(target):
            return False
        modal["motion"] = motion
        state.feed = feed
        planner = self.stepper.planner
        if len(planner.blocks) >= planner.capacity:
            self._begin(self._plain_task(target, rapid, feed))
            return True
        state.position = target
        planner.add(px, py, pz, feed / 60.0, rapid, feed=feed, line=self.line)
        if self.state == "Run":
            self.stepper.prepare()
        self.say("ok")
        return True

    def _plain_task(self, target: Triple, rapid: bool, feed: float) -> Task:
        yield ROOM
        self.interpreter.position = target
        self.stepper.planner.add(*target, feed / 60.0, rapid, feed=feed, line=self.line)
        if self.state == "Run":
            self.stepper.prepare()
        self.say("ok")

    def _line_task(self, code: bytes) -> Task:
        from machines.simulated.system_commands import system_command

        try:
            if code[:1] == b"$":
                yield from system_command(self, code.decode("latin-1"))
            elif self.state in ("Alarm", "Jog"):
                raise GcodeError(9)
            else:
                yield from self.gcode(code)
        except GcodeError as error:
            self.say(f"error:{error.code}")
        else:
            self.say("ok")

    def _begin(self, task: Task) -> None:
        self.task = task
        self.waiting = 0.0
        self.go_on()

    def go_on(self) -> None:
        """Let the waiting task go on as far as it can."""
        while self.task is not None and not self.suspended():
            waiting = self.waiting
            if waiting is ROOM:
                if len(self.stepper.planner.blocks) >= self.stepper.planner.capacity:
                    self.auto_start()
                    return
            elif waiting is EMPTY:
                if self.stepper.planner.blocks or self.state in ("Run", "Jog"):
                    self.auto_start()
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
        """When the waiting task wants to go on by the clock."""
        if self.task is None or not isinstance(self.waiting, float) or self.suspended():
            return inf
        return self.waiting

    def auto_start(self) -> None:
        """Blocks wait and nobody holds them back: cycle start."""
        if self.state == "Idle" and self.stepper.planner.blocks and not self.starved:
            self.state = "Run"
            self.stepper.start(self.now_s)

    # -- G-code ----------------------------------------------------------------------------------------------------
    def gcode(self, code: bytes) -> Task:
        """Check and execute one block, in GRBL's order."""
        action = self.interpreter.read(code)
        if action.line_number is not None and self.traits.line_numbers:
            self.line = action.line_number
        dry = self.state == "Check"
        state = self.interpreter
        state.feed = action.feed
        if action.spindle_rpm != state.spindle_rpm:
            if state.modal["spindle"] != "M5" and not dry:
                yield EMPTY
            state.spindle_rpm = action.spindle_rpm
            self.spindle_rpm = action.spindle_rpm
        if action.tool is not None:
            state.tool = action.tool
        yield from self._accessories(action, dry=dry)
        if action.dwell_s is not None and not dry:
            yield EMPTY
            yield self.now_s + action.dwell_s
        old_wcs = state.modal["wcs"]
        if action.words.axis_command == "tool-length" or action.modal["wcs"] != old_wcs or action.words.non_modal:
            yield from self._offsets(action, dry=dry)
        state.modal = action.modal
        state.refresh()
        if action.move is not None:
            yield from self._move(action.move)
        if action.stored is not None:
            yield from self._move(Move("G0", action.stored, 0.0, 0.0))
        yield from self._flow(action.words.commands.get("flow", ""), dry=dry)

    def _accessories(self, action: Action, *, dry: bool) -> Task:
        """Spindle and coolant: a change waits for the buffer to run empty."""
        state = self.interpreter
        if action.modal["spindle"] != state.modal["spindle"]:
            if not dry:
                yield EMPTY
                self.spindle = action.modal["spindle"]
                self.spindle_rpm = state.spindle_rpm
                self.report.ov_in = 0
            state.modal["spindle"] = action.modal["spindle"]
        wanted = action.words.commands.get("coolant")
        if wanted is not None:
            coolant = set() if wanted == "M9" else state.coolant | {wanted}
            if coolant != state.coolant:
                if not dry:
                    yield EMPTY
                    self.report.ov_in = 0
                state.coolant = coolant

    def _offsets(self, action: Action, *, dry: bool) -> Task:
        """Changes of offsets wait for an empty buffer, those in the EEPROM shut the receiver meanwhile."""
        state, command = self.interpreter, action.words.non_modal
        if command == "G53" or (command in ("G4", "G28", "G30") and action.modal["wcs"] == state.modal["wcs"]):
            return
        if not dry:
            yield EMPTY
        if command == "G10" and action.offsets is not None:
            yield from self.eeprom(3 * self.traits.eeprom_write_s)
            state.stored[action.system] = action.offsets
        elif command in ("G28.1", "G30.1"):
            yield from self.eeprom(3 * self.traits.eeprom_write_s)
            state.stored[command[:3]] = state.position
        elif command == "G92" and action.offsets is not None:
            state.g92 = action.offsets
        elif command == "G92.1":
            state.g92 = ZERO
        elif action.words.axis_command == "tool-length" and action.offsets is not None:
            state.tool_length = action.offsets[2]
        self.report.wco_in = 0

    def eeprom(self, seconds: float) -> Task:
        if seconds > 0.0:
            self.write_eeprom(seconds)
            yield self.now_s + seconds

    def _flow(self, command: str, *, dry: bool) -> Task:
        if command in ("", "M1"):
            return
        if not dry:
            yield EMPTY
        if command == "M0":
            if not dry:
                self.state, self.held = "Hold", True
                yield 0.0
            return
        state = self.interpreter
        state.modal.update({"motion": "G1", "plane": "G17", "distance": "G90", "feed-mode": "G94", "wcs": "G54"})
        state.modal["spindle"] = "M5"
        state.coolant.clear()
        state.refresh()
        if not dry:
            self.feed_percent = self.rapid_percent = self.spindle_percent = 100
            self._apply_overrides()
            self.spindle = "M5"
            self.report.wco_in = self.report.ov_in = 0
        self.say("[MSG:Pgm End]")

    def _move(self, move: Move) -> Task:
        if move.motion.startswith("G38"):
            yield from self._probe(move)
            return
        rapid = move.motion == "G0"
        points = [move.target] if move.arc is None else list(chords(move.arc, self.settings[12]))
        speed = move.speed
        last = self.interpreter.position
        for point in points:
            if move.inverse_time and not rapid:
                length = sum((a - b) ** 2 for a, b in zip(point, last, strict=True)) ** 0.5
                speed = length * len(points) * move.speed
            last = point
            yield from self.plan(point, speed, rapid=rapid, feed=move.feed)
        self.interpreter.position = move.target

    def plan(self, point: Triple, speed: float, *, rapid: bool, feed: float, kind: str = "program") -> Task:
        """mc_line: soft limits, room, planner."""
        if self.settings[20] and self.state != "Jog" and self._out_of_travel(point):
            yield from self._soft_limit()
        if self.state == "Check":
            return
        yield ROOM
        self.stepper.planner.add(*point, speed, rapid, feed=feed, line=self.line, kind=kind)
        if self.stepper.moving:
            self.stepper.prepare()

    def out_of_travel(self, point: Triple) -> bool:
        return self._out_of_travel(point)

    def _out_of_travel(self, point: Triple) -> bool:
        travel = self.settings
        return any(not -travel[130 + i] - 1e-6 <= p <= 1e-6 for i, p in enumerate(point))

    def _soft_limit(self) -> Task:
        """Stops in good order, then ALARM:2; the line that asked for it is never answered."""
        if self.state == "Run":
            self.soft_limit = True
            self.state, self.held = "Hold", False
            self.stepper.hold()
        else:
            self.raise_alarm(2)
        yield NEVER

    def _probe(self, move: Move) -> Task:
        """Straight probe. The contact ends the move at once (the real one overshoots by its braking distance)."""
        if self.state == "Check":
            self.interpreter.position = move.target
            return
        yield EMPTY
        towards, strict = move.motion in ("G38.2", "G38.3"), move.motion in ("G38.2", "G38.4")
        surface = self.traits.probe_surface_mm
        here, there = self.interpreter.position[2] + self.shift[2], move.target[2] + self.shift[2]
        touching = surface is not None and here < surface - 1e-9
        if touching == towards:
            self.raise_alarm(4)
            self.probe_found = False
            return
        end, found = move.target, False
        if surface is not None and (here - surface) * (there - surface) <= 0.0 and here != there:
            share, found = (here - surface) / (here - there), True
            end_list = [a + share * (b - a) for a, b in zip(self.interpreter.position, move.target, strict=True)]
            end = (end_list[0], end_list[1], end_list[2])
        self.stepper.planner.add(*end, move.speed, False, feed=move.feed, line=self.line, kind="probe")
        yield EMPTY
        self.interpreter.position = (self.stepper.x, self.stepper.y, self.stepper.z)
        self.probe_found = found
        self.probed = self.interpreter.position if found else ZERO
        if strict and not found:
            self.raise_alarm(5)
        self.say(f"[PRB:{reports.xyz(self.probed)}:{int(found)}]")

    # -- motion has got somewhere ----------------------------------------------------------------------------------
    def _piece(self, b: Block, x: float, y: float, z: float, at_s: float, whole: bool) -> None:
        sx, sy, sz = self.shift
        end = (x + sx, y + sy, z + sz)
        start = (b.sx + sx, b.sy + sy, b.sz + sz)
        b.sx, b.sy, b.sz = x, y, z
        on = self.spindle != "M5" and not self.spindle_paused
        if whole or start != end:
            self.recording.add(CutSegment(start, end, b.rapid, b.feed, on, b.line, at_s, whole, b.kind))
        if whole:
            self.executed += 1
            if self.executed == self.traits.idle_with_blocks_at:
                self._run_dry(at_s)

    def _run_dry(self, at_s: float) -> None:
        """The stepper finds its buffer empty although blocks wait: Idle, until something starts it again."""
        self.stepper.starve()
        self.state = "Idle"
        self.starved = True

    def _stopped(self, at_s: float) -> None:
        """Motion has ended."""
        self.now_s = at_s
        if self.soft_limit:
            self.soft_limit = False
            self.raise_alarm(2)
        elif self.jog_cancel:
            self.jog_cancel = False
            self.stepper.clear()
            self.interpreter.position = (self.stepper.x, self.stepper.y, self.stepper.z)
            self.state = "Door" if "D" in self.pressed else "Idle"
            self.held = True
        elif self.state in _SUSPENDED:
            self.stepper.planner.replan()
            self._hold_complete()
        elif self.state != "Alarm":
            self.state = "Idle"

    def _hold_complete(self) -> None:
        self.held = True
        if self.state in ("Door", "Sleep"):
            self.spindle_paused = True
            if self.state == "Sleep":
                self.spindle = "M5"
                self.interpreter.coolant.clear()
                self.say("[MSG:Sleeping]")

    # -- realtime --------------------------------------------------------------------------------------------------
    def realtime(self, byte: int) -> None:
        from machines.simulated.realtime import realtime_command

        realtime_command(self, byte)

    def hold(self) -> None:
        """Feed hold, from `!` or the button."""
        if self.state == "Run":
            self.state, self.held = "Hold", False
            self.stepper.hold()
        elif self.state == "Jog":
            self.cancel_jog()
        elif self.state == "Idle":
            self.state, self.held = "Hold", True

    def cancel_jog(self) -> None:
        if self.state == "Jog":
            self.jog_cancel = True
            self.stepper.hold()

    def resume(self) -> None:
        """Cycle start, from `~` or the button. Before a hold is complete it is ignored."""
        if self.state == "Door" and self.held and "D" not in self.pressed:
            self.door_restoring = True
            self.spindle_paused = False
            self.held = False
            self._leave_hold()
        elif self.state == "Hold" and self.held:
            self.spindle_paused = False
            self._leave_hold()
        elif self.state == "Idle":
            self.starved = False
            self.auto_start()

    def _leave_hold(self) -> None:
        self.door_restoring = False
        self.state = "Idle"
        self.stepper.holding = False
        self.auto_start()
        self.go_on()

    def open_door(self) -> None:
        self.pressed.add("D")
        if self.state in ("Alarm", "Check"):
            return
        self.say("[MSG:Check Door]")
        if self.state == "Home":
            self.task = None
            self.cut_off(7)
        elif self.state == "Jog":
            self.cancel_jog()
        elif self.state != "Sleep":
            was = self.state
            self.state = "Door"
            if was == "Run":
                self.held = False
                self.stepper.hold()
            elif not self.stepper.moving:
                self._hold_complete()

    def sleep(self) -> None:
        moving = self.stepper.moving
        self.state, self.held = "Sleep", not moving
        if moving:
            self.stepper.hold()
        else:
            self._hold_complete()

    def _apply_overrides(self) -> None:
        planner = self.stepper.planner
        feed, rapid = self.feed_percent / 100.0, self.rapid_percent / 100.0
        if (feed, rapid) != (planner.feed_override, planner.rapid_override):
            planner.feed_override, planner.rapid_override = feed, rapid
            planner.overrides_changed()
            if self.stepper.moving:
                self.stepper.prepare()

    def overrides_changed(self) -> None:
        self.report.ov_in = 0
        self._apply_overrides()

    # -- alarms and resets -----------------------------------------------------------------------------------------
    def raise_alarm(self, code: int) -> None:
        self.state = "Alarm"
        self.say(f"ALARM:{code}")
        if code in (1, 2):
            self.spindle = "M5"
            self.interpreter.coolant.clear()
            self.critical = True
            self.stepper.clear()
            self.say("[MSG:Reset to continue]")

    def cut_off(self, code: int) -> None:
        """Steppers off in motion: the position is no longer what is counted."""
        x, y, z, block = self.stepper.stop_dead(self.now_s)
        if block is not None:
            slip = self.traits.reset_slip_mm
            sx, sy, sz = self.shift
            start = (x + sx, y + sy, z + sz)
            self.shift = (sx + slip * block.ux, sy + slip * block.uy, sz + slip * block.uz)
            end = (x + self.shift[0], y + self.shift[1], z + self.shift[2])
            on = self.spindle_on()
            self.recording.add(
                CutSegment(start, end, block.rapid, block.feed, on, block.line, self.now_s, False, "slip")
            )
        self.position_lost = True
        self.raise_alarm(code)

    def reset(self) -> None:
        """Ctrl-X or the reset button."""
        if self.state == "Home":
            self.task = None
            self.cut_off(6)
        elif self.stepper.moving:
            self.cut_off(3)
        locked = self.state in ("Alarm", "Sleep")
        self.restart(locked=locked)

    def restart(self, *, locked: bool) -> None:
        """Everything but the EEPROM and the stepper position starts anew."""
        at = (self.stepper.x, self.stepper.y, self.stepper.z)
        self.on_restart()
        self.power_on_state()
        self.stepper.place(*at)
        self.interpreter.position = at
        self.say("")
        self.say(self.traits.banner)
        if locked:
            self.state = "Alarm"
            self.say("[MSG:'$H'|'$X' to unlock]")
        elif "D" in self.pressed:
            self.open_door()
        else:
            self.run_startup()

    def run_startup(self) -> None:
        lines = [line for line in self.startup.values() if line]
        if lines:
            self._begin(self._startup_task(lines))

    def _startup_task(self, lines: list[str]) -> Task:
        for line in lines:
            try:
                yield from self.gcode(line.encode())
            except GcodeError as error:
                self.say(f">{line}:error:{error.code}")
            else:
                self.say(f">{line}:ok")

    def home(self) -> Task:
        """The whole cycle: deaf to `?` until it ends."""
        self.state = "Home"
        machine = tuple(p + o for p, o in zip(self.physical(), self.traits.power_up_machine_mm, strict=True))
        at = self.physical()
        for point, seconds in homing_moves((machine[0], machine[1], machine[2]), self.settings):
            yield self.now_s + seconds
            end = tuple(p - o for p, o in zip(point, self.traits.power_up_machine_mm, strict=True))
            there = (end[0], end[1], end[2])
            self.recording.add(
                CutSegment(at, there, True, 0.0, self.spindle_on(), self.line, self.now_s, True, "homing")
            )
            at, last = there, point
            x, y, z = self.stepper.where(self.now_s)
            self.shift = (at[0] - x, at[1] - y, at[2] - z)
        self.shift = tuple(-o for o in self.traits.power_up_machine_mm)  # type: ignore[assignment]
        self.stepper.place(*last)
        self.interpreter.position = last
        self.position_lost = False
        self.state = "Idle"
        if self.status_pending:
            self.status_pending = False
            self.say(self.report.text(self))
