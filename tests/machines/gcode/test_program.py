"""The reader of programs: what it hands out is what pre-flight has read, from any line, in a constant bit of memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.errors import ProgramChangedError, ProgramRefusedError
from machines.gcode.interpreter import Interpreter
from machines.gcode.program import ProgramIndex, ProgramReader
from machines.gcode.scan import ProgramScan
from machines.gcode.text import strip_block
from tests.machines.gcode.conftest import programs

RATES = (5000.0, 5000.0, 1500.0)


def indexed(program: bytes, every_lines: int = 5, dialect: str = "grbl") -> ProgramIndex:
    scan = ProgramScan(dialect, RATES, every_lines=every_lines)
    for _ in scan.read_batches([program]):
        pass
    return ProgramIndex.from_dict(scan.index.to_dict())


@pytest.mark.thorough
@settings(max_examples=300)
@given(program=programs(wrong=False), every=st.integers(1, 9), start=st.integers(1, 18))
def test_every_block_once_in_order_with_its_line_and_offset(
    tmp_path_factory: pytest.TempPathFactory, program: bytes, every: int, start: int
) -> None:
    """Line numbers and offsets are those of the file; only blanks and comments are left out."""
    try:
        index = indexed(program, every)
    except ProgramRefusedError:
        return
    path = tmp_path_factory.mktemp("program") / "p.nc"
    path.write_bytes(program)
    texts = program.split(b"\n")
    got = list(ProgramReader(path, index).lines(start))
    want = [number for number, text in enumerate(texts, 1) if strip_block(text) and number >= start]
    assert [line.number for line in got] == want
    for line in got:
        text = texts[line.number - 1]
        assert line.text == strip_block(text)
        assert program[line.offset : line.offset + len(text)] == text


@given(program=programs(wrong=False), every=st.integers(1, 9), data=st.data())
def test_the_state_before_a_line_is_that_of_running_up_to_it(
    tmp_path_factory: pytest.TempPathFactory, program: bytes, every: int, data: st.DataObject
) -> None:
    try:
        index = indexed(program, every)
    except ProgramRefusedError:
        return
    path = tmp_path_factory.mktemp("program") / "p.nc"
    path.write_bytes(program)
    line = data.draw(st.integers(1, index.lines + 1))
    interpreter = Interpreter()
    for text in program.split(b"\n")[: line - 1]:
        interpreter.take(text)
    assert ProgramReader(path, index).state_before(line) == interpreter.state


def test_offsets_count_what_is_left_out(tmp_path: Path) -> None:
    program = b"G21 G90 (modes)\r\n\n; nothing\ng0 x1 y2 z3\r\nX2\nM2"
    path = tmp_path / "p.nc"
    path.write_bytes(program)
    lines = list(ProgramReader(path, indexed(program)).lines())
    assert [(line.number, line.text) for line in lines] == [(1, b"G21G90"), (4, b"G0X1Y2Z3"), (5, b"X2"), (6, b"M2")]
    assert [line.offset for line in lines] == [0, program.index(b"g0"), program.index(b"X2"), program.index(b"M2")]


def long_program(lines: int) -> bytes:
    return b"G21G90\nG0X0Y0Z5\n" + b"".join(b"G1X%d.%04dF100\n" % (k % 90, k % 10_000) for k in range(lines))


@pytest.mark.parametrize("how", ["change", "cut", "grow line", "vanish"])
def test_nothing_of_a_changed_piece_is_handed_out(tmp_path: Path, how: str) -> None:
    """One flipped digit, a shorter file, a shifted line: the pieces before it still come, the changed one never."""
    program = long_program(50)
    path = tmp_path / "p.nc"
    path.write_bytes(program)
    index = indexed(program, every_lines=10)
    reader = ProgramReader(path, index)
    entry = index.entries[3]
    lines = reader.lines()
    first = next(lines)
    assert first.number == 1
    if how == "change":
        at = entry.offset + 3
        path.write_bytes(program[:at] + (b"8" if program[at : at + 1] != b"8" else b"7") + program[at + 1 :])
    elif how == "cut":
        path.write_bytes(program[: entry.offset + 5])
    elif how == "grow line":
        path.write_bytes(program[: entry.offset] + b" " + program[entry.offset :])
    else:
        path.unlink()
        with pytest.raises(ProgramChangedError, match=r"p\.nc: can no longer be read"):
            next(reader.lines())
        return
    got = []
    with pytest.raises(ProgramChangedError, match="changed on disk since pre-flight"):
        for line in lines:
            got.append(line.number)
    assert got == list(range(2, entry.line))


def test_an_appended_line_is_not_run(tmp_path: Path) -> None:
    """What pre-flight has not read is not part of the program."""
    program = long_program(5)
    path = tmp_path / "p.nc"
    path.write_bytes(program + b"G1X99F9\n")
    got = [line.text for line in ProgramReader(path, indexed(program)).lines()]
    assert got[-1] == program.splitlines()[-1]


def test_memory_does_not_grow_with_the_program(tmp_path: Path) -> None:
    program = long_program(200_000)
    path = tmp_path / "p.nc"
    path.write_bytes(program)
    index = indexed(program, every_lines=20_000)
    tracemalloc.start()
    try:
        lines = ProgramReader(path, index).lines()
        for _ in range(50_000):
            next(lines)
        tracemalloc.reset_peak()
        for _ in lines:
            pass
        assert tracemalloc.get_traced_memory()[1] < 4e6  # a piece of 320 kB and its 20 000 lines
    finally:
        tracemalloc.stop()


def test_percent_marks_are_sent_where_the_control_wants_them(tmp_path: Path) -> None:
    program = b"%\nO0001\nG21G90\nG00X0.Y0.Z5.\nM30\n%\n"
    path = tmp_path / "p.nc"
    path.write_bytes(program)
    texts = {d: [line.text for line in ProgramReader(path, indexed(program, 5, d)).lines()] for d in ("okuma", "fanuc")}
    assert texts["okuma"] == texts["fanuc"] == program.splitlines()
    program = b"%\nG21G90\nM30\n%\n"
    path.write_bytes(program)
    assert [line.text for line in ProgramReader(path, indexed(program, 5, "grblhal")).lines()] == [b"G21G90", b"M30"]
