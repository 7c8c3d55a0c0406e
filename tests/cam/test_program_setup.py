"""What programs do beside their cuts: on before the first cut, off at the end, read alike by all readers, refused where
the control cannot."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.around.paths import trace_paths
from cam.moves import Path, cut, rapid
from cam.parts import PartLimits, PassFrame, programs
from cam.passes import Stock
from cam.posts.dialects import POSTS, find_unsupported
from cam.posts.post import ProgramSetup
from cam.posts.writers import create_writer
from cam.reading.gcode import LANGUAGES, ProgramError, read_parts
from machines.gcode.interpreter import Interpreter
from machines.preflight.preflight import limits_of
from machines.profile import load_profile
from service.milling.preflight_child import examine
from tests.cam.programs import read_program

DIALECTS = sorted(POSTS)
SAFE_Z = 5.0
STOCK = Stock(width_mm=8, height_mm=6, thickness_mm=10, margin_mm=2)
WAY = [rapid((0, 0, SAFE_Z), (0, 0, 1)), cut([(0, 0, -0.5), (4, 0, -0.5), (4, 3, -1)], 600), rapid((4, 3, SAFE_Z))]
TRACE = trace_paths(STOCK, (), safe_z_mm=SAFE_Z, feed_mm_per_min=1200)
SETUPS = [
    (dialect, ProgramSetup(coolant=coolant))
    for dialect, post in POSTS.items()
    for coolant in post.coolant
] + [
    ("linuxcnc", ProgramSetup(blend_tolerance_mm=0.002)),
    ("linuxcnc", ProgramSetup(blend_tolerance_mm=0.0)),
    ("fanuc", ProgramSetup(high_precision="g05.1")),
    ("fanuc", ProgramSetup(high_precision="g08", coolant="flood")),
    *((dialect, ProgramSetup(warm_up_s=60.0, slowest_rpm=4000)) for dialect in DIALECTS),
    *((dialect, ProgramSetup(work_offset=3)) for dialect, post in POSTS.items() if post.offsets),
]  # fmt: skip


def parts(
    dialect: str, setup: ProgramSetup, trace: tuple[Path, ...] = (), limits: PartLimits | None = None
) -> list[bytes]:
    frame = PassFrame(
        remarks=("pass tiny",), rpm=12000, plunge_mm_per_min=300, safe_z_mm=SAFE_Z, aperture_mm=(8, 6), setup=setup,
        trace=trace,
    )  # fmt: skip
    return [b"".join(text) for text in programs(WAY, POSTS[dialect], frame, limits)]


def program(dialect: str, setup: ProgramSetup, trace: tuple[Path, ...] = ()) -> bytes:
    (text,) = parts(dialect, setup, trace)
    return text


def moves_of(dialect: str, text: bytes) -> dict[str, np.ndarray]:
    batches = list(read_program([text], LANGUAGES[dialect]))
    assert batches[-1].ended
    names = ("start_mm", "end_mm", "is_rapid", "spindle_on", "pause_s", "feed_mm_per_min")
    return {name: np.concatenate([getattr(batch, name) for batch in batches]) for name in names}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_setup_that_asks_for_nothing_changes_no_byte(dialect: str) -> None:
    writer = create_writer(POSTS[dialect])
    pieces = [writer.start(("pass tiny",), rpm=12000, safe_z_mm=SAFE_Z, program=101)]
    pieces += [piece for path in WAY for piece in writer.write(path)]
    assert program(dialect, ProgramSetup()) == b"".join([*pieces, writer.end(safe_z_mm=SAFE_Z)])


@pytest.mark.parametrize(("dialect", "setup"), SETUPS)
def test_the_moves_are_the_same_with_and_without(dialect: str, setup: ProgramSetup) -> None:
    plain, wanted = (moves_of(dialect, program(dialect, one)) for one in (ProgramSetup(), setup))
    for name in ("end_mm", "is_rapid", "feed_mm_per_min", "spindle_on"):
        both = [moves[name][moves["pause_s"] < 0] for moves in (plain, wanted)]
        np.testing.assert_array_equal(*both)


@pytest.mark.parametrize(("dialect", "setup"), SETUPS)
def test_the_mill_s_pre_flight_takes_it(dialect: str, setup: ProgramSetup, tmp_path) -> None:
    """GRBL's M7 with a warning, since the stock firmware is built without it; everything else with none."""
    profile = replace(load_profile("grbl"), dialect=dialect, spindle_rpm=(4000.0, 15000.0))
    profile = replace(profile, work_offset=setup.work_offset)
    text = program(dialect, setup, TRACE)
    (file := tmp_path / "p.nc").write_bytes(text)
    found = examine(file, limits_of(profile), lambda share: None)
    told = [words for words in found.warnings if "M7" in words]
    assert bool(told) == (dialect == "grbl" and setup.coolant == "mist")
    own = [words for words in found.warnings if "no sequence numbers" in words]
    if dialect != "rml-1":
        assert list(found.bounds_by_frame) == [f"G{53 + setup.work_offset}"]  # so that it is held against the work zero
    assert sorted(found.warnings) == sorted([*told, *own])
    assert found.ends


@pytest.mark.parametrize(("dialect", "setup"), [row for row in SETUPS if row[1].coolant != "none"])
def test_coolant_runs_in_every_cut_and_is_off_before_the_end_of_the_program(dialect: str, setup: ProgramSetup) -> None:
    """As a control's modal state has it, block by block, and so also after M2, which is not what switches it off."""
    word = POSTS[dialect].coolant[setup.coolant]
    mill = Interpreter(dialect=dialect)
    for line in program(dialect, setup).splitlines():
        if line.startswith((b"M2", b"M30")):
            assert mill.state.coolant == "M9"
        step = mill.take(line)
        if step.kind == "feed":
            assert mill.state.coolant == word
    assert mill.state.coolant == "M9" and mill.state.spindle == "M5"


@pytest.mark.parametrize("dialect", [dialect for dialect, post in POSTS.items() if post.offsets])
def test_a_program_works_in_the_one_offset_asked_for(dialect: str) -> None:
    """Whoever changes it on the way, or between two parts, is refused: all that follows would be cut elsewhere."""
    first, second = (program(dialect, ProgramSetup(work_offset=number)) for number in (2, 3))
    word = b"G15H%d" if dialect == "okuma" else b"G%d"
    numbers = (2, 3) if dialect == "okuma" else (55, 56)
    assert word % numbers[0] in first and word % numbers[1] in second
    language = LANGUAGES[dialect]
    for texts in ([first, first], [second]):
        assert list(read_parts(([text] for text in texts), language))[-1].ended
    down = re.search(rb"G0?1[XYZ]", first)
    assert down is not None
    changed = first[: down.start()] + word % numbers[1] + b"\n" + first[down.start() :]
    for texts in ([first, second], [changed]):
        with pytest.raises(ProgramError, match="one work offset"):
            list(read_parts(([text] for text in texts), language))


def test_small_letters_stand_in_no_comment_of_a_control_that_does_not_take_them() -> None:
    for dialect in DIALECTS:
        text = program(dialect, ProgramSetup(), TRACE)
        assert bool(re.search(rb"[a-z]", text)) == (dialect in ("grbl", "grblhal", "fluidnc", "linuxcnc")), dialect
        assert b"tiny" in text.lower() or dialect == "rml-1"


def test_corners_are_blended_within_the_tolerance_or_stopped_at_exactly() -> None:
    words = {None: b"G64P0.001Q0\n", 0.002: b"G64P0.002Q0\n", 0.0: b"G61.1\n"}
    for tolerance_mm, word in words.items():
        assert word in program("linuxcnc", ProgramSetup(blend_tolerance_mm=tolerance_mm))


@pytest.mark.parametrize(("mode", "on", "off"), [("g05.1", b"G05.1Q1", b"G05.1Q0"), ("g08", b"G08P1", b"G08P0")])
def test_a_high_precision_mode_holds_for_all_moves_and_no_longer(mode, on: bytes, off: bytes) -> None:
    lines = program("fanuc", ProgramSetup(high_precision=mode)).splitlines()
    moving = [k for k, line in enumerate(lines) if re.search(rb"X|Y", line) and not line.startswith((b"(", b"G4"))]
    assert lines.index(on) < min(moving) and max(moving) < lines.index(off) < lines.index(b"M30")


def test_the_spindle_is_warmed_up_in_rising_steps_that_take_the_time_asked_for() -> None:
    for dialect in DIALECTS:
        text = program(dialect, ProgramSetup(warm_up_s=60.0, slowest_rpm=4000)).decode()
        speeds = [float(speed) for speed in re.findall(r"(?:(?<![A-Z])S|!RC|M3S)(\d+)", text)]
        assert speeds == [4000, 6000, 9000, 12000], dialect
        assert moves_of(dialect, text.encode())["pause_s"].clip(0).sum() == pytest.approx(60.0)


@given(st.floats(1, 60000), st.floats(0, 3600), st.floats(0, 60000))
def test_no_step_is_slower_than_the_spindle_can_or_faster_than_the_cut(rpm, warm_up_s, slowest_rpm) -> None:
    setup = ProgramSetup(warm_up_s=warm_up_s, slowest_rpm=slowest_rpm)
    speeds, dwells = zip(*setup.spindle_steps(rpm, dwell_s=4.0), strict=True)
    assert list(speeds) == sorted(set(speeds)) and speeds[-1] == rpm
    assert min(speeds) >= min(rpm, slowest_rpm)
    assert min(dwells) >= 4.0 and sum(dwells) >= warm_up_s - 1e-9


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_trace_goes_around_block_and_lens_at_the_safe_height_before_the_spindle_turns(dialect: str) -> None:
    """But where a control faults on a feed without the spindle: there it turns."""
    moves = moves_of(dialect, program(dialect, ProgramSetup(warm_up_s=20.0), TRACE))
    first_down = int(np.argmax(moves["end_mm"][:, 2] < SAFE_Z))
    traced = (moves["pause_s"] < 0) & (np.arange(len(moves["pause_s"])) < first_down)
    assert (moves["end_mm"][traced, 2] == SAFE_Z).all()
    at = moves["end_mm"][traced, :2]
    for corner in [(-2, -2), (10, -2), (10, 8), (-2, 8), (0, 0), (8, 0), (8, 6), (0, 6)]:
        assert (at == corner).all(axis=1).any(), corner
    fed = traced & ~moves["is_rapid"]
    assert (moves["feed_mm_per_min"][fed] <= 1200).all()
    assert moves["spindle_on"][fed].all() if dialect == "roland-nc" else not moves["spindle_on"][fed].any()
    cuts = ~moves["is_rapid"] & (moves["pause_s"] < 0) & (np.arange(len(moves["pause_s"])) >= first_down)
    assert moves["spindle_on"][cuts].all()


def test_only_the_first_program_of_a_split_pass_is_begun_with_warm_up_and_trace() -> None:
    setup = ProgramSetup(warm_up_s=60.0, coolant="flood")
    first, *others = parts("grbl", setup, TRACE, PartLimits(most_bytes=450))
    assert others
    assert (first.count(b"M3S"), first.count(b"M8\n"), first.count(b"M9\n")) == (4, 1, 1)
    for text in others:
        assert (text.count(b"M3S"), text.count(b"M8\n"), text.count(b"M9\n")) == (1, 1, 1)
        assert b"X-2" not in text
    assert list(read_parts([[first], *([text] for text in others)]))[-1].ended


def test_what_a_control_cannot_do_is_named_with_what_it_can() -> None:
    for dialect in DIALECTS:
        for coolant in ("air", "mist", "flood"):
            told = list(find_unsupported(dialect, ProgramSetup(coolant=coolant)))
            assert bool(told) != (coolant in POSTS[dialect].coolant)
            assert all(coolant in value and "'none'" in allowed for _, value, allowed in told)
        blends = not list(find_unsupported(dialect, ProgramSetup(blend_tolerance_mm=0.01)))
        precise = not list(find_unsupported(dialect, ProgramSetup(high_precision="g08")))
        offsets = not list(find_unsupported(dialect, ProgramSetup(work_offset=2)))
        assert (blends, precise, offsets) == (dialect == "linuxcnc", dialect == "fanuc", dialect != "rml-1")


REFUSED = [
    ("roland-nc", b"M03", b"M08\r\nM03"),
    ("grbl", b"M3", b"G64P0.1\nM3"),
    ("grbl", b"M3", b"G5.1Q1\nM3"),
    ("linuxcnc", b"M3", b"G5.1Q1\nM3"),
    ("linuxcnc", b"M3", b"G8P1\nM3"),
    ("fanuc", b"M3", b"G64\nM3"),
    ("fanuc", b"M3", b"M3G5.1Q1"),
    ("fanuc", b"G4", b"G5.1Q2\nG4"),
    ("fanuc", b"G4", b"G5.1P1\nG4"),
    ("fanuc", b"G4", b"G8Q1\nG4"),
    ("okuma", b"G15H1", b"G15H1\r\nG8P1"),
]


@pytest.mark.parametrize(("dialect", "old", "new"), REFUSED)
def test_words_of_another_control_are_refused_when_read_back(dialect: str, old: bytes, new: bytes) -> None:
    text = program(dialect, ProgramSetup())
    assert old in text
    with pytest.raises(ProgramError):
        list(read_program([text.replace(old, new, 1)], LANGUAGES[dialect]))
