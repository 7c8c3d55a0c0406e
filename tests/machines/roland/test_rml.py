"""RML-1: what a program may say, what it does, and that a faulty one is named by line."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.errors import ProgramRefusedError
from machines.profile import MachineProfile
from machines.roland.rml import RmlFacts, RmlInterpreter, check_rml, parse

MILL = MachineProfile(
    name="mill",
    dialect="rml-1",
    travel_mm=(305.0, 305.0, 105.0),
    max_rate_mm_per_min=(3000.0, 3000.0, 1800.0),
    acceleration_mm_per_s2=(200.0, 200.0, 200.0),
    step_mm=0.002,
    junction_deviation_mm=0.01,
    planner_blocks=4,
    lines_per_s=100.0,
    spindle_rpm=(4500.0, 15000.0),
    safe_z_mm=5.0,
)
JOB = (
    b";;^DF;\n!MC0;V50.0;\n!RC15;!MC1;\nZ0,0,500;\nV10;Z0,0,-50;\nZ3000,0,-50;\n"
    b"Z3000,4000,-50;\n!MC0;\n^PR;Z0,0,10500;^PA;\n^DF;\n"
)


def check(text: bytes, size: int = 1 << 16) -> RmlFacts:
    return check_rml((text[i : i + size] for i in range(0, len(text), size)), MILL)


def test_the_job_of_the_reference_is_taken_and_measured() -> None:
    """Bounds in 0.01 mm units; 5.5 mm down, 30 mm and 40 mm at 10 mm/s; the lift at the end stops at the mill's top."""
    facts = check(JOB)
    assert facts.bounds_mm == ((0.0, 0.0, -0.5), (30.0, 40.0, 5.0))
    assert facts.path_length_mm == pytest.approx(5.5 + 30 + 40)
    assert facts.time_s == pytest.approx(7.55)
    assert facts.spindle_rpm == (15000.0, 15000.0)
    assert facts.feeds_mm_per_min == (600.0, 3000.0)
    assert (facts.lines, facts.bytes, facts.ends) == (10, len(JOB), True)


@given(size=st.integers(1, 60))
def test_the_verdict_does_not_depend_on_how_the_file_is_cut_into_chunks(size: int) -> None:
    assert check(JOB, size) == check(JOB)
    with pytest.raises(ProgramRefusedError) as refusal:
        check(JOB.replace(b"Z3000,0,-50", b"Q3000,0,-50"), size)
    assert refusal.value.line == 6


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"V50.1;", "outside 0.1..50"),
        (b"V0;", "outside 0.1..50"),
        (b"W0;", "outside 1..32767"),
        (b"Z0.5,0,0;", "whole number"),
        (b"Z0,0;", "Z takes 3 numbers"),
        (b"Z9000000,0,0;", "outside"),
        (b"G01 X1;", "not an RML-1 command"),
        (b"!QQ1;", "not an RML-1 command"),
        (b"!RC200;", "outside the spindle's 4500..15000"),
        (b"!MC2;", "outside 0..1"),
        (b"!ZO-100;", "set the zero at the mill"),
        (b"Z31000,0,0;", "spans 310.00 mm in X"),
        (b"Z0,0,-10600;", "spans 111.00 mm in Z"),
        (b"!MC0;Z0,0,-1;", "spindle off"),
        (b"x" * 400 + b";", "400 bytes without ';'"),
        (b"Z0,0,0", "no ';'"),
    ],
)
def test_a_fault_is_refused_with_its_line(line: bytes, words: str) -> None:
    with pytest.raises(ProgramRefusedError, match=words) as refusal:
        check(b";;^DF;\n!MC1;V10;\nZ0,0,500;\n" + line)
    assert refusal.value.line == 4


def test_no_move_before_a_speed_and_no_relative_move_from_nowhere() -> None:
    with pytest.raises(ProgramRefusedError, match="before any speed"):
        check(b"Z0,0,0;")
    with pytest.raises(ProgramRefusedError, match="no command before it has given"):
        check(b"V10;^PR;Z1,0,0;")


def test_an_empty_file_is_refused() -> None:
    with pytest.raises(ProgramRefusedError, match="no RML-1 command"):
        check(b"\n\n;;")


def test_a_program_that_leaves_the_spindle_on_says_so() -> None:
    assert not check(b"!MC1;V10;Z0,0,0;").ends


@given(st.lists(st.tuples(st.integers(-9000, 9000), st.integers(-9000, 9000), st.integers(1, 3000)), min_size=1))
def test_relative_and_absolute_moves_reach_the_same_places(points: list[tuple[int, int, int]]) -> None:
    """PR then Z of differences = PA then Z of places (a pure lift aside: there the mill stops at its top)."""
    absolute, relative = RmlInterpreter(), RmlInterpreter()
    before = (0, 0, 0)
    for mill in (absolute, relative):
        for text in (b"V5", b"Z0,0,0"):
            mill.take(parse(text))  # type: ignore[arg-type]
    relative.take(parse(b"PR"))  # type: ignore[arg-type]
    for point in points:
        step = tuple(b - a for a, b in zip(before, point, strict=True))
        if step[:2] == (0, 0):
            continue
        absolute.take(parse(b"Z%d,%d,%d" % point))  # type: ignore[arg-type]
        relative.take(parse(b"Z%d,%d,%d" % step))  # type: ignore[arg-type]
        before = point
        assert relative.position_mm == pytest.approx(absolute.position_mm)


def test_z_is_slower_than_xy() -> None:
    """At V50 a plunge of 60 mm takes 60 / 30 s: Z of the MDX-40A runs at most at 1800 mm/min."""
    fast = check_rml([b"!MC1;V50;Z0,0,0;Z0,0,-6000;!MC0;"], MILL)
    assert fast.time_s == pytest.approx(2.0)
    assert check_rml([b"!MC1;V50;Z0,0,0;Z0,0,-6000;!MC0;"], replace(MILL, max_rate_mm_per_min=(9e9,) * 3)).time_s < 1.3
