"""The programs of a job in one, for a control that changes tools itself: it moves as they do, sheet and report have its
changes, `check` reads it again, and a job or a mill for which it would not be safe is refused.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from machines.preflight.preflight import limits_of
from service.errors import FailedError, SpecError
from service.job.checking import CheckSettings, check_programs
from service.job.files import is_known, is_program
from service.job.spec.resolve import cam_passes_of, look_up
from service.job.stages.context import versions
from service.job.stages.restarts import list_restarts
from service.milling.preflight_child import examine
from service.progress import QuietReporter
from service.server.api.job_views import media_type
from tests.service.job.report.sheet import render_report
from tests.service.job.stages.jobs import StagedJob, staged_job, tiny_spec

CHANGING = ("machine.profile=linuxcnc", "machine.tool_change=true", "machine.one_program=true")
WHOLE = "all-passes.ngc"


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> StagedJob:
    values = (*CHANGING, "machine.optional_stop=true", "stock.face.above_mm=0.5", "passes.1.radius_mm=0.9")
    folder = tmp_path_factory.mktemp("one")
    made = staged_job(folder, *values).run_all(until="check", without=("caustic",))
    made.run("check")
    return made


def test_it_is_a_file_of_the_job_that_names_each_change(job: StagedJob) -> None:
    whole, lines = job.report["one_program"], job.bytes(WHOLE).splitlines()
    assert (whole["file"], whole["sha256"], whole["lines"]) == (WHOLE, job.outputs[WHOLE].sha256, len(lines))
    assert is_known(WHOLE) and not is_program(WHOLE) and media_type(WHOLE) == media_type("pass-1-rough.ngc")
    files = ["pass-0-face.ngc", "pass-1-rough.ngc", "pass-2-finish.ngc"]
    assert [one["file"] for one in whole["changes"]] == files
    for one in whole["changes"]:
        own = job.bytes(one["file"]).splitlines()
        assert lines[one["lines_before"] + 11 : one["lines_before"] + len(own) - 2] == own[11:-2]
    assert [lines[one["line"] - 1] for one in whole["changes"]] == [b"T1M6", b"T2M6", b"T3M6"]
    assert whole["lines"] == sum(job.bytes(name).count(b"\n") - 1 for name in files) + 1  # one end
    assert whole["time_s"] == pytest.approx(sum(
        row["time_s"] for row in (job.report["around"]["face"], *job.report["passes"])
    ))  # fmt: skip


def test_the_stop_that_the_job_has_asked_for_is_no_warning(job: StagedJob) -> None:
    assert job.bytes(WHOLE).count(b"\nM1\n") == 3
    assert not any("stops for" in note for result in job.results.values() for note in result.notes.get("passes", ()))


def test_the_sheet_says_where_each_tool_comes_and_that_zero_is_set_once(job: StagedJob) -> None:
    spec = job.spec.plain()
    sheet = render_report(job.report, spec={**spec, "machine": {**spec["machine"], "tool_change": True}}, files=[WHOLE])
    lines = [one["line"] for one in job.report["one_program"]["changes"]]
    assert f"T2 in line {lines[1]} for pass-1-rough.ngc, T3 in line {lines[2]} for pass-2-finish.ngc" in sheet
    assert "It is set once" in sheet and "each new tool" not in sheet and "Set it again" not in sheet
    assert job.report["one_program"]["sha256"] in sheet


def test_check_reads_it_again_and_finds_another_move(job: StagedJob, tmp_path: Path) -> None:
    for name in (*(one["file"] for one in job.report["one_program"]["changes"]), WHOLE, "heightfield.npz"):
        (tmp_path / name).write_bytes(job.bytes(name))
    nothing = CheckSettings(
        **dict.fromkeys(("radius_mm", "pitch_mm", "stock_to_leave_mm", "step_down_mm"), ()),
        **dict.fromkeys(("thickness_mm", "margin_mm", "machine")),
    )
    (tmp_path / "spec.json").write_text(json.dumps(job.spec.plain()))
    (tmp_path / "report.json").write_text(json.dumps({**job.report, "versions": versions()}))
    lens, reporter = tmp_path / "heightfield.npz", QuietReporter()
    assert [one.ok for one in check_programs([tmp_path / WHOLE], lens, nothing, reporter=reporter)] == [True] * 3
    whole = tmp_path / WHOLE
    text = whole.read_bytes()
    at = text.rindex(b"\nX-") + 3
    whole.write_bytes(text[:at] + b"1" + text[at:])
    with pytest.raises(FailedError, match=r"all-passes\.ngc: does not move as the programs that were checked"):
        check_programs([whole], lens, nothing, reporter=reporter)


def test_the_places_to_go_on_from_are_lines_of_the_programs(
    job: StagedJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The job is done in a minute, so that no place of its own is worth a row; without that limit there are some."""
    assert list(job.report["restarts"]) == ["pass-1-rough.ngc", "pass-2-finish.ngc"]
    monkeypatch.setattr("cam.checking.restarts.LEAST_GAP_S", 0.5)
    machine = look_up(job.spec).machine
    for name, spec in zip(job.report["restarts"], cam_passes_of(job.spec), strict=True):
        file = tmp_path / name
        file.write_bytes(job.bytes(name))
        found = examine(file, limits_of(machine), lambda share: None)
        rows, lines = list_restarts(file, found, spec, machine), job.bytes(name).decode().splitlines()
        assert 2 <= len(rows) <= 12
        assert all(lines[row["line"] - 1] == row["text"] for row in rows)
        times = [row["time_s"] for row in rows]
        assert times == sorted(times) and times[0] >= 0.0 and times[-1] <= found.time_s


def test_a_mill_may_run_it(job: StagedJob, tmp_path: Path) -> None:
    file = tmp_path / WHOLE
    file.write_bytes(job.bytes(WHOLE))
    limits = limits_of(look_up(job.spec).machine)
    found = examine(file, limits, lambda share: None)
    assert not found.faults and found.ends
    assert found.time_s == pytest.approx(job.report["one_program"]["time_s"], rel=0.1)
    text = file.read_bytes()
    file.write_bytes(text.replace(b"G53G0Z0\nM5\n(pass finish", b"M5\n(pass finish"))
    assert any(one.code == "frame" for one in examine(file, limits, lambda share: None).findings)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (["machine.one_program=true"], "machine.one_program: true is not allowed; allowed: left out in dialect 'grbl'"),
        (
            ["machine.profile=linuxcnc", "machine.one_program=true"],
            "machine.one_program: true is not allowed; allowed: with machine.tool_change = true",
        ),
        ([*CHANGING, "machine.most_program_mb=5"], "allowed: without machine.most_program_mb, which splits programs"),
    ],
)
def test_where_it_would_not_be_safe_it_is_refused(values: list[str], words: str) -> None:
    with pytest.raises(SpecError) as caught:
        tiny_spec(*values)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_a_mill_whose_top_is_not_known_changes_no_tool_in_the_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    job = look_up(tiny_spec(*CHANGING))
    figures: Any = replace(job.figures, profile=replace(job.figures.profile, top_z_mm=None))
    with pytest.raises(SpecError, match=r"allowed: with machine\.top_z_mm, to which the head goes"):
        assert replace(job, figures=figures).machine
