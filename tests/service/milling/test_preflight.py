"""Pre-flight as the streamer sees it: refusals, warnings, what is remembered and when it is not, the estimate."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from machines.errors import ProgramRefusedError
from machines.grbl.settings import ControllerSettings
from machines.preflight.preflight import Preflight, limits_of, placement_problems
from machines.profile import MachineProfile, load_profile
from service.milling import preflight as module
from service.milling.preflight import PreflightError, run_preflight
from service.milling.preflight_child import examine

GRBL = load_profile("grbl", [])
PROGRAM = (
    b"G21 G90 G94 G17 G54\nG0 Z5\nG0 X10 Y20\nM3 S10000\nG4 P2\nG1 Z-1 F300\nX110\nG2 X90 Y0 I-20 J0 F600\n"
    b"G0 Z5\nM5\nM2\n"
)


RML = b"V10;\n!RC15;!MC1;\nZ0,0,100;Z0,0,-100;\nW1000;\n!MC0;\n\x1a"
RML_MILL = replace(load_profile("roland-mdx-40a", []), dialect="rml-1")
STREAMER = """
import json, sys
from pathlib import Path
from machines.gcode.program import ProgramReader
from machines.profile import load_profile
from service.milling.preflight import run_preflight
path, shares = Path(sys.argv[1]), []
facts = run_preflight(path, load_profile("grbl", []), cache=Path(sys.argv[2]), on_progress=shares.append)
lines = len(list(ProgramReader(path, facts.index).lines()))
heavy = sorted({"numpy", "numba", "scipy"} & set(sys.modules))
print(json.dumps({"facts": facts.to_json(), "shares": shares, "lines": lines, "heavy": heavy}))
"""


@dataclass(frozen=True, slots=True)
class Read:
    """What a process like the streamer's found in PROGRAM, and where it is kept."""

    program: Path
    cache: Path
    told: dict[str, Any]

    @property
    def facts(self) -> Preflight:
        return Preflight.from_json(self.told["facts"])


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> Read:
    """Each child that reads a program loads its kernels for seconds: one for all tests."""
    folder = tmp_path_factory.mktemp("read")
    program, cache = folder / "p.nc", folder / "cache"
    program.write_bytes(PROGRAM)
    done = subprocess.run(
        [sys.executable, "-c", STREAMER, program, cache],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    )
    return Read(program, cache, json.loads(done.stdout))


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def no_child(*_: object, **__: object) -> None:
    raise AssertionError("the child was started although the result is kept")


def examine_here(path: Path, profile: MachineProfile = GRBL) -> Preflight:
    """As the child does it."""
    return examine(path, limits_of(profile), lambda share: None)


def test_what_is_found_and_that_it_survives_as_json(read: Read) -> None:
    facts, shares = read.facts, read.told["shares"]
    assert facts.lines == 11 and facts.blocks == 11 and facts.bytes == len(PROGRAM)
    assert facts.bounds_mm is not None
    # the arc about (90, 20) from (110, 20) clockwise to (90, 0): a quarter turn
    assert facts.bounds_mm.least_mm == pytest.approx((10, 0, -1))
    assert facts.bounds_mm.most_mm == pytest.approx((110, 20, 5), abs=0.01)
    assert facts.feeds_mm_per_min == (300, 600)
    assert facts.spindle_rpm == (10000, 10000)
    assert facts.path_length_mm == pytest.approx(6 + 100 + 10 * 3.141592 + 6, rel=1e-3)
    assert facts.ends and not facts.assumed and not facts.warnings
    cutting_s = 60 * (6 / 300 + 100 / 300 + 31.42 / 600)
    assert cutting_s + 2 < facts.time_s < cutting_s + 2 + 3  # dwell, ramps and two short rapids
    assert shares[-1] == 1.0
    assert Preflight.from_json(facts.to_json()) == facts


def test_a_result_is_kept_by_content_and_by_the_machine(
    read: Read, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    facts = read.facts
    other = replace(GRBL, acceleration_mm_per_s2=(50.0, 50.0, 50.0))
    assert examine_here(read.program, other).time_s > facts.time_s
    monkeypatch.setattr(module, "Child", no_child)
    with pytest.raises(AssertionError, match="child was started"):
        run_preflight(read.program, other, cache=read.cache)
    assert run_preflight(read.program, GRBL, cache=read.cache) == facts
    copy = tmp_path / "copy.nc"
    copy.write_bytes(PROGRAM)
    assert run_preflight(copy, GRBL, cache=read.cache) == facts  # known by its content
    copy.write_bytes(PROGRAM.replace(b"X110", b"X111"))
    with pytest.raises(AssertionError, match="child was started"):
        run_preflight(copy, GRBL, cache=read.cache)


def test_the_controllers_own_figures_take_the_place_of_the_profiles() -> None:
    values = {110: "800", 111: "800", 112: "500", 120: "30", 121: "30", 122: "20", 11: "0.02", 30: "12000", 31: "100"}
    limits = limits_of(GRBL, ControllerSettings(values=values, planner_blocks=100))
    assert limits.max_rate_mm_per_min == (800, 800, 500)
    assert limits.acceleration_mm_per_s2 == (30, 30, 20)
    assert limits.junction_deviation_mm == 0.02
    assert limits.spindle_rpm == (100, 12000)
    assert limits.planner_blocks == 100
    assert limits.travel_mm == GRBL.travel_mm  # not told
    assert limits_of(GRBL).bytes_per_s == 11520


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (b"G21G90\nG0 X1\nT1M6\n", 3, "'T1M6': GRBL has no tool changes"),
        (b"G21G90\nG0 X0 Y0 Z5\nG0 X301\n", 0, "301.000 mm; grbl travels 300 mm"),
        (b"G21G90\nG0 X0 Y0 Z5\nG1 X5\n", 3, "needs a feed"),
        (b"\xff\x01junk", 1, "letter"),
        (b"x" * 70_000, 1, "characters"),
        (bytes(range(1, 256)).replace(b"\r", b""), 1, "letter"),
        (b"\xef\xbb\xbfG21G90\n", 1, "byte order mark"),
        ("G21G90\n".encode("utf-16"), 1, "UTF-16"),
        ("G21G90\n".encode("utf-16-be"), 1, "UTF-16"),
        (b"G21G90\rG0 Z5\rM2\r", 1, "CR alone"),
        (b"G21G90\r\nG0 Z5 (up)\rX5\r\nM2\r\n", 2, "CR alone"),
        (b"$O100%\nG15 H1\n", 1, "settings are commands"),
        (b"^IN;!MC1;\n", 1, "letter"),
    ],
)
def test_refusals(tmp_path: Path, text: bytes, line: int, words: str) -> None:
    path = tmp_path / "p.nc"
    path.write_bytes(text)
    with pytest.raises(ProgramRefusedError, match=words) as caught:
        examine_here(path)
    assert caught.value.line == line
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_warnings_and_assumptions(tmp_path: Path) -> None:
    path = tmp_path / "p.nc"
    path.write_bytes(b"G0 X1 Y1\nZ5\nG1 Z-1 F9000\nM3 S40000\nG53 G0 Z-1\nG28\n")
    facts = examine_here(path)
    assert facts.assumed == ("G21", "G90") and not facts.ends
    text = "\n".join(facts.warnings)
    for words in (
        "line 1 ",
        "spindle off",
        "line 3: asks for a higher feed",
        "40000 rpm",
        "G53",
        "line 6: goes to a place",
        "no end",
    ):
        assert words.strip() in text, words


def test_a_link_that_starves_the_mill_is_told_with_figures(tmp_path: Path) -> None:
    """Vertices 0.0777 mm apart at F800 come to 172 lines a second; 35 of them carry F173."""
    moves = "".join(f"X{0.0777 * k:.3f}Z-{1 + 0.001 * (k % 2):.3f}\r\n" for k in range(1, 5000))
    begin = "%\r\nO0001\r\nN1 G21G90G94G17\r\nG15H1\r\nG0Z10.0\r\nX0.Y0.\r\nS5000M3\r\nG1Z-1.F800.\r\n"
    file, okuma = tmp_path / "p.min", load_profile("okuma-osp", [])
    file.write_text(f"{begin}{moves}G0Z10.0\r\nM5\r\nM2\r\n%\r\n")
    (told,) = examine_here(file, okuma).warnings
    assert "F800, but 35 lines and 873 bytes a second carry F17" in told
    assert not examine_here(file, replace(okuma, lines_per_s=1000.0, link=GRBL.link)).warnings


def test_no_such_program_and_a_folder_are_one_line(tmp_path: Path, cache: Path) -> None:
    for path in (tmp_path / "none.nc", tmp_path):
        with pytest.raises(PreflightError) as caught:
            run_preflight(path, GRBL, cache=cache)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_child_that_dies_is_told(read: Read, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/bin/false")
    with pytest.raises(PreflightError, match=r"ended early \(code 1\)"):
        run_preflight(read.program, GRBL, cache=cache)


def test_the_placement_at_the_present_offsets(read: Read) -> None:
    """Machine coordinates run from -travel to 0 unless the firmware forces its origin."""
    facts = read.facts
    values = {20: "1", 22: "1", 130: "300", 131: "300", 132: "80"}
    right = ControllerSettings(values=values, offsets={"G54": (-290.0, -290.0, -40.0), "G92": (0.0, 0.0, 0.0)})
    assert placement_problems(facts, right) == ()
    high = replace(right, offsets={"G54": (-290.0, -290.0, -4.0), "TLO": (0.0, 0.0, 0.0)})
    (problem,) = placement_problems(facts, high)
    assert problem.startswith("Z would go from -5.000 to 1.000 mm in machine coordinates (G54)")
    (warning,) = run_preflight(read.program, GRBL, settings=high, cache=read.cache).warnings
    assert warning == f"at the present work zero {problem}"
    assert run_preflight(read.program, GRBL, settings=right, cache=read.cache).warnings == ()
    far = replace(right, offsets={"G54": (-305.0, -290.0, -44.0), "G92": (-10.0, 0.0, 0.0), "TLO": (0.0, 0.0, 2.0)})
    (problem,) = placement_problems(facts, far)
    assert problem.startswith("X would go from -305.000")
    assert placement_problems(facts, ControllerSettings(values={22: "0", 20: "0"})) == ()


def test_the_streaming_process_gets_neither_numpy_nor_numba(read: Read) -> None:
    """What a streamer imports, and a whole pre-flight and read in it, stay without the array libraries."""
    assert (read.told["lines"], read.told["heavy"]) == (11, [])


def test_an_index_in_json_has_only_what_differs(read: Read) -> None:
    assert json.loads(read.told["facts"])["index"]["entries"][0][3] == {}


def test_the_planner_looks_ahead_as_far_in_cam_as_in_preflight() -> None:
    """GRBL 1.1 has 16 slots, one always free: `$I` and the profile say 15, the model of the planner wants 16."""
    from cam.duration import DurationModel, Kinematics

    assert GRBL.planner_blocks == limits_of(GRBL).planner_blocks == 15
    assert Kinematics.of(GRBL).planner_blocks == 16
    assert DurationModel(Kinematics.of(GRBL))._window == 15


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (b"V10;\n!MC1;\nZ0,0,\n-5;\n", 3, "goes on in the next line"),
        (b"V10;\n!MC1;Z0,0,0;\nG01 X5;\n", 3, 'dialect = "roland-nc"'),
        (b"V10;\n!MC1;Z0,0,0;\n" + b"Z1,1,1;" * 90 + b"\n", 3, "put a line end"),
        (b"V10;\n!MC1;Z0,0,0;\nZ40000,0,0;", 3, "travel of roland-mdx-40a is 305"),
        (b"V10;\n!MC1;Z0,0,0;\nZ4\x000,0,0;", 3, "is not a number"),
        (b"V10;\n!MC1;Z0,0,0;\nZ1,1", 3, "cut off"),
        (b"", 0, "no RML-1 command"),
    ],
)
def test_an_rml_program_is_refused_by_line_text_and_reason(tmp_path: Path, text: bytes, line: int, words: str) -> None:
    path = tmp_path / "p.rml"
    path.write_bytes(text)
    with pytest.raises(ProgramRefusedError, match=words) as caught:
        examine_here(path, RML_MILL)
    assert caught.value.line == line and str(caught.value).isprintable()


def test_what_the_child_refuses_is_told_and_not_kept(tmp_path: Path, cache: Path) -> None:
    path = tmp_path / "p.rml"
    path.write_bytes(RML.replace(b"Z0,0,-100", b"Z40000,0,0"))
    with pytest.raises(ProgramRefusedError) as by_child:
        run_preflight(path, RML_MILL, cache=cache)
    with pytest.raises(ProgramRefusedError) as here:
        examine_here(path, RML_MILL)
    assert (by_child.value.line, str(by_child.value)) == (3, str(here.value))
    assert [file.name for file in cache.iterdir() if not file.name.startswith("quick")] == []


def test_an_rml_program_is_remembered_too_and_read_anew_where_that_is_damaged(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "p.rml"
    path.write_bytes(RML)
    facts = run_preflight(path, RML_MILL, cache=cache)
    assert (facts.lines, facts.blocks, facts.spindle_rpm) == (6, 5, (15000, 15000))
    assert facts.time_s == pytest.approx(2.0 / 10 + 1.0)
    for kept in cache.glob("*.json"):
        kept.write_text(kept.read_text()[:-40])
    assert run_preflight(path, RML_MILL, cache=cache) == facts
    monkeypatch.setattr(module, "Child", no_child)
    assert run_preflight(path, RML_MILL, cache=cache) == facts
