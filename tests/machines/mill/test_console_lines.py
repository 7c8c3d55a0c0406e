"""Lines of the console that change what protects the mill or where things are: each row of the table, and the rest."""

from __future__ import annotations

import re

import pytest

from machines.mill.console_lines import EFFECTS, describe_effect

# One line for each row, in the table's order, spelled in one of the ways that controllers take.
LINES = (
    ("$RST=*", "factory values"),
    ("$N0=G0X0", "by itself"),
    ("$1=255", "driven and held"),
    ("$5=1", "signals"),
    ("$10=3", "reports"),
    ("$13=1", "inches"),
    ("$20=0", "soft limits off"),
    ("$021 = 0.0", "limit switches off"),
    ("$22=0", "homing off"),
    ("$23=3", "homes"),
    ("$30=1000", "spindle speed"),
    ("$32=1", "laser mode on"),
    ("$100=250", "steps per mm"),
    ("$110=5000", "how fast"),
    ("$130=900", "travel"),
    ("$f=/part.nc", "a file"),
    ("$/axes/x/max_travel_mm=900", "for good"),
    ("$$", ""),
    ("$MD", "not known here"),
    ("[ESP220]/part.nc", "files and network"),
    ("#5221=1", "parameter"),
    ("g10 l20 p1 x0", "work zero or a tool's length"),
    ("G1 F100 G092.10", "shifts the work zero"),
    ("G(to the second vice)55", "another work coordinate system"),
    ("G43.1 Z-3", "length of the tool"),
    ("G51 X2", "scales"),
    ("G28.1", "stores this place"),
    ("N5 G20 G0 X1", "inches"),
)


@pytest.mark.parametrize("row", range(len(EFFECTS)))
def test_each_row_says_what_its_line_would_do(row: int) -> None:
    (line, words), effect = LINES[row], EFFECTS[row][1]
    assert describe_effect(line) == effect and words in effect
    assert len(LINES) == len(EFFECTS)


@pytest.mark.parametrize(
    "line",
    ["$N1=M3 S9000", "$21=0", "$RST=$", "$RST=#", "$ rst = *", "$130=1", "$20=1", "$N=G20", "G92", "G59.3", "$+20=0"],
)
def test_no_other_spelling_passes(line: str) -> None:
    assert describe_effect(line)


@pytest.mark.parametrize(
    "line",
    ["G0 Z5", "M3 S1000", "$#", "$G", "$I", "$N", "$", "G54", "G91 G0 X-1", "G1 X10 Y92 F100", "(G10 L20)", "G4 P1"],
)
def test_moves_and_questions_pass(line: str) -> None:
    assert describe_effect(line) == ""


def test_the_words_are_the_end_of_a_sentence() -> None:
    assert all(re.fullmatch(r"[a-z][^.]*", words.replace("25.4", "")) for _, words in EFFECTS if words)
