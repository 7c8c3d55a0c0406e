"""The compiled scanner and the interpreter are one language; both agree with the reader of cam where that reads."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.errors import CamError
from machines.errors import ProgramRefusedError
from machines.gcode import scan as scan_module
from machines.gcode import tally
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState, Step
from machines.gcode.program import piece_digest
from machines.gcode.scan import ProgramScan, ScanBatch
from tests.cam.programs import read_program
from tests.machines.gcode.conftest import WRONG_LINES, programs

RATES = (5000.0, 5000.0, 1500.0)
HEAD = b"G21 G90\nG0 Z5\nG0 X0 Y0\nM3 S1000\n"


def scanned(
    chunks: Iterable[bytes], dialect: str = "grbl", *, every_lines: int = scan_module.EVERY_LINES
) -> tuple[ProgramScan, list[ScanBatch], int, str]:
    """The scan, its batches, and line and reason of a refusal (0 and "" without one)."""
    scan, batches = ProgramScan(dialect, RATES, every_lines=every_lines), []
    try:
        for batch in scan.read_batches(chunks):
            batches.append(batch)
    except ProgramRefusedError as error:
        return scan, batches, error.line, error.reason
    return scan, batches, 0, ""


def interpreted(program: bytes, dialect: str = "grbl") -> tuple[list[ModalState], list[Step], int, str]:
    """States before each line and after the last, steps, line and reason of a refusal."""
    interpreter = Interpreter(dialect=dialect)
    states, steps = [interpreter.state], []
    lines = program.removesuffix(b"\n").split(b"\n") if program else []
    for number, line in enumerate(lines, 1):
        try:
            steps.append(interpreter.take(line))
        except ProgramRefusedError as error:
            return states, steps, number, error.reason
        states.append(interpreter.state)
    return states, steps, 0, ""


@pytest.mark.thorough
@settings(max_examples=400)
@given(program=programs())
def test_scanner_and_interpreter_agree_on_every_line(program: bytes) -> None:
    """Modal state and position before every line, which line is refused, how long the path is."""
    states, steps, bad_line, _ = interpreted(program)
    scan, _, scanned_bad, _ = scanned([program], every_lines=1)
    assert scanned_bad == bad_line
    entries = scan.index.entries
    count = len(states) - 1
    for entry, state in zip(entries, states, strict=False):
        assert entry.state == state, entry.line
    if not bad_line:
        assert scan.lines == count
        assert scan.state == states[-1]
        length = sum(step.length_mm for step in steps if step.moves)
        # Chords are shorter than their arc by less than (2/3) tolerance over radius; tiny arcs are a single chord.
        assert scan.totals[tally.PATH_MM] <= length * (1 + 1e-9)
        straight = sum(step.length_mm for step in steps if step.kind in ("feed", "rapid") and step.moves)
        assert scan.totals[tally.PATH_MM] >= straight * (1 - 1e-9)


@settings(max_examples=300)
@given(
    program=st.one_of(st.binary(max_size=120), st.text("GGGXYZFMIJRNP0123459.-+() ;%\n\n", max_size=80).map(str.encode))
)
def test_no_text_whatever_tells_them_apart(program: bytes) -> None:
    """Neither breaks on anything, and both refuse the same line."""
    states, _, bad_line, _ = interpreted(program)
    scan, _, scanned_bad, _ = scanned([program], every_lines=1)
    assert scanned_bad == bad_line
    if not bad_line:
        assert scan.state == states[-1]


@given(program=programs(), cuts=st.lists(st.integers(0, 600), max_size=5))
def test_where_the_chunks_are_cut_does_not_matter(program: bytes, cuts: list[int]) -> None:
    edges = [0, *sorted(min(cut, len(program)) for cut in cuts), len(program)]
    whole, _, bad, why = scanned([program])
    parts, _, bad_of_parts, why_of_parts = scanned(program[a:b] for a, b in pairwise(edges))
    assert (bad, why) == (bad_of_parts, why_of_parts)
    if not bad:
        np.testing.assert_array_equal(whole.totals, parts.totals)
        np.testing.assert_array_equal(whole.bounds, parts.bounds)
        assert whole.state == parts.state
        assert whole.bytes == len(program)


@pytest.mark.thorough
@settings(max_examples=300)
@given(program=programs(wrong=False))
def test_batches_tell_each_move_of_the_interpreter(program: bytes) -> None:
    """Straight moves between known places: same ends, same feed, same order; arcs end where the interpreter says."""
    _, steps, bad, _ = interpreted(program)
    if bad:
        return
    _, batches, _, _ = scanned([program])
    for batch in batches:
        for k in np.flatnonzero(batch.pause_s < 0):
            step = steps[batch.line[k] - 1]
            last_of_line = k + 1 == len(batch) or batch.line[k + 1] != batch.line[k]
            assert step.moves
            assert batch.is_rapid[k] == (step.kind == "rapid")
            if not batch.is_rapid[k]:
                assert batch.feed_mm_per_min[k] == pytest.approx(step.feed_mm_per_min)
            if step.kind != "arc" and None not in step.start_mm:
                assert math.dist(batch.start_mm[k], batch.end_mm[k]) == pytest.approx(step.length_mm)
            if last_of_line:
                for axis, value in enumerate(step.end_mm):
                    if value is not None and step.start_mm[axis] is not None:
                        assert batch.end_mm[k][axis] == pytest.approx(value, abs=1e-12)
    told = {int(line) for batch in batches for line in batch.line[batch.pause_s < 0]}
    for number, step in enumerate(steps, 1):
        if step.moves and step.length_mm > 0:
            assert number in told, number


CAM_LINES = st.lists(
    st.one_of(
        st.builds(
            lambda word, x, z: f"{word}X{x:.4f}Z{z:.5f}",
            *(st.sampled_from(["", "G1", "G0"]), st.floats(-9, 9), st.floats(-9, 9)),
        ),
        st.sampled_from(
            ["M3S1200", "M5", "G4P0.25", "F75", "G1F80", "(x)", "G91", "G90", "G20", "G21", "N5 Y2 F33", ""]
        ),
    ),
    max_size=12,
)


@given(lines=CAM_LINES)
def test_the_reader_of_cam_sees_the_same_moves(lines: list[str]) -> None:
    program = (HEAD.decode() + "G1 F60\n" + "\n".join(lines) + "\nM2\n").encode()
    try:
        theirs = list(read_program([program]))
    except CamError:
        return
    _, ours, bad, why = scanned([program])
    assert not bad, why

    def moves(batches: list) -> np.ndarray:
        rows = []
        for b in batches:
            feed = np.where(b.is_rapid, 0, b.feed_mm_per_min)
            rows.append(np.column_stack([b.start_mm, b.end_mm, b.is_rapid, feed, b.line])[b.pause_s < 0])
        return np.concatenate(rows)

    np.testing.assert_allclose(moves(ours), moves(theirs), atol=1e-12)
    dwells = [sum(b.pause_s[b.pause_s > 0].sum() for b in batches) for batches in (ours, theirs)]
    assert dwells[0] == pytest.approx(dwells[1])
    _, steps, bad_line, _ = interpreted(program)
    assert not bad_line
    assert sum(s.length_mm for s in steps) == pytest.approx(ours_length(ours))


def ours_length(batches: list[ScanBatch]) -> float:
    return sum(float(np.linalg.norm(b.end_mm - b.start_mm, axis=1)[b.pause_s < 0].sum()) for b in batches)


@given(radius=st.floats(0.05, 500), start=st.floats(0, 6.28), sweep=st.floats(0.01, 6.27), left=st.booleans())
def test_chords_of_an_arc_stay_within_the_tolerance(radius: float, start: float, sweep: float, left: bool) -> None:
    """Chord middles lie inside the circle, by no more than GRBL's $12 = 0.002 mm as its mc_arc counts chords."""
    turn = sweep if left else -sweep
    x0, y0 = radius * math.cos(start), radius * math.sin(start)
    x1, y1 = radius * math.cos(start + turn), radius * math.sin(start + turn)
    word = "G3" if left else "G2"
    program = f"G21G90\nG0X{x0:.7f}Y{y0:.7f}Z0\n{word}X{x1:.7f}Y{y1:.7f}I{-x0:.7f}J{-y0:.7f}F100\n"
    _, batches, bad, why = scanned([program.encode()])
    assert not bad, why
    (batch,) = batches
    chords = batch.pause_s < 0
    middle = 0.5 * (batch.start_mm + batch.end_mm)[chords][:, :2]
    inside = radius - np.hypot(*middle.T)
    n = int(chords.sum())
    assert inside.max() <= 0.00201 * ((n + 1) / n) ** 2  # GRBL rounds the count of chords down
    assert inside.min() >= -1e-6
    length = np.linalg.norm((batch.end_mm - batch.start_mm)[chords], axis=1).sum()
    assert length == pytest.approx(radius * sweep, rel=0.05, abs=0.003)


def test_the_index_covers_the_file_in_pieces_whose_digests_hold() -> None:
    body = b"".join(b"G1 X%d F100 (%s)\r\n" % (k, b"c" * (k % 50)) for k in range(100))
    program = HEAD + body + b"M2"  # no line end at the end
    scan, _, bad, why = scanned([program[:333], program[333:]], every_lines=7)
    assert not bad, why
    entries = scan.index.entries
    assert entries[0].line == 1 and entries[0].offset == 0
    ends = [entry.offset for entry in entries[1:]] + [len(program)]
    assert [piece_digest(program[e.offset : end]) for e, end in zip(entries, ends, strict=True)] == [
        e.digest for e in entries
    ]
    for entry in entries:
        assert program[: entry.offset].count(b"\n") == entry.line - 1
    assert scan.lines == len(program.split(b"\n"))


@pytest.mark.parametrize("line", WRONG_LINES)
def test_each_wrong_line_is_refused_by_both_for_the_same_reason(line: str) -> None:
    program = HEAD + b"G1 X1 F100\n" + line.encode() + b"\n"
    _, _, bad, why = scanned([program])
    assert (bad, why) == interpreted(program)[2:]
    assert bad == 6


def test_words_beside_a_straight_move_count_in_both() -> None:
    program = HEAD + b"G1X1F100\nX2S500\nN9X3T4\n"
    scan, _, bad, _ = scanned([program])
    assert not bad and scan.state == interpreted(program)[0][-1]
    assert (scan.state.spindle_rpm, scan.state.tool) == (500, 4)


def test_a_refusal_names_line_text_and_way_out() -> None:
    with pytest.raises(ProgramRefusedError) as caught:
        list(ProgramScan("grbl", RATES).read_batches([HEAD + b"X1\n T1M6 \n"]))
    assert str(caught.value).startswith("line 6: 'T1M6': GRBL has no tool changes")
    assert "split the program" in str(caught.value)


def test_events_name_their_first_line() -> None:
    program = b"X1\nG0X5Y5Z5\nG1X9Z4F100\nM3S100\nG91\nM0\nG10L20P1X0\nG92X0\nG1X1F9999\n"
    scan, _, bad, why = scanned([b"G0 " + program])
    assert not bad, why
    first = {slot: int(scan.events[slot, 0]) for slot in range(tally.EVENTS) if scan.events[slot, 1]}
    assert first[tally.UNITS_ASSUMED] == 1 and first[tally.DISTANCE_ASSUMED] == 1
    assert first[tally.SPINDLE_OFF] == 3
    assert first[tally.STOPS] == 6
    assert first[tally.SETTINGS_WRITTEN] == 7
    assert first[tally.FRAME_MOVED] == 7
    assert first[tally.OVER_RATE] == 9


@pytest.mark.parametrize(("moves", "told"), [("X9", 0), ("X9\nX1Y1", 0), ("Z4", 1), ("X9Z4.9", 1), ("Z-1\nX9", 2)])
def test_a_level_way_at_the_height_of_rapids_is_no_cut_with_the_spindle_off(moves: str, told: int) -> None:
    """A trace in the air is run with the spindle off on purpose; whatever goes lower is a cut."""
    scan, _, bad, why = scanned([f"G21G90\nG0Z5\nX5Y5\nG1F100{moves}\n".encode()])
    assert not bad, why
    assert scan.events[tally.SPINDLE_OFF, 1] == told


@given(points=st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=30))
def test_bounds_are_those_of_the_points_however_little_they_grow(points: list[tuple[float, float]]) -> None:
    lines = [f"G1X{x / 9:.4f}Z{z / 9:.4f}F9" for x, z in points]
    scan, _, bad, why = scanned([b"G21G90\nG0X0Y0Z0\n" + "\n".join(lines).encode()])
    assert not bad, why
    for axis, values in ((0, [x for x, _ in points]), (2, [z for _, z in points])):
        rounded = [0.0, *(round(v / 9, 4) for v in values)]
        assert scan.bounds[0, axis] == pytest.approx(min(rounded), abs=1e-4)
        assert scan.bounds[0, 3 + axis] == pytest.approx(max(rounded), abs=1e-4)
