"""Alarms, and stops that lose the position."""

from __future__ import annotations

from machines.simulated.controller import Controller
from machines.simulated.recording import CutSegment

PROBING = (4, 5)


def raise_alarm(fw: Controller, code: int) -> None:
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


def stop_spindle(fw: Controller) -> None:
    fw.spindle = "M5"
    fw.interpreter.coolant.clear()


def cut_off(fw: Controller, code: int) -> None:
    """Switch the steppers off in motion: the position is no longer what is counted."""
    x, y, z, block = fw.stepper.stop_dead(fw.now_s)
    if block is not None:
        slip = fw.traits.reset_slip_mm
        sx, sy, sz = fw.shift
        start = fw.to_physical(x, y, z)
        fw.shift = (sx + slip * block.ux, sy + slip * block.uy, sz + slip * block.uz)
        end = fw.to_physical(x, y, z)
        on = fw.spindle_on()
        fw.recording.add(CutSegment(start, end, block.rapid, block.feed, on, block.line, fw.now_s, False, "slip"))
    fw.position_lost = True
    raise_alarm(fw, code)
