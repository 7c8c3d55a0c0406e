"""Alarms, stops that lose the position, resets, start-up and homing."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

from machines.simulated.homing import homing_moves
from machines.simulated.recording import CutSegment
from machines.simulated.waiting import NEVER, Task
from machines.simulated.words import GcodeError

if TYPE_CHECKING:
    from machines.simulated.firmware import Firmware


CRITICAL, PROBING = (1, 2), (4, 5)


def raise_alarm(fw: Firmware, code: int) -> None:
    """Say it and stand still for half a second: whatever is asked for meanwhile is only noted.

    A probe's alarm leaves the spindle on; all others have come with a reset of the firmware's own, which stops it.
    """
    fw.state = "Alarm"
    fw.say(f"ALARM:{code}")
    fw.alarm, fw.alarm_until_s = code, fw.now_s + fw.traits.alarm_delay_s
    fw.reset_pending = fw.status_pending = False
    if code not in PROBING:
        stop_spindle(fw)
        fw.stepper.clear()


def stop_spindle(fw: Firmware) -> None:
    fw.spindle = "M5"
    fw.interpreter.coolant.clear()


def end_alarm(fw: Firmware) -> None:
    """The half second is over: 1 and 2 forget a reset asked for meanwhile and wait for a new one, the rest go on."""
    code, fw.alarm, fw.alarm_until_s = fw.alarm, 0, inf
    if code in CRITICAL:
        fw.critical, fw.reset_pending = True, False
        fw.say("[MSG:Reset to continue]")
    elif code not in PROBING or fw.reset_pending:
        fw.restart(locked=True)
    else:
        if fw.status_pending:
            fw.status_pending = False
            fw.say(fw.report.text(fw))
        fw.go_on()


def cut_off(fw: Firmware, code: int) -> None:
    """Steppers off in motion: the position is no longer what is counted."""
    x, y, z, block = fw.stepper.stop_dead(fw.now_s)
    if block is not None:
        slip = fw.traits.reset_slip_mm
        sx, sy, sz = fw.shift
        start = (x + sx, y + sy, z + sz)
        fw.shift = (sx + slip * block.ux, sy + slip * block.uy, sz + slip * block.uz)
        end = (x + fw.shift[0], y + fw.shift[1], z + fw.shift[2])
        on = fw.spindle_on()
        fw.recording.add(CutSegment(start, end, block.rapid, block.feed, on, block.line, fw.now_s, False, "slip"))
    fw.position_lost = True
    fw.raise_alarm(code)


def reset(fw: Firmware) -> None:
    """Ctrl-X or the reset button: in motion ALARM:6 or ALARM:3, and the banner when that has been said."""
    stop_spindle(fw)
    if fw.alarm:
        fw.reset_pending = True
    elif fw.state == "Home":
        fw.task = None
        fw.cut_off(6)
    elif fw.stepper.moving:
        fw.cut_off(3)
    else:
        fw.restart(locked=fw.state in ("Alarm", "Sleep"))


def restart(fw: Firmware, *, locked: bool) -> None:
    """Everything but the EEPROM and the stepper position starts anew."""
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
        fw.open_door()
    else:
        _run_startup(fw)


def _run_startup(fw: Firmware) -> None:
    lines = [line for line in fw.startup.values() if line]
    if lines:
        fw._begin(_startup_task(fw, lines))


def _startup_task(fw: Firmware, lines: list[str]) -> Task:
    for line in lines:
        try:
            yield from fw.gcode(line.encode())
        except GcodeError as error:
            fw.say(f">{line}:error:{error.code}")
        else:
            fw.say(f">{line}:ok")


def home(fw: Firmware) -> Task:
    """The whole cycle: deaf to `?` until it ends."""
    fw.state = "Home"
    machine = tuple(p + o for p, o in zip(fw.physical(), fw.traits.power_up_machine_mm, strict=True))
    at = fw.physical()
    for point, seconds in homing_moves((machine[0], machine[1], machine[2]), fw.settings):
        yield fw.now_s + seconds
        end = tuple(p - o for p, o in zip(point, fw.traits.power_up_machine_mm, strict=True))
        there = (end[0], end[1], end[2])
        fw.recording.add(CutSegment(at, there, True, 0.0, fw.spindle_on(), fw.line, fw.now_s, True, "homing"))
        at, last = there, point
        x, y, z = fw.stepper.where(fw.now_s)
        fw.shift = (at[0] - x, at[1] - y, at[2] - z)
        if fw.traits.homing_alarm:
            fw.cut_off(fw.traits.homing_alarm)
            yield NEVER
    fw.shift = tuple(-o for o in fw.traits.power_up_machine_mm)  # type: ignore[assignment]
    fw.stepper.place(*last)
    fw.interpreter.position = last
    fw.position_lost = False
    if fw.status_pending:
        fw.status_pending = False
        fw.say(fw.report.text(fw))
    fw.state = "Idle"
