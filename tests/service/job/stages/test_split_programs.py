"""A pass in several programs: their names, their order, their numbers, and what is set up before each."""

from __future__ import annotations

from typing import Any

import pytest

from service.cli.summary import summary_lines
from service.job.files import files_of_pass, is_known, is_program, program_name, program_order
from service.server.api.job_views import programs
from service.server.fleet.representation import programs_of, set_up

PARTS = tuple(program_name(2, "finish-3", ".nc", part) for part in (1, 2, 10, 99, 100))
NAMES = ["pass-1-rough.nc", *PARTS, "pass-10-last.nc"]


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
    assert [file.name for file in programs(files).values()] == NAMES
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
