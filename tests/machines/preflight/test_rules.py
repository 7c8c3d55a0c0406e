"""The one table of machine rules: what our posts write keeps them all; each planted fault is named, in every dialect,
by pre-flight and by `check`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cam.moves import Path as ToolPath
from cam.moves import cut, rapid
from cam.parts import PassFrame, programs
from cam.posts.dialects import POSTS
from cam.posts.post import ProgramSetup
from machines.errors import ProgramRefusedError
from machines.preflight.preflight import MillLimits, limits_of
from machines.preflight.rules import RULES
from machines.profile import load_profile
from optics.heightfield import Heightfield
from service.job.arrays import heightfield_bytes
from service.job.checking import CheckSettings, check_programs
from service.job.spec.loading import resolve_job
from service.job.spec.resolve import cam_passes_of, cam_stock_of
from service.job.stages.programs import first_stock
from service.milling.preflight_child import examine
from service.progress import report_progress
from tests.cam.programs import generate_program

DIALECTS = sorted(POSTS)
SAFE_Z, TOP_Z, RPM = 5.0, -1.0, 12_000.0
WAY = [rapid((0, 0, SAFE_Z), (0, 0, 1)), cut([(0, 0, -0.5), (4, 0, -0.5), (4, 3, -1)], 600), rapid((4, 3, SAFE_Z))]
TOPS = (None, TOP_Z)


def limits(dialect: str, *, top_z_mm: float | None = None, work_offset: int = 1) -> MillLimits:
    profile = replace(load_profile("grbl", ()), dialect=dialect, spindle_rpm=(4500.0, 15_000.0), safe_z_mm=SAFE_Z)
    return limits_of(replace(profile, top_z_mm=top_z_mm, homing=top_z_mm is not None, work_offset=work_offset))


def program(dialect: str, setup: ProgramSetup, way: list[ToolPath]) -> bytes:
    frame = PassFrame(
        remarks=("pass tiny",), rpm=RPM, plunge_mm_per_min=300, safe_z_mm=SAFE_Z, aperture_mm=(8, 6), setup=setup
    )
    return b"".join(piece for text in programs(way, POSTS[dialect], frame, None) for piece in text)


def good(dialect: str, top_z_mm: float | None) -> bytes:
    return program(dialect, ProgramSetup(top_z_mm=top_z_mm), WAY)


def named(file: Path, text: bytes, held_against: MillLimits) -> tuple[set[str], str]:
    """The codes of the faults that pre-flight finds, or the words of a refusal."""
    file.write_bytes(text)
    try:
        found = examine(file, held_against, lambda share: None)
    except ProgramRefusedError as error:
        return set(), str(error)
    return {one.code for one in found.findings if one.is_fault}, " ".join(found.faults)


POINT = st.tuples(st.floats(0, 100), st.floats(0, 100), st.floats(-20, 4))


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    dialect=st.sampled_from(DIALECTS),
    top_z_mm=st.sampled_from(TOPS),
    work_offset=st.integers(1, 6),
    warm_up_s=st.sampled_from([0.0, 60.0, 3600.0]),
    points=st.lists(POINT, min_size=1, max_size=20),
    feed=st.floats(30, 2900),
)
def test_what_our_posts_write_keeps_every_rule(
    tmp_path: Path,
    dialect: str,
    top_z_mm: float | None,
    work_offset: int,
    warm_up_s: float,
    points: list[tuple[float, float, float]],
    feed: float,
) -> None:
    offset = work_offset if POSTS[dialect].offsets else 1
    setup = ProgramSetup(top_z_mm=top_z_mm, work_offset=offset, warm_up_s=warm_up_s, slowest_rpm=4500)
    first, last = ((*point[:2], SAFE_Z) for point in (points[0], points[-1]))
    text = program(dialect, setup, [rapid(first), cut(points, feed), rapid(last)])
    held = limits(dialect, top_z_mm=top_z_mm, work_offset=offset)
    assert named(tmp_path / "p.nc", text, held) == (set(), "")


def _lines(change: Callable[[list[bytes]], list[bytes]]) -> Callable[[bytes], bytes]:
    return lambda text: b"".join(change(text.splitlines(keepends=True)))


def _words(pattern: bytes, new: bytes, count: int = 0) -> Callable[[bytes], bytes]:
    return lambda text: re.sub(pattern, new, text, count=count)


_LIFT = re.compile(rb"(N\d+)?(G53|G16H0)?G0?0?Z-?[\d.]+\s*$|\^PR;Z0,0,10500;|Z\d+,\d+,500;")


def _without_first_lift(lines: list[bytes]) -> list[bytes]:
    at = next(k for k, line in enumerate(lines) if _LIFT.match(line))
    return lines[:at] + lines[at + 1 :]


def _without_last_lifts(lines: list[bytes]) -> list[bytes]:
    cuts = [k for k, line in enumerate(lines) if re.match(rb"(N\d+)?(G0?1(?!\d)|X|Y).*Z-|Z\d+,\d+,-", line)]
    return lines[: cuts[-1] + 1] + [line for line in lines[cuts[-1] + 1 :] if not _LIFT.match(line)]


GCODE = [dialect for dialect in DIALECTS if dialect != "rml-1"]
FAULTS: dict[str, tuple[Callable[[bytes], bytes], str, list[str]]] = {
    "no way up first": (_lines(_without_first_lift), "way-in", DIALECTS),
    "no way up at the end": (_lines(_without_last_lifts), "way-out", DIALECTS),
    "another offset": (_words(rb"G54|G15H1", rb"G55"), "offset", [d for d in GCODE if d != "okuma"]),
    "another offset of an OSP": (_words(rb"G15H1", rb"G15H2"), "offset", ["okuma"]),
    "F90000": (_words(rb"F600(\.0)?", rb"F90000.0"), "feed", GCODE),
    "V90": (_words(rb"V10\.0", rb"V90.0"), "90.0 is outside 0.1..50", ["rml-1"]),
    "S90000": (_words(rb"(?<=S)12000", rb"90000"), "spindle-fast", [d for d in GCODE if d != "roland-nc"]),
    "S100": (_words(rb"(?<=S)12000", rb"100"), "spindle-slow", [d for d in GCODE if d != "roland-nc"]),
    "S of a control that faults": (_words(rb"(?<=S)12000", rb"90000"), "takes 4500 to 15000 rpm", ["roland-nc"]),
    "!RC90000": (_words(rb"!RC12000", rb"!RC90000"), "outside the spindle's", ["rml-1"]),
    "S0": (_words(rb"(?<=S)12000", rb"0"), "spindle-off", [d for d in GCODE if d != "roland-nc"]),
    "no G21": (_words(rb"G21", rb"", 1), "units", GCODE),
    "no G90": (_words(rb"G90", rb"", 1), "distance", GCODE),
    "G91": (
        _words(rb"G90", rb"G91", 1),
        "blind-relative",
        ["grbl", "grblhal", "fluidnc", "linuxcnc", "okuma", "fanuc"],
    ),
    "no spindle": (_words(rb"M0?3", rb"", 1), "spindle-off", [d for d in GCODE if d != "roland-nc"]),
    "no spindle where it faults": (_words(rb"M03", rb"", 1), "needs S and M03", ["roland-nc"]),
    "no !MC1": (_words(rb"!MC1;", rb""), "with the spindle off", ["rml-1"]),
    "spindle left on": (_words(rb"!MC0;(?=\s+\^DF;\s*$)|\^DF;\s*$", rb""), "spindle-left-on", ["rml-1"]),
    "no end": (_words(rb"(N\d+)?M(0?2|30)\s+", rb""), "end", GCODE),
    "G92": (_words(rb"(?=G0?0X|G0X)", rb"G92X1.0\n", 1), "frame", ["grbl", "grblhal", "fluidnc", "linuxcnc", "fanuc"]),
    "too wide": (_words(rb"X4(\.0)?(?=\D)", rb"X4000.0"), "travels 300 mm", GCODE),
    "too wide in RML": (_words(rb"Z400,", rb"Z400000,"), "travel of grbl is 300", ["rml-1"]),
    "a byte order mark": (lambda text: b"\xef\xbb\xbf" + text, "byte order mark", DIALECTS),
    "UTF-16": (lambda text: text.decode().encode("utf-16"), "UTF-16", DIALECTS),
    "CR alone": (lambda text: text.replace(b"\r\n", b"\n").replace(b"\n", b"\r"), "CR alone", GCODE),
}
PLANTED = [(name, dialect) for name, (_, _, dialects) in FAULTS.items() for dialect in dialects]
CODES = {rule.code for rule in RULES}


@pytest.mark.parametrize("top_z_mm", TOPS)
@pytest.mark.parametrize(("name", "dialect"), PLANTED)
def test_pre_flight_names_each_planted_fault(tmp_path: Path, name: str, dialect: str, top_z_mm: float | None) -> None:
    plant, told, _ = FAULTS[name]
    before = good(dialect, top_z_mm)
    text = plant(before)
    assert text != before
    codes, words = named(tmp_path / "p.nc", text, limits(dialect, top_z_mm=top_z_mm))
    assert told in codes if told in CODES else told in words, (codes, words)


@dataclass(frozen=True)
class Written:
    """A pass over a small lens, written for a mill of the dialect, and what `check` must be told of it."""

    folder: Path
    text: bytes
    settings: CheckSettings

    def faults(self, text: bytes) -> str:
        program, lens = self.folder / "pass.nc", self.folder / "heightfield.npz"
        program.write_bytes(text)
        with report_progress(True) as reporter:
            (verdict,) = check_programs([program], lens, self.settings, reporter=reporter)
        assert verdict.ok is not bool(verdict.faults)
        return " ".join(verdict.faults)


@pytest.fixture(scope="module")
def write(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Written]]:
    with pytest.MonkeyPatch.context() as patch:
        top = tmp_path_factory.mktemp("config")
        patch.setenv("CAUSTICMILL_CONFIG_DIR", str(top))
        (top / "machines").mkdir()

        @cache
        def written(dialect: str) -> Written:
            mill = f'extends = "grbl"\ndialect = "{dialect}"\nspindle_rpm = [4500, 15000]\n'
            (top / "machines" / f"mill-{dialect}.toml").write_text(mill)
            folder = tmp_path_factory.mktemp(dialect)
            x, y = np.linspace(0, 4, 41), np.linspace(0, 3, 31)
            lens = Heightfield(z_mm=-0.3 - 0.01 * np.add.outer(y, x), x_mm=x, y_mm=y)
            (folder / "heightfield.npz").write_bytes(heightfield_bytes(lens))
            job = resolve_job(
                base={
                    "optics": {"width_mm": 4.0, "height_mm": 3.0},
                    "stock": {"thickness_mm": 10.0, "margin_mm": 2.0},
                    "machine": {"profile": f"mill-{dialect}"},
                    "passes": [{"radius_mm": 1.0, "pitch_mm": 0.5, "spindle_rpm": 12000.0, "feed_mm_per_min": 600.0}],
                }
            )
            (spec,), stock = cam_passes_of(job.spec), cam_stock_of(job.spec)
            pieces = generate_program(lens, spec, stock, stock_top=first_stock(stock), post=POSTS[dialect])
            settings = CheckSettings(
                radius_mm=(1.0,),
                pitch_mm=(0.5,),
                stock_to_leave_mm=(),
                step_down_mm=(),
                thickness_mm=10.0,
                margin_mm=2.0,
                machine=f"mill-{dialect}",
            )
            made = Written(folder, b"".join(pieces), settings)
            assert made.faults(made.text) == ""
            return made

        yield written


CHECKED = [
    pytest.param(name, dialect, marks=() if dialect in ("grbl", "rml-1") else pytest.mark.thorough)
    for name, dialect in PLANTED
    if not name.startswith("too wide")  # which moves of X4 it has, the pass decides
]


@pytest.mark.parametrize(("name", "dialect"), CHECKED)
def test_the_check_command_names_each_planted_fault(
    write: Callable[[str], Written], tmp_path: Path, name: str, dialect: str
) -> None:
    plant, told, _ = FAULTS[name]
    written = write(dialect)
    text = plant(written.text)
    assert text != written.text
    words = written.faults(text)
    if told not in CODES:
        assert told in words
        return
    (file := tmp_path / "p.nc").write_bytes(text)
    profile = load_profile(f"mill-{dialect}")
    found = [one for one in examine(file, limits_of(profile), lambda share: None).findings if one.code == told]
    assert found and found[0].words in words


HEAD = "G21 G90\n"
CASES = {  # text: codes that are among the findings, and that are not
    HEAD + "G0 Z5\nM3\nG1 X9 F100\nM30\n": ({"spindle-off", "blind-cut"}, {"motion", "way-in", "way-out", "link"}),
    HEAD + "G0 Z5\nM3 S8000\nG4 P3000\nG1 X9 F100\nM30\n": ({"pause", "blind-cut"}, {"motion", "spindle-off"}),
    HEAD + "G0 X0\nM2\n": ({"way-in"}, {"motion"}),
    HEAD + "G91 G0 Z1\nM2\n": ({"blind-relative"}, {"motion"}),
    HEAD + "G28\nM2\n": ({"home"}, {"motion"}),
    HEAD + "G91 G28 Z0\nG90 G0 X0 Y0\nG0 Z5\nM2\n": ({"home"}, {"motion", "way-in", "way-out"}),
    HEAD + "G53 G0 Z-60\nG0 X0 Y0\nG0 Z5\nM2\n": ({"way-in"}, {"motion"}),
    HEAD + "G53 G0 Z-1\nG0 X0 Y0\nG0 Z1\nG53 G0 Z-1\nM2\n": (set(), {"way-in", "way-out"}),
    HEAD + "M5\nM2\n": ({"motion"}, {"way-in", "way-out"}),
    "": ({"motion", "end"}, set()),
    "G21 G90 G55\nG0 Z5\nX0 Y0\nM2\n": ({"offset"}, {"units", "distance"}),
}


def test_the_spindle_of_a_dry_pass_is_off_and_all_other_rules_hold(tmp_path: Path) -> None:
    (file := tmp_path / "p.nc").write_text(HEAD + "G0 Z5\nX0 Y0\nG1 Z-1 F100\nX9\nG0 Z1\nM2\n")
    for dry_pass, codes in ((False, {"spindle-off", "way-out"}), (True, {"way-out"})):
        found = examine(file, replace(limits("grbl"), dry_pass=dry_pass), lambda share: None).findings
        assert {one.code for one in found} == codes


@pytest.mark.parametrize("text", CASES)
def test_what_is_said_of_programs_written_by_hand(tmp_path: Path, text: str) -> None:
    (file := tmp_path / "p.nc").write_text(text)
    codes = {one.code for one in examine(file, limits("grbl"), lambda share: None).findings}
    there, absent = CASES[text]
    assert there <= codes and not absent & codes, codes
