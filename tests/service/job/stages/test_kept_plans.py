"""A plan is made once: for an exact estimate, the job after it, and whoever asks the same again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optics import design
from optics.heightfield import Array
from service.job.picture import OWN_PICTURE
from service.job.planning.estimate import estimate
from service.job.planning.plan import Planned
from service.job.planning.planner import plan_for_picture
from service.job.spec.loading import resolve_spec
from service.job.spec.model import JobSpec
from service.job.spec.resolve import ResolvedJob, look_up, with_plan
from service.job.stages import kept_plans
from service.job.stages.kept_plans import KeptPlans
from service.job.stages.run import run_order
from tests.service.job.stages.jobs import StagedJob, staged_job

CAMERA = Path(__file__).parents[4] / "examples" / "camera.png"
SMALL = ("optics.width_mm=12", "optics.height_mm=12", "optics.throw_mm=30", "image.pixels=64", "finish.process=none")


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch) -> list[ResolvedJob]:
    """Of which jobs the planner has made a plan, in this order."""
    jobs: list[ResolvedJob] = []

    def count(job: ResolvedJob, target: Array, **more: Any) -> Planned:
        jobs.append(job)
        return plan_for_picture(job, target, **more)

    monkeypatch.setattr(kept_plans, "plan_for_picture", count)
    return jobs


def small(*values: str) -> JobSpec:
    return resolve_spec(preset="recommended", overrides=(*SMALL, *values))


def estimate_exactly(spec: JobSpec, plans: Path) -> dict[str, Any]:
    kept = KeptPlans(plans)
    return estimate(look_up(spec), CAMERA, limits=OWN_PICTURE, name=CAMERA.name, exactly=True, plans=kept)


def plan_stage(job: StagedJob, plans: Path | None) -> tuple[dict[str, Any], bytes]:
    """Run the stage as the server does; its report but its times, and plan.png."""
    result = run_order(job.order("passes"), job.store, lambda share: None, plans=plans)
    report = {key: value for key, value in result.report.items() if key not in ("timings_s", "peak_rss_mb")}
    return {"report": report, "notes": result.notes}, b"".join(job.store.open_range(result.outputs["plan.png"].sha256))


def job_with_target(folder: Path, spec: JobSpec) -> StagedJob:
    job = staged_job(folder, spec=spec)
    job.image_sha256, job.image_name = job.store.put_file(CAMERA).sha256, CAMERA.name
    job.run_all(until="passes")
    return job


def test_an_exact_estimate_and_the_job_after_it_plan_once(tmp_path: Path, planned: list[ResolvedJob]) -> None:
    """And the job's plan is the one that it would have made by itself."""
    spec, plans = small(), tmp_path / "plans"
    job = job_with_target(tmp_path, spec)
    first = estimate_exactly(spec, plans)
    assert len(planned) == 1
    found = plan_stage(job, plans)
    assert estimate_exactly(spec, plans) == first
    assert len(planned) == 1
    assert plan_stage(job, None) == found
    assert len(planned) == 2


def test_an_estimate_offers_the_quickest_the_chosen_and_the_best_plan(tmp_path: Path) -> None:
    """The chosen one has the figures of the estimate; a job with the values of another one follows that plan."""
    spec = small("machine.profile=grbl", "finish.process=sanding", "image.pixels=32")
    found = estimate_exactly(spec, tmp_path)
    plans = found["plans"]
    assert 2 <= len(plans) <= 3
    for key in ("hours", "psnr_db"):
        values = [one[key] for one in plans]
        assert values == sorted(set(values))
    (chosen,) = (one for one in plans if one["is_chosen"])
    assert {key: found[key] for key in chosen if key in found and key != "spec"} == {
        key: value for key, value in chosen.items() if key in found and key != "spec"
    }
    for one in plans:
        data = spec.model_dump(mode="json", exclude_none=True)
        given = {key: data[key] | value for key, value in one["spec"].items() if key != "passes"}
        same = estimate_exactly(JobSpec.model_validate(data | given | {"passes": one["spec"]["passes"]}), tmp_path)
        assert same["hours"] == pytest.approx(one["hours"], rel=0.1)
        assert [row["tool"] for row in same["passes"]] == [row["tool"] for row in one["passes"]]
        assert same["plans"] == []
        assert one["hand_min"] == same["spec"]["finish"]["minutes"]


def test_the_lens_of_a_plan_is_the_one_that_the_job_would_make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So its descent is done once, also if the plan was kept for an estimate; another lens has its own."""
    job = job_with_target(tmp_path, small("finish.process=sanding", "image.pixels=32"))
    for _ in range(2):  # made, then found
        result = run_order(job.order("passes"), job.store, lambda share: None, plans=tmp_path / "plans")
    job.take("passes", result)
    job.spec = with_plan(job.spec, job.report)
    job.run("map")
    taken, plan = job.bytes(".heights.npz"), job.outputs.pop(".polished.npz")
    job.run("map")
    assert job.bytes(".heights.npz") == taken
    report, job.outputs[".polished.npz"] = job.results["map"].report["optics"], plan
    monkeypatch.setattr(design, "polish_lens", lambda lens, *_, **__: (lens, report["polish"]))
    job.run("map")
    assert job.bytes(".heights.npz") == taken and job.results["map"].report["optics"] == report
    job.spec = job.spec.model_copy(update={"optics": job.spec.optics.model_copy(update={"throw_mm": 31.0})})
    with pytest.raises(TypeError):  # asks the fake for a record
        job.run("map")


@pytest.mark.thorough
def test_a_job_s_plan_serves_the_estimates_after_it(tmp_path: Path, planned: list[ResolvedJob]) -> None:
    spec, plans = small(), tmp_path / "plans"
    job = job_with_target(tmp_path, spec)
    plan_stage(job, plans)
    estimate_exactly(spec, plans)
    assert len(planned) == 1


def fake_plans(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Plans that cost nothing; the list grows with each that is made."""
    made: list[str] = []

    def describe(_: object, *, viewed_from: str) -> kept_plans.MadePlan:
        made.append(viewed_from)
        seen = kept_plans.PredictedPicture(light=TARGET, target=TARGET, psnr_db=30.0, seen_db=20.0, detail_mm=1.0)
        return kept_plans.MadePlan(figures={"n": len(made)}, notes=[], draw=lambda: b"png", see=lambda: seen)

    monkeypatch.setattr(kept_plans, "plan_for_picture", lambda job, target, on_progress=None: None)
    monkeypatch.setattr(kept_plans, "describe_plan", describe)
    return made


TARGET = np.linspace(0.5, 1.5, 400).reshape(20, 20)
OTHER = TARGET[::-1].copy()
JOB = look_up(small())
DIFFERENT = {
    "the picture": (JOB, OTHER),
    "its last bit": (JOB, np.nextafter(TARGET, 2.0)),
    "its shape": (JOB, TARGET.reshape(10, 40)),
    "the goal": (look_up(small("plan.hours=6")), TARGET),
    "the block": (look_up(small("stock.thickness_mm=25")), TARGET),
    "the side": (look_up(small("optics.viewed_from=behind")), TARGET),
    "the mill": (look_up(small("machine.step_mm=0.01")), TARGET),
    "the tools": (replace(JOB, figures=replace(JOB.figures, tools=JOB.figures.tools[1:])), TARGET),
}


@pytest.mark.parametrize("what", DIFFERENT)
def test_what_a_plan_depends_on_makes_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    made, plans = fake_plans(monkeypatch), KeptPlans(tmp_path)
    for job, target in ((JOB, TARGET), DIFFERENT[what], (JOB, TARGET), DIFFERENT[what]):
        plans.make(job, target, at_once=True)
    assert len(made) == 2


def test_other_sources_make_another_plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, plans = fake_plans(monkeypatch), KeptPlans(tmp_path)
    plans.make(JOB, TARGET, at_once=True)
    monkeypatch.setattr("service.job.stages.table.state_of_sources", lambda module, data: "changed")
    plans.make(JOB, TARGET, at_once=True)
    assert len(made) == 2


def test_a_damaged_plan_is_made_again_and_a_folder_that_takes_none_hinders_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = fake_plans(monkeypatch)
    for number, damage in enumerate((b"", b"PK\x03\x04", b"no plan"), 1):
        (file,) = KeptPlans(tmp_path).make(JOB, TARGET, at_once=True) and tmp_path.iterdir()
        file.write_bytes(damage)
        assert len(made) == number
    (tmp_path / "file").touch()
    assert KeptPlans(tmp_path / "file").make(JOB, TARGET).draw() == b"png"


def test_the_folder_does_not_grow_without_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_plans(monkeypatch)
    monkeypatch.setattr(kept_plans, "KEPT_BYTES", 20_000)
    for number in range(20):
        KeptPlans(tmp_path).make(JOB, TARGET + number, at_once=True)
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) <= 20_000
