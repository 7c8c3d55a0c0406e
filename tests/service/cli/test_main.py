"""The command line: every bad input is one line on stderr and an exit code, with nothing left on disk.

The commands run in this process (service.cli.main.run is all that the installed command calls).
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import signal
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from service.cli.main import run
from service.job.spec.loading import resolve_spec

SMALL = [
    part
    for value in ("image.pixels=32", "optics.width_mm=10", "optics.height_mm=10", "optics.throw_mm=20")
    for part in ("--set", value)
]


def save_ramp(folder: Path) -> Path:
    ramp = np.linspace(60, 255, 64).astype(np.uint8)
    path = folder / "in" / "ramp.png"
    path.parent.mkdir()
    Image.fromarray(np.add.outer(ramp // 2, ramp // 2).astype(np.uint8)).save(path)
    return path


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    return save_ramp(tmp_path)


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a design, to be copied, and what the command printed."""
    folder, told = tmp_path_factory.mktemp("designed"), io.StringIO()
    with contextlib.redirect_stdout(told):
        assert run(["design", str(save_ramp(folder)), "-o", str(folder / "out"), *SMALL]) == 0
    return folder / "out", told.getvalue()


def refused(capsys: pytest.CaptureFixture[str], code: int, arguments: list[str], *words: str) -> None:
    """The command ends with `code` and one line on stderr that holds all words."""
    capsys.readouterr()
    assert run([str(a) for a in arguments]) == code
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    assert all(word in lines[0] for word in words), lines[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--set", "optics.widht_mm=3"], ["optics.widht_mm", "width_mm"]),
        (["--set", "optics.width_mm=wide"], ["optics.width_mm", "'wide'", "2000"]),
        (["--set", "passes.1.pitch_mm=0"], ["passes.1.pitch_mm", "0", "0.002"]),
        (["--set", "nonsense"], ["--set", "key=value"]),
        (["--preset", "best"], ["preset", "'best'", "'paper', 'draft', 'recommended'"]),
        (["--preset", "recommended", "--set", "passes.0.pitch_mm=1"], ["passes.0", "no such pass", "is empty"]),
        (["--spec", "/nowhere/job.toml"], ["/nowhere/job.toml", "no such file"]),
        (["--bogus"], ["--bogus"]),
        (["--set", "machine.profile=haas"], ["machine.profile", "'haas'", "'grbl'"]),
    ],
)
@pytest.mark.parametrize("command", ["make", "design"])
def test_bad_options_are_input_errors(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    picture: Path,
    command: str,
    options: list[str],
    words: list[str],
) -> None:
    refused(capsys, 2, [command, str(picture), "-o", str(tmp_path / "out"), *options], *words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def png_header(width: int, height: int) -> bytes:
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in [(b"IHDR", head)]]
    return b"\x89PNG\r\n\x1a\n" + parts[0] + b"\0\0\1\0IDAT"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ["empty"]),
        (b"GIF89a garbage", ["a.png"]),
        (png_header(30_000, 30_000), ["900000000", "at most 100000000"]),
        (png_header(1, 1), ["1 x 1", "at least 8 x 8"]),
        (png_header(64, 64), ["damaged"]),
    ],
)
def test_bad_pictures_are_input_errors(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, content: bytes, words: list[str]
) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    refused(capsys, 2, ["make", str(path), "-o", str(tmp_path / "out"), *SMALL, "--quiet"], "a.png", *words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png"]


def test_an_all_black_picture_has_no_light_to_aim(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "black.png"
    Image.new("L", (64, 64)).save(path)
    refused(capsys, 2, ["make", str(path), "-o", str(tmp_path / "out"), *SMALL, "--quiet"], "no light to aim")


def test_a_missing_picture_and_a_folder(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = ["-o", str(tmp_path / "out"), "--quiet"]
    refused(capsys, 2, ["make", str(tmp_path / "none.png"), *out], "none.png", "no such file")
    refused(capsys, 2, ["make", str(tmp_path), *out], "folder")


def test_a_name_with_a_line_break_stays_on_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "two\nlines.png"
    refused(capsys, 2, ["make", str(path), "-o", str(tmp_path / "out"), "-q"], "two?lines.png", "no such file")
    path.write_text("x")
    refused(capsys, 2, ["make", str(path), "-o", str(tmp_path / "out"), "-q"], "two?lines.png", "not a picture")
    refused(capsys, 2, ["make", "--bo\ngus"], "--bo", "gus")


def test_one_tone_is_a_plain_window_and_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "white.png"
    Image.new("L", (64, 64), 255).save(path)
    for command in ("make", "design"):
        refused(capsys, 2, [command, str(path), "-o", str(tmp_path / "out"), *SMALL, "-q"], "contrast", "plain window")
    refused(capsys, 2, ["make", str(path), "-o", str(tmp_path / "out"), "--preset", "recommended", "-q"], "contrast")
    assert not (tmp_path / "out").exists()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["optics.throw_mm=1", "optics.screen_width_mm=60"], ["throw", "1"]),
        (["stock.thickness_mm=2.05"], ["relief", "stock.thickness_mm", "2.05", "or more"]),
        (["machine.travel_mm=[9,300,80]"], ["optics.width_mm", "machine.travel_mm.0", "along X", "travels 9 mm"]),
        (["machine.travel_mm=[300,300,5]"], ["machine.travel_mm.2", "Z", "at least"]),
    ],
)
def test_jobs_that_cannot_be_made(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, picture: Path, options: list[str], words: list[str]
) -> None:
    settings = [part for option in options for part in ("--set", option)]
    refused(capsys, 2, ["make", str(picture), "-o", str(tmp_path / "out"), *SMALL, *settings, "--quiet"], *words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


@pytest.mark.thorough
def test_a_ball_that_touches_too_little_of_its_lens_leaves_the_lens(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, picture: Path
) -> None:
    large = ("passes=[{radius_mm=25,pitch_mm=0.5}]", "machine.travel_mm=[900,900,90]", "machine.collet_mm=50")
    settings = [part for one in (*large, "optics.min_radius_mm=0.5") for part in ("--set", one)]
    assert run(["make", str(picture), "-o", str(tmp_path / "out"), *SMALL, *settings, "--quiet"]) == 2
    fault, kept = capsys.readouterr().err.splitlines()
    assert fault.startswith("error: passes.0.radius_mm: 25 ") and "largest that fits" in fault
    assert "causticmill cam" in kept
    assert (tmp_path / "out" / "heightfield.npz").is_file() and not list(tmp_path.rglob("*.nc"))


@pytest.mark.thorough
def test_an_output_that_holds_other_files_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, picture: Path
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("x")
    refused(capsys, 2, ["design", str(picture), "-o", str(tmp_path / "out"), *SMALL, "--quiet"], "--force")
    assert run(["design", str(picture), "-o", str(tmp_path / "out"), *SMALL, "--quiet", "--force"]) == 0
    assert (tmp_path / "out" / "thesis.tex").read_text() == "x"


def test_an_output_under_a_file_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path, picture: Path) -> None:
    refused(capsys, 2, ["design", str(picture), "-o", str(picture / "out"), *SMALL, "--quiet"], "ramp.png is a file")


def test_cam_and_caustic_need_a_design(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for command in ("cam", "caustic"):
        refused(capsys, 2, [command, str(tmp_path)], "spec.json", "design")


GOOD_REPORT = {"versions": {"causticmill": "0"}, "passes": [], "optics": {}}


def job_folder(folder: Path, **files: str) -> Path:
    """A folder with spec.json and report.json as a job leaves them, some files with other content."""
    folder.mkdir()
    content = {"spec.json": json.dumps(resolve_spec().plain()), "report.json": json.dumps(GOOD_REPORT)}
    for name, text in (content | {key.replace("__", "."): text for key, text in files.items()}).items():
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"report__json": "{"}, ["report.json", "not valid JSON"]),
        ({"report__json": "[]"}, ["report.json", "not a report"]),
        ({"report__json": '{"passes": 3}'}, ["report.json", "not a report"]),
        ({"report__json": '{"passes": [{}]}'}, ["report.json", "not a report"]),
        ({"report__json": '{"timings_s": [1]}'}, ["report.json", "not a report"]),
        ({"spec__json": "{"}, ["DIR", "spec.json", "not valid JSON"]),
        ({"spec__json": "{}"}, ["spec.json", "passes", "missing"]),
        ({}, ["out/heightfield.npz", "no such file"]),
        ({"heightfield__npz": "x"}, ["out/heightfield.npz", "not a file of this program"]),
    ],
)
@pytest.mark.parametrize("command", ["cam", "caustic"])
def test_a_damaged_job_folder_is_an_input_error(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str, files: dict[str, str], words: list[str]
) -> None:
    folder = job_folder(tmp_path / "out", **files)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    refused(capsys, 2, [command, str(folder), "-q"], *words)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def lens_file(path: Path, z_mm: float) -> Path:
    axis = np.linspace(0, 10, 8)
    np.savez(path, z_mm=np.full((8, 8), z_mm), x_mm=axis, y_mm=axis)
    return path


def test_check_needs_a_lens_programs_and_tools(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    program, tools = tmp_path / "a.nc", ["--radius-mm", "1", "--pitch-mm", "0.1"]
    program.write_text("hello\n")
    lens = ["--heightfield", str(lens_file(tmp_path / "lens.npz", -0.1)), "-q"]
    high = ["--heightfield", str(lens_file(tmp_path / "high.npz", 1.0)), "-q"]
    refused(capsys, 2, ["check", str(program), "--heightfield", str(tmp_path), "-q", *tools], "this is a folder")
    refused(capsys, 2, ["check", str(program), *high, *tools], "high.npz", "reaches 1 mm", "stock top")
    refused(capsys, 2, ["check", str(tmp_path / "b.nc"), *lens, *tools], "b.nc", "no such program")
    refused(capsys, 2, ["check", str(program), *lens], "--radius-mm is missing")
    refused(capsys, 2, ["check", str(program), *lens, *tools, "--radius-mm", "2"], "2 values for 1 program; allowed: 1")
    refused(capsys, 1, ["check", str(program), *lens, *tools], "a.nc", "line 1", "hello")


def test_check_runs_the_earlier_passes_of_a_job_and_misses_them(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    row = {"lines": 1, "path_length_mm": 1.0, "time_s": 1.0, "entries": 1, "bounds": {}}
    rows = [{"file": name, **row} for name in ("pass-1-rough.nc", "pass-2-rough.nc")]
    folder = job_folder(tmp_path / "out", report__json=json.dumps(GOOD_REPORT | {"passes": rows}))
    (folder / "pass-2-rough.nc").write_text("M2\n")
    lens = ["--heightfield", str(lens_file(tmp_path / "lens.npz", -0.1)), "-q"]
    refused(capsys, 2, ["check", str(folder / "pass-2-rough.nc"), *lens], "pass-1-rough.nc", "no such program")


@pytest.mark.thorough
def test_design_then_caustic_gives_the_same_scores(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, design: tuple[Path, str]
) -> None:
    made, text = design
    assert "PSNR" in text
    assert str(made / "report.html") in text
    out = shutil.copytree(made, tmp_path / "out")
    first = json.loads((out / "report.json").read_text())
    (out / "caustic.png").unlink()
    assert run(["caustic", str(out), "--quiet"]) == 0
    second = json.loads((out / "report.json").read_text())
    assert capsys.readouterr().out == ""
    assert second["optics"] == first["optics"]
    assert (out / "caustic.png").is_file()
    assert (out / "spec.json").is_file()


@pytest.mark.thorough
def test_cam_refuses_another_lens(capsys: pytest.CaptureFixture[str], tmp_path: Path, design: tuple[Path, str]) -> None:
    out = shutil.copytree(design[0], tmp_path / "out")
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    refused(capsys, 2, ["cam", str(out), "--set", "optics.throw_mm=50"], "optics.throw_mm", "20.0", "design")
    assert {path.name: path.stat().st_mtime_ns for path in out.iterdir()} == before


def test_help_answers_at_once_and_imports_nothing_heavy() -> None:
    """The wall time is the reason, the imports are what can be held: numba alone takes half a second."""
    code = (
        "import sys, service.cli.main; service.cli.main.run(['--help'])\n"
        "sys.exit(any(name in sys.modules for name in ('numba', 'numpy', 'matplotlib')))"
    )
    begun = time.perf_counter()
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False).returncode == 0
    assert time.perf_counter() - begun < 10


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["version"]) == 0
    assert capsys.readouterr().out.startswith("causticmill ")


def test_an_interrupt_that_a_library_turns_into_another_error_is_still_an_interrupt(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an extension module does whose import is interrupted. A second Ctrl-C at once changes nothing."""

    def load() -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            signal.raise_signal(signal.SIGTERM)
            raise ImportError("initialization failed") from None

    monkeypatch.setattr("service.cli.main.use_current_kernels", load)
    before = signal.getsignal(signal.SIGINT)
    refused(capsys, 130, ["version"], "interrupted")
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_that_is_swallowed_comes_again(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by `try: import fast_module; except ImportError: fast_module = None`."""

    def load() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.pause()

    monkeypatch.setattr("service.cli.main.use_current_kernels", load)
    monkeypatch.setattr("service.cli.main._AGAIN_S", 0.01)
    refused(capsys, 130, ["version"], "interrupted")
