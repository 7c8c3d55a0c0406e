"""What a job is carried out with is what stood in the files when it was submitted, wherever that is done."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.profile import profile_names
from service.errors import FailedError, SpecError
from service.job.spec.finish import BEST, NONE
from service.job.spec.finish_library import built_in_processes
from service.job.spec.loading import load_stored_job, resolve_job, restore_job
from service.job.spec.resolve import ResolvedJob
from service.job.stages.table import facts_of, plan, stage_key

jobs = st.builds(
    lambda profile, process: resolve_job(
        preset="recommended",
        base={
            "machine": {"profile": profile, **({"top_z_mm": 400.0} if profile == "okuma-osp" else {})},
            "finish": {"process": process},
        },
    ),
    st.sampled_from(profile_names()),
    st.sampled_from([NONE, BEST, *built_in_processes()]),
)


def kept(job: ResolvedJob) -> ResolvedJob:
    """As another process finds it."""
    return restore_job(json.loads(json.dumps(job.spec.model_dump(mode="json"))), job.figures.to_text())


@given(jobs)
def test_a_job_that_was_kept_is_the_same_job(job: ResolvedJob) -> None:
    again = kept(job)
    assert again == job
    assert repr(facts_of(again)) == repr(facts_of(job))


def test_files_that_change_after_a_job_was_submitted_change_nothing_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mill, tools and finish of other figures, or gone: its figures and all of its keys stay."""
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    (tmp_path / "machines").mkdir()
    profile, tools, finish = tmp_path / "machines/bench.toml", tmp_path / "tools.toml", tmp_path / "finishing.toml"
    profile.write_text('extends = "grbl"\nsafe_z_mm = 4\n')
    tools.write_text('[[tool]]\nname = "a"\nradius_mm = 2\nflutes = 2\nflute_length_mm = 8\nmax_rpm = 30000\n')
    finish.write_text('[buffing]\ntitle = "Buffing"\norder = 2\nk0_rad_per_mm = 5\ndefault_minutes = 8\n')

    def submit() -> ResolvedJob:
        return resolve_job(preset="recommended", overrides=["machine.profile=bench", "finish.process=buffing"])

    def keys(job: ResolvedJob) -> list[str]:
        stages = [one for one in plan(job.spec) if not one.startswith("pass-")]  # they are not planned yet
        return [stage_key(one, job, image_sha256="a", image_name="b", outputs={}) for one in stages]

    job = submit()
    before = keys(job)
    profile.write_text('extends = "grbl"\nsafe_z_mm = 6\n')
    assert kept(job).machine.safe_z_mm == 4 and keys(kept(job)) == before != keys(submit())
    for path in (profile, tools, finish):
        path.unlink()
    again = kept(job)
    assert again.figures.tools[0].name == "a" and again.figures.processes["buffing"].title == "Buffing"
    assert keys(again) == before


def test_figures_of_another_version_are_refused_not_guessed() -> None:
    job = resolve_job()
    figures = json.loads(job.figures.to_text())
    del figures["profile"]["travel_mm"]
    with pytest.raises(FailedError, match=r"another version \(profile\.travel_mm\): submit it again"):
        restore_job(job.spec.plain(), json.dumps(figures))


def test_a_job_that_is_made_stays_readable_when_its_process_has_left_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its figures stand in its spec; only a new job cannot name it any more."""
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    library = tmp_path / "finishing.toml"
    library.write_text('[buffing]\ntitle = "Buffing"\norder = 2\nk0_rad_per_mm = 5\ndefault_minutes = 8\n')
    made = resolve_job(overrides=["finish.process=buffing"])
    (tmp_path / "spec.json").write_text(json.dumps(made.spec.plain()))
    library.unlink()
    assert load_stored_job(tmp_path).spec == made.spec
    with pytest.raises(SpecError, match=r"finish\.process: 'buffing' is not known; allowed: .*'best'"):
        resolve_job(overrides=["finish.process=buffing"])
