"""The controller's program: it carries out lines, of G-code and those that begin with `$`, and realtime bytes, which
are picked out on arrival, acted on at once, never counted and never answered by ok.
"""

from __future__ import annotations

import re
from functools import partial

from machines.simulated import interruptions, reports, resets
from machines.simulated.blocks import carry_out_gcode, eeprom, is_out_of_travel, plan
from machines.simulated.controller import ROOM, Controller, Task
from machines.simulated.interpreter import ZERO, Triple
from machines.simulated.interruptions import cancel_jog, change_overrides, hold, open_door, resume, sleep
from machines.simulated.reports import status_report
from machines.simulated.resets import home, reset
from machines.simulated.words import GcodeError

_HELP = "[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]"
_SETTING = re.compile(r"\$([-+]?\d+\.?\d*)=([-+]?(?:\d+\.?\d*|\.\d+))")
_LIMITED_HZ = 30_000
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


def run_system_command(fw: Controller, line: str) -> Task:
    """Carry out; raises GcodeError. The `ok` is the caller's."""
    if line == "$":
        fw.say(_HELP)
    elif line.startswith("$J"):
        yield from _jog(fw, line)
    elif line == "$$":
        if fw.state in ("Run", "Hold"):
            raise GcodeError(8)
        for text in reports.settings_lines(fw):
            fw.say(text)
    elif line == "$G":
        fw.say(reports.parser_state(fw))
    elif line == "$C":
        _toggle_check_mode(fw)
    elif line == "$X":
        if fw.state == "Alarm":
            if "D" in fw.pressed:
                raise GcodeError(13)
            fw.say("[MSG:Caution: Unlocked]")
            fw.state = "Idle"
    elif line[1] in "$GCX":
        raise GcodeError(3)
    else:
        if fw.state not in ("Idle", "Alarm"):
            raise GcodeError(8)
        yield from _run_at_standstill(fw, line)


def _toggle_check_mode(fw: Controller) -> None:
    if fw.state == "Check":
        fw.say("[MSG:Disabled]")
        fw.after_task = partial(reset, fw)  # the answer comes first, then the banner
    elif fw.state == "Idle" and not fw.stepper.planner.blocks:
        fw.state = "Check"
        fw.say("[MSG:Enabled]")
    else:
        raise GcodeError(8)


def _run_at_standstill(fw: Controller, line: str) -> Task:
    if line == "$#":
        for text in reports.offsets_lines(fw):
            fw.say(text)
    elif line == "$H":
        if not fw.settings[22]:
            raise GcodeError(5)
        if "D" in fw.pressed:
            raise GcodeError(13)
        yield from home(fw)
    elif line == "$SLP":
        fw.after_task = partial(sleep, fw)  # the answer comes first
    elif line == "$I":
        for text in reports.build_info(fw):
            fw.say(text)
    elif line.startswith("$RST="):
        yield from _restore(fw, line[5:])
    elif line == "$N":
        for k, text in fw.startup.items():
            fw.say(f"$N{k}={text}")
    elif line.startswith("$N"):
        yield from _run_startup_line(fw, line)
    else:
        yield from _change_setting(fw, line)


def _change_setting(fw: Controller, line: str) -> Task:
    match = _SETTING.fullmatch(line)
    if match is None:
        raise GcodeError(2 if not line[1:2].isdigit() else 3)
    number, value = int(float(match.group(1))), float(match.group(2))
    if number not in fw.settings:
        raise GcodeError(3)
    if value < 0:
        raise GcodeError(4)
    if number == 0 and value < 3:
        raise GcodeError(6)
    if number == 20 and value and not fw.settings[22]:
        raise GcodeError(10)
    if 100 <= number <= 112:
        changed = {**fw.settings, number: value}
        axis = number % 10
        if changed[100 + axis] * changed[110 + axis] / 60 > _LIMITED_HZ:
            raise GcodeError(12)
    yield from eeprom(fw, fw.traits.eeprom_write_s)
    before, fw.settings[number] = fw.settings[number], value
    if 100 <= number <= 102 and value:
        fw.count_steps_anew(number - 100, before)
    if number == 22 and not value:
        fw.settings[20] = 0.0
    fw.stepper.planner.use_settings(fw.settings)
    if number == 10:
        fw.wco_in = 0


def _run_startup_line(fw: Controller, line: str) -> Task:
    match = re.fullmatch(r"\$N([01])=(.*)", line)
    if match is None:
        raise GcodeError(3 if line[2:3].isdigit() else 2)
    if fw.state != "Idle":
        raise GcodeError(8)
    if match.group(2):
        yield from carry_out_gcode(fw, match.group(2).encode("latin-1"))
    yield from eeprom(fw, 3 * fw.traits.eeprom_write_s)
    fw.startup[int(match.group(1))] = match.group(2)


def _restore(fw: Controller, what: str) -> Task:
    if what not in ("$", "#", "*"):
        raise GcodeError(3)
    yield from eeprom(fw, 10 * fw.traits.eeprom_write_s)
    if what in "$*":
        before = dict(fw.settings)
        fw.settings.update(fw.traits.all_settings())
        for axis in range(3):
            fw.count_steps_anew(axis, before[100 + axis])
    if what in "#*":
        fw.interpreter.stored = dict.fromkeys(fw.interpreter.stored, ZERO)
    if what == "*":
        fw.startup = {0: "", 1: ""}
    fw.say("[MSG:Restoring defaults]")
    fw.after_task = partial(reset, fw)


def _jog(fw: Controller, line: str) -> Task:
    """Jog by $J=: its own modes, error:15 outside the travel, several may be queued, cancelled by 0x85."""
    if fw.state not in ("Idle", "Jog"):
        raise GcodeError(8)
    if not line.startswith("$J="):
        raise GcodeError(3)
    action = fw.interpreter.read(line[3:].encode("latin-1"), jog=True)
    if set(action.words.commands) - {"distance", "units", "non-modal"} or action.words.non_modal not in ("", "G53"):
        raise GcodeError(16)
    if action.move is None:
        raise GcodeError(26)
    if fw.settings[20] and is_out_of_travel(fw, action.move.target):
        raise GcodeError(15)
    yield from plan(fw, action.move.target, action.feed / 60.0, rapid=False, feed=action.feed, kind="jog")
    fw.interpreter.position = action.move.target
    if fw.state == "Idle" and fw.stepper.planner.blocks:
        fw.state = "Jog"
        fw.stepper.start(fw.now_s)


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
