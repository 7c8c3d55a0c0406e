"""Every dialect: what is written is read back to half a digit, by our reader and by another, and a mill may run it."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.moves import Path as ToolPath
from cam.moves import cut, rapid
from cam.posts.dialects import POSTS
from cam.posts.post import ProgramSetup
from cam.posts.writers import create_writer
from cam.reading.gcode import LANGUAGES, ProgramError, read_parts
from machines.preflight.preflight import limits_of
from machines.profile import load_profile
from machines.roland.rml import check_rml
from service.milling.preflight_child import examine
from tests.cam.programs import read_program

GOLDEN = Path(__file__).parents[2] / "golden"
REWRITE = "CAUSTICMILL_REWRITE_GOLDEN"
DIALECTS = sorted(POSTS)
SAFE_Z = 5.0
TOPS = {"grbl": None, "okuma": 300.0}  # grbl: as a mill without homing has it
PROFILES = {"linuxcnc": "linuxcnc", "okuma": "okuma-osp", "roland-nc": "roland-mdx-40a", "rml-1": "roland-mdx-40a"}

POINT = st.tuples(st.floats(-90, 90), st.floats(-90, 90), st.floats(-40, 4))
TINY = [
    rapid((0, -0.5, SAFE_Z), (0, -0.5, 1)),
    cut([(0, -0.5, 0.1), (2.00004, -0.5, -0.004)], 250),
    cut([(2.5, -0.5, -0.123456), (2.5, 0, -0.15), (2.5, 0, -0.150001), (-1, 0, -1.99999)], 612.55),
    rapid((-1, 0, SAFE_Z)),
]


def program(dialect: str, paths: list[ToolPath], number: int = 7) -> bytes:
    writer, setup = create_writer(POSTS[dialect]), ProgramSetup(top_z_mm=TOPS.get(dialect, -1.0))
    pieces = [writer.start(("pass tiny: (ball)",), rpm=12000, safe_z_mm=SAFE_Z, program=number, setup=setup)]
    pieces += [piece for path in paths for piece in writer.write(path)]
    return b"".join([*pieces, writer.end(safe_z_mm=SAFE_Z, setup=setup)])


def read(dialect: str, *parts: bytes) -> dict[str, np.ndarray]:
    batches = list(read_parts(([part] for part in parts), LANGUAGES[dialect]))
    assert batches[-1].ended
    names = ("end_mm", "is_rapid", "feed_mm_per_min", "spindle_on", "pause_s", "line")
    return {name: np.concatenate([getattr(batch, name) for batch in batches]) for name in names}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_golden_program(dialect):
    file = GOLDEN / f"tiny-{dialect}{POSTS[dialect].suffix}"
    made = program(dialect, TINY)
    if os.environ.get(REWRITE):
        file.write_bytes(made)
    assert made == file.read_bytes()


@pytest.mark.parametrize("dialect", DIALECTS)
@settings(max_examples=25, deadline=None)
@given(st.lists(POINT, min_size=1, max_size=30), st.floats(30, 2900))
def test_a_path_is_read_back_to_half_a_digit(dialect, points, feed):
    """And its feed to what the language can say, never faster."""
    digits = POSTS[dialect].digits
    start = (*points[0][:2], SAFE_Z)
    moves = read(dialect, program(dialect, [rapid(start), cut(points, feed), rapid((*points[-1][:2], SAFE_Z))]))
    cuts = (moves["pause_s"] < 0) & ~moves["is_rapid"]
    wanted = _rounded(np.array([start, *points]), digits)
    stays = (np.diff(wanted, axis=0) == 0).all(axis=1)
    scale = np.array([digits.xy_mm, digits.xy_mm, digits.z_mm])
    np.testing.assert_allclose(moves["end_mm"][cuts], wanted[1:][~stays] * scale, atol=1e-9)
    assert (np.abs(wanted[1:] * scale - points) <= scale / 2 + 1e-9).all()
    assert moves["spindle_on"][cuts].all()
    told = moves["feed_mm_per_min"][cuts]
    assert (told <= feed + 1e-4).all() and (told > feed - 6.001).all()


def _rounded(points: np.ndarray, digits) -> np.ndarray:
    scale = np.array([digits.xy_mm, digits.xy_mm, digits.z_mm])
    return np.floor(points * np.round(1 / scale) + 0.5)


@pytest.mark.parametrize("dialect", [d for d in DIALECTS if d != "rml-1"])
def test_words_as_anybody_reads_them_say_the_same(dialect):
    """A reader of ten lines, which knows nothing but letters and numbers."""
    text = program(dialect, TINY).decode()
    at, places = {}, []
    for line in text.splitlines():
        words = dict(re.findall(r"([A-Z])(-?[\d.]+)", re.sub(r"\(.*?\)|^O.*", "", line)))
        if set(words) & set("XYZ") and float(words.get("G", 0)) != 4 and not re.match("G53|G16H0", line):
            at.update({axis: float(words[axis]) for axis in "XYZ" if axis in words})
            places.append(tuple(at.get(axis, np.nan) for axis in "XYZ"))
    places = [place for place in places if not np.isnan(place).any()]
    moves = read(dialect, text.encode())
    ends = moves["end_mm"][moves["pause_s"] < 0]
    np.testing.assert_array_equal(ends[-1], places[-1])
    assert {tuple(end) for end in ends} <= set(places)


def test_rml_as_the_mills_own_reader_reads_it():
    profile = replace(load_profile("roland-mdx-40a"), dialect="rml-1")
    facts = check_rml([program("rml-1", TINY)], profile)
    assert facts.bounds_mm == ((-1.0, -0.5, -2.0), (2.5, 0.0, 5.0))
    assert facts.spindle_rpm == (12000, 12000) and facts.ends


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_mill_may_run_it(dialect, tmp_path):
    file = tmp_path / f"tiny{POSTS[dialect].suffix}"
    file.write_bytes(program(dialect, TINY * 30))
    profile = replace(load_profile(PROFILES.get(dialect, "grbl")), dialect=dialect)
    profile = replace(profile, spindle_rpm=(4500.0, 15000.0), homing=True, safe_z_mm=SAFE_Z, top_z_mm=TOPS.get(dialect))
    found = examine(file, limits_of(profile), lambda share: None)
    assert found.ends and found.spindle_rpm == (12000, 12000)
    assert not found.warnings
    assert dialect == "rml-1" or list(found.bounds_by_frame) == ["G54", "machine"][: 1 + (dialect != "grbl")]


@pytest.mark.parametrize("dialect", [d for d in DIALECTS if d != "rml-1"])
def test_extents_are_those_of_a_program_that_begins_at_the_safe_height(dialect, tmp_path, monkeypatch):
    """A head raised in machine coordinates adds their one height, and hides nothing of the work's own box."""
    boxes = []
    for top_mm in (None, 7.5):
        monkeypatch.setitem(TOPS, dialect, top_mm)
        (file := tmp_path / "tiny.nc").write_bytes(program(dialect, TINY))
        profile = replace(load_profile(PROFILES.get(dialect, "grbl")), dialect=dialect)
        boxes.append(examine(file, limits_of(profile), lambda share: None))
    plain, raised = boxes
    own = raised.bounds_by_frame.pop("machine")
    assert (own.least_mm, own.most_mm) == ((None, None, 7.5), (None, None, 7.5))
    assert raised.bounds_by_frame == plain.bounds_by_frame and raised.bounds_mm == plain.bounds_mm


@pytest.mark.parametrize("dialect", DIALECTS)
def test_lines_are_short_and_plain_and_the_spindle_turns_before_the_first_cut(dialect):
    data = program(dialect, [*TINY, cut([(-1234.56789, -1234.56789, -123.456789)], 12345.678)])
    assert data.isascii() and max(map(len, data.split(b"\n"))) <= 79
    moves = read(dialect, data)
    assert moves["spindle_on"][~moves["is_rapid"] & (moves["pause_s"] < 0)].all()
    assert moves["pause_s"].max() == 4.0


def test_parts_are_one_pass_and_each_begins_anew():
    """The second program stands where the first has ended, and nothing but that is known of it."""
    for dialect in DIALECTS:
        first, second = program(dialect, TINY), program(dialect, [rapid((1, 1, SAFE_Z)), cut([(1, 1, -1)], 60)])
        moves = read(dialect, first, second)
        alone = read(dialect, first)
        between = len(alone["line"])
        assert moves["line"][between:].min() > first.count(b"\n")
        move = between + int(np.argmax(moves["is_rapid"][between:]))
        np.testing.assert_allclose(moves["end_mm"][move], [1, 1, SAFE_Z])
        bare = re.sub(rb"M0?3(?!\d)", b"", second).replace(b"!MC1", b"!MC0")
        assert not read(dialect, first, bare)["spindle_on"][between + 1 :].any()


REFUSED = {
    "linuxcnc": [("G64P0.1\n", "G64Q0.1P-\n", "number"), ("G64P0.001Q0\n", "G1X1Q2F1\n", "H belongs")],
    "fanuc": [
        ("X2.5Z-0.123", "X2Z-0.123", "least input"),
        ("X2.5Z-0.123", "X2.5Z-0.1234", "more decimals"),
        ("G4X4.0", "G4P4000", "(seconds)"),
        ("%\n", "", "must stand alone"),
        ("O0007\n", "O\n", "name"),
        ("M30\n%", "M30\nG0X1.0\n%", "nothing may follow"),
    ],
    "okuma": [
        ("G15H1", "G54", "not allowed"),
        ("F612.5", "F612", "least input"),
        ("G4F4.0", "G4P4", "(seconds)"),
        ("G15H1", "H1", "H belongs"),
        ("G15H1", "G15H7", "1 to 6"),
    ],
    "roland-nc": [("G01", "G1", "two digits"), ("Z1.0", "Z1", "least input"), ("M03", "M3", "two digits")],
    "rml-1": [
        ("!MC1;", "!MC1", "ends with ;"),
        ("!MC1;", "!MC2;", "other numbers"),
        ("!MC1;", "!ZO;", "not a command"),
        ("V50.0;", "V64.0;", "from 0.1 to 50"),
        ("V50.0;\r\n^PR", "V4.0;\r\n^PR", "position is not known"),
        ("Z200,-50,0;", "Z200,-50;", "other numbers"),
        ("Z200,-50,0;", "Z200,-50,0.5;", "other numbers"),
        ("^DF;\r\n\0", "^DF;\r\nZ0,0,0;\r\n\0", "nothing may follow"),
        ("^PR;Z0,0,10500", "^PR;Z10,0,10500", "straight up"),
    ],
}


@pytest.mark.parametrize(
    ("dialect", "old", "new", "words"), [(dialect, *row) for dialect, rows in REFUSED.items() for row in rows]
)
def test_what_a_control_reads_otherwise_is_refused(dialect, old, new, words):
    text = program(dialect, TINY).decode() + "\0"
    assert old in text or dialect == "linuxcnc"
    changed = text.replace(old, new, 1) if old in text else text.replace("G64P0.001Q0", new.strip())
    with pytest.raises(ProgramError, match=re.escape(words)):
        list(read_program([changed.rstrip("\0").encode()], LANGUAGES[dialect]))


def test_one_control_does_not_read_anothers_program():
    """Where a word would mean something else, or nothing, the reader says so; so does no post write it."""
    for writes, reads in [("grbl", "fanuc"), ("fanuc", "grbl"), ("grbl", "roland-nc"), ("rml-1", "grbl"),
                          ("grbl", "rml-1"), ("okuma", "fanuc"), ("fanuc", "okuma"), ("linuxcnc", "grbl")]:  # fmt: skip
        with pytest.raises(ProgramError):
            list(read_program([program(writes, TINY)], LANGUAGES[reads]))
