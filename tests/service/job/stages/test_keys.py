"""The key of a stage changes if, and only if, something changes that its outputs can depend on."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.job.spec.loading import resolve_spec
from service.job.spec.model import JobSpec
from service.job.spec.resolve import look_up
from service.job.stages.order import FileRef, StageResult
from service.job.stages.run import run_order
from service.job.stages.table import facts_of, part_of, plan, reads, shares, stage_key, stage_of
from service.processes.source_tree import modules_used, state_of_sources
from tests.service.job.stages.jobs import StagedJob, hashes, staged_job
from tests.service.job.stages.variants import (
    ALONE,
    BASE,
    CLAMP,
    FELT,
    ONLY_ONE_VALUE,
    OTHER,
    POINT,
    leaves,
    spec_of,
    spec_with,
)

STAGES = plan(spec_with())
FILES = (
    ".picture.npz", ".target.npz", "target.png", "map.npz", ".heights.npz", "heightfield.npz", "lens.stl", "lens.png",
    "caustic.png", "pass-1-rough.nc", ".stock-1.npz", "pass-2-finish.nc", "toolpath.png",
)  # fmt: skip
KEYS = sorted(OTHER)


def own_keys(
    changed: Iterable[str] = (), *, image: str = "a", name: str = "a.png", files: Iterable[str] = ()
) -> dict[str, str]:
    """Key of each stage for the same files, except for `files`."""
    return keys_of(spec_with(*changed), image=image, name=name, files=files)


def keys_of(spec: JobSpec, *, image: str = "a", name: str = "a.png", files: Iterable[str] = ()) -> dict[str, str]:
    outputs = {file: FileRef(f"{file} {file in set(files)}", 1) for file in FILES}
    return {
        stage: stage_key(stage, look_up(spec), image_sha256=image, image_name=name, outputs=outputs)
        for stage in plan(spec)
    }


@cache
def keys_before() -> dict[str, str]:
    return own_keys()


def changes(**what: Any) -> set[str]:
    after = own_keys(**what)
    return {stage for stage in STAGES if after[stage] != keys_before()[stage]}


def test_there_is_another_value_for_every_key_of_the_spec() -> None:
    """Guards the laws below: a new key of the spec must come here, too."""
    assert set(leaves(spec_with().model_dump())) == set(OTHER) | set(ALONE) | ONLY_ONE_VALUE
    assert set(leaves(BASE)) == set(OTHER) | set(ALONE) | ONLY_ONE_VALUE
    assert all(spec_with(key) != spec_with() for key in OTHER)
    assert all(spec_of(before) != spec_of(after) for before, after in ALONE.values())


@pytest.mark.parametrize(
    ("key", "stages"),
    [
        ("passes.1.pitch_mm", {"pass-2", "check", "as-milled"}),
        ("passes.1.feed_mm_per_min", {"pass-2", "check"}),
        ("passes.0.pitch_mm", {"pass-1", "check", "as-milled"}),
        ("passes.1.radius_mm", {"fit", "pass-2", "check", "as-milled"}),
        ("optics.throw_mm", {"map", "caustic", "as-milled"}),
        ("optics.corrections", {"map"}),
        ("optics.polish", {"map"}),
        ("optics.foreseen_blur_mm", {"map"}),
        ("optics.branch", {"map"}),
        ("optics.vertices_per_pixel", {"map"}),
        ("optics.surface", {"map", "caustic", "as-milled"}),
        ("optics.screen_shift_x_mm", {"map", "caustic", "as-milled"}),
        ("optics.outline", {"map", "heightfield", "caustic", "check", "as-milled"}),
        ("optics.light.profile", {"map", "caustic", "as-milled"}),
        ("optics.light.spectrum", {"map", "caustic", "as-milled"}),
        ("optics.viewed_from", {"irradiance", "map", "caustic", "as-milled"}),
        ("image.tone", {"image"}),
        ("image.pixels", {"image"}),
        ("image.prepare", {"irradiance"}),
        ("stock.thickness_mm", {"heightfield", "fit", "pass-1", "pass-2", "check"}),
        ("stock.skim_mm", {"map", "fit", "check"}),  # which hold the envelope against it
        *((f"stock.{key}", {"caustic", "as-milled"}) for key in ("haze_percent", "back_flatness_mm", "back_period_mm")),
        ("machine.safe_z_mm", {"fit", "pass-1", "pass-2", "check"}),
        ("machine.most_program_mb", {"pass-1", "pass-2", "check"}),
        ("machine.spindle_rpm", {"check"}),
        ("machine.screw_error_mm", {"check", "as-milled"}),
        ("machine.screw_lead_mm", {"check", "as-milled"}),
        ("machine.profile", {"fit", "check"}),  # all its figures are given otherwise
        ("machine.coolant", {"pass-1", "pass-2", "check"}),
        ("machine.work_offset", {"pass-1", "pass-2", "check"}),
        ("machine.collet_mm", {"check"}),
        ("machine.removal_cm3_per_min", {"check"}),
        ("machine.warm_up_s", {"pass-1", "check"}),
        ("machine.trace_outline", {"fit", "pass-1", "check"}),
        ("preset", set()),
    ],
)
def test_what_a_change_reaches(key: str, stages: set[str]) -> None:
    """On the same inputs; what comes after a stage that made another file changes by that file's hash."""
    assert changes(changed=[key]) == stages | {"report"}


@pytest.mark.parametrize(
    ("key", "stages"),
    [
        ("optics.method", {"map"}),
        ("optics.creases", {"map"}),
        ("image.prepare_detail_mm", {"irradiance"}),
        ("plan.hours", set()),  # the passes are given
        (
            "stock.face",
            {"fit", "pass-1", "check"},
        ),  # its stage is a further one; the first pass begins from another stock
        ("stock.cut_out", {"fit", "pass-2", "check"}),  # the last pass hands on what it leaves; the first is the same
        ("finish.k0_rad_per_mm", {"map", "caustic", "as-milled"}),  # and the stage that only a finish brings
        ("finish.witness", {"pass-2", "check"}),  # the last pass hands on what it leaves
        ("machine.high_precision", set()),  # said to be none, or left so
        *((key, {"map", "caustic", "as-milled"}) for key in ALONE if key.startswith("optics.light")),
    ],
)
def test_what_a_change_reaches_where_values_go_together(key: str, stages: set[str]) -> None:
    before, after = (keys_of(spec_of(changes)) for changes in ALONE[key])
    assert {stage for stage in STAGES if before[stage] != after[stage]} == stages | {"report"}


UNDER_HEAD = {"fit", "check"}  # which hold the envelope against what is milled around the passes
FACED = {"stock.face": {"above_mm": 0.5}, "stock.cut_out": {"radius_mm": 0.5, "tabs": 1, "tab_width_mm": 1.0}}


@pytest.mark.parametrize(
    ("changes", "stages"),
    [
        ({"stock.face": {"above_mm": 0.6}}, {"pass-face", *UNDER_HEAD}),
        ({"stock.cut_out": {"radius_mm": 0.5, "tabs": 2, "tab_width_mm": 1.0}}, {"pass-cut-out", *UNDER_HEAD}),
        ({"machine.warm_up_s": 9.0}, {"pass-face", "check"}),
        ({"machine.coolant": "flood"}, {"pass-face", "pass-1", "pass-2", "pass-cut-out", "check"}),
        ({"passes.1.pitch_mm": 0.3}, {"pass-2", "check", "as-milled"}),
        ({"optics.throw_mm": 21.0}, {"map", "caustic", "as-milled"}),
    ],
)
def test_what_is_milled_around_the_passes_depends_on_the_block_and_not_on_the_lens(
    changes: dict[str, Any], stages: set[str]
) -> None:
    before, after = keys_of(spec_of(FACED)), keys_of(spec_of({**FACED, **changes}))
    assert {stage for stage in before if before[stage] != after[stage]} == stages | {"report"}


WITNESSED = {**FACED, "finish": FELT}


@pytest.mark.parametrize(
    "changes",
    [
        {"finish": {**FELT, "minutes": 3.0}}, {"passes.1.radius_mm": 2.75}, {"passes.1.feed_mm_per_min": 900.0},
        {"stock.margin_mm": 2.5}, {"stock.skim_mm": 0.15}, {"stock.clamps": [CLAMP]}, {"machine.step_mm": 0.01},
        {"machine.z_noise_mm": 0.001}, {"machine.travel_mm": [190.0, 190.0, 55.0]}, {"machine.safe_z_mm": 6.0},
        {"stock.cut_out": {"radius_mm": 0.4, "tabs": 1, "tab_width_mm": 1.0}}, {"optics.outline": "ellipse"},
    ],
    ids=lambda changes: next(iter(changes)),
)  # fmt: skip
def test_witness_marks_depend_on_all_that_their_place_and_shape_follow_from(changes: dict[str, Any]) -> None:
    before, after = keys_of(spec_of(WITNESSED)), keys_of(spec_of({**WITNESSED, **changes}))
    assert before["pass-witness"] != after["pass-witness"]


def test_witness_marks_do_not_depend_on_picture_and_wall() -> None:
    others = {"image.pixels": 20, "optics.throw_mm": 25.0, "optics.corrections": 1}
    before, after = keys_of(spec_of(WITNESSED)), keys_of(spec_of({**WITNESSED, **others}))
    assert before["pass-witness"] == after["pass-witness"]


@pytest.mark.parametrize(
    ("light", "stages"),
    [
        ({"kind": "collimated"}, {"heightfield", "fit", "pass-1", "pass-2", "check"}),
        ({"kind": "sun"}, {"map", "caustic", "as-milled", "heightfield", "fit", "pass-1", "pass-2", "check"}),
        (POINT["optics.light"], {"map", "caustic", "as-milled", "heightfield", "fit", "pass-1", "pass-2", "check"}),
    ],
)
def test_the_block_s_thickness_is_the_lens_s_business_where_light_slants(
    light: dict[str, Any], stages: set[str]
) -> None:
    before, after = (
        keys_of(spec_of({"optics.light": light, "stock.thickness_mm": thickness})) for thickness in (20.0, 25.0)
    )
    assert {stage for stage in STAGES if before[stage] != after[stage]} == stages | {"report"}


def test_a_branch_that_is_chosen_looks_at_the_block() -> None:
    before, after = (
        keys_of(spec_of({"optics.branch": "auto", "stock.thickness_mm": thickness})) for thickness in (20.0, 25.0)
    )
    assert before["map"] != after["map"]
    assert before["caustic"] == after["caustic"]


def test_the_ball_of_the_finish_pass_shapes_the_lens_unless_the_person_said_another() -> None:
    before, after = (
        keys_of(spec_of({"optics.min_radius_mm": None, "passes.1.radius_mm": radius})) for radius in (3.0, 2.5)
    )
    assert {stage for stage in STAGES if before[stage] != after[stage]} == {
        "map", "fit", "pass-2", "check", "as-milled", "report",
    }  # fmt: skip


def test_a_further_pass_leaves_those_before_the_last_alone() -> None:
    short = resolve_spec(base={**BASE, "passes": [BASE["passes"][0], BASE["passes"][0], BASE["passes"][1]]})
    outputs = {file: FileRef(file, 1) for file in FILES}
    keys = {
        stage: stage_key(stage, look_up(short), image_sha256="a", image_name="a.png", outputs=outputs)
        for stage in plan(short)
    }
    for stage in ("image", "irradiance", "map", "heightfield", "caustic"):
        unchanged = stage_key(stage, look_up(spec_with()), image_sha256="a", image_name="a.png", outputs=outputs)
        assert keys[stage] == unchanged


@given(st.sets(st.sampled_from(KEYS)))
def test_a_key_changes_exactly_with_the_declared_part_of_the_spec(keys: set[str]) -> None:
    before, after = facts_of(look_up(spec_with())), facts_of(look_up(spec_with(*keys)))
    expected = {stage for stage in STAGES if any(part_of(before, k) != part_of(after, k) for k in stage_of(stage).spec)}
    assert changes(changed=keys) == expected


@given(st.sets(st.sampled_from(FILES)))
def test_a_key_changes_exactly_with_the_files_that_the_stage_reads(files: set[str]) -> None:
    expected = {stage for stage in STAGES if (stage_of(stage).sheet and files) or set(reads(stage, FILES)) & files}
    assert changes(files=files) == expected


def test_the_picture_counts_once_and_its_name_on_the_sheet_only() -> None:
    assert changes(image="b") == {"image"}
    assert changes(name="b.png") == {"report"}


@given(st.sets(st.sampled_from(KEYS)))
def test_shares_are_parts_of_a_whole(keys: set[str]) -> None:
    spec = spec_with(*keys)
    parts = shares(spec)
    assert tuple(parts) == plan(spec)
    assert min(parts.values()) > 0
    assert sum(parts.values()) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> StagedJob:
    return staged_job(tmp_path_factory.mktemp("base"), spec=spec_with()).run_all()


def undeclared(job: StagedJob, stage: str) -> list[str]:
    """Keys of the spec on which a stage does not depend, by its own row."""
    before = part_values(stage, ())
    return [key for key in KEYS if part_values(stage, (key,)) == before]


def part_values(stage: str, keys: Iterable[str]) -> list[Any]:
    facts = facts_of(look_up(spec_with(*keys)))
    return [part_of(facts, key) for key in stage_of(stage).spec]


@pytest.mark.thorough
@pytest.mark.parametrize("stage", [stage for stage in STAGES if stage != "report"])
def test_what_a_stage_does_not_declare_does_not_show_in_what_it_makes(job: StagedJob, stage: str) -> None:
    """The law that makes reuse safe: with all undeclared keys changed at once, the bytes are the same."""
    others = undeclared(job, stage)
    assert others
    inputs = _files_before(job, stage)
    order = replace(
        job.order(stage),
        spec=spec_with(*others).plain(),
        image_name="another name.png",
        inputs=inputs,
        report={"passes": _rows(job)} if stage in ("check", "as-milled") else {},
        notes={"optics": ["something else"]},
        job_id="another",
        attempt=7,
        scratch=str(job.scratch / "elsewhere" / stage),
    )
    result = run_order(order, job.store, lambda share: None)
    assert hashes(result.outputs) == hashes(job.results[stage].outputs), others
    assert _said(result) == _said(job.results[stage]), others
    key = stage_key(stage, look_up(spec_with(*others)), image_sha256=job.image_sha256, image_name="x", outputs=inputs)
    assert key == job.keys[stage]


@pytest.mark.thorough
def test_the_bytes_do_not_depend_on_the_number_of_processors(job: StagedJob, tmp_path: Path) -> None:
    """Another process, bound to one processor, with another seed of hashes."""
    code = (
        "import json, os, sys; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from pathlib import Path\n"
        "from tests.service.job.stages.jobs import hashes, staged_job\n"
        "from tests.service.job.stages.variants import spec_with\n"
        "job = staged_job(Path(sys.argv[1]), spec=spec_with()).run_all()\n"
        "print(json.dumps([job.keys, hashes(job.outputs)]))"
    )
    root = Path(__file__).parents[4]
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True, cwd=root
    )
    keys, files = json.loads(done.stdout)
    assert keys == job.keys
    own_of_a_run = {"report.json", "report.html", "report-de.html", "report-ja.html"}
    assert {k: v for k, v in files.items() if k not in own_of_a_run} == {
        name: ref.sha256 for name, ref in job.outputs.items() if name not in own_of_a_run
    }


@pytest.mark.thorough
@pytest.mark.parametrize(
    "module", ["service.job.stages.lens", "service.job.stages.programs", "service.job.stages.check"]
)
def test_the_sources_in_a_key_are_all_that_python_loads(module: str) -> None:
    code = (
        f"import sys, {module}\n"
        "print(*(n for n in sys.modules if n.split('.')[0] in ('optics', 'cam', 'machines', 'service')))"
    )
    root = Path(__file__).parents[4]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root, env=environment
    )
    assert set(done.stdout.split()) <= modules_used(module)


def test_jobs_that_begin_at_once_find_the_same_sources() -> None:
    """Each slot of a worker is a thread, and two that parse Python at once can fail (issue 106905 of CPython).

    Here each is made to let the others go on, again and again, in the middle of its parsing.
    """
    script = (
        "import gc, time\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from service.processes.source_tree import state_of_sources\n"
        "gc.callbacks.append(lambda *_: time.sleep(0))\n"
        "gc.set_threshold(50)\n"
        "with ThreadPoolExecutor(4) as slots:\n"
        "    print(*slots.map(state_of_sources, ['service.job.stages.run'] * 4))\n"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert found.stderr == ""
    assert found.stdout.split() == [state_of_sources("service.job.stages.run")] * 4


_PLANNING = """
from service.job.spec.loading import resolve_job
from service.job.stages.table import plan, stage_key
stage_key('image', resolve_job(), image_sha256='a', image_name='b', outputs={})
"""


@pytest.mark.parametrize(
    ("modules", "code", "heavy"),
    [
        (("table", "order"), _PLANNING, {"numpy", "numba", "scipy", "PIL", "matplotlib", "trimesh", "rich"}),
        (("check",), "", {"scipy.ndimage", "scipy.spatial", "scipy.special", "matplotlib", "optics.transport"}),
    ],
    ids=["the API and the worker, which plan", "the check, which reads programs"],
)
def test_what_a_process_does_not_use_is_not_loaded(modules: Sequence[str], code: str, heavy: set[str]) -> None:
    imports = ", ".join(f"service.job.stages.{module}" for module in modules)
    code = f"import sys, {imports}\n{code}\nprint(*({heavy} & set(sys.modules)))"
    root = Path(__file__).parents[4]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.split() == []


def _files_before(job: StagedJob, stage: str) -> dict[str, FileRef]:
    earlier = STAGES[: STAGES.index(stage)]
    return {name: ref for before in earlier for name, ref in job.results[before].outputs.items()}


def _rows(job: StagedJob) -> list[Any]:
    return [row for stage in STAGES for row in job.results[stage].report.get("passes", [])]


def _said(result: StageResult) -> Any:
    own_of_a_run = ("timings_s", "peak_rss_mb")
    return {k: v for k, v in result.report.items() if k not in own_of_a_run}, result.notes
