"""Facing and cutting out as stages of a job: in the plan where asked for, checked, reported, offered, and told of."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from machines.profile import load_profile
from service.errors import ServiceError, SpecError
from service.job.files import is_program, page_in, program_order, programs_in_order
from service.job.report.passes import around_sentences
from service.job.report.setup_sheet import LANGUAGES
from service.job.spec.loading import resolve_job, resolve_spec
from service.job.spec.resolve import cut_out_of, facing_task_of, look_up, without_derived
from service.job.stages.table import plan
from tests.cam.programs import read_program
from tests.service.job.report.sheet import render_report
from tests.service.job.report.test_sheet_in_languages import said_past_the_tables
from tests.service.job.stages.jobs import StagedJob, staged_job, tiny_spec

FACE = "stock.face={above_mm=0.5,radius_mm=1}"
CUT = "stock.cut_out={radius_mm=0.25,tabs=2,tab_width_mm=0.6,tab_height_mm=0.3,step_down_mm=1}"
AROUND = (
    FACE, CUT, "stock.thickness_mm=4", "machine.coolant=air", "machine.warm_up_s=20", "machine.trace_outline=true",
)  # fmt: skip


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> StagedJob:
    return staged_job(tmp_path_factory.mktemp("around"), *AROUND).run_all()


def programs(job: StagedJob) -> list[str]:
    return sorted((name for name in job.outputs if is_program(name)), key=program_order)


def test_they_are_stages_where_they_are_asked_for_and_nowhere_else() -> None:
    usual, both = plan(tiny_spec()), plan(tiny_spec(FACE, CUT))
    assert "pass-face" not in usual and "pass-cut-out" not in usual
    around = ("pass-face", "pass-1", "pass-2", "pass-cut-out", "check")
    assert both[both.index("pass-face") : both.index("check") + 1] == around


def test_the_programs_are_run_in_the_order_of_their_names(job: StagedJob) -> None:
    wanted = ["pass-0-face.nc", "pass-1-rough.nc", "pass-2-finish.nc", "pass-3-cut-out.nc"]
    assert programs(job) == wanted
    assert [row["file"] for row in programs_in_order(job.report)] == wanted
    assert all(row["ok"] and row["time_s"] > 0 for row in programs_in_order(job.report))


def test_warm_up_and_trace_are_the_first_program_s_and_coolant_is_every_program_s(job: StagedJob) -> None:
    texts = [job.bytes(name) for name in programs(job)]
    assert [text.count(b"M3S") for text in texts] == [
        3,
        1,
        1,
        1,
    ]  # a quarter of the speed is slower than the spindle turns
    assert [b"X-1.5Y-1.5Z" in text and b"G1X4.5F1200" in text for text in texts] == [True, False, False, False]
    assert all(text.count(b"M8\n") == text.count(b"M9\n") == 1 for text in texts)


def test_without_a_facing_the_first_pass_begins_so() -> None:
    """The trace of a pass is above everything it cuts, and its report knows both extents."""
    from service.job.stages.programs import trace_of

    spec = tiny_spec("machine.trace_outline=true")
    paths = trace_of(look_up(spec))
    at = np.concatenate([path.points_mm for path in paths])
    assert (at[:, 2] == look_up(spec).machine.safe_z_mm).all()
    assert at[:, 0].min() == -1.5 and at[:, 0].max() == 4.5


def test_the_lens_is_what_it_is_without_them(job: StagedJob, tmp_path: Path) -> None:
    """Passes begin at a faced block as at one that was flat from the first: the same programs, byte by byte."""
    plain = staged_job(tmp_path, "stock.thickness_mm=4", "machine.coolant=air")
    plain.run_all(until="check", without=("caustic",))
    for name in ("pass-1-rough.nc", "pass-2-finish.nc"):
        assert plain.bytes(name) == job.bytes(name)


def test_the_first_pass_begins_at_what_the_facing_has_left(job: StagedJob, tmp_path: Path) -> None:
    """Under the cusps of a ball it finds another block than under a flat cutter, and goes another way."""
    coarse = staged_job(tmp_path, *AROUND, 'stock.face={above_mm=0.5,radius_mm=1,tool="ball",pitch_mm=1.0}')
    coarse.run_all(until="pass-2", without=("caustic",))
    assert coarse.report["around"]["face"]["left_um"] == pytest.approx(1000 * (1 - 0.75**0.5), rel=0.1)
    assert coarse.bytes("pass-1-rough.nc") != job.bytes("pass-1-rough.nc")


def test_every_program_s_moves_are_above_or_beside_the_lens_as_they_should_be(job: StagedJob) -> None:
    face, cut_out = job.report["around"]["face"], job.report["around"]["cut-out"]
    assert face["bounds"]["z"][0] == 0 and face["gouge_um"] == 0 and face["left_um"] == 0
    assert cut_out["bounds"]["z"][0] == -4 and cut_out["gouge_um"] == 0 and cut_out["clear_um"] > 0
    assert [tab["height_mm"] for tab in cut_out["tabs"]] == pytest.approx([0.3, 0.3], abs=0.01)
    last = list(read_program([job.bytes("pass-3-cut-out.nc")]))[-1]
    assert last.ended


def test_the_setup_sheet_says_what_happens_around_the_passes(job: StagedJob) -> None:
    page = re.sub(r"\s+", " ", job.bytes("report.html").decode())
    for words in (
        "up to 0.5 mm on its top", "touch the raw top and set Z to 0.5", "goes once around the block", "warms up",
        "air blast on by M8", "2 tabs 0.3 mm high", "pass-0-face.nc", "pass-3-cut-out.nc", "measure from the back",
        "All 4 programs passed", "before pass 1 and pass 3",
        "0.5 mm diameter has to reach 4 mm deep in a slot, 8 times its diameter",
    ):  # fmt: skip
        assert words in page, words
    assert "cut the block along the outline" not in page


def test_the_setup_sheet_is_there_in_the_languages_of_the_page(job: StagedJob, monkeypatch: pytest.MonkeyPatch) -> None:
    for language in LANGUAGES:
        assert f'<html lang="{language}">' in job.bytes(page_in(language)).decode()
    report, spec = (json.loads(job.bytes(name)) for name in ("report.json", "spec.json"))
    assert said_past_the_tables(report, spec, monkeypatch) == []


def test_a_job_without_all_that_says_nothing_of_it() -> None:
    spec = tiny_spec()
    machine = {**spec.plain()["machine"], "dialect": "grbl", "coolant": "none", "warm_up_s": 0.0}
    assert around_sentences({**spec.plain(), "machine": machine}, {}) == []
    assert "Around the passes" not in render_report({}, spec=spec.plain())


def test_the_check_command_knows_them(job: StagedJob, tmp_path: Path) -> None:
    """The whole folder in one go, and one that has been edited by hand is found."""
    from service.job.checking import CheckSettings, check_programs
    from service.progress import QuietReporter

    names = [*programs(job), "spec.json", "report.json", "heightfield.npz"]
    for name in names:
        (tmp_path / name).write_bytes(job.bytes(name))
    nothing = CheckSettings(
        radius_mm=(),
        pitch_mm=(),
        stock_to_leave_mm=(),
        step_down_mm=(),
        thickness_mm=None,
        margin_mm=None,
        machine=None,
    )

    def verdicts(files: list[str]) -> list[bool]:
        paths = [tmp_path / name for name in files]
        found = check_programs(paths, tmp_path / "heightfield.npz", nothing, reporter=QuietReporter())
        return [verdict.ok for verdict in found]

    assert verdicts(programs(job)) == [True] * 4
    face = tmp_path / "pass-0-face.nc"
    face.write_bytes(face.read_bytes().replace(b"G1Z0F", b"G1Z-0.01F"))
    assert verdicts(["pass-0-face.nc"]) == [False]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (["stock.cut_out={radius_mm=2}"], "stock.margin_mm: 1.5 leaves 1.5 mm beside the lens"),
        (["stock.cut_out={radius_mm=2}"], "needs 5 mm: its slot and 1 mm of frame; allowed: a margin of at least 5"),
        (["stock.cut_out={radius_mm=0.2,tabs=9}"], "tabs: 9 of 4 mm do not fit"),
        (["stock.cut_out={radius_mm=0.2,tab_height_mm=30}"], "more than half the block"),
        (["stock.face={radius_mm=1,pitch_mm=2.5}"], "leaves stock between the rows; allowed: 0.01 to 2"),
        (["stock.face={above_mm=0}"], "stock.face.above_mm: 0 is not allowed"),
        (["stock.face={hight_mm=1}"], "there is no such key"),
        (["stock.cut_out={radius_mm=0.2,tabs=1,spindle_rpm=90000}"], "stock.cut_out.spindle_rpm: 90000 is not allowed"),
        (["machine.coolant=steam"], "'steam' is not allowed; allowed: 'none', 'air', 'mist', 'flood'"),
        (["machine.profile=roland-mdx-40a", "machine.coolant=air"], "allowed: 'none' in dialect 'roland-nc'"),
        (["machine.profile=okuma-osp", "machine.coolant=mist"], "allowed: 'none' or 'flood' in dialect 'okuma'"),
        (["machine.blend_tolerance_mm=0.01"], "blend_tolerance_mm: 0.01 is not allowed; allowed: left out in dialect"),
        (["machine.high_precision=g08"], "high_precision: 'g08' is not allowed; allowed: 'none' in dialect 'grbl'"),
        (["machine.warm_up_s=-1"], "from 0 to 3600"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line_with_what_can(values: list[str], words: str) -> None:
    with pytest.raises(SpecError) as refused:
        tiny_spec(*values)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_profile_may_say_so_and_a_job_may_say_otherwise(tmp_path: Path) -> None:
    profile = replace(load_profile("grbl"), coolant="air", warm_up_s=60.0, trace_outline=True)

    def machine(*values: str) -> Any:
        return resolve_job(overrides=values, load=lambda name: profile).machine

    assert (machine().coolant, machine().warm_up_s, machine().trace_outline) == ("air", 60.0, True)
    quiet = machine("machine.coolant=none", "machine.warm_up_s=0", "machine.trace_outline=false")
    assert (quiet.coolant, quiet.warm_up_s, quiet.trace_outline) == ("none", 0.0, False)
    (tmp_path / "m.toml").write_text('extends = "linuxcnc"\ncoolant = "mist"\nblend_tolerance_mm = 0.002\n')
    assert load_profile("m", [tmp_path]).blend_tolerance_mm == 0.002


def test_what_moves_beside_the_block_must_fit_the_mill() -> None:
    small = ("machine.travel_mm=[7.0,40.0,40.0]", "machine.safe_z_mm=5")
    tiny_spec(*small, "machine.trace_outline=true")
    with pytest.raises(SpecError, match=r"width_mm: .*moves 10 mm along X.*facing.*\(machine\.travel_mm\.0\)"):
        tiny_spec(*small, FACE)
    with pytest.raises(SpecError, match=r"travel_mm\.2: .*moves 45 mm along Z"):
        tiny_spec(*small, CUT)


def test_figures_left_out_follow_from_the_cutter_and_are_chosen_anew_for_another() -> None:
    spec = tiny_spec(FACE, CUT)
    facing, cut_out = facing_task_of(spec), cut_out_of(spec)
    assert facing is not None and cut_out is not None
    assert facing.pitch_mm == 1.2 and facing.shape == "flat"
    assert cut_out.step_down_mm == 1.0 and cut_out.feed_mm_per_min > 0
    asked = without_derived(look_up(spec))["stock"]
    assert asked["face"] == {"above_mm": 0.5, "radius_mm": 1.0, "tool": "flat"}
    again = resolve_spec(
        base={**without_derived(look_up(spec)), "stock": {**asked, "face": {**asked["face"], "radius_mm": 3.0}}}
    )
    assert again.stock.face is not None and again.stock.face.pitch_mm == 3.6


def test_an_estimate_counts_them(tmp_path: Path) -> None:
    from service.job.picture import OWN_PICTURE
    from service.job.planning.estimate import estimate
    from tests.service.job.stages.jobs import save_picture

    picture = save_picture(tmp_path / "blob.png")
    told = estimate(look_up(tiny_spec(*AROUND)), picture, limits=OWN_PICTURE, name="blob.png")
    assert [row["name"] for row in told["passes"]] == ["face", "rough", "finish", "cut-out"]
    assert told["hours"] == pytest.approx(sum(row["hours"] for row in told["passes"]))
    json.dumps(told)


def test_a_faulty_program_fails_the_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from cam.around import specs

    monkeypatch.setattr(specs.Facing, "levels_mm", property(lambda self: (-0.02,)))
    job = staged_job(tmp_path, FACE)
    with pytest.raises(ServiceError, match=r"pass-0-face\.nc: .*Z-0\.02"):
        job.run("pass-face")
