"""A job stage by stage through the artifact store is the same job as `causticmill make`. A pass in several programs:
their names, their order, their numbers, and what is set up before each.
"""

from __future__ import annotations

import hashlib
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from service.cli.summary import summary_lines
from service.job import pipeline
from service.job.files import files_of_pass, is_known, is_program, program_name, program_order
from service.job.spec.resolve import look_up
from service.job.stages.order import merge_notes, merge_reports
from service.job.stages.table import plan
from service.progress import QuietReporter
from service.server.database.job_rows import sort_programs
from service.server.fleet.representation import programs_of, set_up
from tests.phrases.sentences import untold
from tests.service.job.stages.jobs import StagedJob, save_picture, staged_job, tiny_spec, without_light

CORRECTED = "optics.corrections=2"
OWN_OF_A_RUN = {"timings_s", "peak_rss_mb"}  # what a run says of itself, not of the job

PARTS = tuple(program_name(2, "finish-3", ".nc", part) for part in (1, 2, 10, 99, 100))
NAMES = ["pass-1-rough.nc", *PARTS, "pass-10-last.nc"]


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> StagedJob:
    return staged_job(tmp_path_factory.mktemp("staged"), CORRECTED, preset="paper").run_all()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    picture = save_picture(folder / "blob.png")
    pipeline.make(picture, folder / "out", look_up(tiny_spec(CORRECTED, preset="paper")), reporter=QuietReporter())
    return folder / "out"


def test_the_stages_are_those_of_the_contract(job: StagedJob) -> None:
    assert plan(job.spec) == (
        "image", "irradiance", "map", "heightfield", "caustic", "fit", "pass-1", "pass-2", "pass-3", "check",
        "as-milled", "report",
    )  # fmt: skip


@pytest.mark.thorough
def test_the_files_are_those_of_make_byte_for_byte(job: StagedJob, made: Path) -> None:
    """But for what only the operator page draws."""
    drawn = {
        "thumbnail.png",
        "thumbnail-as-milled.png",
        "surface.bin",
        "light.bin",
        "light-as-milled.bin",
        "pass-1.path",
        "pass-2.path",
        "pass-3.path",
        "report-de.html",
        "report-ja.html",
    }
    offered = {name for name in job.outputs if not name.startswith(".")}
    assert offered == {path.name for path in made.iterdir()} | drawn
    for name in offered - drawn - {"report.json", "report.html"}:
        assert job.bytes(name) == (made / name).read_bytes(), name


def test_the_report_is_that_of_make_but_for_the_clock(job: StagedJob, made: Path) -> None:
    ours, theirs = json.loads(job.bytes("report.json")), json.loads((made / "report.json").read_text())
    assert set(ours) == set(theirs)
    assert set(ours["timings_s"]) == set(theirs["timings_s"])
    assert _settled(ours) == _settled(theirs)


def test_every_score_says_under_which_light_it_holds(job: StagedJob) -> None:
    report = json.loads(job.bytes("report.json"))
    white = {"kind": "collimated", "spectrum": "white", "dispersion": 0.0085, "words": "a white LED"}
    assert without_light(report) == []
    assert [report[part]["light"] for part in ("optics", "as_milled")] == [white, white]
    assert report["optics"]["psnr_db_one_wavelength"] > 20
    assert report["optics"]["tolerances"]["index"]["more_index"] == 0.0035


def test_screws_that_are_stated_are_part_of_what_is_milled(job: StagedJob, tmp_path: Path) -> None:
    """20 um each tenth of a millimetre of height are a cause; a mill that says nothing of its screws has none."""
    wavy = staged_job(
        tmp_path, "machine.screw_error_mm=[0, 0, 0.02]", "machine.screw_lead_mm=[2, 2, 0.1]", CORRECTED, preset="paper"
    ).run_all()
    plain, seen = (one.results["as-milled"].report["as_milled"] for one in (job, wavy))
    assert "screws" not in plain["gain_db_without"]
    assert seen["gain_db_without"]["screws"] > 0.5
    assert seen["slope_rms_mrad"] > plain["slope_rms_mrad"] + 2.0
    assert list(seen["screw_error_mm"]) == [0.0, 0.0, 0.02]


def test_what_a_block_is_like_costs_light_and_no_program(job: StagedJob, tmp_path: Path) -> None:
    """Haze and a back that is not flat are causes where they are stated; lens and programs stay as they are."""
    poor = staged_job(
        tmp_path, "stock.haze_percent=10", "stock.back_flatness_mm=0.05", CORRECTED, preset="paper"
    ).run_all()
    plain, seen = (one.results["as-milled"].report["as_milled"] for one in (job, poor))
    assert abs(plain["gain_db_without"]["haze"]) < 0.2
    assert "back" not in plain["gain_db_without"]
    assert seen["gain_db_without"]["haze"] > plain["gain_db_without"]["haze"]
    assert set(seen["gain_db_without"]) == {*plain["gain_db_without"], "back"}
    assert seen["psnr_db_designed"] < plain["psnr_db_designed"] - 1.0
    for name in (one for one in job.outputs if one.endswith(".nc") or one == "heightfield.npz"):
        assert poor.bytes(name) == job.bytes(name), name


def test_the_parts_of_the_report_add_up_to_the_file(job: StagedJob) -> None:
    parts = [job.results[stage].report for stage in plan(job.spec)]
    merged = {key: value for key, value in merge_reports(parts).items() if key not in OWN_OF_A_RUN}
    assert _plain(merged) == _settled(json.loads(job.bytes("report.json")))


def test_what_a_report_says_can_be_said_in_another_language(job: StagedJob, tmp_path: Path) -> None:
    assert untold(json.loads(job.bytes("report.json"))) == []
    enlarged = staged_job(tmp_path, "image.pixels=128", "finish.process=sanding", image_name="Anna {0}.png")
    for stage in ("image", "report"):
        enlarged.run(stage)
    told = json.loads(enlarged.bytes("report.json"))
    assert untold(told) == []
    assert told["warnings"][0].startswith("Anna {0}.png has 48 x 40 pixels")
    assert told["finishing"]["steps"]


def test_outputs_are_recorded_as_they_are(job: StagedJob) -> None:
    for name, ref in job.outputs.items():
        data = job.bytes(name)
        assert (hashlib.sha256(data).hexdigest(), len(data)) == (ref.sha256, ref.bytes), name


def test_each_file_comes_from_one_stage_only(job: StagedJob) -> None:
    names = [name for result in job.results.values() for name in result.outputs]
    assert len(names) == len(set(names))


def test_nothing_is_left_in_scratch(job: StagedJob) -> None:
    assert list(job.scratch.iterdir()) == []


def test_progress_goes_from_0_to_1_and_never_back(job: StagedJob) -> None:
    for stage, told in job.told.items():
        assert told[0] == 0.0
        assert told[-1] == 1.0
        assert all(before <= after for before, after in pairwise(told)), (stage, told)
        assert stage in ("image", "irradiance", "report", "heightfield", "fit") or len(set(told)) > 2, stage


def test_stages_say_what_they_cost(job: StagedJob) -> None:
    for stage, result in job.results.items():
        assert result.seconds > 0, stage
        assert 20 < result.peak_rss_mb < 20_000, stage


def test_notes_keep_their_order_and_are_said_once() -> None:
    parts: list[dict[str, list[str]]] = [{"optics": ["a", "b", "a"]}, {"passes": ["c"]}, {"optics": ["b", "d"]}]
    assert merge_notes(parts) == {"optics": ["a", "b", "d"], "passes": ["c"]}


def _settled(report: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in report.items() if key not in OWN_OF_A_RUN}


def _plain(report: dict[str, Any]) -> Any:
    return json.loads(json.dumps(report))


class Stored:
    def __init__(self, name: str) -> None:
        self.name, self.sha256, self.bytes = name, f"hash of {name}", 7


class Job:
    def __init__(self) -> None:
        self.spec: dict[str, Any] = {"passes": [{"radius_mm": 3.0}, {"radius_mm": 0.5}], "optics": {}, "stock": {}}
        self.report = None


def test_names_tell_the_order() -> None:
    assert NAMES[1] == "pass-2-finish-3-01.nc" and NAMES[-2] == "pass-2-finish-3-100.nc"
    assert all(is_program(name) and is_known(name) for name in NAMES)
    assert sorted(NAMES, key=program_order) == NAMES


def test_programs_are_numbered_in_the_order_in_which_they_are_run() -> None:
    """So they are, unsplit, the numbers of the passes."""
    files: Any = [Stored(name) for name in reversed([*NAMES, "report.json"])]
    assert [file.name for file in sort_programs(files)] == NAMES
    found = programs_of(files)
    assert [(one.number, one.pass_number, one.part) for one in found] == [
        (1, 1, 1), (2, 2, 1), (3, 2, 2), (4, 2, 3), (5, 2, 4), (6, 2, 5), (7, 10, 1),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("part", "words"), [(1, "change the tool from R 3 (Ø 6 mm) to R 0.5 (Ø 1 mm)"), (2, "all zeros as they are")]
)
def test_between_parts_nothing_is_changed(part: int, words: str) -> None:
    job: Any = Job()
    assert words in set_up(job, 2, part)["change"]["words"]


def test_a_row_names_all_its_files() -> None:
    whole = {"file": "a", "sha256": "1", "lines": 5}
    parts = [{"file": "a-01", "sha256": "1", "lines": 5}, {"file": "a-02", "sha256": "2", "lines": 6}]
    assert files_of_pass(whole) == [("a", "1")]
    assert files_of_pass({**parts[0], "parts": parts}) == [("a-01", "1"), ("a-02", "2")]


def test_the_summary_counts_all_parts(tmp_path: Any) -> None:
    parts = [{"file": f"pass-1-finish-0{k}.nc", "lines": 10 * k} for k in (1, 2, 3)]
    row = {**parts[0], "parts": parts, "path_length_mm": 1000.0, "time_s": 60.0, "entries": 3, "bounds": {"z": [-1, 5]}}
    line = next(summary_lines(tmp_path, {"passes": [row]}))
    assert line.startswith("pass-1-finish-01.nc to pass-1-finish-03.nc: 60 lines, 1.0 m")
