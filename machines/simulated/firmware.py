"""The controller's program: lines, realtime commands, alarms and resets of one controller."""

from __future__ import annotations

import re

from machines.simulated import alarms, resets, suspending
from machines.simulated.blocks import carry_out_gcode, is_out_of_travel
from machines.simulated.controller import ROOM, Controller, Task
from machines.simulated.interpreter import Triple
from machines.simulated.realtime import obey_realtime
from machines.simulated.system_commands import run_system_command
from machines.simulated.words import GcodeError

_NUMBER = rb"([-+]?(?:\d+\.?\d*|\.\d+))"
_PLAIN_MOVE = re.compile(
    rb"(?:G0?([01])(?![\d.]))?(?:X%s)?(?:Y%s)?(?:Z%s)?(?:F%s)?" % (_NUMBER, _NUMBER, _NUMBER, _NUMBER)
).fullmatch
_COMMENT = re.compile(rb"\([^)]*\)?|;.*")


class Firmware(Controller):
    """A controller with its program."""

    def take_line(self, raw: bytes) -> None:
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
            self.begin(self._line_task(code))

    def _plain(self, raw: bytes) -> bool:
        """Execute straight moves without any other word, the millions of a program: the same as the general way, in
        short.
        """
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
        if self.settings[20] and is_out_of_travel(self, target):
            return False
        modal["motion"] = motion
        state.feed = feed
        planner = self.stepper.planner
        if len(planner.blocks) >= planner.capacity:
            self.begin(self._start_task(target, rapid, feed))
            return True
        state.position = target
        planner.add(px, py, pz, feed / 60.0, rapid, feed=feed, line=self.line)
        if self.state == "Run":
            self.stepper.segments.fill()
        self.say("ok")
        return True

    def _start_task(self, target: Triple, rapid: bool, feed: float) -> Task:
        yield ROOM
        self.interpreter.position = target
        self.stepper.planner.add(*target, feed / 60.0, rapid, feed=feed, line=self.line)
        if self.state == "Run":
            self.stepper.segments.fill()
        self.say("ok")

    def _line_task(self, code: bytes) -> Task:
        try:
            if code[:1] == b"$":
                yield from run_system_command(self, code.decode("latin-1"))
            elif self.state in ("Alarm", "Jog"):
                raise GcodeError(9)
            else:
                yield from carry_out_gcode(self, code)
        except GcodeError as error:
            self.say(f"error:{error.code}")
        else:
            self.say("ok")

    def stop_for_limit(self) -> None:
        alarms.raise_alarm(self, 2)

    realtime = obey_realtime

    hold = suspending.hold
    resume = suspending.resume
    open_door = suspending.open_door

    raise_alarm = alarms.raise_alarm
    cut_off = alarms.cut_off
    end_alarm = resets.end_alarm
    reset = resets.reset
    restart = resets.restart
