"""What single blocks mean, where a step passes, and which blocks make a controller answer late."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.errors import ProgramRefusedError
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState, Step
from tests.machines.gcode.conftest import programs

READY = ModalState(position_mm=(0.0, 0.0, 0.0), feed_mm_per_min=100.0)


def last(*blocks: str, state: ModalState = READY, dialect: str = "grbl") -> tuple[Step, ModalState]:
    interpreter = Interpreter(state, dialect=dialect)
    step = None
    for block in blocks:
        step = interpreter.take(block.encode())
    assert step is not None
    return step, interpreter.state


@pytest.mark.parametrize(
    ("blocks", "end"),
    [
        (["G20 G1 X1 F10"], (25.4, 0, 0)),
        (["G91 G1 X1", "X1 Z-.5"], (2, 0, -0.5)),
        (["G0 Z5", "G53 G0 X-10"], (None, 0, 5)),  # machine coordinates: the work place of X is not known
        (["G28"], (None, None, None)),
        (["G91 G28 Z0"], (0, 0, None)),
        (["G1 X9", "G92 X1"], (1, 0, 0)),
        (["G1 X9", "G10 L20 P1 X2 Y3"], (2, 3, 0)),
        (["G1 X9", "G10 L2 P1 X2"], (None, 0, 0)),
        (["G1 X9", "G10 L2 P3 X2"], (9, 0, 0)),  # another offset than the one in force
        (["G43.1 Z10"], (0, 0, -10)),
        (["G43.1 Z10", "G49"], (0, 0, 0)),
        (["G55 G0 X1"], (1, None, None)),
        (["G38.2 Z-9"], (0, 0, -9)),
        (["G3 X-10 Y0 R5 (half)"], (-10, 0, 0)),
    ],
)
def test_where_a_block_ends(blocks: list[str], end: tuple) -> None:
    step, _ = last(*blocks)
    assert step.end_mm == end


def test_after_a_probe_nobody_but_the_controller_knows_where_it_touched() -> None:
    step, state = last("G38.2 Z-9 F50")
    assert step.probes and step.waits_for_empty_buffer
    assert state.position_mm == (0, 0, None)


@pytest.mark.parametrize(
    ("block", "waits", "withholds", "ends", "writes"),
    [
        ("G1 X1", False, False, False, False),
        ("G4 P1", True, False, False, False),
        ("M3 S100", True, False, False, False),
        ("M8", True, False, False, False),
        ("M0", True, True, False, False),
        ("M2", True, False, True, False),
        ("M30", True, False, True, False),
        ("G10 L20 P1 X0", True, False, False, True),
        ("G28.1", True, False, False, True),
        ("G92 X0", False, False, False, False),
    ],
)
def test_blocks_whose_ok_comes_late(block: str, waits: bool, withholds: bool, ends: bool, writes: bool) -> None:
    step, _ = last(block)
    assert (step.waits_for_empty_buffer, step.withholds_ok, step.ends_program, step.writes_settings) == (
        waits, withholds, ends, writes,
    )  # fmt: skip


def test_a_speed_change_while_the_spindle_turns_waits() -> None:
    assert last("M3 S100", "S200 G1 X1")[0].waits_for_empty_buffer
    assert not last("M3 S100", "S100 G1 X1")[0].waits_for_empty_buffer
    assert not last("S200")[0].waits_for_empty_buffer


def test_the_end_of_a_program_resets_modes_but_not_units() -> None:
    _, state = last("G20", "G91 G18 G93 M3 S5", "M2")
    assert (state.units, state.distance, state.plane, state.feed_mode) == ("G20", "G90", "G17", "G94")
    assert (state.spindle, state.motion, state.ended) == ("M5", "G1", True)
    with pytest.raises(ProgramRefusedError, match="nothing may follow"):
        last("M2", "G0 X1")


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ("T1M6", "GRBL has no tool changes here; split the program"),
        ("G81 X1 Z-1 R1", "canned cycles"),
        ("%", "error:1"),
        ("G43 H1", "G43.1"),
        ("N10000001", "10000000"),
        ("G2 X2 I1.5", "equally far"),
        ("G0 G92 X1", "claim"),
        ("G1 X1 (open", "must close"),
        ("$H", "commands"),
        ("G1 X1 F-1", "above 0"),
        ("G0 X1 F0", "above 0"),
        ("G0X1F0", "above 0"),
        ("G0X100001", "100 000 mm away"),
        ("\u00ef\u00bb\u00bfG21", "letter"),
    ],
)
def test_refusals_say_what_to_do(block: str, words: str) -> None:
    with pytest.raises(ProgramRefusedError, match=words) as caught:
        last(block)
    assert caught.value.line == 0
    assert "\n" not in str(caught.value)


def test_feeds_and_centres_are_read_in_the_units_in_force() -> None:
    assert last("G20 F10", "G21 G1 X1")[0].feed_mm_per_min == pytest.approx(254)
    assert last("G20 G2 X2 I1 F1")[0].length_mm == pytest.approx(25.4 * math.pi)
    assert last("G20 G2 X2 R1 F1")[0].length_mm == pytest.approx(25.4 * math.pi)


def test_a_motion_has_to_be_said_once() -> None:
    with pytest.raises(ProgramRefusedError, match="coordinates need"):
        Interpreter().take(b"X1")


def test_a_cut_needs_a_feed_and_inverse_time_one_on_every_line() -> None:
    with pytest.raises(ProgramRefusedError, match="needs a feed"):
        Interpreter().take(b"G1 X1")
    with pytest.raises(ProgramRefusedError, match="needs a feed"):
        last("G93 G1 X1 F2", "X2")
    step, _ = last("G93", "G1 X10 F2")
    assert step.feed_mm_per_min == pytest.approx(20)


@given(program=programs())
def test_state_survives_plain_data_and_a_new_interpreter_goes_on_from_it(program: bytes) -> None:
    """Cutting a program anywhere and going on from the stored state gives the same states."""
    one = Interpreter()
    for line in program.split(b"\n"):
        stored = ModalState.from_dict(one.state.to_dict())
        assert stored == one.state
        other = Interpreter(stored)
        try:
            step = one.take(line)
        except ProgramRefusedError:
            with pytest.raises(ProgramRefusedError):
                other.take(line)
            return
        assert other.take(line) == step
        assert other.state == one.state


@given(
    share=st.floats(0, 1),
    off=st.floats(0, 3),
    end=st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-9, 9)),
)
def test_distance_from_a_straight_move(share: float, off: float, end: tuple[float, float, float]) -> None:
    """A point moved off the line at right angles is that far away, and projects back to its share."""
    text = "G1 " + "".join(f"{letter}{value:.6f}" for letter, value in zip("XYZ", end, strict=True))
    step, state = last(text)
    length = step.length_mm
    if length < 0.1:
        return
    a, b, c = (float(value or 0) for value in state.position_mm)
    normal = (-b, a, 0.0) if math.hypot(a, b) > 0.05 else (1.0, 0.0, 0.0)
    size = math.hypot(*normal)
    point = tuple(share * e + off * n / size for e, n in zip((a, b, c), normal, strict=True))
    if math.hypot(a, b) > 0.05:
        assert step.distance_mm(point) == pytest.approx(off, abs=1e-9)
        assert step.fraction(point) == pytest.approx(share, abs=1e-9)
    beyond = tuple(e * (1 + off / length) for e in (a, b, c))
    assert step.distance_mm(beyond) == pytest.approx(off, abs=1e-9)


@given(turn=st.floats(0, 1), off=st.floats(-4, 4), left=st.booleans())
def test_distance_from_a_helix(turn: float, off: float, left: bool) -> None:
    """Three quarters of a turn of radius 5 rising 3 mm: off the wall by `off` is that far away (at the same height)."""
    step, _ = last(f"{'G3' if left else 'G2'} X-5 Y{5 if not left else -5} Z3 I-5 J0 F100")
    assert step.length_mm == pytest.approx(math.hypot(5 * 1.5 * math.pi, 3))
    angle = 1.5 * math.pi * turn * (1 if left else -1)
    place = (-5 + (5 + off) * math.cos(angle), (5 + off) * math.sin(angle), 3 * turn)
    assert step.distance_mm(place) <= abs(off) + 1e-9
    assert step.distance_mm(place) >= abs(off) * 0.9 - 1e-9
    if abs(off) < 0.5:
        assert step.fraction(place) == pytest.approx(turn, abs=1e-6)


def test_a_full_circle_passes_both_its_sides() -> None:
    step, _ = last("G2 X0 Y0 I5")
    assert step.length_mm == pytest.approx(10 * math.pi)
    for point in [(10.0, 0.0, 0.0), (5.0, 5.0, 0.0), (5.0, -5.0, 0.0), (0.0, 0.0, 0.0)]:
        assert step.distance_mm(point) == pytest.approx(0, abs=1e-9)
    assert step.distance_mm((5.0, 0.0, 0.0)) == pytest.approx(5)


def test_beyond_an_arcs_ends_the_nearer_end_counts() -> None:
    step, _ = last("G3 X-5 Y5 I-5 F100")  # a quarter about (-5, 0), from angle 0
    assert [step.fraction(point) for point in [(0.0, -0.1, 0.0), (-5.1, 5.0, 0.0)]] == [0.0, 1.0]
    assert step.distance_mm((0.0, -3.0, 0.0)) == pytest.approx(3)


def test_unknown_axes_do_not_count_in_a_distance() -> None:
    step = Interpreter().take(b"G0 X5")
    assert step.distance_mm((700.0, 1.0, 2.0)) == 0


@given(x=st.floats(-9, 9), y=st.floats(-9, 9), radius=st.floats(6.5, 40), long=st.booleans(), left=st.booleans())
def test_an_arc_by_radius_turns_the_way_it_says(x: float, y: float, radius: float, long: bool, left: bool) -> None:
    """Centre at distance R from both ends; R > 0 turns less than half, R < 0 more; G3 counter-clockwise."""
    if math.hypot(x, y) < 0.1:
        return
    step, _ = last(f"{'G3' if left else 'G2'} X{x:.6f} Y{y:.6f} R{-radius if long else radius:.6f}")
    arc = step.arc
    assert arc is not None
    assert math.hypot(arc.centre_u_mm, arc.centre_v_mm) == pytest.approx(radius, rel=1e-5)
    assert math.hypot(arc.centre_u_mm - x, arc.centre_v_mm - y) == pytest.approx(radius, rel=1e-5)
    assert (abs(arc.sweep_rad) > math.pi) == long
    assert (arc.sweep_rad > 0) == left
    angle = arc.angle_rad + arc.sweep_rad
    assert arc.centre_u_mm + radius * math.cos(angle) == pytest.approx(x, abs=1e-4)
