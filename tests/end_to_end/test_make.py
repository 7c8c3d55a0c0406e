"""`causticmill make` as a person runs it: another process, a small lens, three passes like the paper's."""

from __future__ import annotations

import hashlib
import json
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from pygcode import Line, Machine

from optics.heightfield import Heightfield
from service.job.arrays import load_heightfield
from tests.end_to_end.command import COMMAND, ran, settings
from tests.waiting import PATIENCE_S

SIDE_MM = 4.0
LINES_READ_TWICE = 400  # the independent machine takes a millisecond for each
SETTINGS = settings(
    {
        "image.pixels": 64,
        "image.tone": "linear",
        "optics.width_mm": SIDE_MM,
        "optics.height_mm": SIDE_MM,
        "optics.throw_mm": 23,
        "stock.margin_mm": 2,
        "passes.0.radius_mm": 1,
        "passes.0.pitch_mm": 0.3,
        "passes.1.pitch_mm": 0.1,
        "passes.2.pitch_mm": 0.05,
    }
)
PICTURES = (
    "target.png", "caustic.png", "through-focus.png", "toolpath.png", "caustic-as-milled.png", "as-milled.png",
)  # fmt: skip
SHEETS = {"report.html", "setup-sheet.pdf"}
FILES = {"spec.json", "heightfield.npz", "map.npz", "lens.stl", "report.json", *SHEETS, *PICTURES}


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two soft blobs, the brighter one at the upper left: no mirror of it looks the same."""
    y, x = np.mgrid[0:64, 0:64] / 63
    blobs = ((1.0, 0.35, 0.25, 0.03), (0.5, 0.75, 0.6, 0.04))
    light = 0.4 + sum(a * np.exp(-((x - u) ** 2 + (y - v) ** 2) / s) for a, u, v, s in blobs)
    path = tmp_path_factory.mktemp("picture") / "blobs.png"
    Image.fromarray(np.rint(255 * light / light.max()).astype(np.uint8)).save(path)
    return path


@pytest.fixture(scope="module")
def job(picture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The finished job's folder and what the command printed."""
    out = tmp_path_factory.mktemp("job") / "out"
    done = ran("make", picture, "-o", out, *SETTINGS)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return out, done.stdout


@pytest.fixture(scope="module")
def report(job: tuple[Path, str]) -> dict[str, Any]:
    return json.loads((job[0] / "report.json").read_text())  # type: ignore[no-any-return]


def test_all_files_are_there_and_nothing_else_is_left(job: tuple[Path, str], report: dict[str, Any]) -> None:
    out, _ = job
    names = {path.name for path in out.iterdir()}
    programs = {"pass-1-rough.nc", "pass-2-rough.nc", "pass-3-finish.nc"}
    assert names >= FILES | programs
    assert {row["file"] for row in report["passes"]} == programs
    assert all(path.stat().st_size > 0 for path in out.iterdir())
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    for name in PICTURES:
        with Image.open(out / name) as image:
            image.verify()


def test_the_report_states_the_bytes_that_are_there(job: tuple[Path, str], report: dict[str, Any]) -> None:
    for row in report["passes"]:
        data = (job[0] / row["file"]).read_bytes()
        assert hashlib.sha256(data).hexdigest() == row["sha256"]
        assert (len(data), data.count(b"\n")) == (row["bytes"], row["lines"])
        assert max(map(len, data.split(b"\n"))) < 80
        assert row["ok"] is True
        assert row["gouge_um"] <= 1.0


def test_the_report_holds_what_the_design_page_promises(report: dict[str, Any]) -> None:
    assert set(report) >= {"optics", "passes", "timings_s", "peak_rss_mb", "versions"}
    assert set(report["optics"]) >= {
        "psnr_db", "ssim", "misplaced_light", "relief_mm", "max_slope_deg", "min_concave_radius_mm", "converged",
        "history",
    }  # fmt: skip
    for row in report["passes"]:
        assert set(row) >= {
            "file", "sha256", "lines", "bytes", "path_length_mm", "time_s", "entries", "max_engagement_mm", "gouge_um",
            "max_gap_mm", "bounds",
        }  # fmt: skip
    assert report["optics"]["converged"] is True
    assert report["optics"]["psnr_db"] > 40
    assert set(report["versions"]) >= {"python", "numpy", "scipy", "numba", "causticmill"}
    assert report["timings_s"]
    assert 50 < report["peak_rss_mb"] < 3000


def test_the_heightfield_file_is_as_promised(job: tuple[Path, str]) -> None:
    with np.load(job[0] / "heightfield.npz", allow_pickle=False) as stored:
        x, y, z = stored["x_mm"], stored["y_mm"], stored["z_mm"]
    assert z.dtype == np.float64
    assert z.shape == (y.size, x.size)
    assert (np.diff(x) > 0).all()
    assert (np.diff(y) > 0).all()
    assert np.isfinite(z).all()
    assert z.max() == pytest.approx(-0.1)  # the skim


_MOTION = 1  # pygcode's number for the group of G0, G1, G2, G3


def positions(text: str) -> list[tuple[int, dict[str, float]]]:
    """(0 or 1, position) after each motion: the words of a line, and of those before it what it leaves as it was."""
    motion, position, reached = 0, {}, []
    for line in text.splitlines():
        words = {letter: float(value) for letter, value in re.findall(r"([GXYZ])(-?[\d.]+)", line.partition("(")[0])}
        motion = int(words["G"]) if words.get("G") in (0, 1) else motion
        if moved := {axis: words[axis] for axis in "XYZ" if axis in words}:
            position = position | moved
            reached.append((motion, position))
    return reached


def positions_by_pygcode(text: str) -> list[tuple[int, dict[str, float]]]:
    """Likewise, as an independent virtual machine has it; modal words are its own business."""
    mill = Machine()
    axes: set[str] = set()
    reached = []
    for line in text.splitlines():
        block = Line(line).block
        mill.process_block(block)
        moved = {word.letter for word in block.words} & set("XYZ")
        axes |= moved
        if moved:
            position = {axis: mill.pos.values[axis] for axis in axes}
            reached.append((int(mill.mode.modal_groups[_MOTION].word.value), position))
    return reached


def test_every_line_lies_within_the_declared_bounds_and_an_independent_parser_reads_the_same(
    job: tuple[Path, str], report: dict[str, Any]
) -> None:
    for row in report["passes"]:
        text = (job[0] / row["file"]).read_text(encoding="ascii")
        moves = [position for _, position in positions(text)]
        motions = len(re.findall(r"^(?:G[01](?!\d))?[XYZ]", text, flags=re.MULTILINE))
        assert len(moves) == motions > 100
        begins = "\n".join(text.splitlines()[:LINES_READ_TWICE])
        assert positions(begins) == positions_by_pygcode(begins)
        for axis in "XYZ":
            values = np.array([position[axis] for position in moves if axis in position])
            low, high = row["bounds"][axis.lower()]
            assert low - 1e-9 <= values.min()
            assert values.max() <= high + 1e-9


def finish_points(out: Path) -> NDArray[np.float64]:
    """(n, 3) cutting positions of the finish pass over the aperture."""
    text = (out / "pass-3-finish.nc").read_text(encoding="ascii")
    rows = [[p["X"], p["Y"], p["Z"]] for motion, p in positions(text) if motion == 1 and len(p) == 3]
    points = np.array(rows)
    inside = ((points[:, :2] > 0.2) & (points[:, :2] < SIDE_MM - 0.2)).all(axis=1)
    return points[inside]


@pytest.mark.thorough
def test_the_finish_program_follows_this_lens_and_not_its_mirror(job: tuple[Path, str]) -> None:
    """The tip rides above the surface by R (1 / cos a - 1) and no mirror image of the lens fits the program."""
    lens = load_heightfield(job[0] / "heightfield.npz")
    points = finish_points(job[0])
    lift = points[:, 2] - lens.spline().heights_mm(points[:, 0], points[:, 1])
    steepest = np.hypot(*np.gradient(lens.z_mm, lens.dy_mm, lens.dx_mm)).max()
    assert lift.min() > -1e-5
    assert lift.max() < 1.05 * 0.5 * (np.hypot(1, steepest) - 1) + 1e-5
    for z in (lens.z_mm[::-1], lens.z_mm[:, ::-1], lens.z_mm.T):
        mirrored = Heightfield.on_aperture(z, width_mm=SIDE_MM, height_mm=SIDE_MM).spline()
        assert np.abs(points[:, 2] - mirrored.heights_mm(points[:, 0], points[:, 1])).max() > 20 * lift.max()


def test_no_rapid_runs_below_the_stock_top(job: tuple[Path, str], report: dict[str, Any]) -> None:
    for row in report["passes"]:
        at = None
        for motion, position in positions((job[0] / row["file"]).read_text(encoding="ascii")):
            if motion == 0 and at is not None and {"X", "Y", "Z"} <= set(position):
                rises = position["Z"] > at["Z"] and (position["X"], position["Y"]) == (at.get("X"), at.get("Y"))
                assert rises or position["Z"] > 0
            at = position


def test_the_command_says_where_things_are_and_how_good(job: tuple[Path, str]) -> None:
    out, text = job
    assert str(out / "report.html") in text
    for words in ("PSNR", "SSIM", "relief", "pass-3-finish.nc", "machine time"):
        assert words in text


def test_the_setup_sheet_names_programs_and_shows_pictures(job: tuple[Path, str]) -> None:
    page = (job[0] / "report.html").read_text(encoding="utf-8")
    for name in ("pass-1-rough.nc", "pass-3-finish.nc", *PICTURES):
        assert name in page


@pytest.mark.thorough
def test_check_accepts_the_programs_and_sees_a_gouge(job: tuple[Path, str], tmp_path: Path) -> None:
    """The same program, one line of it 50 µm deeper, is refused with exit code 1 and that line's number."""
    out, _ = job
    lens = ["--heightfield", out / "heightfield.npz"]
    good = ran("check", out / "pass-1-rough.nc", *lens)
    assert (good.returncode, good.stderr) == (0, "")
    assert "no fault" in good.stdout
    lines = (out / "pass-3-finish.nc").read_text().splitlines()
    middle = next(k for k in range(len(lines) // 2, len(lines)) if re.fullmatch(r"X[\d.]+Z-[\d.]+", lines[k]))
    head, depth = lines[middle].split("Z")
    lines[middle] = f"{head}Z{float(depth) - 0.05:.5f}"
    for name in ("spec.json", "report.json", "pass-1-rough.nc", "pass-2-rough.nc"):
        (tmp_path / name).write_bytes((out / name).read_bytes())
    (tmp_path / "pass-3-finish.nc").write_text("\n".join(lines) + "\n")
    bad = ran("check", tmp_path / "pass-3-finish.nc", *lens, "--quiet")
    assert bad.returncode == 1
    assert all(line.startswith("error: ") for line in bad.stderr.splitlines())
    assert f"line {middle + 1} " in bad.stderr or f"line {middle + 2} " in bad.stderr
    assert "below the lens" in bad.stderr


@pytest.mark.thorough
def test_cam_alone_makes_the_same_programs_again(job: tuple[Path, str], report: dict[str, Any], tmp_path: Path) -> None:
    """Same lens, same spec, same bytes; and only the passes' part of the report is new."""
    copy = tmp_path / "out"
    copy.mkdir()
    for path in job[0].iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    for name in ("pass-3-finish.nc", "toolpath.png", "report.html"):
        (copy / name).unlink()
    done = ran("cam", copy, "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    again = json.loads((copy / "report.json").read_text())
    assert [row["sha256"] for row in again["passes"]] == [row["sha256"] for row in report["passes"]]
    assert again["optics"] == report["optics"]
    assert {path.name for path in copy.iterdir()} == {path.name for path in job[0].iterdir()}


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "stage"), [(signal.SIGTERM, "lens"), (signal.SIGINT, "write pass 1")])
def test_an_interrupt_leaves_nothing(picture: Path, tmp_path: Path, kind: signal.Signals, stage: str) -> None:
    command = [*COMMAND, "make", picture, "-o", tmp_path / "a" / "out", *SETTINGS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert any(line.startswith(stage) for line in process.stdout)
        time.sleep(0.05)  # into the stage; where exactly does not matter
        process.send_signal(kind)
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert errors.splitlines() == ["error: interrupted; no half-written file is left"]
    assert list(tmp_path.iterdir()) == []


INTERRUPTED_LOADING = """
import signal, sys
from service.cli import main as cli
from service.processes import kernel_cache
kernel_cache.use_current_kernels()
from numba.core.codegen import CPUCodeLibrary
loaded = CPUCodeLibrary._object_getbuffer_hook.__func__
numbers = iter(range(int(sys.argv.pop(1)), -1, -1))
def hook(*arguments):
    if next(numbers, None) == 0:
        signal.raise_signal(signal.SIGTERM)
    return loaded(*arguments)
CPUCodeLibrary._object_getbuffer_hook = classmethod(hook)
cli.main()
"""


@pytest.mark.thorough
def test_an_interrupt_while_a_kernel_is_loaded_leaves_nothing(
    job: tuple[Path, str], picture: Path, tmp_path: Path
) -> None:
    """The compiler asks for the kernel's code by a callback: what that raises is swallowed, and the kernel empty."""
    assert (job[0] / "report.json").exists()  # so that all kernels are there to be loaded
    given = ["make", picture, "-o", tmp_path / "out", *SETTINGS]
    command = [sys.executable, "-c", INTERRUPTED_LOADING, "6", *map(str, given)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert (done.returncode, done.stderr) == (130, "error: interrupted; no half-written file is left\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_a_disk_that_takes_no_more_leaves_nothing(picture: Path, tmp_path: Path) -> None:
    """A limit on the size of a file stands in for a full disk: the write fails in the middle of the lens's solid, and
    the last pass is not begun.
    """

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))

    earlier = tmp_path / "out"
    earlier.mkdir()
    fewer = settings({"optics.corrections": 0})
    done = ran("make", picture, "-o", earlier, *SETTINGS, *fewer, preexec_fn=limit)
    assert done.returncode == 1
    assert "write pass 3" not in done.stdout
    assert len(done.stderr.splitlines()) == 1
    assert "the file is larger than this system allows" in done.stderr
    assert list(tmp_path.iterdir()) == [earlier]
    assert list(earlier.iterdir()) == []
