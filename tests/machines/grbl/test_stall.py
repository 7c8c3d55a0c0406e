"""How long silence is legal: what the line waits for, and no longer."""

from __future__ import annotations

from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.step import Step
from machines.grbl.settings import ControllerSettings
from machines.grbl.stall import MARGIN_S, homing_time_s, longest_wait_s, motion_time_s

VALUES = {110: "3000", 111: "3000", 112: "600", 120: "200", 121: "200", 122: "100", 130: "300", 131: "300", 132: "80"}
SETTINGS = ControllerSettings(values={**VALUES, 24: "25", 25: "500", 27: "1"})
FULL = (100, 100, 100)


def steps(*blocks: bytes) -> list[Step]:
    interpreter = Interpreter(ModalState(position_mm=(0.0, 0.0, 0.0)))
    return [interpreter.take(block) for block in blocks]


def test_a_program_stop_waits_for_a_person_for_ever() -> None:
    (stop,) = steps(b"M0")
    assert longest_wait_s(stop, (), SETTINGS, FULL) is None


def test_a_dwell_may_last_as_long_as_it_says() -> None:
    short, long = (longest_wait_s(steps(b"G4P%d" % p)[0], (), SETTINGS, FULL) for p in (1, 100))
    assert short is not None and long is not None and long - short == 99.0


def test_a_move_waits_for_one_block_a_sync_word_for_all() -> None:
    moves = steps(b"G1X10F60", b"X20", b"X30")
    move, sync = steps(b"G1X1F600")[0], steps(b"M5")[0]
    one, all_ = longest_wait_s(move, moves, SETTINGS, FULL), longest_wait_s(sync, moves, SETTINGS, FULL)
    assert one is not None and all_ is not None
    assert one > 10.0 and all_ > 30.0 and all_ - one > 15.0


def test_short_lines_are_missed_after_little_more_than_the_margin() -> None:
    moves = steps(*(b"G1X%.2fF1500" % (0.05 * k) for k in range(1, 20)))
    wait_s = longest_wait_s(moves[-1], moves[:-1], SETTINGS, FULL)
    assert wait_s is not None and MARGIN_S < wait_s < MARGIN_S + 0.5


def test_a_feed_override_stretches_the_time() -> None:
    (move,) = steps(b"G1X100F600")
    assert motion_time_s(move, SETTINGS, (10, 100, 100)) > 9.5 * motion_time_s(move, SETTINGS, FULL)


def test_homing_may_take_one_and_a_half_travels_at_the_seek_rate() -> None:
    assert homing_time_s(SETTINGS) > 1.5 * 680 / 500 * 60
    assert homing_time_s(ControllerSettings()) == 300.0
