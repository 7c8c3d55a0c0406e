"""Laws of the standing mill: never beyond what it has passed, and as far as the place can show."""

from __future__ import annotations

import itertools
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.gcode.program import ProgramReader
from machines.grbl.settings import ControllerSettings
from machines.recovery.standing import count_executed_at_rest, frame_offset_mm, tolerance_at_rest_mm
from tests.trials.kill_program import facts_of

Point = tuple[float, float, float]
HEAD = ["G21 G90 G94 G17 G54", "M3 S12000", "G0 X0 Y0 Z0", "G1 X1 F200"]
OFFSET = (-100.0, -50.25, -12.125)
TOLERANCE_MM = tolerance_at_rest_mm(ControllerSettings(values={100: "250", 101: "250", 102: "250"}))
STEP_MM = 1 / 250


class Path3:
    """A program on disk, and where each line of it ends."""

    def __init__(self, folder: Path, lines: list[str]) -> None:
        path = folder / "p.nc"
        path.write_text("\n".join(lines) + "\n")
        self.reader = ProgramReader(path, facts_of(path, 7).index)
        self.count = len(lines)
        self.ends = [self.reader.state_before(number + 1).position_mm for number in range(1, self.count + 1)]

    def end(self, line: int) -> Point:
        x, y, z = self.ends[line - 1]
        assert x is not None and y is not None and z is not None
        return x, y, z

    def proven(self, executed: int, place_mm: Point, last: int | None = None, **record: Any) -> int:
        machine = tuple(reported(p + o) for p, o in zip(place_mm, OFFSET, strict=True))
        known = {"executed_line": executed, "answered_line": executed + 1, "work_offset_mm": OFFSET,
                 "offsets": {"G54": OFFSET, "G92": (0, 0, 0), "TLO": (0, 0, 0)}}  # fmt: skip
        return count_executed_at_rest(self.reader, known | record, machine,  # type: ignore[arg-type]
                                    last_line=last or self.count, tolerance_mm=TOLERANCE_MM)  # fmt: skip


def reported(value_mm: float) -> float:
    """Rounded to a step of the axis, and to the three decimals of a report."""
    return round(round(value_mm / STEP_MM) * STEP_MM, 3)


# Points of a coarse grid: paths cross and come back all the time; and lines that do not move.
_LINES = st.lists(
    st.one_of(
        st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 1)).map(lambda p: f"X{p[0]}Y{p[1]}Z-{p[2]}"),
        st.sampled_from(["F300", "M8", "G4 P0", "X1.002", "G2 X1 Y1 I0.5 J0.5", "G1 X2 Y2"]),
    ),
    min_size=1,
    max_size=30,
)


def only_straight(lines: list[str]) -> list[str]:
    """An arc needs its start; here it always stands behind a move to it, and is followed by a straight one."""
    out = []
    for line in lines:
        out += ["G1 X0 Y0", line, "G1"] if line.startswith("G2") else [line]
    return out


@pytest.mark.thorough
@given(lines=_LINES, data=st.data())
@settings(max_examples=300, deadline=None)
def test_a_mill_at_the_end_of_a_line_never_proves_a_later_one(lines: list[str], data: Any) -> None:
    with TemporaryDirectory() as folder:
        program = Path3(Path(folder), HEAD + only_straight(lines))
        true = data.draw(st.integers(len(HEAD), program.count))
        executed = data.draw(st.integers(len(HEAD), true))
        found = program.proven(executed, program.end(true))
    assert executed <= found <= true


@pytest.mark.thorough
@given(lines=_LINES, data=st.data(), share=st.floats(0.0, 1.0))
@settings(max_examples=300, deadline=None)
def test_a_mill_within_a_line_proves_at_most_the_one_before(lines: list[str], data: Any, share: float) -> None:
    """It does not stop there by itself; should it ever, nothing is skipped."""
    with TemporaryDirectory() as folder:
        straight = [line for line in lines if not line.startswith("G2")]
        program = Path3(Path(folder), [*HEAD, *straight])
        true = data.draw(st.integers(len(HEAD), program.count))
        executed = data.draw(st.integers(len(HEAD) - 1, true - 1))
        start, end = program.end(true - 1), program.end(true)
        place = tuple(a + share * (b - a) for a, b in zip(start, end, strict=True))
        found = program.proven(executed, place)  # type: ignore[arg-type]
    rest_mm = max(abs(a - b) for a, b in zip(place, end, strict=True))
    assert found <= (true if rest_mm <= 2 * TOLERANCE_MM else true - 1)


@given(executed=st.integers(5, 60), more=st.integers(0, 40))
@settings(max_examples=60, deadline=None)
def test_on_a_path_that_never_comes_back_the_line_is_found_exactly(executed: int, more: int) -> None:
    with TemporaryDirectory() as folder:
        lines = [f"X{1 + n * 0.05:.3f}Y{(n * 7) % 5 * 0.3:.3f}" for n in range(1, 100)]
        program = Path3(Path(folder), HEAD + lines)
        true = min(executed + more, program.count)
        assert program.proven(executed, program.end(true)) == true
        assert program.proven(executed, program.end(true), last=true - 1) in (executed, true - 1)


def test_where_a_path_comes_back_the_first_time_is_believed(tmp_path: Path) -> None:
    program = Path3(tmp_path, [*HEAD, "X2", "X3", "X2", "X3", "X9"])
    assert program.proven(4, (3.0, 0.0, 0.0)) == 6
    assert program.proven(6, (3.0, 0.0, 0.0)) == 6
    assert program.proven(4, (2.5, 0.0, 0.0)) == 5


@pytest.mark.parametrize(
    "record",
    [
        {"answered_line": 0},  # still on the way in
        {"offsets": None},
        {"offsets": {"G54": (-100.0, -50.25, -12.0)}},  # not the zero the mill has reported
        {"work_offset_mm": None},
    ],
)
def test_nothing_is_proven_on_doubt(tmp_path: Path, record: dict[str, Any]) -> None:
    program = Path3(tmp_path, [*HEAD, "X2", "X3", "X4"])
    assert program.proven(4, (3.0, 0.0, 0.0)) == 6
    assert program.proven(4, (3.0, 0.0, 0.0), **record) == 4


@pytest.mark.parametrize("wall", ["M0", "G38.2 Z-1 F50", "G55", "G92 X0", "G28"])
def test_nothing_is_proven_beyond_what_the_program_tells(tmp_path: Path, wall: str) -> None:
    program = Path3(tmp_path, [*HEAD, "X2", wall, "G1 X3 Y0 Z0 F200", "X4"])
    assert program.proven(4, (3.0, 0.0, 0.0)) == 4


def test_off_the_path_nothing_is_proven(tmp_path: Path) -> None:
    program = Path3(tmp_path, [*HEAD, "X2", "X3", "X4"])
    for by in itertools.product((0.0, 0.02), repeat=3):
        place = (3.0, 0.0 + by[1], 0.0 + by[2])
        assert program.proven(4, place) == (4 if any(by[1:]) else 6)


def test_g92_and_tool_length_are_part_of_the_frame() -> None:
    offsets = {"G54": (1.0, 2.0, 3.0), "G92": (0.5, 0.0, 0.0), "TLO": (0.0, 0.0, 4.0)}
    assert frame_offset_mm({"offsets": offsets, "work_offset_mm": (1.5, 2.0, 7.0)}, "G54") == (1.5, 2.0, 7.0)
    assert frame_offset_mm({"offsets": offsets, "work_offset_mm": (1.5, 2.0, 3.0)}, "G54") is None
    assert frame_offset_mm({"offsets": offsets, "work_offset_mm": (1.5, 2.0, 7.0)}, "G55") is None


@pytest.mark.parametrize("executed", [0, 1, 2])
def test_a_program_that_has_told_no_place_yet_began_where_the_mill_stood(tmp_path: Path, executed: int) -> None:
    """Without that place nothing is known; after G28 neither."""
    lines = ["G21 G90", "M3 S9000", "G0 Z5", "G0 X1 Y1", "G1 Z-1 F100", "X2", "X3"]
    program = Path3(tmp_path, lines)
    began = tuple(o + 7.0 for o in OFFSET)
    assert program.proven(executed, (2.0, 1.0, -1.0), began_mm=began) == 6
    assert program.proven(executed, (7.0, 7.0, 5.0), began_mm=began) == 3
    assert program.proven(executed, (7.0, 7.0, 7.0), began_mm=began) == executed
    assert program.proven(executed, (2.0, 1.0, -1.0)) == executed
    away = Path3(tmp_path, ["G21 G90", "G28", *lines])
    assert away.proven(2, (2.0, 1.0, -1.0), began_mm=began) == 2
