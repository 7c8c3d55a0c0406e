"""Every alarm and every state of GRBL 1.1 in one table each: what is heard, what is answered, what is kept.

After the firmware's own source (protocol.c, system.c, limits.c, motion_control.c of GRBL 1.1) and measurements of it:
an alarm is said, then the program stands still for 500 ms; 1 and 2 forget a reset that came meanwhile and wait for a
new one; 3 and 6 to 10 end in a restart of the firmware's own; 4 and 5 only lock, with the spindle on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest

from machines.simulated import GRBL_11
from tests.machines.simulated.terminal import Terminal

HOMED = replace(GRBL_11, homing=True).with_settings({20: 1, 21: 1})
BANNER, LOCKED = "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"
RESET_TO_CONTINUE = "[MSG:Reset to continue]"


def homed(t: Terminal) -> None:
    t.ask("$X\n" if t.mill.firmware.traits.homing_alarm else "$H\n", 120.0)
    t.ask("G0X-20Y-20Z-5\nM3S1000\n", 8.0)


def run_into_a_limit_switch(t: Terminal) -> None:
    homed(t)
    t.ask("G1X-30F600\n", 0.5)
    t.mill.press("limit")


def run_out_of_the_travel(t: Terminal) -> None:
    """While it moves: it has to stop in good order first."""
    homed(t)
    t.ask("G1X-30F600\n", 0.5)
    assert t.mill.firmware.state == "Run"
    t.ask("X20\n", 0.0)


def reset_in_motion(t: Terminal) -> None:
    homed(t)
    t.ask("G1X-30F600\n", 0.5)
    t.ask("\x18", 0.0)


def probe_what_touches_already(t: Terminal) -> None:
    homed(t)
    t.ask("G0Z-40\n", 5.0)
    t.ask("G38.2Z-50F600\n", 0.0)


def probe_in_the_air(t: Terminal) -> None:
    homed(t)
    t.ask("G38.2Z-6F600\n", 0.0)


def reset_while_homing(t: Terminal) -> None:
    homed(t)
    t.ask("$H\n", 1.0)
    t.ask("\x18", 0.0)


def open_the_door_while_homing(t: Terminal) -> None:
    homed(t)
    t.ask("$H\n", 1.0)
    t.mill.press("door")
    t.mill.press("close-door")


def fail_to_home(t: Terminal) -> None:
    homed(t)
    t.ask("$H\n", 0.0)


@dataclass(frozen=True)
class AlarmRow:
    """restarts: by itself; needs_reset: hears nothing else; answered: the line that led to it gets its `ok`"""

    provoke: Callable[[Terminal], None]
    restarts: bool = False
    needs_reset: bool = False
    answered: bool = False
    keeps_position: bool = False
    spindle_stays_on: bool = False


ALARMS = {
    1: AlarmRow(run_into_a_limit_switch, needs_reset=True),
    2: AlarmRow(run_out_of_the_travel, needs_reset=True, keeps_position=True),
    3: AlarmRow(reset_in_motion, restarts=True),
    4: AlarmRow(probe_what_touches_already, answered=True, keeps_position=True, spindle_stays_on=True),
    5: AlarmRow(probe_in_the_air, answered=True, keeps_position=True, spindle_stays_on=True),
    6: AlarmRow(reset_while_homing, restarts=True),
    7: AlarmRow(open_the_door_while_homing, restarts=True),
    8: AlarmRow(fail_to_home, restarts=True),
    9: AlarmRow(fail_to_home, restarts=True),
    10: AlarmRow(fail_to_home, restarts=True),
}


@pytest.mark.parametrize("number", ALARMS)
def test_an_alarm_as_the_firmware_has_it(number: int) -> None:
    row = ALARMS[number]
    surface = -25.0 if number == 4 else None
    t = Terminal(replace(HOMED, homing_alarm=number if number in (8, 9, 10) else 0, probe_surface_mm=surface))
    row.provoke(t)
    words: list[str] = []
    while f"ALARM:{number}" not in words:
        words += t.wait(0.02)
        assert t.mill.now_s < 1000.0, words
    firmware = t.mill.firmware
    assert firmware.spindle_on() is row.spindle_stays_on
    assert t.ask("?!~", 0.4) == []  # for half a second nothing is answered
    after = t.ask("\x18" if row.needs_reset else "?", 0.3)  # a reset that comes now is lost on 1 and 2
    if row.needs_reset:
        assert after == [RESET_TO_CONTINUE]
        assert t.ask("?\n$X\n$H\nG0X0\n!~", 5.0) == []
        after = t.ask("\x18")
    assert (BANNER in after) is (row.restarts or row.needs_reset)
    assert (LOCKED in after) is (row.restarts or row.needs_reset)
    assert ("ok" in after) is row.answered
    assert t.ask("?")[-1].startswith("<Alarm")
    assert t.ask("G0X-1\n") == ["error:9"]
    assert firmware.position_lost is not row.keeps_position
    assert firmware.spindle_on() is row.spindle_stays_on
    assert t.ask("$X\n") == ["[MSG:Caution: Unlocked]", "ok"]
    assert t.ask("?")[-1].startswith("<Idle")


@dataclass(frozen=True)
class StateRow:
    """How to get there (parts one after the other); what G0X-21 and $# answer; the state after !, ~ and 0x18."""

    reach: str
    seconds: float
    line: str | None
    query: str | None
    held: str
    resumed: str
    reset: str
    spindle_on: bool = True
    loses_position: bool = False


STATES = {
    "Idle": StateRow("", 0.1, "ok", "ok", "Hold:0", "Idle", "Idle"),
    "Run": StateRow("G1X-100F600\n", 0.5, "ok", "error:8", "Hold:0", "Run", "Alarm", loses_position=True),
    "Hold": StateRow("G1X-100F600\n!", 1.0, None, None, "Hold:0", "Run", "Idle"),
    "Jog": StateRow("$J=X-100F600\n", 0.5, "error:9", "error:8", "Idle", "Jog", "Alarm", loses_position=True),
    "Alarm": StateRow("$SLP\n|\x18", 0.5, "error:9", "ok", "Alarm", "Alarm", "Alarm", spindle_on=False),
    "Door": StateRow("\x84", 0.5, None, None, "Door:0", "Idle", "Idle", spindle_on=False),
    "Check": StateRow("$C\n", 0.2, "ok", "error:8", "Check", "Check", "Idle"),
    "Sleep": StateRow("$SLP\n", 0.2, None, None, "Sleep", "Sleep", "Alarm", spindle_on=False),
}


def in_state(name: str) -> Terminal:
    t = Terminal(HOMED)
    homed(t)
    for part in STATES[name].reach.split("|"):
        t.ask(part, STATES[name].seconds)
    assert t.ask("?", 0.05)[-1].startswith(f"<{name}")
    return t


@pytest.mark.parametrize("name", STATES)
def test_a_state_as_the_firmware_has_it(name: str) -> None:
    row = STATES[name]
    assert in_state(name).mill.firmware.spindle_on() is row.spindle_on
    assert in_state(name).ask("G0X-21\n")[-1:] == ([row.line] if row.line else [])
    assert in_state(name).ask("$#\n")[-1:] == ([row.query] if row.query else [])
    for byte, after in (("!", row.held), ("~", row.resumed), ("\x18", row.reset)):
        t = in_state(name)
        t.ask(byte, 1.5)
        assert t.ask("?", 0.05)[-1].startswith(f"<{after}|"), byte
        if byte == "\x18":
            assert t.mill.firmware.position_lost is row.loses_position
            assert not t.mill.firmware.spindle_on()
