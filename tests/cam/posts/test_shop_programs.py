"""Programs as shops keep them: a tool change with its length, an optional stop, N words, inches. What is written is
read back to half a digit, a mill may run it, and recovery knows that a tool's length came from the control's table.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.joining import find_tool_changes, hash_moves, join_programs
from cam.moves import cut, rapid
from cam.posts.dialects import POSTS, find_unsupported
from cam.posts.post import ProgramSetup
from cam.posts.writers import create_writer
from cam.reading.gcode import LANGUAGES, ProgramError, read_parts
from machines.errors import MachineError
from machines.gcode.interpreter import Interpreter
from machines.preflight.preflight import limits_of
from machines.profile import load_profile
from service.milling.preflight_child import examine

SAFE_Z = 5.08  # two tenths of an inch
POINT = st.tuples(st.floats(-90, 90), st.floats(-90, 90), st.floats(-40, 4))
CHANGING = ("linuxcnc", "fanuc", "okuma")
LENGTH = {"linuxcnc": "G43H3", "fanuc": "G43H3", "okuma": "G56H3"}


def program(dialect, points, *, units="mm", number_every=None, tool=0, stop=False, top_mm=-1.0, feed=250.0) -> bytes:
    post = POSTS[dialect].adapt(units=units, number_every=number_every)
    setup = ProgramSetup(top_z_mm=top_mm, tool=tool, optional_stop=stop)
    writer = create_writer(post)
    x, y, _ = points[0]
    paths = [rapid((x, y, SAFE_Z)), cut(points, feed), rapid((*points[-1][:2], SAFE_Z))]
    pieces = [writer.start(("pass",), rpm=6000, safe_z_mm=SAFE_Z, setup=setup)]
    pieces += [piece for path in paths for piece in writer.write(path)]
    return b"".join([*pieces, writer.end(safe_z_mm=SAFE_Z, setup=setup)])


def read(dialect, *parts):
    return list(read_parts(([part] for part in parts), LANGUAGES[dialect]))


@pytest.mark.parametrize("dialect", ["grbl", *CHANGING])
@settings(max_examples=25, deadline=None)
@given(st.lists(POINT, min_size=1, max_size=20), st.floats(30, 2900), st.booleans())
def test_inches_are_read_back_to_half_a_digit_and_their_feed_is_never_faster(dialect, points, feed, raised):
    text = program(dialect, points, units="inch", feed=feed, top_mm=-1.0 if raised else None)
    assert b"G20" in text and b"G21" not in text
    digits = POSTS[dialect].adapt(units="inch", number_every=None).digits
    batches = read(dialect, text)
    ends = np.vstack([batch.end_mm[(batch.pause_s < 0) & ~batch.is_rapid] for batch in batches])
    feeds = np.concatenate([batch.feed_mm_per_min[(batch.pause_s < 0) & ~batch.is_rapid] for batch in batches])
    scale = np.array([digits.xy_mm, digits.xy_mm, digits.z_mm])
    wanted = np.floor(np.array([(*points[0][:2], SAFE_Z), *points]) / scale + 0.5)
    moved = (np.diff(wanted, axis=0) != 0).any(axis=1)
    np.testing.assert_allclose(ends, wanted[1:][moved] * scale, atol=1e-9)
    assert (feeds <= feed + 1e-4).all() and (feeds > feed - 0.3).all()


@pytest.mark.parametrize("dialect", CHANGING)
@pytest.mark.parametrize("top_mm", [-1.0, None])
@pytest.mark.parametrize("units", ["mm", "inch"])
def test_the_tool_comes_first_and_its_length_with_the_first_z_of_the_work_frame(dialect, top_mm, units, tmp_path):
    text = program(dialect, [(1, 2, -3), (4, 2, -3)], units=units, tool=3, stop=True, number_every=1, top_mm=top_mm)
    lines = text.decode().splitlines()
    change, stop = lines.index("T3M6"), lines.index("M1")
    length = next(k for k, line in enumerate(lines) if LENGTH[dialect] in line)
    in_work = [k for k, line in enumerate(lines) if re.search(r"(?<!G53G0)(?<!G16H0G0)Z-?\d", line) and line[0] != "("]
    spindle = next(k for k, line in enumerate(lines) if "M3" in line and line[0] != "(")
    assert change < length == in_work[0] and change < stop < spindle
    assert [int(n) for n in re.findall(r"^N(\d+)", text.decode(), re.M)] == list(range(1, text.count(b"\nN") + 1))
    batches = read(dialect, text, text)  # two parts of a pass, one after the other
    assert batches[-1].ended and sum(map(len, batches)) > 6
    file = tmp_path / "pass.nc"
    file.write_bytes(text)
    profile = replace(
        *[load_profile({"okuma": "okuma-osp"}.get(dialect, "linuxcnc"))],
        dialect=dialect, safe_z_mm=SAFE_Z, homing=True, top_z_mm=top_mm,
    )  # fmt: skip
    found = examine(file, limits_of(profile), lambda share: None)
    assert not found.faults, found.faults
    assert set(found.bounds_by_frame) <= {"G54", "machine"}


def test_a_second_tool_and_a_length_in_the_middle_are_refused_by_the_check_and_reported_before_a_start(tmp_path):
    head = b"G21G90G17G54\nT1M6\nG0G43H1Z5\nM3S6000\nG0X0Y0\nG1Z-1F100\nG0Z5\n"
    for late, line in ((b"T2M6\n", 8), (b"G43H2\n", 8), (b"G28\nG0X5\n", 9)):
        with pytest.raises(ProgramError, match=rf"^line {line}, "):
            read("linuxcnc", head + late + b"M5\nM2\n")
    file = tmp_path / "two.ngc"
    file.write_bytes(head + b"M5\nT2M6\nG43H2\nG0X1Y1Z5\nM3\nG1Z-1\nG0Z5\nM5\nM2\n")
    profile = replace(load_profile("linuxcnc"), safe_z_mm=5.0)
    assert any(one.code == "frame" for one in examine(file, limits_of(profile), lambda share: None).findings)


def three_programs(dialect, *, units="mm", number_every=None) -> list[bytes]:
    ways = [(1, 2, -3), (4, 2, -3)], [(9, 9, -1), (9, 5, -2)], [(0, 0, -4), (1, 1, -4.5)]
    given = {"units": units, "number_every": number_every, "stop": True}
    return [program(dialect, way, tool=tool, **given) for way, tool in zip(ways, (1, 4, 1), strict=True)]


def pieces_of(text: bytes, size: int) -> list[bytes]:
    return [text[at : at + size] for at in range(0, len(text), size)]


@pytest.mark.parametrize("dialect", CHANGING)
@settings(max_examples=15, deadline=None)
@given(units=st.sampled_from(["mm", "inch"]), every=st.sampled_from([None, 1, 3]), size=st.integers(1, 400))
def test_programs_in_one_move_as_they_do_alone_and_a_control_runs_them(dialect, units, every, size, tmp_path_factory):
    parts = three_programs(dialect, units=units, number_every=every)
    post = POSTS[dialect].adapt(units=units, number_every=every)
    whole = b"".join(join_programs((pieces_of(part, size) for part in parts), post))
    language = LANGUAGES[dialect]
    alone = hash_moves(read_parts(([part] for part in parts), language))
    assert hash_moves(read_parts([pieces_of(whole, size)], language, changes_tools=True)) == alone
    lines = whole.splitlines(keepends=True)
    changes = find_tool_changes(lines)
    assert [tool for _, tool in changes] == [1, 4, 1]
    mill = Interpreter(dialect=dialect)
    for number, line in enumerate(lines, 1):
        if number in dict(changes):  # the head is at its top, which the work frame does not know; all is off
            assert mill.state.position_mm[2] is None and mill.state.spindle == "M5"
        mill.take(line.rstrip())
        assert mill.state.tool == dict(changes).get(number, mill.state.tool)
    assert [whole.count(word) for word in post.tape and (b"%", b"\nO")] == [2, 1][: len(post.tape)]
    assert sum(line.strip() in (b"M2", b"M30") for line in lines) == 1
    numbers = [int(n) for n in re.findall(rb"^N(\d+)", whole, re.M)]
    assert numbers == sorted(set(numbers)) and bool(numbers) == (post.number_every in (1, 3))
    file = tmp_path_factory.mktemp("whole") / "all.nc"
    file.write_bytes(whole)
    profile = replace(
        *[load_profile({"okuma": "okuma-osp"}.get(dialect, "linuxcnc"))],
        dialect=dialect, safe_z_mm=SAFE_Z, homing=True, top_z_mm=-1.0,
    )  # fmt: skip
    found = examine(file, limits_of(profile), lambda share: None)
    assert not found.faults, found.faults
    assert set(found.bounds_by_frame) == {"G54", "machine"}


def test_a_program_that_does_other_moves_than_its_parts_is_found_out():
    parts = three_programs("linuxcnc")
    whole = b"".join(join_programs(([part] for part in parts), POSTS["linuxcnc"]))
    alone = hash_moves(read_parts(([part] for part in parts), LANGUAGES["linuxcnc"]))
    for found, planted in ((b"Y5", b"Y5.0001"), (b"F250", b"F251"), (b"S6000", b"S6001"), (b"G4P4", b"G4P5")):
        assert found in whole
        changed = whole[::-1].replace(found[::-1], planted[::-1], 1)[::-1]
        assert hash_moves(read_parts([[changed]], LANGUAGES["linuxcnc"], changes_tools=True)) != alone
    with pytest.raises(ValueError, match="program 1 ends with"):
        list(join_programs([[parts[0] + b"G0X1\n"], [parts[1]]], POSTS["linuxcnc"]))


@pytest.mark.parametrize("at_change", [b"", b"G0Z5\nM5\n", b"G53G0Z0\n", b"G53G0Z0\nM5\nG0Z5\n"])
def test_a_tool_is_changed_in_the_middle_only_at_the_top_with_the_spindle_off(at_change):
    head = b"G21G90G17G54\nT1M6\nG53G0Z0\nG0X0Y0\nG0G43H1Z5\nM3S6000\nG1Z-1F100\n"
    tail = b"T2M6\nG0X1Y1\nG0G43H2Z5\nM3\nG1Z-1\nG53G0Z0\nM5\nM2\n"
    assert list(read_parts([[head + b"G53G0Z0\nM5\n" + tail]], LANGUAGES["linuxcnc"], changes_tools=True))
    with pytest.raises(ProgramError, match="T2M6"):
        list(read_parts([[head + at_change + tail]], LANGUAGES["linuxcnc"], changes_tools=True))


def test_a_length_from_the_table_is_part_of_the_state_so_that_recovery_can_refuse():
    interpreter = Interpreter(dialect="linuxcnc")
    for line in (b"G21G90G17G54", b"T1M6", b"G0G43H1Z5", b"G0X0Y0", b"G1Z-1F100"):
        interpreter.take(line)
    assert interpreter.state.shifted and interpreter.state.tool == 1
    assert interpreter.state.position_mm == (0.0, 0.0, -1.0)


def test_tool_words_that_name_no_tool_are_refused():
    for text, reason in ((b"G21\nM6\n", "needs T"), (b"G21\nG43\n", "needs H"), (b"G21\nG1H1\n", "H belongs")):
        with pytest.raises(ProgramError, match=reason):
            read("linuxcnc", text)
    with pytest.raises(ProgramError, match="T1 is not allowed here"):
        read("grbl", b"G21\nT1M6\n")


@settings(max_examples=40, deadline=None)
@given(st.floats(0.5, 50), st.floats(-3.1, 3.1), st.floats(0.05, 6.2), st.booleans(), st.booleans(), st.floats(-3, 3))
def test_arcs_are_read_as_chords_on_the_circle(radius, start, sweep, clockwise, by_r, rise):
    way = -sweep if clockwise else sweep
    a = radius * np.array([np.cos(start), np.sin(start)])
    b = radius * np.array([np.cos(start + way), np.sin(start + way)])
    if by_r and abs(sweep - np.pi) < 0.05:
        return  # there, the arc's centre follows from digits that are not written
    r = radius if sweep < np.pi else -radius
    words = f"R{r:.9f}" if by_r else f"I{-a[0]:.9f}J{-a[1]:.9f}"
    begin = f"G21G90G17\nM3S9000\nG0Z5\nG0X{a[0]:.9f}Y{a[1]:.9f}\nG1Z0F100\n"
    arc = f"G{2 if clockwise else 3}X{b[0]:.9f}Y{b[1]:.9f}Z{rise:.9f}{words}\n"
    batches = read("linuxcnc", f"{begin}{arc}M5\nM2\n".encode())
    points = np.vstack([batch.end_mm[batch.line == 6] for batch in batches])
    starts = np.vstack([batch.start_mm[batch.line == 6] for batch in batches])
    off_mm = 1e-3 if by_r else 1e-6
    assert np.abs(np.hypot(*points[:, :2].T) - radius).max() < off_mm
    middle = (points + starts)[:, :2] / 2
    assert (radius - np.hypot(*middle.T)).max() < 0.0005 + off_mm  # of a chord
    length = np.hypot(*(points - starts)[:, :2].T).sum()
    assert length == pytest.approx(radius * sweep, rel=2e-3, abs=2e-3)
    np.testing.assert_allclose(points[-1], (*b, rise), atol=1e-8)


def test_what_a_control_cannot_do_is_named_with_those_that_can():
    asked = ProgramSetup(tool=1, optional_stop=True)
    found = {
        field: str(words) for field, _, words in find_unsupported("roland-nc", asked, units="inch", number_every=1)
    }
    assert set(found) == {"tool_change", "optional_stop", "units", "number_every"}
    assert "'linuxcnc'" in found["tool_change"] and "'grbl'" in found["units"]
    assert not list(find_unsupported("linuxcnc", asked, units="inch", number_every=1))


def test_grbl_relatives_refuse_a_tool_table_as_before():
    with pytest.raises(MachineError):
        Interpreter(dialect="grbl").take(b"G43H1")
