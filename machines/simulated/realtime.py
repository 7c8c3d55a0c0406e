"""Realtime bytes: picked out on arrival, acted on at once, never counted, never answered by ok."""

from __future__ import annotations

from machines.simulated.controller import Controller
from machines.simulated.reports import status_report
from machines.simulated.resets import reset
from machines.simulated.suspending import cancel_jog, change_overrides, hold, open_door, resume

RESET, STATUS, HOLD, RESUME = 0x18, 0x3F, 0x21, 0x7E
DOOR, JOG_CANCEL = 0x84, 0x85
_FEED = {0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}
_RAPID = {0x95: 100, 0x96: 50, 0x97: 25}
_SPINDLE = {0x9A: 10, 0x9B: -10, 0x9C: 1, 0x9D: -1}


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
