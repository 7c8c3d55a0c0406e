"""A real picture planned: by the command, by the stage, and what becomes of the plan in the job."""

from __future__ import annotations

import json
import re
import tomllib
from copy import copy
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from cam.planning.pass_time import LensForm
from cam.planning.planner import find_candidates
from machines.profile import profile_names
from optics.irradiance import target_irradiance
from service.cli.main import run
from service.errors import SpecError
from service.job.picture import OWN_PICTURE
from service.job.planning.estimate import estimate
from service.job.planning.plan import Planned
from service.job.planning.plan_report import plan_figures
from service.job.planning.planner import mill_of, plan_for_picture, shop_of
from service.job.planning.sentences import blur_warning, reasons
from service.job.spec import lens_task
from service.job.spec.lens_task import facts_of_light
from service.job.spec.loading import resolve_job, resolve_spec
from service.job.spec.model import JobSpec, PlanSpec
from service.job.spec.resolve import cam_passes_of, look_up, warn_of_removal, with_plan
from service.job.stages.context import StageContext
from service.job.stages.kept_plans import describe_plan, report_plan
from service.job.stages.table import plan, shares, stage_key
from service.wording import duration
from tests.cam.planning.test_planner import Blur, bumps
from tests.levels import mostly_thorough
from tests.page import canned_job
from tests.phrases.sentences import untold
from tests.service.job.stages.jobs import without_light

SIZE = ("optics.width_mm=20", "optics.height_mm=20", "optics.throw_mm=60", "image.pixels=48")
ASTRONAUT = Path(__file__).parents[4] / "examples" / "astronaut.png"
OPTIONS = [word for text in SIZE for word in ("--set", text)]


def grey(pixels: int = 48) -> np.ndarray:
    """A soft hill with fine stripes along y, so that blur along x is the one that hurts."""
    y, x = np.mgrid[0:pixels, 0:pixels] / pixels
    return 0.4 + 0.3 * np.exp(-8 * ((x - 0.4) ** 2 + (y - 0.6) ** 2)) + 0.25 * np.sin(2 * np.pi * 12 * x)


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("in") / "stripes.png"
    Image.fromarray(np.uint8(255 * np.clip(grey(), 0, 1))).save(path)
    return path


@pytest.fixture(scope="module")
def spec() -> JobSpec:
    return resolve_spec(preset="recommended", overrides=SIZE)


@pytest.fixture(scope="module")
def planned(spec: JobSpec) -> Planned:
    return plan_for_picture(look_up(spec), target_irradiance(grey(), viewed_from="lens"))


def report(planned: Planned) -> dict[str, Any]:
    return {"plan": plan_figures(planned)}


def test_what_a_plan_says_can_be_said_in_another_language(planned: Planned) -> None:
    assert untold(plan_figures(planned)) == []


@pytest.mark.thorough
def test_blur_goes_where_the_picture_has_no_detail(planned: Planned) -> None:
    """Rows along X blur along Y, where the stripes are."""
    assert planned.chosen.finish.direction == "x"


def test_a_plan_makes_the_spec_whole_and_only_once(spec: JobSpec, planned: Planned) -> None:
    whole = with_plan(spec, report(planned))
    assert spec.to_be_planned
    assert not whole.to_be_planned
    assert [row.radius_mm for row in whole.passes] == [one.radius_mm for one in planned.chosen.passes]
    assert whole.optics.min_radius_mm == planned.chosen.finish.radius_mm
    assert whole.machine.whole_steps
    assert any("whole steps" in sentence for sentence in reasons(planned))
    assert with_plan(whole, {"plan": {"passes": []}}) is whole
    assert with_plan(spec, {}) is spec
    again = resolve_spec(base=whole.plain())
    assert again == whole


def test_the_lens_is_of_the_branch_that_its_passes_were_planned_for(
    spec: JobSpec, planned: Planned, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the picture would suggest for the ball that was chosen: the plan is of no other lens."""
    monkeypatch.setattr(lens_task, "choose_branch", lambda *_: "inverted")
    assert planned.light.bench.branch == "direct"
    assert lens_task.branch_of(with_plan(spec, report(planned)), np.ones((4, 4))) == "direct"


def test_any_row_of_the_trade_submitted_as_a_spec_is_that_plan(spec: JobSpec, planned: Planned) -> None:
    """What the operator page does: the row's spec over the job's own; the chosen row is the job itself."""
    told = json.loads(json.dumps(plan_figures(planned)))
    for row, one in zip(told["candidates"], planned.plan.front, strict=True):
        laid = row["spec"]
        posted = {
            **spec.plain(),
            "passes": laid["passes"],
            **{name: {**spec.plain()[name], **laid[name]} for name in ("optics", "machine")},
        }
        whole = resolve_spec(base=posted)
        assert cam_passes_of(whole) == one.passes
        assert whole.optics.foreseen_blur_mm == planned.foreseen_blur_mm(one)
        assert whole.lens_radius_mm == one.finish.radius_mm
        assert row["hours"] == pytest.approx(sum(row["hours_by_pass"]))
        assert (row["warning"] is None) == (row["blur_px"] <= 1.0)
        if row is told["candidates"][told["chosen"]]:
            assert whole == with_plan(spec, {"plan": told})


def test_a_plan_says_under_which_light_it_holds(spec: JobSpec, planned: Planned) -> None:
    context = SimpleNamespace(report={}, spec=spec, note=lambda *_: None, draw=lambda *_: None)
    report_plan(cast(StageContext, context), describe_plan(planned, viewed_from=spec.optics.viewed_from))
    assert context.report["plan"]["light"] == facts_of_light(spec)
    assert without_light(context.report) == []


def test_the_page_s_tests_are_told_of_such_a_plan(planned: Planned) -> None:
    told, canned = plan_figures(planned), canned_job.plan()
    assert set(told) == set(canned)
    row, theirs = told["candidates"][0], canned["candidates"][0]
    assert set(row) == set(theirs)
    assert {key: set(row["spec"][key]) for key in ("optics", "machine")} == {
        key: set(theirs["spec"][key]) for key in ("optics", "machine")
    }


def test_the_trade_is_a_curve(planned: Planned) -> None:
    rows = plan_figures(planned)["candidates"]
    for before, after in pairwise(rows):
        assert before["hours"] < after["hours"]
        assert before["psnr_db"] < after["psnr_db"]


def test_a_foretold_figure_is_told_with_its_margin(planned: Planned) -> None:
    """And where the wall is near for the ball, that there is none."""
    told = plan_figures(planned)["hopeful_db"]
    assert f"as milled up to {told:g} dB less" in reasons(planned)[0]
    form = planned.light.forms[planned.chosen.finish.radius_mm]
    assert planned.chosen.finish.radius_mm <= 0.15 * planned.light.reach_mm(form)


def test_a_picture_without_detail_is_not_told_that_its_detail_is_lost(planned: Planned) -> None:
    """However wide the blur is: a soft hill looks the same."""
    blurred = next(one for one in planned.plan.front if planned.blur_px(one) > 1.0)
    assert blur_warning(planned, blurred) is not None
    light = copy(planned.light)
    light.target = gaussian_filter(light.target, 12.0)
    assert blur_warning(replace(planned, light=light), blurred) is None


@pytest.mark.thorough
def test_a_limit_of_time_is_kept_or_said_to_be_kept_by_no_plan(spec: JobSpec, planned: Planned) -> None:
    """With the figures, and with a value that does."""

    def plan_within(hours: float) -> Planned:
        job = look_up(spec.model_copy(update={"plan": PlanSpec(hours=hours)}))
        return plan_for_picture(job, target_irradiance(grey(), viewed_from="lens"))

    quickest, best = planned.plan.quickest, planned.plan.best
    for hours in (1.001 * quickest.hours, (quickest.hours + best.hours) / 2):
        assert plan_within(hours).chosen.hours <= hours < best.hours
    with pytest.raises(SpecError) as told:
        plan_within(0.5 * quickest.hours)
    words = f"no plan takes {0.5 * quickest.hours:g} h or less; the quickest: {duration(3600 * quickest.hours)}"
    ((field, said),) = told.value.problems
    assert (field, said) == ("plan.hours", words)
    (row,) = told.value.rows()
    assert quickest.hours <= row["use"] <= quickest.hours + 0.1


def test_what_the_person_decided_stays(planned: Planned) -> None:
    given = resolve_spec(
        preset="recommended", overrides=[*SIZE, "optics.min_radius_mm=1", "optics.foreseen_blur_mm=[0.1, 0.2]"]
    )
    whole = with_plan(given, report(planned))
    assert whole.optics.min_radius_mm == 1
    assert whole.optics.foreseen_blur_mm == [0.1, 0.2]


@pytest.mark.parametrize(
    ("given", "whole"),
    [((), True), (("machine.whole_steps=false",), False), (("machine.step_mm=0.0001",), False)],
)
def test_heights_are_in_whole_steps_where_these_are_coarse(given: tuple[str, ...], whole: bool) -> None:
    assert mill_of(resolve_job(preset="recommended", overrides=[*SIZE, *given])).whole_steps == whole


def test_a_planned_job_is_the_same_after_any_restart(spec: JobSpec, planned: Planned) -> None:
    """Stages up to the plan are those of before; keys of later ones depend on what was planned."""
    whole = with_plan(spec, report(planned))
    upto = plan(spec).index("passes") + 1
    assert plan(whole)[:upto] == plan(spec)[:upto]
    assert sum(shares(spec).values()) == pytest.approx(1.0)
    assert sum(shares(whole).values()) == pytest.approx(1.0)
    keys = [stage_key("map", look_up(one), image_sha256="a", image_name="b", outputs={}) for one in (spec, whole)]
    assert keys[0] != keys[1]


def test_wishes_of_the_plan_and_the_mill_are_in_its_key(
    spec: JobSpec, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def key(*overrides: str) -> str:
        one = resolve_job(preset="recommended", overrides=[*SIZE, *overrides])
        return stage_key("passes", one, image_sha256="a", image_name="b", outputs={})

    found = [key(), key("plan.hours=3"), key("machine.z_noise_mm=0"), key("stock.margin_mm=5")]
    (tmp_path / "tools.toml").write_text(
        '[[tool]]\nname = "a"\nradius_mm = 2\nflutes = 2\nflute_length_mm = 8\nmax_rpm = 30000\n'
    )
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    assert len({*found, key()}) == 5


@pytest.mark.thorough
def test_the_command_writes_a_picture_and_a_spec_that_make_takes(
    picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plan.png"
    assert run(["plan", str(picture), *OPTIONS, "--hours", "0.5", "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "->" in said
    assert "best picture within 0.5 h" in said
    with Image.open(out) as drawn:
        assert min(drawn.size) > 600
    fragment = resolve_spec(file=out.with_suffix(".toml"))
    assert not fragment.to_be_planned
    assert fragment.passes[-1].stock_to_leave_mm == 0
    assert fragment.optics.min_radius_mm == fragment.passes[-1].radius_mm
    assert fragment.optics.width_mm == 20
    assert fragment.machine.whole_steps
    assert tomllib.loads(out.with_suffix(".toml").read_text())["preset"] == "recommended"


@pytest.mark.thorough
def test_the_command_speaks_json(picture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", str(picture), *OPTIONS, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["hours"] == pytest.approx(sum(found["hours_by_pass"]))
    assert found["why"]
    assert found["passes"][-1]["stock_to_leave_mm"] == 0


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--hours", "0.01"], ["plan.hours", "0.01", "quickest"]),
        (["--hours", "-1"], ["plan.hours", "from 0.01"]),
        (["--hours", "1", "--blur-mm", "1"], ["plan.blur_mm", "one of them"]),
        (["-o", "plan.jpg"], ["plan.jpg", ".png"]),
        (["--tools", "/nowhere.toml"], ["/nowhere.toml"]),
        (["--machine", "haas"], ["machine.profile", "'haas'"]),
        (["--set", "optics.widht_mm=3"], ["optics.widht_mm", "width_mm"]),
    ],
)
def test_what_cannot_be_planned_is_one_line(
    picture: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: list[str]
) -> None:
    assert run(["plan", str(picture), *OPTIONS, *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(word in line for word in words), line


@pytest.mark.thorough
def test_a_plan_of_a_picture_hard_to_recognise_says_what_shows_more(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each with values that a command takes, and with what an estimate of them says."""
    small = (
        "image.pixels=64",
        "optics.width_mm=20",
        "optics.height_mm=20",
        "optics.throw_mm=150",
        "finish.process=none",
    )

    def seen_db(*values: str) -> float:
        job = resolve_job(preset="recommended", overrides=(*small, *values))
        return float(estimate(job, ASTRONAUT, limits=OWN_PICTURE, name="astronaut")["psnr_db"])

    options = [word for text in small for word in ("--set", text)]
    assert run(["plan", str(ASTRONAUT), *options, "-o", str(tmp_path / "plan.png")]) == 0
    lines = capsys.readouterr().out.splitlines()
    told = [line for line in lines[lines.index("what shows more:") + 1 :] if line.startswith("  ")]
    assert any(line.startswith("  a lens of 30 x 30 mm: ") for line in told)
    own_db = seen_db()
    for line in told:
        told_db, values = re.findall(r"\((-?[\d.]+) dB\).*\(--set (.*)\)$", line)[0]
        assert float(told_db) >= own_db + 0.9
        assert seen_db(*values.split(" --set ")) == pytest.approx(float(told_db), abs=0.06)


@pytest.mark.parametrize("profile", mostly_thorough(profile_names(()), quick=("grbl",)))
def test_every_way_to_mill_keeps_collet_and_removal_rate_of_the_mill(profile: str) -> None:
    """With the built-in tools, whose largest have shanks of 8 and 12 mm, and a margin that has room for all."""
    asked = [*SIZE, f"machine.profile={profile}", "stock.margin_mm=14"]
    if profile == "okuma-osp":
        asked.append("machine.top_z_mm=400")
    job = look_up(resolve_spec(preset="recommended", overrides=asked))
    shop, form = shop_of(job), LensForm.of(bumps(0.2))
    candidates, left_out = find_candidates(
        shop, {one.radius_mm: form for one in shop.balls}, Blur(), fillings={}, quickly=True
    )
    passes = [spec for one in candidates for spec in one.passes]
    assert passes and max(2 * (spec.shank_radius_mm or 0.0) for spec in passes) <= job.machine.collet_mm
    assert max(spec.pitch_mm * spec.step_down_mm * spec.feed_mm_per_min for spec in passes) <= (
        1000 * job.machine.removal_cm3_per_min
    )
    unheld = {one.name for one in shop.balls if 2 * one.shank_radius_mm > job.machine.collet_mm}
    assert unheld <= {name for name, why in left_out if "collet takes" in why}


def test_a_shank_that_the_collet_cannot_take_is_refused_with_both_figures() -> None:
    with pytest.raises(SpecError, match=r"passes.0.radius_mm.*shank of 12 mm.*'grbl' takes 6.35 mm.*thinner shank"):
        resolve_spec(overrides=("passes=[{radius_mm=6, pitch_mm=0.5}]",))
    thin = "passes=[{radius_mm=6, pitch_mm=0.5, flute_length_mm=20, shank_radius_mm=%g}]"
    assert resolve_spec(overrides=(thin % 3.0,)).passes[0].radius_mm == 6.0
    with pytest.raises(SpecError, match=r"passes.0.shank_radius_mm.*at most 3.175"):
        resolve_spec(overrides=(thin % 3.5,))
    assert resolve_spec(overrides=("passes=[{radius_mm=6, pitch_mm=0.5}]", "machine.collet_mm=12")).passes


@pytest.mark.parametrize("place", ["stock.face", "stock.cut_out"])
def test_what_mills_around_the_lens_is_held_against_the_collet_too(place: str) -> None:
    """A surfacing bit may be wider than its shank, which then has to be told."""
    wide = ("stock.margin_mm=20", f"{place}={{radius_mm=6%s}}")
    with pytest.raises(SpecError, match=rf"{place}.radius_mm.*cutter R 6 with a shank of 12 mm.*as shank_radius_mm$"):
        resolve_spec(overrides=(wide[0], wide[1] % ""))
    with pytest.raises(SpecError, match=rf"{place}.shank_radius_mm.*at most 3.175"):
        resolve_spec(overrides=(wide[0], wide[1] % ", shank_radius_mm=3.5"))
    assert resolve_spec(overrides=(wide[0], wide[1] % ", shank_radius_mm=3"))


def test_layers_that_a_light_frame_cannot_stand_are_made_shallower_or_told() -> None:
    light = ("machine.profile=grbl-3018", "passes=[{radius_mm=3, pitch_mm=1.5%s}]")
    chosen = resolve_spec(overrides=(light[0], light[1] % ""))
    (row,) = chosen.passes
    assert row.pitch_mm * row.step_down_mm * row.feed_mm_per_min == pytest.approx(1000, rel=0.03)
    own = resolve_spec(overrides=(light[0], light[1] % ", step_down_mm=1.5"))
    assert not list(warn_of_removal(chosen, look_up(chosen).machine))
    (words,) = warn_of_removal(own, look_up(own).machine)
    assert "passes.0 (finish) takes off 2.2 cm3/min in rows; 'grbl-3018' can take about 1 " in words
