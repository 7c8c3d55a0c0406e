"""Nothing half-written: files and folders appear whole or not at all, and foreign files are left alone. And the
programs of a job, each with its own tool, by the number of its file: on the sheet and at the mill.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import FailedError, InputError
from service.job import files as job_files
from service.job.files import (
    atomic_file,
    is_job_folder,
    program_name,
    require_usable_output,
    stage_folder,
    write_bytes,
    write_program,
)
from service.job.report.setup_sheet import describe_setup
from service.server.fleet.representation import set_up

SPEC: dict[str, Any] = {
    "passes": [{"radius_mm": 3.0, "spindle_rpm": 9000}, {"radius_mm": 0.5, "spindle_rpm": 18000}],
    "optics": {},
    "stock": {"face": {"radius_mm": 4.0, "tool": "flat", "above_mm": 1.0}, "cut_out": {"radius_mm": 1.0}},
}
FACE = {"file": "pass-0-face.nc", "settings": {"radius_mm": 4.0, "tool": "flat"}}
PASSES = [{"file": "pass-1-rough.nc"}, {"file": "pass-2-finish.nc"}]
MARKS = {"file": "pass-3-witness.nc", "settings": {"radius_mm": 0.25, "tool": "ball", "spindle_rpm": 20000}}
CUT = {"file": "pass-4-cut-out.nc", "settings": {"radius_mm": 1.0, "tool": "flat"}}
ALL = {"face": FACE, "witness": MARKS, "cut-out": CUT}
TOOLS = {
    0: ("flat end mill", 4.0),
    1: ("ball end mill", 3.0),
    2: ("ball end mill", 0.5),
    3: ("ball end mill", 0.25),
    4: ("flat end mill", 1.0),
}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def job(folder: Path, **files: str) -> Path:
    """A folder as an earlier command leaves it."""
    folder.mkdir(parents=True)
    (folder / "spec.json").write_text("{}")
    (folder / "report.json").write_text(json.dumps({"versions": {"causticmill": "0"}}))
    for name, text in files.items():
        (folder / name.replace("__", ".").replace("_", "-")).write_text(text)
    return folder


@given(st.lists(st.binary(max_size=50), max_size=10))
def test_a_program_is_counted_and_hashed_as_it_stands_on_disk(chunks: list[bytes]) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pass-1-rough.nc"
        written = write_program(path, chunks)
        data = path.read_bytes()
    assert data == b"".join(chunks)
    assert (written.bytes, written.lines) == (len(data), data.count(b"\n"))
    assert written.sha256 == hashlib.sha256(data).hexdigest()


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.nc"
    write_bytes(path, b"old")

    def chunks():  # type: ignore[no-untyped-def]
        yield b"new"
        assert path.read_bytes() == b"old"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_program(path, chunks())
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == {"a.nc"}


@pytest.mark.parametrize(
    ("number", "words"), [(errno.ENOSPC, "no space left on the disk"), (errno.EROFS, "read-only"), (errno.EIO, "error")]
)
def test_what_the_disk_refuses_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    def refuse(_descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(FailedError) as caught:
        write_bytes(tmp_path / "pass-1-rough.nc", b"G0")
    assert str(caught.value).startswith("cannot write pass-1-rough.nc: ")
    assert words in str(caught.value)
    assert names(tmp_path) == set()


def test_a_name_appears_only_when_the_file_is_whole(tmp_path: Path) -> None:
    with atomic_file(tmp_path / "a") as file:
        file.write(b"x")
        assert not (tmp_path / "a").exists()
    assert (tmp_path / "a").read_bytes() == b"x"


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, OSError])
def test_a_failed_job_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    """Neither the output, nor the staging folder, nor the parents made for it."""
    with pytest.raises(error), stage_folder(tmp_path / "a" / "b" / "out") as folder:
        (folder / "spec.json").write_text("{}")
        raise error
    assert names(tmp_path) == set()


def test_a_failed_job_leaves_the_earlier_one_as_it_was(tmp_path: Path) -> None:
    out = job(tmp_path / "out", pass_1_rough__nc="G0", notes__txt="mine")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(ValueError), stage_folder(out, keep=["pass-1-rough.nc"]) as folder:
        write_bytes(folder / "pass-1-rough.nc", b"G1")
        write_bytes(folder / "report.json", b"{}")
        raise ValueError
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert names(tmp_path) == {"out"}


def test_a_new_job_replaces_the_old_one_s_files_and_keeps_foreign_ones(tmp_path: Path) -> None:
    out = job(tmp_path / "out", pass_3_finish__nc="old", notes__txt="mine", lens__stl="kept")
    with stage_folder(out, keep=["lens.stl", "none.png"]) as folder:
        assert names(folder) == {"lens.stl"}
        write_bytes(folder / "report.json", b"new")
        write_bytes(folder / "pass-1-rough.nc", b"new")
    assert names(out) == {"notes.txt", "lens.stl", "report.json", "pass-1-rough.nc"}
    assert (out / "report.json").read_bytes() == b"new"
    assert (out / "lens.stl").read_text() == "kept"
    assert names(tmp_path) == {"out"}


def test_a_killed_job_s_staging_folder_is_cleared_by_the_next(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    for abandoned in (tmp_path / ".out.0123abcd.part", tmp_path / "out" / ".out.0123abcd.part"):
        abandoned.mkdir()
        (abandoned / "x").write_text("x")
    require_usable_output(tmp_path / "out", force=False)
    mine = tmp_path / ".out.mine.part"
    mine.mkdir()
    with stage_folder(tmp_path / "out") as folder, stage_folder(tmp_path / "other"):
        (folder / "a").write_text("a")
    assert names(tmp_path) == {"out", "other", ".out.mine.part"}


@pytest.mark.parametrize("there_before", [False, True])
def test_a_second_job_for_the_same_folder_is_refused_and_the_first_goes_on(tmp_path: Path, there_before: bool) -> None:
    out = tmp_path / "out"
    if there_before:
        out.mkdir()
    with stage_folder(out) as running:
        (running / "spec.json").write_text("first")
        with pytest.raises(InputError, match="another causticmill is working on"), stage_folder(out):
            pytest.fail("the second job has begun")
    assert (out / "spec.json").read_text() == "first"
    assert names(tmp_path) == {"out"}
    assert names(out) == {"spec.json"}


def test_an_output_that_exists_is_worked_on_from_inside(tmp_path: Path) -> None:
    """It may be a mount of its own; a rename from outside would fail after hours of work."""
    out = job(tmp_path / "out")
    with stage_folder(out) as folder:
        assert folder.parent == out
        assert names(tmp_path) == {"out"}


def test_a_job_killed_while_it_was_put_in_place_may_be_made_again(tmp_path: Path) -> None:
    out = job(tmp_path / "out", lens__stl="x")
    (out / "report.json").unlink()
    require_usable_output(out, force=False)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds other files"):
        require_usable_output(out, force=False)


def test_a_signal_while_a_job_is_put_in_place_comes_too_late(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def put(staging: Path, output: Path) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        staging.rename(output)

    monkeypatch.setattr(job_files, "_put_in_place", put)
    with stage_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("a")
    assert names(tmp_path / "out") == {"a"}


def test_an_output_that_leads_nowhere_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to(tmp_path / "gone" / "far")
    with pytest.raises(InputError, match="link to a place that does not exist"):
        require_usable_output(tmp_path / "out", force=True)


def test_output_folders_that_are_refused_and_taken(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    earlier = job(tmp_path / "job")
    assert is_job_folder(earlier)
    for taken in (tmp_path / "new", tmp_path / "empty", earlier):
        require_usable_output(taken, force=False)
    require_usable_output(tmp_path / "mine", force=True)
    with pytest.raises(InputError, match=r"holds other files; allowed: .*--force"):
        require_usable_output(tmp_path / "mine", force=False)
    for force in (False, True):
        with pytest.raises(InputError, match="is a file"):
            require_usable_output(tmp_path / "file", force=force)


def test_names_of_programs() -> None:
    assert program_name(3, "finish", ".nc") == "pass-3-finish.nc"
    assert job_files.is_program("pass-3-finish.nc")
    assert not job_files.is_program("pass-x.nc")
    assert not job_files.is_program("../pass-1-a.nc")


def job_of(around: dict[str, Any]) -> Any:
    return SimpleNamespace(spec=SPEC, report={"passes": PASSES, "around": around})


@pytest.mark.parametrize("around", [ALL, {"cut-out": CUT}, {"witness": MARKS}, {}], ids=" ".join)
def test_each_program_is_set_up_with_its_own_tool(around: dict[str, Any]) -> None:
    """Where no marks could be made, the cutting out keeps the number behind theirs."""
    job = job_of(around)
    files = [*PASSES, *(row for name, row in around.items() if name != "face")]
    for number in (int(row["file"][5]) for row in files):
        tool = set_up(job, number)["tool"]
        assert (tool["shape"], tool["radius_mm"]) == TOOLS[number]


def test_the_change_is_from_the_tool_of_the_program_before() -> None:
    assert "from R 0.25 (Ø 0.5 mm) to flat R 1" in set_up(job_of(ALL), 4)["change"]["words"]
    assert "from R 0.5 (Ø 1 mm) to flat R 1" in set_up(job_of({"cut-out": CUT}), 4)["change"]["words"]
    assert "from flat R 4 (Ø 8 mm) to R 3" in set_up(job_of(ALL), 1)["change"]["words"]


@pytest.mark.parametrize("around", [ALL, {"cut-out": CUT}], ids=" ".join)
def test_the_sheet_numbers_programs_as_their_files_do(around: dict[str, Any]) -> None:
    rows = describe_setup(job_of(around).report, spec=SPEC)["passes"]
    assert [row["number"] for row in rows] == [int(row["file"][5]) for row in rows]
    assert [(f"{row['shape']} end mill", row["radius_mm"]) for row in rows] == [TOOLS[row["number"]] for row in rows]
