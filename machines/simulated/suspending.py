"""Hold, door, sleep, jog cancel and overrides: what interrupts motion or changes its speed, and what lets it go on."""

from __future__ import annotations

from machines.simulated.alarms import cut_off
from machines.simulated.controller import Controller


def hold(fw: Controller) -> None:
    """Hold, asked for by `!` or the button."""
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
