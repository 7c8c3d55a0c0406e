"""The controller's program: it carries out lines, and realtime bytes, which are picked out on arrival, acted on at
once, never counted and never answered by ok.
"""

from __future__ import annotations

import re

from machines.simulated import interruptions, resets
from machines.simulated.blocks import carry_out_gcode, is_out_of_travel
from machines.simulated.controller import ROOM, Controller, Task
from machines.simulated.interpreter import Triple
from machines.simulated.interruptions import cancel_jog, change_overrides, hold, open_door, resume
from machines.simulated.reports import status_report
from machines.simulated.resets import reset
from machines.simulated.system_commands import run_system_command
from machines.simulated.words import GcodeError

RESET, STATUS, HOLD, RESUME = 0x18, 0x3F, 0x21, 0x7E
DOOR, JOG_CANCEL = 0x84, 0x85
_FEED = {0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}
_RAPID = {0x95: 100, 0x96: 50, 0x97: 25}
_SPINDLE = {0x9A: 10, 0x9B: -10, 0x9C: 1, 0x9D: -1}
_NUMBER = rb"([-+]?(?:\d+\.?\d*|\.\d+))"
_PLAIN_MOVE = re.compile(
    rb"(?:G0?([01])(?![\d.]))?(?:X%s)?(?:Y%s)?(?:Z%s)?(?:F%s)?" % (_NUMBER, _NUMBER, _NUMBER, _NUMBER)
).fullmatch
_COMMENT = re.compile(rb"\([^)]*\)?|;.*")


def obey_realtime(fw: Controller, byte: int) -> None:
    if byte == RESET:
        reset(fw)
    elif fw.alarm:
        fw.status_pending |= byte == STATUS
    elif fw.critical:
        # ALARM:1 and ALARM:2 wait in a loop that looks for nothing but a reset; grblHAL still reports.
        if byte == STATUS and fw.traits.reports_when_critical:
            fw.say(status_report(fw))
    elif fw.state == "Home":
        if byte == STATUS:
            fw.status_pending = True
        elif byte == DOOR:
            open_door(fw)
    elif byte == STATUS:
        fw.say(status_report(fw))
    elif byte == HOLD:
        hold(fw)
    elif byte == RESUME:
        resume(fw)
    elif byte == DOOR:
        open_door(fw)
        fw.pressed.discard("D")  # a byte, not a switch that stays open
    elif byte == JOG_CANCEL:
        cancel_jog(fw)
    else:
        _change_overrides(fw, byte)


def _change_overrides(fw: Controller, byte: int) -> None:
    before = (fw.feed_percent, fw.rapid_percent, fw.spindle_percent)
    if byte == 0x90:
        fw.feed_percent = 100
    elif byte in _FEED:
        fw.feed_percent = min(200, max(10, fw.feed_percent + _FEED[byte]))
    elif byte in _RAPID:
        fw.rapid_percent = _RAPID[byte]
    elif byte == 0x99:
        fw.spindle_percent = 100
    elif byte in _SPINDLE:
        fw.spindle_percent = min(200, max(10, fw.spindle_percent + _SPINDLE[byte]))
    elif byte == 0x9E and fw.state == "Hold" and fw.held:
        fw.spindle_paused = not fw.spindle_paused
        fw.ov_in = 0
    elif byte in (0xA0, 0xA1) and fw.state in ("Idle", "Run", "Hold", "Jog"):
        fw.interpreter.coolant ^= {"M8" if byte == 0xA0 else "M7"}
        fw.ov_in = 0
    if before != (fw.feed_percent, fw.rapid_percent, fw.spindle_percent):
        change_overrides(fw)


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
        interruptions.raise_alarm(self, 2)

    realtime = obey_realtime

    hold = interruptions.hold
    resume = interruptions.resume
    open_door = interruptions.open_door

    raise_alarm = interruptions.raise_alarm
    cut_off = interruptions.cut_off
    end_alarm = resets.end_alarm
    reset = resets.reset
    restart = resets.restart
