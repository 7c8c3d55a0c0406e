"""Where a line sends the tool: offsets, units, distance modes, stored points; and what a probe touches on the way."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, sqrt

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from machines.simulated import GRBL_11, SimulatedMill
from machines.simulated.controller import find_contact
from machines.simulated.traits import CornerPlate
from tests.machines.simulated.terminal import power_up


def end_of(*lines: str, traits=GRBL_11) -> tuple[SimulatedMill, list[str]]:
    """Machine after these lines, each waited for, and all answers."""
    mill = SimulatedMill(replace(traits, eeprom_write_s=0.001))
    port = power_up(mill, None)
    words = b""
    for line in lines:
        port.write(line.encode() + b"\n")
        mill.advance(mill.now_s + 200.0)
        words += mill.output()
    return mill, words.decode().split("\r\n")


@pytest.mark.parametrize(
    ("lines", "machine"),
    [
        (["G0X1Y2Z3"], (1, 2, 3)),
        (["G0X1", "G91X2", "X3Y1"], (6, 1, 0)),
        (["G20G0X1", "G21X1Y1"], (1, 1, 0)),
        (["G10L2P1X10Y5", "G0X1Y1"], (11, 6, 0)),
        (["G10L2P2X10", "G0X1", "G55X1"], (11, 0, 0)),
        (["G0X4Z1", "G10L20P1X1Z0", "G0X0Z2"], (3, 0, 3)),
        (["G0X4", "G92X1", "G0X0"], (3, 0, 0)),
        (["G0X4", "G92X1", "G92.1", "G0X0"], (0, 0, 0)),
        (["G43.1Z2", "G0Z1"], (0, 0, 3)),
        (["G43.1Z2", "G49", "G0Z1"], (0, 0, 1)),
        (["G10L2P1X10", "G53G0X1"], (1, 0, 0)),
        (["G0X5Y6Z7", "G28.1", "G0X0Y0Z0", "G28"], (5, 6, 7)),
        (["G0X5Y6Z7", "G28.1", "G0X0Y0Z0", "G91G28Z1"], (0, 0, 7)),
        (["G93G1X10F6"], (10, 0, 0)),
        (["N10 g1 x1.5 f100 (turn) y2"], (1.5, 2, 0)),
        (["G2X0Y10I0J5F1000", "G18G3X0Z4R2"], (0, 10, 4)),
        (["G38.3Z-9F200"], (0, 0, -5)),
        (["$J=X4F1000", "$J=G91X-1F1000"], (3, 0, 0)),
    ],
)
def test_target(lines, machine):
    mill, words = end_of(*lines)
    assert not any(w.startswith(("error", "ALARM")) for w in words), words
    assert mill.firmware.stepper.where(mill.now_s) == pytest.approx(machine, abs=1e-9)


def test_inverse_time_feed_takes_its_time():
    mill, _ = end_of("G93G1X10F6")
    assert mill.recording.segments[0].at_s - 1.0 == pytest.approx(10.0, rel=0.01)


def test_a_jog_outside_the_travel_is_refused_and_nothing_moves():
    _, words = end_of("$H", "$J=X5F1000", traits=replace(GRBL_11, homing=True).with_settings({20: 1}))
    assert "error:15" in words


def test_work_position_is_machine_position_less_the_offset():
    mill, _ = end_of("$10=0", "G0X4", "G10L20P1X1", "G0Y2")
    mill.receive(b"?")
    mill.advance(mill.now_s + 1.0)
    assert mill.output().startswith(b"<Idle|WPos:1.000,2.000,0.000|")
    assert mill.firmware.interpreter.offset == (3.0, 0.0, 0.0)


def test_program_end_resets_the_modes_that_it_resets():
    _, words = end_of("G18G91G55M3S100", "M30", "$G")
    assert "[MSG:Pgm End]" in words
    assert "[GC:G1 G54 G17 G21 G90 G94 M5 M9 T0 F0 S100]" in words


def test_with_13_lengths_are_reported_in_inch_and_settings_stay_in_mm() -> None:
    mill = SimulatedMill(GRBL_11.with_settings({13: 1}))
    port = power_up(mill, None)
    port.write(b"G21G1X25.4F2540\nG92X0Z2.54\n")
    mill.advance(1.3)
    port.write(b"?")
    mill.advance(1.31)
    assert b"|FS:100,0" in mill.output()
    mill.advance(20.0)
    port.write(b"?$#\n$$\n")
    mill.advance(20.1)
    words = mill.output()
    assert b"MPos:1.0000,0.0000,0.0000" in words and b"[G92:1.0000,0.0000,-0.1000]" in words and b"$110=5000" in words


LEFT_MM, FRONT_MM, TOP_MM, RADIUS_MM = -10.0, -20.0, -5.0, 1.5
PLATE = CornerPlate(left_mm=LEFT_MM, front_mm=FRONT_MM, tool_radius_mm=RADIUS_MM)
WITH_PLATE = replace(GRBL_11, probe_surface_mm=TOP_MM, corner_plate=PLATE)
coordinates = st.floats(-40.0, 20.0)


@given(coordinates, st.floats(-20.0, 5.0), st.sampled_from(["X", "Y"]), st.booleans())
@example(FRONT_MM - 1.0, -7.0, "X", False)
@example(LEFT_MM - 1.0, -7.0, "Y", True)
def test_a_side_is_touched_with_the_cutters_side_and_past_the_corner_not_at_all(
    other_mm: float, z_mm: float, axis: str, away: bool
) -> None:
    """The same place is found on the way to the plate and on the way from it, in coordinates that are shifted, too."""
    face_mm, end_mm = (LEFT_MM, FRONT_MM) if axis == "X" else (FRONT_MM, LEFT_MM)
    shift = (100.0, -50.0, 7.0)
    way = [(at, other_mm, z_mm) if axis == "X" else (other_mm, at, z_mm) for at in (-60.0, 30.0)]
    start, end = ((x - shift[0], y - shift[1], z - shift[2]) for x, y, z in (reversed(way) if away else way))
    found = find_contact(WITH_PLATE, start, end, shift_mm=shift)
    past_mm = max(end_mm - other_mm, 0.0)
    if z_mm >= TOP_MM - 1e-9 or past_mm >= RADIUS_MM - 1e-9:
        assert found is None
        return
    k = "XY".index(axis)
    assert found is not None
    touched_mm = face_mm - sqrt(RADIUS_MM**2 - past_mm**2)
    assert found[k] + shift[k] == pytest.approx(touched_mm, abs=1e-4)  # noise is amplified where a cutter just grazes


@given(coordinates, coordinates)
def test_the_top_is_touched_wherever_the_cutter_is_over_it(x: float, y: float) -> None:
    found = find_contact(WITH_PLATE, (x, y, 0.0), (x, y, -30.0), shift_mm=(0.0, 0.0, 0.0))
    outside_mm = hypot(max(LEFT_MM - x, 0.0), max(FRONT_MM - y, 0.0))
    assert found == (pytest.approx((x, y, TOP_MM)) if outside_mm < RADIUS_MM - 1e-9 else None)
