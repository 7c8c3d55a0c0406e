"""Lines that begin with `$`."""

from __future__ import annotations

import re
from functools import partial

from machines.simulated import reports
from machines.simulated.blocks import carry_out_gcode, eeprom, is_out_of_travel, plan
from machines.simulated.controller import Controller, Task
from machines.simulated.interpreter import ZERO
from machines.simulated.interruptions import sleep
from machines.simulated.resets import home, reset
from machines.simulated.words import GcodeError

_HELP = "[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]"
_SETTING = re.compile(r"\$([-+]?\d+\.?\d*)=([-+]?(?:\d+\.?\d*|\.\d+))")
_LIMITED_HZ = 30_000


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
        yield from _run_standing(fw, line)


def _toggle_check_mode(fw: Controller) -> None:
    if fw.state == "Check":
        fw.say("[MSG:Disabled]")
        fw.after_task = partial(reset, fw)  # the answer comes first, then the banner
    elif fw.state == "Idle" and not fw.stepper.planner.blocks:
        fw.state = "Check"
        fw.say("[MSG:Enabled]")
    else:
        raise GcodeError(8)


def _run_standing(fw: Controller, line: str) -> Task:
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
