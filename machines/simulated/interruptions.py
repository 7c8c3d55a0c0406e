"""Interruptions of motion, changes of its speed, and resuming: alarms, stops that lose the position, hold, door, sleep,
jog cancel and overrides.
"""

from __future__ import annotations

from machines.simulated.controller import Controller, CutSegment

PROBING = (4, 5)


def raise_alarm(fw: Controller, code: int) -> None:
    """Report an alarm and stand still for half a second; requests that come meanwhile are only noted.

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
    """Switch the steppers off in motion: the counters no longer match the position."""
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


def hold(fw: Controller) -> None:
    """Hold, as requested by `!` or the button."""
    if fw.state == "Run":
        fw.state, fw.held = "Hold", False
        fw.stepper.hold()
    elif fw.state == "Jog":
        cancel_jog(fw)
    elif fw.state == "Idle":
        fw.state, fw.held = "Hold", True


def cancel_jog(fw: Controller) -> None:
    if fw.state == "Jog":
        fw.jog_cancel = True
        fw.stepper.hold()


def resume(fw: Controller) -> None:
    """Resume by a cycle start, from `~` or the button. Before a hold is complete it is ignored."""
    if fw.state == "Door" and fw.held and "D" not in fw.pressed:
        fw.door_restoring = True
        fw.spindle_paused = False
        fw.held = False
        _leave_hold(fw)
    elif fw.state == "Hold" and fw.held:
        fw.spindle_paused = False
        _leave_hold(fw)
    elif fw.state == "Idle":
        fw.starved = False
        fw.start_cycle()


def _leave_hold(fw: Controller) -> None:
    fw.door_restoring = False
    fw.state = "Idle"
    fw.stepper.segments.holding = False
    fw.start_cycle()
    fw.go_on()


def open_door(fw: Controller) -> None:
    fw.pressed.add("D")
    if fw.state in ("Alarm", "Check"):
        return
    fw.say("[MSG:Check Door]")
    if fw.state == "Home":
        fw.task = None
        cut_off(fw, 7)
    elif fw.state == "Jog":
        cancel_jog(fw)
    elif fw.state != "Sleep":
        was = fw.state
        fw.state = "Door"
        if was == "Run":
            fw.held = False
            fw.stepper.hold()
        elif not fw.stepper.moving:
            fw.complete_hold()


def sleep(fw: Controller) -> None:
    moving = fw.stepper.moving
    fw.state, fw.held = "Sleep", not moving
    if moving:
        fw.stepper.hold()
    else:
        fw.complete_hold()


def apply_overrides(fw: Controller) -> None:
    planner = fw.stepper.planner
    feed, rapid = fw.feed_percent / 100.0, fw.rapid_percent / 100.0
    if (feed, rapid) != (planner.feed_override, planner.rapid_override):
        planner.feed_override, planner.rapid_override = feed, rapid
        planner.use_overrides()
        if fw.stepper.moving:
            fw.stepper.segments.fill()


def change_overrides(fw: Controller) -> None:
    fw.ov_in = 0
    apply_overrides(fw)
