"""What each control takes and what it refuses."""

from __future__ import annotations

import pytest

from machines.errors import ProgramRefusedError
from machines.gcode.dialects import DIALECTS
from machines.gcode.scan import ProgramScan

RATES = (5000.0, 5000.0, 1500.0)
ROLAND = "%\nO00000001\nG90 G21\nS8000 M03\nG00 X0.0 Y0.0 Z5.0\nG01 Z-1.0 F100.0\nX8.5 Y.125\nM05\nM02\n%\n"
OKUMA = "%\nO100\nG15 H1\nG90 G17\nG56 H1\nG0 X0. Y0.\nZ5.\nS5000 M3\nG1 Z-1. F200.\nX9.\nM5\nM2\n%\n"
LINUXCNC = "%\nG21 G90 G94 G17 G64 P0.002\nT1 M6\nG43 H1\nM3 S900\nG0 X0 Y0 Z5\nG1 Z-1 F100\nM5\nM2\n%\n"
FANUC = "%\nO0001\nG21 G90 G54\nG00 X0. Y0.\nG43 H01 Z5.\nS900 M03\nG01 Z-1. F100.\nM05\nM30\n%\n"
GRBL = "G21 G90\nG0 X0 Y0 Z5\nM3 S900\nG1 Z-1 F100\nM5\nM2\n"


def read(dialect: str, text: str) -> ProgramScan:
    scan = ProgramScan(dialect, RATES)
    for _ in scan.batches([text.encode()]):
        pass
    return scan


@pytest.mark.parametrize(
    ("dialect", "text"),
    [
        ("roland-nc", ROLAND), ("okuma", OKUMA), ("linuxcnc", LINUXCNC), ("fanuc", FANUC),
        ("grbl", GRBL), ("grblhal", "%\n" + GRBL + "%\n"), ("fluidnc", "%\n" + GRBL),
    ],
)  # fmt: skip
def test_a_usual_program_of_each_control_is_taken(dialect: str, text: str) -> None:
    scan = read(dialect, text)
    assert scan.state.ended
    assert scan.state.position_mm[2] == -1


@pytest.mark.parametrize(
    ("dialect", "text", "line", "words"),
    [
        ("roland-nc", ROLAND.replace("G01", "G1"), 6, "two digits"),
        ("roland-nc", ROLAND.replace("Z5.0", "Z5"), 5, "decimal point"),
        ("roland-nc", ROLAND.replace("X8.5", "X8.5001"), 7, "at most 3 decimals"),
        ("roland-nc", ROLAND.replace("S8000 M03\n", ""), 5, "S and M03 before"),
        ("roland-nc", ROLAND.replace("G90 G21", "G91 G53 G00 Z0.0"), 3, "G53 works in G90"),
        ("okuma", OKUMA.replace("X9.", "X9"), 10, "decimal point"),
        ("grbl", "%\n" + GRBL, 1, "error:1"),
        ("grbl", GRBL.replace("G21", "T1 M6"), 1, "split the program"),
        ("grblhal", GRBL.replace("M3", "M6"), 3, "split the program"),
        ("linuxcnc", LINUXCNC.replace("G64 P0.002", "G90.1"), 2, "relative"),
        ("grbl", GRBL + "N1", 7, ""),
    ],
)
def test_refusals_by_dialect(dialect: str, text: str, line: int, words: str) -> None:
    if not words:
        assert read(dialect, text).lines == line
        return
    with pytest.raises(ProgramRefusedError, match=words) as caught:
        read(dialect, text)
    assert caught.value.line == line


def test_no_sentence_names_a_value_that_is_not_filled_in() -> None:
    from machines.gcode import refusals

    for dialect in DIALECTS.values():
        for code in refusals.REASONS:
            words = refusals.reason_for(dialect, code)
            assert "{" not in words and "\n" not in words
    assert sorted(refusals.REASONS) == list(range(1, len(refusals.REASONS) + 1))


@pytest.mark.parametrize(("dialect", "limit"), [("grbl", 79), ("grblhal", 255), ("okuma", 157)])
def test_the_line_limit_counts_neither_comments_nor_blanks(dialect: str, limit: int) -> None:
    """Code of exactly the limit is taken, one character more refused, whatever else stands on the line."""
    words = "N1 G00 X1.5 Y2.5 Z3.5 M05 "
    for extra in (0, 1):
        code = words.replace(" ", "")
        filler = "G17" * ((limit - len(code)) // 3)  # refused as a group said twice, but only after its length
        rest = "." * (limit + extra - len(code) - len(filler))
        line = f"(note {'c' * 300}) {words}{filler}{rest} (more)"
        with pytest.raises(ProgramRefusedError) as caught:
            read(dialect, line + "\n")
        assert ("characters" in caught.value.reason) == bool(extra)
