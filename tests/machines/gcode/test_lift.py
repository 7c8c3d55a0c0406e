"""A program in the air, as the simulated mill's own parser reads it: the same places, so much higher, nothing on."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.errors import ProgramRefusedError
from machines.gcode.lift import lift_program, require_liftable
from machines.simulated.controller import CutSegment
from tests.machines.grbl.bench import Bench, numbered

NUMBERS = st.floats(-20.0, 20.0).map(lambda mm: f"{mm:.4f}")
WORDS = st.fixed_dictionaries({}, optional=dict.fromkeys("XYZ", NUMBERS))
MOVES = st.lists(st.tuples(st.sampled_from(["G0", "G1", ""]), WORDS), min_size=1, max_size=12)
HEAD = ["G21 G90 G94 G17 G54 (head)", "M3 S12000", "M8", "G0 X0 Y0 Z5", "G1 F900"]
TAIL = ["G2 X1 Y0 I0.5 J0", "G18 G3 X0 Z5 I-0.5 K0", "g0 z 5. ; up", "M9", "M5", "M2"]


def cut(lines: list[bytes]) -> list[CutSegment]:
    bench = Bench().connected()
    bench.run(numbered(lines), within_s=600.0)
    return [one for one in bench.mill.recording.segments if one.kind == "program"]


@settings(max_examples=20, deadline=None)
@given(moves=MOVES, lift_mm=st.sampled_from([1.0, 12.5, 40.0]))
def test_each_place_is_so_much_higher_and_nothing_turns(
    moves: list[tuple[str, dict[str, str]]], lift_mm: float
) -> None:
    body = [word + "".join(axis + mm for axis, mm in axes.items()) for word, axes in moves if axes]
    lines = [line.encode() for line in [*HEAD, *body, *TAIL]]
    lines[-len(TAIL)] = b"G1 X0 Y0 Z5 F900"  # where the arcs begin
    lines.insert(-len(TAIL) + 1, TAIL[0].encode())
    here, above = cut(lines), cut(list(lift_program(lines, lift_mm)))
    assert any(one.spindle_on for one in here) and not any(one.spindle_on for one in above)
    places = [[one.end for one in found if one.whole] for found in (here, above)]
    first = [next(k for k, end in enumerate(ends) if end[2] > 0.0) for ends in places]
    for (x, y, z), end in zip(places[0][first[0] :], places[1][first[1] :], strict=True):
        assert end == pytest.approx((x, y, z + lift_mm), abs=1e-6)


@pytest.mark.parametrize(
    "line",
    ["G91 G0 Z1", "G20", "G92 Z0", "G10 L2 P1 Z0", "G43.1 Z1", "G28 Z0", "G81 Z-1 R2", "G38.2 Z-9", "M98 P1", "%",
     "#1=2", "G1 X[1]", "$H", "O100", "G52 Z1", "M62 P1", "G1 H1"],
)  # fmt: skip
def test_what_may_mean_more_than_a_height_is_refused_by_line(line: str) -> None:
    with pytest.raises(ProgramRefusedError, match="line 2"):
        list(lift_program([b"G21 G90", line.encode()], 10.0))


def test_moves_in_machine_coordinates_stay() -> None:
    found = list(lift_program([b"G53G0Z-1", b"M3S12000", b"G4P4", b"G0Z5", b"N7 G1 Z-0.12346 F612.55"], 20.0))
    assert found == [b"M5M9", b"G53G0Z-1", b"G4P4", b"G0Z25.0", b"N7G1Z19.87654F612.55"]


@pytest.mark.parametrize("dialect", ["rml-1", "roland-nc", "okuma-osp", "fanuc"])
def test_a_language_that_is_not_raised_line_by_line_is_refused(dialect: str) -> None:
    with pytest.raises(ProgramRefusedError, match="not possible"):
        require_liftable(dialect)
    require_liftable("grbl")
