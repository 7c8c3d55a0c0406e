"""The reader of programs: what it understands, what it refuses, and that chunks do not matter."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from gcodeparser import parse_gcode_lines
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.errors import CamError
from cam.reading.gcode import ProgramError
from tests.cam.programs import read_program

APPROACH = "G21 G90\nG0 Z5\nG0 X0 Y0\n"


def moves(text: str, *cuts: int):
    """All batches of a text joined, the text cut into chunks at the given places."""
    data = text.encode()
    edges = [0, *sorted(min(c, len(data)) for c in cuts), len(data)]
    batches = list(read_program(data[a:b] for a, b in pairwise(edges)))
    joined = {
        name: np.concatenate([getattr(b, name) for b in batches])
        for name in ("start_mm", "end_mm", "is_rapid", "feed_mm_per_min", "line", "spindle_on", "pause_s")
    }
    return joined, batches[-1]


def test_words_are_modal_and_case_spaces_comments_and_line_ends_do_not_matter():
    plain, _ = moves(APPROACH + "M3 S12000\nG1 X1 Z-0.5 F600\nX2.25\nY-.5\nM5\nM2\n")
    odd, last = moves(
        "(a (nested start) g21G90; units\r\n\r\nN10 g0 z5.\nG0X0y+0\n\nm3 s12000\n"
        "g1 (to the side) x1.0 z-.5f600 ; cut\r\nN11X 2.25\nY-0.50\nM5\nM2\n; the end\n"
    )
    for name in ("start_mm", "end_mm", "is_rapid", "feed_mm_per_min", "spindle_on", "pause_s"):
        np.testing.assert_array_equal(plain[name], odd[name])
    np.testing.assert_allclose(plain["end_mm"][-3], [2.25, -0.5, -0.5])
    assert last.ended and last.lines_read == 12


def test_inches_and_distances_become_absolute_millimetres():
    read, _ = moves(APPROACH + "G20 G91\nG1 X1 F10\nZ-.5\nG21 X-5.4\n")
    np.testing.assert_allclose(read["end_mm"], [[25.4, 0, 5], [25.4, 0, -7.7], [20, 0, -7.7]])
    np.testing.assert_allclose(read["feed_mm_per_min"], 254)


def test_the_approach_from_nowhere_is_not_a_move():
    read, _ = moves("G21G90\nG0 Z5\nG0 X7 Y8\nG1 Z-1 F60\n")
    np.testing.assert_array_equal(read["start_mm"], [[7, 8, 5]])
    np.testing.assert_array_equal(read["line"], [4])


def test_a_head_raised_in_machine_coordinates_goes_across_at_a_height_that_nobody_knows():
    read, _ = moves("G21G90\nG53 G0 Z-1\nM3 S1000\nG4 P2\nG0 X7 Y8\nZ5\nG1 Z-1 F60\nG53 G0 Z-1\nM2\n")
    np.testing.assert_array_equal(read["start_mm"], [[7, 8, 5], [7, 8, 5], [7, 8, -1]])
    np.testing.assert_array_equal(read["line"], [6, 7, 9])
    np.testing.assert_array_equal(read["pause_s"], [2, -1, 0])


def test_dwell_and_spindle_stop_the_motion_for_their_time():
    read, _ = moves(APPROACH + "M3 S1000\nG4 P1.5\nG1 X1 F60\nM5\n")
    np.testing.assert_array_equal(read["pause_s"], [0, 1.5, -1, 0])
    np.testing.assert_array_equal(read["spindle_on"], [True, True, True, False])


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("G21\n%\n", 2, "error:1"),
        (APPROACH + "G1 X1\n", 4, "feed"),
        (APPROACH + "G1 X1 F0\n", 4, "above 0"),
        (APPROACH + "G53 G0 X1\n", 4, "machine coordinates"),
        (APPROACH + "G53 G0 X1 Z-1\n", 4, "machine coordinates"),
        (APPROACH + "G53 G1 Z-1 F60\n", 4, "machine coordinates"),
        (APPROACH + "G91 G53 G0 Z-1\n", 4, "machine coordinates"),
        ("G53 G0 Z-1\nG1 X1 Y1 F60\n", 2, "position is not known"),
        (APPROACH + "G2 X1 Y1 F100\n", 4, "an arc needs"),
        (APPROACH + "G90.1\n", 4, "allowed"),
        (APPROACH + "T1\n", 4, "allowed"),
        (APPROACH + "M6\n", 4, "allowed"),
        (APPROACH + "G0 X1 X2\n", 4, "twice"),
        (APPROACH + "G0 G1 X1 F9\n", 4, "modal group"),
        (APPROACH + "G0 Xnan\n", 4, "decimal number"),
        (APPROACH + "G0 X1e5\n", 4, "allowed"),
        (APPROACH + "G0 X1.2.3\n", 4, "starts with a letter"),
        (APPROACH + "G0 X--1\n", 4, "decimal number"),
        (APPROACH + "G0 X123456789012345678\n", 4, "17 digits"),
        (APPROACH + "G0 X1 (open\n", 4, "must close"),
        (APPROACH + "G4\n", 4, "P"),
        (APPROACH + "G4 P-1\n", 4, "P"),
        (APPROACH + "G4 P1 X1\n", 4, "without a motion"),
        (APPROACH + "G0 X1 P1\n", 4, "G4"),
        (APPROACH + "M3\n", 4, "speed"),
        (APPROACH + "M2\nG0 X1\n", 5, "M2"),
        (APPROACH + "G0 X1 " + 74 * " " + "\n", 4, "79"),
        (APPROACH + "(" + 200 * "x" + ")", 4, "79"),
        (APPROACH + "\u00b5\n", 4, "starts with a letter"),
        ("G0 X1 Y1\n", 1, "position is not known"),
        ("G0 Z5\nG1 X1 Y1 F60\n", 2, "position is not known"),
        ("G91\nG0 Z5\n", 2, "position is not known"),
        ("G90\nX1\n", 2, "G0 or G1"),
    ],
)
def test_what_may_not_run_is_refused_with_line_text_and_reason(text, line, words):
    with pytest.raises(ProgramError) as refused:
        moves(text)
    assert isinstance(refused.value, CamError)
    assert refused.value.line == line
    assert words in str(refused.value)
    assert f"line {line}" in str(refused.value)
    assert text.split("\n")[line - 1].strip()[:3].encode("ascii", "backslashreplace").decode() in str(refused.value)


def test_a_line_of_79_characters_is_taken():
    read, _ = moves(APPROACH + "G0 X1" + 74 * " " + "\n")
    assert read["end_mm"][-1, 0] == 1


numbers = st.decimals(-999, 999, places=5, allow_nan=False).map(lambda d: f"{d:f}")


@st.composite
def programs(draw):
    """Valid programs with the motion word on every line, so that another parser can read them too."""
    lines = ["G21", "G90", "G0 Z5", "G0 X0 Y0", "F100"]
    for _ in range(draw(st.integers(1, 25))):
        kind = draw(st.integers(0, 9))
        if kind == 0:
            lines.append(draw(st.sampled_from(["G90", "G91", "G20", "G21", "M5", "(note)", ""])))
        else:
            axes = draw(st.lists(st.sampled_from("XYZ"), min_size=1, max_size=3, unique=True))
            words = [draw(st.sampled_from(["G0", "G1"])), *(a + draw(numbers) for a in axes)]
            if draw(st.booleans()):
                words.append(f"F{draw(st.integers(1, 5000))}")
            lines.append(" ".join(words))
    return "\n".join(lines) + "\n"


@given(programs(), st.lists(st.integers(0, 900), max_size=8))
@settings(max_examples=150, deadline=None)
def test_chunk_boundaries_change_nothing(text, cuts):
    whole, last = moves(text)
    pieces, last_piece = moves(text, *cuts)
    for name, values in whole.items():
        np.testing.assert_array_equal(values, pieces[name])
    assert last.lines_read == last_piece.lines_read == text.count("\n")
    assert last.bytes_read == last_piece.bytes_read == len(text)


@given(programs())
@settings(max_examples=100, deadline=None)
def test_agrees_with_an_independent_parser(text):
    read, _ = moves(text)
    here = np.array([0.0, 0.0, 5.0])
    scale, absolute = 1.0, True
    expected = []
    for block in list(parse_gcode_lines(text))[4:]:
        match block.command:
            case ("G", 20 | 21 as unit):
                scale = 25.4 if unit == 20 else 1.0
            case ("G", 90 | 91 as mode):
                absolute = mode == 90
            case ("G", 0 | 1 as motion):
                target = here.copy()
                for d, axis in enumerate("XYZ"):
                    if axis in block.params:
                        target[d] = block.params[axis] * scale + (0 if absolute else here[d])
                if (target != here).any():
                    expected.append((*target, motion == 0))
                here = target
    motions = read["pause_s"] < 0
    got = np.column_stack([read["end_mm"], read["is_rapid"]])[motions]
    np.testing.assert_allclose(got, np.array(expected).reshape(-1, 4), atol=1e-9)
