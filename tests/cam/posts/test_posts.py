"""Blocks: modal, short, exact to the last decimal, and readable by a controller with an 80-character buffer."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.errors import LineTooLongError
from cam.moves import cut, rapid
from cam.posts import writers
from cam.posts.dialects import GRBL
from cam.posts.post import Post
from cam.posts.writers import ProgramWriter

POSITION = st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(-80, 20))
WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d+)?)")


def text(paths, post: Post = GRBL) -> str:
    writer = ProgramWriter(post)
    return b"".join(piece for path in paths for piece in writer.write(path)).decode("ascii")


def positions(program: str) -> np.ndarray:
    """Where a modal controller would go."""
    at, found = {}, []
    for line in program.splitlines():
        at.update((letter, float(value)) for letter, value in WORD.findall(line))
        found.append([at["X"], at["Y"], at["Z"]])
    return np.array(found)


@given(st.lists(POSITION, min_size=1, max_size=40))
def test_every_point_is_reached_to_half_a_unit_of_the_last_decimal(points):
    program = text([cut(points, 600.0)])
    rounded = np.round(np.array(points), (4))
    rounded[:, 2] = np.round(np.array(points)[:, 2], 5)
    moved = np.concatenate([[True], (np.abs(np.diff(rounded, axis=0)) > 1e-9).any(axis=1)])
    reached = positions(program)
    if len(reached) == moved.sum():  # a tie may round either way and so make or save a block
        wanted = np.array(points)[moved]
        assert (np.abs(reached - wanted) <= np.array([5e-5, 5e-5, 5e-6]) + 1e-9).all()
    np.testing.assert_allclose(reached[-1], points[-1], atol=5.1e-5)


@given(st.lists(POSITION, min_size=1, max_size=40))
def test_blocks_are_short_and_say_only_what_changed(points):
    program = text([rapid((0, 0, 5)), cut(points, 612.5), cut(points[::-1], 612.5)])
    before: dict[str, str] = {}
    for line in program.splitlines():
        assert len(line) < 80
        words = WORD.findall(line)
        assert "".join(letter + value for letter, value in words) == line
        for letter, value in words:
            assert before.get(letter) != value
            before[letter] = value
            assert not re.search(r"\.\d*0$|\.$|^-?0\d|^-0$", value)  # nothing spare


def test_the_longest_block_fits():
    path = cut([(-1234.5678, -1234.5678, -123.45678)], 12345.6789)
    assert text([path]) == "G1X-1234.5678Y-1234.5678Z-123.45678F12345.6789\n"


@pytest.mark.parametrize("at_once", [1, 2, 7])
def test_pieces_do_not_show_in_the_text(monkeypatch, at_once):
    """Modal state lives on between paths and pieces."""
    points = np.cumsum(np.random.default_rng(1).normal(size=(50, 3)), axis=0)
    whole = text([cut(points, 600.0)])
    assert text([cut(points[:20], 600.0), cut(points[20:], 600.0)]) == whole
    monkeypatch.setattr(writers, "POINTS_AT_ONCE", at_once)
    assert text([cut(points, 600.0)]) == whole


def test_motion_and_feed_words_only_when_they_change():
    paths = [rapid((0, 0, 5)), cut([(0, 0, 1)], 300), cut([(1, 0, 1), (2, 0, 1)], 600), rapid((2, 0, 5), (9, 0, 5))]
    assert text(paths).splitlines() == ["G0X0Y0Z5", "G1Z1F300", "X1F600", "X2", "G0Z5", "X9"]


def test_a_move_to_where_the_tool_stands_makes_no_block():
    """And its feed and motion words wait for the next block that moves."""
    assert text([rapid((0, 0, 5)), cut([(0, 0, 5)], 300), cut([(0, 0, 5.000004), (1, 0, 5)], 300)]).splitlines() == [
        "G0X0Y0Z5",
        "G1X1F300",
    ]


def test_another_dialect_is_data():
    """Spaces, decimals on whole numbers, whole feeds, CR LF, two-digit motion words."""
    other = Post(
        name="o",
        suffix=".nc",
        start=(),
        end=(),
        rapid="G00",
        cut="G01",
        between_words=" ",
        least_decimals=1,
        feed_decimals=0,
        line_end="\r\n",
        z_decimals=3,
    )
    paths = [rapid((0, 1.5, 5)), cut([(0, 1.5, -0.0004)], 300.7)]
    assert text(paths, other) == "G00 X0.0 Y1.5 Z5.0\r\nG01 Z0.0 F300\r\n"


def test_every_so_many_lines_carry_their_number():
    numbered = replace(GRBL, number_every=2, between_words=" ")
    paths = [rapid((0, 0, 5)), cut([(0, 0, 1), (1, 0, 1), (1, 0, 1), (2, 0, 1)], 60)]
    assert text(paths, numbered).splitlines() == ["G0 X0 Y0 Z5", "N2 G1 Z1 F60", "X1", "N4 X2"]


def test_first_and_last_blocks():
    writer = ProgramWriter(GRBL)
    start = writer.start(("pass (one)",), rpm=24000, safe_z_mm=5.5).decode()
    assert start == (
        "(pass _one_)\n(zero: G54, with G92 and tool length G43.1 as they were when it was set)\n"
        "(start: with the tool over the block, or not above Z5.5, where it goes first)\n"
        "G21G90G94G17G54\nG0Z5.5\nM3S24000\nG4P4\n"
    )
    assert writer.end(safe_z_mm=5.5) == b"G0Z5.5\nM5\nM2\n"


@given(st.text(max_size=300))
def test_no_remark_can_break_the_program(remark):
    line = GRBL.remark(remark).decode("ascii")
    assert re.fullmatch(r"\([^()\n]*\)\n", line)
    assert len(line) < 81


def test_a_block_too_long_for_the_controller_is_refused():
    with pytest.raises(LineTooLongError) as error:
        GRBL.block("G1" + "X" * 90)
    assert error.value.allowed == 79
