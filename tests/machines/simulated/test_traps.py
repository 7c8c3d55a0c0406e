"""Each row of section 1 of the reference on machines: what the real firmware does and a naive model does not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from machines.errors import PortLostError
from machines.simulated import FLUIDNC, GRBL_11, GRBL_11_ECHO, GRBLHAL, MemoryPort
from tests.machines.simulated.terminal import Terminal

HOMED = replace(GRBL_11, homing=True)


def test_ok_runs_ahead_of_execution_by_planner_and_segment_buffer():
    """15 planner blocks and the block under way are answered and not cut; short blocks fill the segments as well."""
    t = Terminal()
    t.ask("G1F600")
    for k in range(40):
        t.port.write(b"X%d\n" % (k + 1))
        t.wait(0.02)
    answered = t.mill.firmware.received - 1 - (t.mill.firmware.task is not None)
    assert 15 <= answered - t.mill.recording.count <= 17


@pytest.mark.parametrize(("traits", "answers"), [(GRBL_11, 2), (GRBLHAL, 1), (FLUIDNC, 1)])
def test_crlf_answers(traits, answers):
    t = Terminal(traits)
    assert t.ask("G4P0\r\n").count("ok") == answers
    t.port.write(b"G4P0\r")
    assert t.ask("\nG4P0\n").count("ok") == answers + 1


def test_damaged_eeprom_says_error_7_before_the_banner():
    t = Terminal(replace(GRBL_11, damaged_eeprom=True))
    assert t.first.index("error:7") < t.first.index("Grbl 1.1h ['$' for help]")
    assert "error:7" not in Terminal().first


def test_homing_is_deaf_until_it_ends_then_reports_and_answers():
    t = Terminal(HOMED)
    assert t.ask("$H\n", 0.01) == []
    assert all(t.ask("?!~") == [] for _ in range(10))
    lines = t.wait(120.0)
    assert lines[0].startswith("<") and lines[1:] == ["ok"]
    assert t.status().startswith("<Idle|MPos:-1.000,-1.000,-1.000")
    assert t.mill.firmware.physical() == pytest.approx((199.0, 149.0, 9.0))


def test_m0_keeps_its_ok_until_cycle_start():
    t = Terminal()
    assert t.ask("M0\n", 5.0) == []
    assert t.status().startswith("<Hold:0")
    assert t.ask("~") == ["ok"]


@pytest.mark.parametrize("line", ["M3S1000", "M8", "G4P0.1", "M2", "M5M9M30", "G10L2P1X1", "G92X0", "G55"])
def test_sync_words_wait_for_an_empty_buffer(line):
    t = Terminal(replace(GRBL_11, mist=True))
    t.ask("S500M4M7\n")
    t.ask("G1X10F600\n")
    assert "ok" not in t.ask(line + "\n", 0.8)
    assert "ok" in t.wait(0.8)
    assert t.mill.recording.count == 1


def test_ctrl_x_in_motion_is_alarm_3_and_everything_is_gone():
    t = Terminal()
    t.ask("G1X10F600\nX0\nX10\n")
    words = t.ask("\x18", 0.7)
    assert words == ["ALARM:3", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]
    assert t.status().startswith("<Alarm")
    assert t.mill.firmware.position_lost
    assert t.ask("G0X0\n") == ["error:9"]
    assert t.ask("$X\n") == ["[MSG:Caution: Unlocked]", "ok"]
    x = t.mill.firmware.stepper.x
    assert t.mill.firmware.physical()[0] == pytest.approx(x + GRBL_11.reset_slip_mm)


def test_ctrl_x_when_idle_is_a_banner_and_modal_state_is_gone():
    t = Terminal()
    t.ask("G10L2P1X3\n")
    t.ask("G91G20G92X1\nG43.1Z2\n")
    assert t.ask("\x18") == ["Grbl 1.1h ['$' for help]"]
    assert "[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]" in t.ask("$G\n")
    offsets = t.ask("$#\n")
    assert "[G92:0.000,0.000,0.000]" in offsets and "[TLO:0.000]" in offsets and "[G54:3.000,0.000,0.000]" in offsets


def test_power_on_lock_survives_ctrl_x_and_after_unlock_ctrl_x_does_not_lock():
    t = Terminal(HOMED)
    assert "[MSG:'$H'|'$X' to unlock]" in t.first
    assert t.ask("G0X1\n") == ["error:9"]
    assert "[MSG:'$H'|'$X' to unlock]" in t.ask("\x18")
    assert t.status().startswith("<Alarm")
    t.ask("$X\n")
    assert t.ask("\x18") == ["Grbl 1.1h ['$' for help]"]
    fresh = Terminal()
    fresh.ask("$22=1\n")
    assert fresh.ask("\x18") == ["Grbl 1.1h ['$' for help]"]


def test_lost_port_finishes_what_it_holds_then_stands_idle_with_the_spindle_on():
    t = Terminal()
    t.ask("M3S1000\nG1F600\n")
    t.port.write(b"".join(b"X%d\n" % k for k in range(1, 31)))
    t.wait(0.5)
    t.mill.unplug()
    with pytest.raises(PortLostError):
        t.port.read(1.0)
    t.mill.advance(t.mill.now_s + 60.0)
    assert t.mill.firmware.state == "Idle"
    assert t.mill.firmware.spindle_on()
    assert t.mill.recording.count == 30
    t.mill.replug()
    assert MemoryPort(t.mill).read(0.1) == b""


def test_hold_button_just_stops_the_answers():
    t = Terminal()
    t.ask("G1X10F600\n")
    t.mill.press("hold")
    assert t.ask("X20\nX30\n", 3.0) == []
    assert t.status().startswith("<Hold:0")
    t.mill.press("start")
    assert t.wait(10.0)[:2] == ["ok", "ok"]
    assert t.mill.firmware.stepper.x == 30.0


def test_a_cycle_start_before_the_hold_is_complete_is_ignored():
    t = Terminal()
    t.ask("G1X10F600\n", 0.7)
    t.ask("!~", 2.0)
    assert t.status().startswith("<Hold:0") and t.mill.firmware.stepper.x < 10.0
    t.ask("~", 5.0)
    assert t.status().startswith("<Idle|MPos:10.000")


def test_after_an_error_the_rest_is_executed():
    t = Terminal()
    assert t.ask("G1X1F600\nQ3\nX2\n", 3.0) == ["ok", "error:20", "ok"]
    assert t.mill.firmware.stepper.x == 2.0


def test_one_dropped_byte_in_a_number_is_a_wrong_cut_without_a_word():
    t = Terminal()
    assert t.ask("G1X1F600\nX10\n", 3.0) == ["ok", "ok"]
    assert t.mill.firmware.stepper.x == 10.0  # meant was X1.0


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("%", 1), ("G1X", 2), ("G1X-", 2),
        ("X1.2.3F1", 1), ("F-1", 4), ("$H", 5), ("$0=2", 6), ("G81", 20), ("T1M6", 20),
        ("G43H1", 20), ("G64", 20), ("G1X1", 22), ("G1G2X1F1", 24), ("G0G80", 21), ("G17G18", 21), ("M3M4", 21),
        ("G1.5", 23), ("M3.1", 23), ("X1X2", 25), ("G10L2P1", 26), ("G92", 26), ("N10000001", 27), ("G4", 28),
        ("G10P1X1", 28), ("G10L2P9X1", 29), ("G2G53X1I1F1", 30), ("G80X1", 31), ("G2Z1I1F1", 32), ("G2X1I5J5F1", 33),
        ("G2X9R1F1", 34), ("G2X1F1", 35), ("P1", 36), ("G43.1X1", 37), ("T256", 38), ("$20=1", 10), ("$100=99999", 12),
        ("$J=X1", 22), ("$J=G2X1F1", 16), ("$nonsense", 2), ("$XY", 3), ("G1X1F100" + "0" * 72, 11),
    ],
)  # fmt: skip
def test_error_numbers(line, error):
    assert Terminal().ask(line + "\n") == [f"error:{error}"]


def test_comments_and_blanks_do_not_count_as_length():
    t = Terminal()
    assert t.ask("G1 X1 F100 " + "(" + "x" * 90 + ")" + " ; and more of it\n", 0.2) == ["ok"]
    assert t.ask("G1X" + "0" * 75 + "1\n") == ["ok"]  # 79 characters
    assert t.ask("G1X" + "0" * 76 + "1\n") == ["error:11"]


def test_buffer_fields_only_when_asked():
    t = Terminal()
    assert "Bf:" not in t.status()
    t.ask("$10=3\n")
    assert "|Bf:15,128|" in t.status()
    hal = Terminal(GRBLHAL)
    hal.ask("$10=3\n")
    assert "|Bf:100,1023|" in hal.status()
    assert "[OPT:V,15,128]" in t.ask("$I\n")


def test_a_starved_stepper_ends_idle_with_blocks_left_until_cycle_start():
    t = Terminal(replace(GRBL_11, idle_with_blocks_at=3))
    t.ask("G1F600\n")
    t.port.write(b"".join(b"X%d\n" % k for k in range(1, 9)))
    t.wait(10.0)
    assert t.status().startswith("<Idle")
    assert t.mill.firmware.stepper.x == 3.0
    t.ask("~", 10.0)
    assert t.mill.firmware.stepper.x == 8.0
    assert [s.end[0] for s in t.mill.recording.cuts()] == [1, 2, 3, 4, 5, 6, 7, 8]


def test_power_cycle_forgets_the_position_and_the_tool_stays():
    t = Terminal()
    t.ask("G1X10F600\n", 3.0)
    t.mill.power_cycle()
    assert "Grbl" in "".join(t.wait(3.0))
    assert "MPos:0.000,0.000,0.000" in t.status()
    t.ask("G1X1F600\n", 3.0)
    assert t.mill.recording.segments[-1].end == pytest.approx((11.0, 0.0, 0.0))


def test_eeprom_writes_lose_what_arrives_meanwhile():
    t = Terminal()
    words = t.ask("$10=1\n" + "G4P0\n" * 20, 1.0)
    assert t.mill.serial.lost_deaf > 50
    assert words.count("ok") < 12


def test_wco_and_overrides_come_now_and_then_and_after_a_change():
    t = Terminal()
    reports = [t.status() for _ in range(20)]
    assert sum("WCO:" in r for r in reports) == 2
    assert sum("Ov:" in r for r in reports) == 2
    assert not any("WCO:" in r and "Ov:" in r for r in reports)
    t.ask("G92X5\n")
    assert "WCO:-5.000,0.000,0.000" in t.status()
    t.ask(b"\x91")
    assert "Ov:110,100,100" in t.status()


def test_echo_comes_before_the_answer():
    assert Terminal(GRBL_11_ECHO).ask("g1 x1 (why) f100\n") == ["[echo: G1X1F100]", "ok"]


def test_wrong_baud_is_garbage_both_ways():
    t = Terminal(baud=57600)
    assert "Grbl" not in "".join(t.first)
    assert not any("ok" in w for w in t.ask("G4P0\n"))


def test_door_stops_spindle_and_needs_closing_and_cycle_start():
    t = Terminal()
    t.ask("M3S100\n")
    t.ask("G1X10F600\n")
    t.mill.press("door")
    t.wait(1.0)
    assert t.status().startswith("<Door:1") and not t.mill.firmware.spindle_on()
    t.ask("~")
    assert t.status().startswith("<Door:1")
    t.mill.press("close-door")
    assert t.status().startswith("<Door:0")
    t.ask("~", 3.0)
    assert t.status().startswith("<Idle|MPos:10.000") and t.mill.firmware.spindle_on()


def test_check_mode_moves_nothing_and_ends_with_a_reset():
    t = Terminal()
    assert t.ask("$C\n") == ["[MSG:Enabled]", "ok"]
    assert t.ask("G1X10F600\nG1X\nM3S5\n", 2.0) == ["ok", "error:2", "ok"]
    assert t.status().startswith("<Check|MPos:0.000,0.000,0.000")
    assert t.ask("$C\n") == ["[MSG:Disabled]", "ok", "Grbl 1.1h ['$' for help]"]


def test_jog_and_cancel_keep_the_position():
    t = Terminal()
    assert t.ask("$J=G91X100F600\n") == ["ok"]
    assert t.status().startswith("<Jog")
    assert t.ask("G1X1F1\n") == ["error:9"]
    t.ask(b"\x85", 0.5)
    assert t.status().startswith("<Idle")
    stopped = t.mill.firmware.stepper.x
    assert 0 < stopped < 100
    assert t.mill.firmware.interpreter.position[0] == stopped


def test_steps_per_mm_scale_what_is_reported_and_move_nothing_until_the_next_block():
    """GRBL counts steps; its parser keeps mm, so that the next block moves an axis that it does not name."""
    t = Terminal()
    t.ask("G0X100Y10\n", 3.0)
    stood = t.mill.firmware.physical()
    t.ask("$100=200\n")
    assert "MPos:125.000,10.000,0.000" in t.status()
    assert t.mill.firmware.physical() == pytest.approx(stood)
    t.ask("G0Z-1\n", 3.0)
    assert "MPos:100.000,10.000,-1.000" in t.status()
    assert t.mill.firmware.physical() == pytest.approx((80.0, 10.0, -1.0))
    t.ask("$100=250\n")
    assert "MPos:80.000,10.000,-1.000" in t.status()


def test_probe_finds_the_surface_or_raises_an_alarm():
    t = Terminal()
    words = t.ask("G38.2Z-10F100\n", 10.0)
    assert words == ["[PRB:0.000,0.000,-5.000:1]", "ok"]
    t.ask("G0Z0\n", 2.0)
    assert t.ask("G38.2Z-2F100\n", 10.0) == ["ALARM:5", "[PRB:0.000,0.000,0.000:0]", "ok"]


def test_opening_the_port_resets_a_board_that_does_so():
    t = Terminal(replace(GRBL_11, resets_on_open=True))
    t.ask("G1X5F600\n", 3.0)
    port = MemoryPort(t.mill)
    assert port.read(0.3) == b""
    assert port.read(1.0) == b"\r\n"
    assert t.mill.firmware.stepper.x == 0.0 and t.mill.firmware.physical()[0] == 5.0


def test_spindle_stop_override_only_in_hold():
    t = Terminal()
    t.ask("M3S100\n")
    t.ask(b"\x9e")
    assert t.mill.firmware.spindle_on()
    t.ask(b"!\x9e")
    assert not t.mill.firmware.spindle_on()
    t.ask("~")
    assert t.mill.firmware.spindle_on()


def test_line_numbers_when_built_in():
    t = Terminal(replace(GRBL_11, line_numbers=True, planner_blocks=14))
    assert "[OPT:VN,14,128]" in t.ask("$I\n")
    t.ask("N77G1X10F600\n")
    assert "|Ln:77|" in t.status()
