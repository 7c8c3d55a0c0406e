"""Witness marks as a stage of a job: made where a pad finishes and the margin has room; checked, offered, explained."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optics.witness import NoMarksError
from service.errors import SpecError
from service.job import pipeline
from service.job.files import is_program, page_in, program_order, programs_in_order
from service.job.planning.witness import WitnessPlan, plan_witness
from service.job.report.setup_sheet import LANGUAGES
from service.job.spec.loading import resolve_spec
from service.job.spec.resolve import look_up, with_plan
from service.job.stages.table import plan
from service.progress import QuietReporter
from service.wording import number
from tests.service.job.report.test_sheet_in_languages import said_past_the_tables
from tests.service.job.stages.jobs import StagedJob, save_picture, staged_job, tiny_spec

FELT = ('finish.process="felt"', "finish.minutes=1.2", "finish.k0_rad_per_mm=2.5", "finish.depth_um=16")
ROOMY = (*FELT, "stock.margin_mm=24", "passes.1.pitch_mm=0.2")
CUT = "stock.cut_out={radius_mm=0.5,tabs=2,tab_width_mm=0.6,tab_height_mm=0.3,step_down_mm=1}"
LENS = ("optics.width_mm=100", "optics.height_mm=80")


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> StagedJob:
    return staged_job(tmp_path_factory.mktemp("witness"), *ROOMY, CUT, "stock.thickness_mm=4").run_all()


def planned(*values: str) -> WitnessPlan:
    return plan_witness(
        look_up(resolve_spec(preset="draft", overrides=(*LENS, *FELT, "passes.1.radius_mm=3", *values)))
    )


@pytest.mark.parametrize(
    ("values", "there"),
    [
        (FELT, True),
        ((*FELT, "finish.witness=false"), False),
        ((), False),
        (('finish.process="lacquer"',), False),
        (("finish.k0_rad_per_mm=2", "finish.order=1"), False),  # of which nobody knows what comes off
        (("finish.k0_rad_per_mm=2", "finish.order=1", "finish.depth_um=20"), True),
    ],
)
def test_they_are_a_stage_where_a_pad_does_the_work(values: tuple[str, ...], there: bool) -> None:
    assert ("pass-witness" in plan(tiny_spec(*values))) is there


def test_a_plan_of_passes_keeps_what_was_said_of_them() -> None:
    spec = resolve_spec(preset="recommended", overrides=('finish.process="felt"', "finish.witness=false"))
    row = {"name": "finish", "radius_mm": 3.0, "pitch_mm": 0.1}
    report = {
        "plan": {
            "foreseen_blur_mm": [0.0, 0.0], "min_radius_mm": 3.0, "whole_steps": False, "passes": [row],
            "finish": {"process": "felt", "k0_rad_per_mm": 2.0, "order": 1.0, "depth_um": 20.0},
        }
    }  # fmt: skip
    assert not with_plan(spec, report).finish.witness


def test_their_program_comes_after_the_passes_and_before_the_cut_out(job: StagedJob) -> None:
    wanted = ["pass-1-rough.nc", "pass-2-finish.nc", "pass-3-witness.nc", "pass-4-cut-out.nc"]
    assert sorted((name for name in job.outputs if is_program(name)), key=program_order) == wanted
    assert [row["file"] for row in programs_in_order(job.report)] == wanted
    row = job.report["around"]["witness"]
    assert row["ok"] and row["gouge_um"] == 0.0 and row["entries"] == 1
    assert row["settings"]["radius_mm"] == job.spec.passes[-1].radius_mm


def test_the_command_line_writes_the_same_programs(job: StagedJob, tmp_path: Path) -> None:
    """Marks and cut-out both begin from the stock that the passes leave, in one process as in many."""
    spec = tiny_spec(*ROOMY, CUT, "stock.thickness_mm=4")
    pipeline.make(save_picture(tmp_path / "blob.png"), tmp_path / "out", look_up(spec), reporter=QuietReporter())
    for name in filter(is_program, job.outputs):
        assert (tmp_path / "out" / name).read_bytes() == job.bytes(name), name


def test_the_lens_and_its_programs_are_what_they_are_without_them(job: StagedJob, tmp_path: Path) -> None:
    plain = staged_job(tmp_path, *ROOMY, CUT, "stock.thickness_mm=4", "finish.witness=false")
    plain.run_all(until="check", without=("caustic",))
    for name in ("pass-1-rough.nc", "pass-2-finish.nc"):
        assert plain.bytes(name) == job.bytes(name)

    def body(text: bytes) -> list[bytes]:
        return [line for line in text.splitlines() if not line.startswith((b"(", b";"))]

    assert body(plain.bytes("pass-3-cut-out.nc")) == body(job.bytes("pass-4-cut-out.nc"))


def test_the_check_command_knows_them(job: StagedJob, tmp_path: Path) -> None:
    from service.job.checking import CheckSettings, check_programs

    names = [name for name in job.outputs if is_program(name)] + ["spec.json", "report.json", "heightfield.npz"]
    for name in names:
        (tmp_path / name).write_bytes(job.bytes(name))
    nothing = CheckSettings(
        radius_mm=(), pitch_mm=(), stock_to_leave_mm=(), step_down_mm=(), thickness_mm=None, margin_mm=None,
        machine=None,
    )  # fmt: skip

    def judge() -> list[bool]:
        found = check_programs(
            [tmp_path / "pass-4-cut-out.nc"], tmp_path / "heightfield.npz", nothing, reporter=QuietReporter()
        )
        return [verdict.ok for verdict in found]

    assert judge() == [True] * 4
    marks = tmp_path / "pass-3-witness.nc"
    lines = marks.read_text().splitlines()
    deeper = max(k for k, line in enumerate(lines) if re.fullmatch(r"(G1)?[XY\d.-]*Z-0\.\d+", line))
    lines[deeper] = re.sub(r"Z-0\.\d+", "Z-0.2", lines[deeper])
    marks.write_text("\n".join(lines) + "\n")
    assert judge() == [True, True, False]


def test_the_sheet_says_where_they_are_and_what_is_gone_when(job: StagedJob) -> None:
    page = re.sub(r"\s+", " ", job.bytes("report.html").decode())
    box = [number(side, 1) for side in job.report["witness"]["box_mm"]]
    for words in (
        "Finish for 1 min", "keep the picture within about 1 dB", "finish-tolerance.png", "Too much",
        "pass-3-witness.nc",
        f"at X {box[0]} to {box[1]}", "no clamp stands there", "Go by the marks, not by the clock",
        "as soon as mark 3 can no longer be seen", "has just disappeared: stop now", "rows beside the lens",
        "All 4 programs passed", f"the cutters sweep X {number(-2.0)} to 5, Y {number(-2.0)} to 5 mm",
    ):  # fmt: skip
        assert words.lower() in page.lower(), words
    assert page.index("keep the picture within") < page.index("You need:") < page.index("When to stop.")
    report, spec = (json.loads(job.bytes(name)) for name in ("report.json", "spec.json"))
    with pytest.MonkeyPatch.context() as patch:
        assert said_past_the_tables(report, spec, patch) == []
    for language in LANGUAGES:
        assert job.bytes(page_in(language))


def test_the_tolerance_is_what_its_three_pictures_show(job: StagedJob) -> None:
    found = job.report["finish_tolerance"]
    assert found["minutes_ratio"] == pytest.approx([0.8, 1.25])
    assert found["psnr_db"][1] == pytest.approx(job.report["as_finished"]["psnr_db"])
    low, high = found["within_ratio"]
    assert 0.8 <= low < 1.0 < high <= 1.25
    assert "finish-tolerance.png" in job.outputs


def test_without_room_there_is_a_reason_and_no_program(tmp_path: Path) -> None:
    job = staged_job(tmp_path, *FELT, "stock.margin_mm=4")
    job.run_all(without=("caustic", "as-milled", "as-finished"))
    assert job.report["witness"] == {"obstacle": "room"}
    assert "around" not in job.report
    assert "There are no witness marks beside this lens" in job.bytes("report.html").decode()


@pytest.mark.parametrize("preset", ["draft", "paper"])
def test_the_usual_margin_has_room_beside_the_usual_ball(preset: str) -> None:
    overrides = (*LENS, *FELT, *(("passes.1.radius_mm=3",) if preset == "draft" else ()), "passes.0.radius_mm=3")
    found = plan_witness(look_up(resolve_spec(preset=preset, overrides=overrides)))
    assert found.side == "front" and len(found.strip.marks) == 5


def test_one_tool_sticks_out_as_far_as_the_program_that_needs_most(job: StagedJob) -> None:
    """The ball stays in: what one of its programs needs, all have."""
    stick_out_mm = job.report["envelope"]["stick_out_mm"]
    *of_ball, of_end_mill = stick_out_mm.values()
    assert len(of_ball) == 3 and set(of_ball) == {max(of_ball)} != {of_end_mill}


def test_the_holder_stays_clear_of_clamps_beside_the_strip() -> None:
    """As far out as the job says: the nut of 11 mm radius would meet a clamp of 25 mm that the ball goes past."""
    high = "stock.clamps=[{x_mm=40,y_mm=-24,width_mm=20,depth_mm=8,height_mm=25}]"
    values = ("passes.0.radius_mm=3", "stock.margin_mm=24", "machine.safe_z_mm=30", high)
    free, stated = planned(*values), planned(*values, "passes.0.stick_out_mm=20", "passes.1.stick_out_mm=20")
    assert 40 - free.cut.places_mm[-1] < 11 < 40 - stated.cut.places_mm[-1]


clamps = st.builds(
    lambda x, y, w, d: f"{{x_mm={x},y_mm={y},width_mm={w},depth_mm={d},height_mm=5}}",
    st.sampled_from([-25, -20, -14, 110, 120]) | st.integers(-25, 120), st.integers(-25, 100), st.integers(1, 8),
    st.integers(1, 20),
)  # fmt: skip


@given(st.lists(clamps, max_size=6), st.integers(12, 30), st.booleans())
def test_the_strip_stays_in_the_block_beside_everything_else(boxes: list[str], margin: int, cut_out: bool) -> None:
    """Of any clamps: nothing comes nearer to one than the check allows, to the lens than the ball, to what passes sweep
    than their edge, nor over the block's own.
    """
    values = [f"stock.margin_mm={margin}", "passes.0.radius_mm=3", f"stock.clamps=[{','.join(boxes)}]"]
    values += ["stock.cut_out={radius_mm=2.0}"] if cut_out else []
    try:
        found = planned(*values)
    except (NoMarksError, SpecError):  # of a clamp that passes would strike, a job is refused
        return
    cut = found.cut
    left, right, front, back = cut.box_mm
    assert -margin <= left < right <= 100 + margin and -margin <= front < back <= 80 + margin
    outer, inner = cut.across_mm
    away = {"front": -inner, "left": -inner, "back": inner - 80, "right": inner - 100}[found.side]
    assert away >= 6.0 and abs(outer - inner) >= 4.0
    places = np.array(cut.places_mm)
    assert (np.diff(places) > 0).all()
    for box in boxes:
        x, y, wide, deep = (int(one) for one in re.findall(r"=(-?\d+)", box)[:4])
        axes_x, axes_y = (places, np.array(cut.across_mm)) if cut.along == "x" else (np.array(cut.across_mm), places)
        apart_x = max(x - axes_x.max(), axes_x.min() - x - wide)
        apart_y = max(y - axes_y.max(), axes_y.min() - y - deep)
        assert np.hypot(max(apart_x, 0), max(apart_y, 0)) >= cut.radius_mm + 1.0


def test_a_clamp_in_the_middle_moves_the_strip_and_clamps_all_along_send_it_to_another_side() -> None:
    usual = planned("passes.0.radius_mm=3")
    aside = planned("passes.0.radius_mm=3", "stock.clamps=[{x_mm=45,y_mm=-14,width_mm=10,depth_mm=7,height_mm=5}]")
    behind = planned("passes.0.radius_mm=3", "stock.clamps=[{x_mm=-14,y_mm=-14,width_mm=128,depth_mm=7,height_mm=5}]")
    assert usual.side == aside.side == "front" and usual.cut.places_mm != aside.cut.places_mm
    assert behind.side == "back"


def test_a_mill_that_does_not_travel_so_far_has_them_elsewhere_or_not_at_all() -> None:
    assert planned("passes.0.radius_mm=3", "machine.travel_mm=[140,90,60]").side == "left"
    with pytest.raises(NoMarksError):
        planned("passes.0.radius_mm=3", "machine.travel_mm=[106,90,60]")
