"""How long silence is legal: what the line waits for, and no longer."""

from __future__ import annotations

import pytest

from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState, Step
from machines.grbl.settings import ControllerSettings
from machines.grbl.timeouts import MARGIN_S, longest_homing_s, longest_wait_s, motion_time_s

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
    short, long = (longest_wait_s(steps(b"G4P%d" % p)[0], (), SETTINGS, FULL, standing=True) for p in (1, 100))
    assert short is not None and long is not None and 99.0 < long - short < 110.0


def test_what_stands_idle_waits_for_nothing_but_a_dwell_or_a_spindle() -> None:
    moves = steps(b"G1X10F60", b"X20", b"M3S1000", b"M2")
    waits = [longest_wait_s(step, moves[:2], SETTINGS, FULL, standing=True) for step in moves]
    assert waits[0] == waits[1] == waits[3] == MARGIN_S and waits[2] is not None and waits[2] > 20.0


def test_all_that_is_under_way_may_be_waited_for_but_no_more() -> None:
    """Rest to rest, 10 mm at 1 mm/s and 200 mm/s2 (Z the weakest: 100): 10.01 s each."""
    moves = steps(b"G1X10F60", b"X20", b"X30")
    wait_s = longest_wait_s(moves[2], moves[:2], SETTINGS, FULL)
    assert wait_s is not None and 3 * 10.01 < wait_s < MARGIN_S + 2 * 3 * 10.01


def test_an_arc_is_as_many_blocks_as_it_has_chords() -> None:
    """Radius 10 and $12 = 0.002: half a circle is 79 chords of 0.4 mm, each at worst from rest to rest."""
    settings = ControllerSettings(values={**VALUES, 12: "0.002"})
    (arc,) = steps(b"G2X20I10F3000")
    chord_mm = arc.length_mm / 79
    assert motion_time_s(arc, settings, FULL) == pytest.approx(79 * 2 * (chord_mm / 100) ** 0.5, rel=0.03)


def test_an_arc_that_reaches_its_feed_pays_a_ramp_for_each_chord() -> None:
    settings = ControllerSettings(values={**VALUES, 12: "0.002"})
    (arc,) = steps(b"G2X20I10F60")
    assert motion_time_s(arc, settings, FULL) == pytest.approx(arc.length_mm + 79 * 1 / 100, abs=0.05)


def test_a_feed_override_stretches_the_time() -> None:
    (move,) = steps(b"G1X100F600")
    assert motion_time_s(move, SETTINGS, (10, 100, 100)) > 9.5 * motion_time_s(move, SETTINGS, FULL)


def test_homing_may_take_one_and_a_half_travels_at_the_seek_rate() -> None:
    assert longest_homing_s(SETTINGS) > 1.5 * 680 / 500 * 60
    assert longest_homing_s(ControllerSettings()) == 300.0
