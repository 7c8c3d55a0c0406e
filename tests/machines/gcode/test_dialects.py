"""What each control takes and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from machines.errors import ProgramRefusedError
from machines.gcode import refusals
from machines.gcode.dialects import DIALECTS
from machines.gcode.scan import ProgramScan
from machines.grbl.settings import ControllerSettings
from machines.preflight.preflight import MillLimits, limits_of
from machines.profile import load_profile
from service.milling.preflight_child import examine

RATES = (5000.0, 5000.0, 1500.0)
ROLAND = "%\nO00000001\nG90 G21\nS8000 M03\nG00 X0.0 Y0.0 Z5.0\nG01 Z-1.0 F100.0\nX8.5 Y.125\nM05\nM02\n%\n"
OKUMA = "%\nO100\nG15 H1\nG90 G17\nG56 H1\nG0 X0. Y0.\nZ5.\nS5000 M3\nG1 Z-1. F200.\nX9.\nM5\nM2\n%\n"
LINUXCNC = "%\nG21 G90 G94 G17 G64 P0.002\nT1 M6\nG43 H1\nM3 S900\nG0 X0 Y0 Z5\nG1 Z-1 F100\nM5\nM2\n%\n"
FANUC = "%\nO0001\nG21 G90 G54\nG00 X0. Y0.\nG43 H01 Z5.\nS900 M03\nG01 Z-1. F100.\nM05\nM30\n%\n"
GRBL = "G21 G90\nG0 X0 Y0 Z5\nM3 S900\nG1 Z-1 F100\nM5\nM2\n"


def read(dialect: str, text: str) -> ProgramScan:
    scan = ProgramScan(dialect, RATES)
    for _ in scan.read_batches([text.encode()]):
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
        ("roland-nc", ROLAND.replace("S8000 M03", "M03"), 6, "S and M03 before"),
        ("roland-nc", ROLAND.replace("S8000 M03", "S8000 M04"), 4, "does not have this word"),
        ("roland-nc", ROLAND.replace("X8.5", "X8.5 F200"), 7, "decimal point"),
        ("roland-nc", ROLAND.replace("X8.5 Y.125", "G02 X8.5 Y0.0 R9.0"), 7, "by I and J only"),
        ("roland-nc", ROLAND.replace("X8.5 Y.125", "G28 Z0"), 7, "decimal point"),
        ("roland-nc", ROLAND.replace("X8.5 Y.125", "G81 X1.0 Y1.0 Z-2.0 R1.0"), 7, "no canned cycles here"),
        ("roland-nc", ROLAND.replace("X8.5 Y.125", "G10 P1"), 7, "does not have this word"),
        ("roland-nc", ROLAND.replace("O00000001", "O0001"), 2, "O and 8 digits"),
        ("roland-nc", ROLAND + "G01 X1.0\n", 11, "closing %"),
        ("roland-nc", ROLAND + "%\n", 11, "the first and the last line"),
        ("roland-nc", ROLAND.replace("M05", "M05 %"), 8, "the first and the last line"),
        ("fanuc", FANUC.replace("X0.", "X5"), 4, "decimal point"),
        ("fanuc", FANUC.replace("O0001", "O00001"), 2, "O and 1 to 4 digits"),
        ("fanuc", FANUC.replace("O0001", "N5 O0001"), 2, "first on its line"),
        ("fanuc", FANUC.replace("M05", "G38.2 Z-9. F10"), 8, "does not have this word"),
        ("fanuc", FANUC.replace("M05", "G4"), 8, "milliseconds"),
        ("okuma", OKUMA.replace("G15 H1", "G54"), 3, "G15 H"),
        ("okuma", OKUMA.replace("G56 H1", "G43 H1"), 5, "G56 H"),
        ("okuma", OKUMA.replace("M5", "G4 P1."), 11, "seconds"),
        ("okuma", OKUMA.replace("O100", "O" + "A" * 17), 2, "at most 16 letters and digits"),
        ("okuma", "$LENS.MIN%\n" + OKUMA, 1, "file names are set at the control"),
        ("okuma", OKUMA.replace("F200.", "F200"), 9, "decimal point"),
        ("linuxcnc", LINUXCNC.replace("T1 M6", "O100 SUB"), 3, "letter"),
        ("grbl", GRBL.replace("M3", "G15 H1"), 3, "does not know"),
    ],
)
def test_refusals_by_dialect(dialect: str, text: str, line: int, words: str) -> None:
    if not words:
        assert read(dialect, text).lines == line
        return
    with pytest.raises(ProgramRefusedError, match=words) as caught:
        read(dialect, text)
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("dialect", "text", "pause_s"),
    [
        ("grbl", GRBL.replace("M5", "G4 P1.5"), 1.5),
        ("linuxcnc", LINUXCNC.replace("M5", "G4 P1.5"), 1.5),
        ("fanuc", FANUC.replace("M05", "G04 P1500"), 1.5),
        ("fanuc", FANUC.replace("M05", "G04 X1.5"), 1.5),
        ("okuma", OKUMA.replace("M5\n", "G4 F1.5\n"), 1.5),
    ],
)
def test_each_control_has_its_own_letter_and_unit_of_a_dwell(dialect: str, text: str, pause_s: float) -> None:
    """A dwell moves nothing and leaves the feed alone, whatever letter tells its time."""
    scan = ProgramScan(dialect, RATES)
    pauses = [float(pause) for batch in scan.read_batches([text.encode()]) for pause in batch.pause_s]
    assert max(pauses) == pytest.approx(pause_s)
    plain = read(dialect, {"grbl": GRBL, "linuxcnc": LINUXCNC, "fanuc": FANUC, "okuma": OKUMA}[dialect])
    assert scan.state.position_mm == plain.state.position_mm
    assert scan.state.feed_mm_per_min == plain.state.feed_mm_per_min


@pytest.mark.parametrize(
    ("dialect", "text", "line"),
    [
        ("roland-nc", ROLAND, "G02 X0.5 Y0.125 I-4.0 J0.0"),
        ("roland-nc", ROLAND, "G90 G53 G00 Z0.0"),
        ("roland-nc", ROLAND, "G91 G28 Z0.0"),
        ("roland-nc", ROLAND, "G55"),
        ("fanuc", FANUC, "G91 G28 Z0"),
        ("fanuc", FANUC, "G54.1 P12"),
        ("fanuc", FANUC, "G30 P2 Z0."),
        ("fanuc", FANUC, "G01 X5. F500"),
        ("okuma", OKUMA, "G30 P1"),
        ("okuma", OKUMA, "N12 G1 X0 Y4.0001"),
        ("okuma", OKUMA.replace("O100", "OLENS1"), "M01"),
        ("linuxcnc", LINUXCNC, "G43.1 Z3"),
    ],
)
def test_words_of_its_own_are_taken_in_the_middle_of_a_program(dialect: str, text: str, line: str) -> None:
    end = "M05" if "M05" in text else "M5"
    assert read(dialect, text.replace(end, f"{line}\n{end}")).state.ended


@pytest.mark.parametrize(
    ("options", "firmware", "warned"),
    [("", "grbl", True), ("V,15,128", "grbl", True), ("VM,15,128", "grbl", False), ("VM,100,1024", "grblhal", False),
     ("PHSW", "fluidnc", True)],
)  # fmt: skip
def test_mist_is_warned_of_unless_the_controller_says_that_it_has_it(
    options: str, firmware: str, warned: bool, tmp_path: Path
) -> None:
    limits = limits_of(load_profile("grbl", ()), ControllerSettings(options=options, firmware=firmware))
    assert MillLimits.from_dict(limits.to_dict()) == limits
    (file := tmp_path / "p.nc").write_text("G21 G90\nG0 X0 Y0 Z5\nM7\nG1 X1 F100\nM2\n")
    found = examine(file, limits, lambda share: None)
    assert any("M7 is error:20" in one.words for one in found.findings) is warned


def test_a_program_that_could_not_be_restarted_by_number_says_so(tmp_path: Path) -> None:
    limits = limits_of(load_profile("okuma-osp", ()))
    for text, told in ((OKUMA, True), (OKUMA.replace("G90", "N10 G90"), False)):
        (file := tmp_path / "p.min").write_text(text)
        found = examine(file, limits, lambda share: None)
        assert ("numbers" in {one.code for one in found.findings}) is told


def test_no_sentence_names_a_value_that_is_not_filled_in() -> None:
    for dialect in DIALECTS.values():
        for code in refusals.CODES:
            words = dialect.reason_for(code)
            assert "{" not in words and "\n" not in words


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
