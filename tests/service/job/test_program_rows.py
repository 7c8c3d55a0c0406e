"""A person is told the tool of the program that runs, by the number of its file: on the sheet and at the mill."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

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
