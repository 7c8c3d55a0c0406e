"""The end of alarms, resets, start-up and homing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import inf

from machines.simulated.blocks import carry_out_gcode
from machines.simulated.controller import NEVER, Controller, CutSegment, Task
from machines.simulated.interpreter import Triple
from machines.simulated.interruptions import PROBING, cut_off, open_door, stop_spindle
from machines.simulated.reports import status_report
from machines.simulated.words import GcodeError

CRITICAL = (1, 2)  # wait for a reset


def end_alarm(fw: Controller) -> None:
    """End the half second of an alarm: alarms 1 and 2 forget a reset that was requested meanwhile and wait for a new
    one; after other alarms the controller goes on.
    """
    code, fw.alarm, fw.alarm_until_s = fw.alarm, 0, inf
    if code in CRITICAL:
        fw.critical, fw.reset_pending = True, False
        fw.say("[MSG:Reset to continue]")
    elif code not in PROBING or fw.reset_pending:
        restart(fw, locked=True)
    else:
        if fw.status_pending:
            fw.status_pending = False
            fw.say(status_report(fw))
        fw.go_on()


def reset(fw: Controller) -> None:
    """Reset as by Ctrl-X or the reset button: in motion ALARM:6 or ALARM:3, and the banner after that."""
    stop_spindle(fw)
    if fw.alarm:
        fw.reset_pending = True
    elif fw.state == "Home":
        fw.task = None
        cut_off(fw, 6)
    elif fw.stepper.moving:
        cut_off(fw, 3)
    else:
        restart(fw, locked=fw.state in ("Alarm", "Sleep"))


def restart(fw: Controller, *, locked: bool) -> None:
    """Restart everything except the EEPROM and the stepper position."""
    at = (fw.stepper.x, fw.stepper.y, fw.stepper.z)
    fw.on_restart()
    fw.power_on_state()
    fw.stepper.place(*at)
    fw.interpreter.position = at
    fw.say("")
    fw.say(fw.traits.banner)
    if locked:
        fw.state = "Alarm"
        fw.say("[MSG:'$H'|'$X' to unlock]")
    elif "D" in fw.pressed:
        open_door(fw)
    else:
        _run_startup(fw)


def _run_startup(fw: Controller) -> None:
    lines = [line for line in fw.startup.values() if line]
    if lines:
        fw.begin(_run_startup_lines(fw, lines))


def _run_startup_lines(fw: Controller, lines: list[str]) -> Task:
    for line in lines:
        try:
            yield from carry_out_gcode(fw, line.encode())
        except GcodeError as error:
            fw.say(f">{line}:error:{error.code}")
        else:
            fw.say(f">{line}:ok")


def home(fw: Controller) -> Task:
    """Carry out the whole cycle, deaf to `?` until it ends."""
    fw.state = "Home"
    machine = tuple(p + o for p, o in zip(fw.physical(), fw.traits.power_up_machine_mm, strict=True))
    at = fw.physical()
    for point, seconds in _plan_homing((machine[0], machine[1], machine[2]), fw.settings):
        yield fw.now_s + seconds
        end = tuple(p - o for p, o in zip(point, fw.traits.power_up_machine_mm, strict=True))
        there = (end[0], end[1], end[2])
        fw.recording.add(CutSegment(at, there, True, 0.0, fw.spindle_on(), fw.line, fw.now_s, True, "homing"))
        at, last = there, point
        fw.shift = _shift_for(fw, fw.stepper.where(fw.now_s), at)
        if fw.traits.homing_alarm:
            cut_off(fw, fw.traits.homing_alarm)
            yield NEVER
    fw.shift = _shift_for(fw, last, at)
    fw.stepper.place(*last)
    fw.interpreter.position = last
    fw.position_lost = False
    if fw.status_pending:
        fw.status_pending = False
        fw.say(status_report(fw))
    fw.state = "Idle"


def _shift_for(fw: Controller, machine: Triple, physical: Triple) -> Triple:
    """Return the shift that maps these machine coordinates to that physical position."""
    x, y, z = (p - k * m for k, m, p in zip(fw.scale, machine, physical, strict=True))
    return (x, y, z)


def _plan_homing(machine_mm: Triple, settings: Mapping[int, float]) -> Iterator[tuple[Triple, float]]:
    """Return points of the cycle in true machine coordinates with the seconds to get there: Z first, then X and Y
    together.

    $23: a bit for each axis that homes to its negative end; $24 locate feed, $25 seek feed, $26 debounce,
    $27 pull-off.
    """
    mask, locate, seek, pull = int(settings[23]), settings[24] / 60, settings[25] / 60, settings[27]
    debounce_s = settings[26] / 1000
    at = list(machine_mm)
    for axes in ((2,), (0, 1)):
        switch = {i: -settings[130 + i] if mask >> i & 1 else 0.0 for i in axes}
        rest = {i: s + pull if mask >> i & 1 else s - pull for i, s in switch.items()}
        for goal, speed in ((switch, seek), (rest, seek), (switch, locate), (rest, seek)):
            way = max(abs(goal[i] - at[i]) for i in axes)
            for i in axes:
                at[i] = goal[i]
            yield (at[0], at[1], at[2]), way / speed + debounce_s
