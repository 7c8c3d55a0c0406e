"""The table of stages: what each reads, which part of the spec it depends on, and the function that does its work.

Theory of operation: the key of a stage is the hash of everything its outputs can depend on: our sources that it uses,
the versions of the libraries, its part of the spec, and the content of the files it reads. Two jobs with an equal key
have equal outputs, so that one of them need not be computed. So everything that a stage's function reads must be in its
row; a test runs each stage under specs that differ in everything else and requires the same bytes.

Nothing here imports arrays: the API and the worker only plan, and a stage's process computes. The progress of a job is
determined here, both for a folder of the command line and for a job of the server.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cache
from importlib import import_module
from importlib.metadata import version
from typing import Any

from service.job.spec.finish import NONE
from service.job.spec.model import USUAL_ROWS, JobSpec, PassRow
from service.job.spec.resolve import ResolvedJob, number_tools, tool_key, with_plan
from service.job.stages.order import FileRef, merge_notes, merge_reports
from service.processes.source_tree import state_of_sources

_BLOCK = (
    "optics.width_mm", "optics.height_mm", "stock.thickness_mm", "stock.margin_mm", "stock.clamps", "stock.clamping",
)  # fmt: skip
_UNDER_HEAD = (
    "stock.base_mm", "stock.skim_mm", "stock.face", "stock.cut_out", "machine.trace_outline",
    *(f"machine.{name}" for name in ("bed_to_collet_mm", "table_mm", "gantry_mm", "nose_mm", "guesses")),
)  # fmt: skip
_BENCH = (
    "optics.width_mm", "optics.height_mm", "screen_mm", "optics.screen_shift_x_mm", "optics.screen_shift_y_mm",
    "optics.throw_mm", "optics.refractive_index", "optics.surface", "optics.outline", "optics.light", "light_path_mm",
    "stock.material", "stock.haze_percent", "stock.back_flatness_mm", "stock.back_period_mm",
)  # fmt: skip
_KINEMATICS = tuple(
    f"machine.{name}"
    for name in (
        "dialect", "travel_mm", "max_rate_mm_per_min", "acceleration_mm_per_s2", "junction_deviation_mm",
        "planner_blocks", "lines_per_s", "safe_z_mm",
    )
)  # fmt: skip
_SETUP = tuple(
    f"machine.{name}"
    for name in (
        *("coolant", "work_offset", "blend_tolerance_mm", "high_precision", "top_z_mm", "tool_change", "optional_stop"),
        *("units", "number_every"),
    )
)
_LIMITS = ("machine.most_program_mb", "machine.most_program_hours")
_PROGRAMS = ("machine.step_mm", "machine.whole_steps", "finishes", *_LIMITS, *_SETUP)
_ALL_PROGRAMS = ("pass-*-*",)
MILLED_S_PER_M = 0.025
POLISH_S = 20.0  # of 512 x 512 pixels
REST_SHARE = 0.1  # share of the lens that a rest pass covers; a guess
PLAN_S = 12.0
AROUND_S = 2.0
AS_MILLED_S_PER_M = 0.06
AS_FINISHED_S_PER_M = 0.02
_READ_AS_CODE = (
    ("service.job.report.setup_sheet", "service/job/report/templates"),
    ("service.job.report.setup_sheet", "service/page/languages"),
    ("service.job.spec.finish_library", "service/job/spec/finishing.toml"),
)
_LIBRARIES = (
    "numpy", "scipy", "numba", "pyamg", "pillow", "trimesh", "manifold3d", "matplotlib", "fonttools", "jinja2",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """A row of the table.

    function : module:name, imported where the work is done
    reads    : names of files of earlier stages, with * for any characters
    spec     : dotted keys of `facts_of` that it depends on; "" is all of them
    picture  : reads the person's picture itself
    sheet    : states the names of all files and of the picture, and the hashes of the programs
    parts    : the parts that it times, by the beginnings of their names, with their shares of its time
    number   : of the pass, from 1; 0 for all others
    """

    name: str
    function: str
    reads: tuple[str, ...] = ()
    spec: tuple[str, ...] = ()
    picture: bool = False
    sheet: bool = False
    parts: tuple[tuple[str, float], ...] = ()
    number: int = 0

    def load(self) -> Callable[..., None]:
        """Return the function, taking a StageContext."""
        module, _, name = self.function.partition(":")
        found: Callable[..., None] = getattr(import_module(module), name)
        return found


_READING = ("image.pixels", "image.tone", "image.fit", "image.invert")
_LENS, _LIGHT = "service.job.stages.lens", "service.job.stages.light"
_BEFORE = (
    Stage(
        name="image",
        function=f"{_LENS}:run_image",
        picture=True,
        spec=(*_READING, "screen_mm"),
        parts=(("picture", 1.0),),
    ),
    Stage(
        name="irradiance",
        function=f"{_LENS}:run_irradiance",
        reads=(".picture.npz",),
        spec=("optics.viewed_from", "preparation"),
        parts=(("target", 1.0),),
    ),
    Stage(
        name="passes",
        function="service.job.stages.kept_plans:choose_passes",
        reads=(".target.npz",),
        spec=("optics", "stock", "plan", "machine", "tools", "finish"),
        parts=(("plan", 1.0),),
    ),
    Stage(
        name="map",
        function=f"{_LENS}:run_transport_map",
        reads=(".target.npz", ".original.npz", ".polished.npz"),
        spec=("optics", "finish", "stock.skim_mm", "stock.material", "light_path_mm", "block_for_branch_mm"),
        parts=(("lens", 1.0),),
    ),
    Stage(
        name="heightfield",
        function=f"{_LENS}:run_heightfield",
        reads=(".heights.npz",),
        spec=("stock.thickness_mm", "stock.margin_mm", "stock.step_file", "optics.outline"),
        parts=(("facts", 1.0),),
    ),
    Stage(
        name="caustic",
        function=f"{_LIGHT}:run_caustic",
        reads=("heightfield.npz", "map.npz"),
        spec=(*_BENCH, "optics.viewed_from", "finish"),
        parts=(("caustic", 0.5), ("tolerances", 0.5)),
    ),
    Stage(
        name="fit",
        function="service.job.stages.programs:run_fit",
        reads=("heightfield.npz",),
        spec=(
            *(*_BLOCK, *_UNDER_HEAD, "optics.min_radius_mm", "machine.travel_mm", "machine.safe_z_mm"),
            *(f"passes.*.{key}" for key in ("radius_mm", "corner_radius_mm", "flute_length_mm", "shank_radius_mm")),
            *(f"passes.*.{key}" for key in ("stick_out_mm", "stock_to_leave_mm", "step_down_mm")),
        ),
        parts=(("fit", 1.0),),
    ),
)
_PASS = Stage(
    name="pass-*",
    function="service.job.stages.programs:run_pass",
    reads=("heightfield.npz",),
    spec=(*_BLOCK, *_KINEMATICS, *_PROGRAMS, "stock.material"),
    parts=(("write", 0.3), ("check", 0.7)),
)
_AROUND = "service.job.stages.around"
_FACE = Stage(
    name="pass-face",
    function=f"{_AROUND}:run_facing",
    spec=("stock.face", "tools_around", *_BLOCK, *_KINEMATICS, *_LIMITS, *_SETUP, "beginning"),
    parts=(("write", 0.2), ("check", 0.8)),
)
_WITNESS = Stage(
    name="pass-witness",
    function=f"{_AROUND}:run_witness",
    reads=(".stock-last.npz",),
    spec=(
        *("finish", "passes", "stock.cut_out", "stock.skim_mm", "optics.outline", "optics.surface", "machine.step_mm"),
        *("machine.whole_steps", "machine.z_noise_mm", *_BLOCK, *_KINEMATICS, *_LIMITS, *_SETUP),
    ),
    parts=(("write", 0.2), ("check", 0.8)),
)
_CUT_OUT = Stage(
    name="pass-cut-out",
    function=f"{_AROUND}:run_cut_out",
    reads=(".stock-last.npz",),
    spec=(
        "stock.cut_out",
        "tools_around",
        "optics.outline",
        "programs_before_cut_out",
        *_BLOCK,
        *_KINEMATICS,
        *_LIMITS,
        *_SETUP,
    ),
    parts=(("write", 0.2), ("check", 0.8)),
)
_MILLED = (
    *_BENCH,
    "optics.viewed_from",
    "machine.dialect",
    "machine.step_mm",
    "machine.z_noise_mm",
    "machine.screw_error_mm",
    "machine.screw_lead_mm",
    "finish",
    *(f"passes.*.{key}" for key in ("radius_mm", "pitch_mm", "stock_to_leave_mm", "strategy", "direction")),
)
_PIT = ("stock.margin_mm", "stock.material", "passes.*.corner_radius_mm", "passes.*.where")
_AFTER = (
    Stage(
        name="check",
        function="service.job.stages.check:run_final_check",
        reads=_ALL_PROGRAMS,
        spec=("passes", "machine", "optics.outline", "stock.material", *_BLOCK, *_UNDER_HEAD),
        parts=(("pre-flight", 0.35), ("toolpath", 0.65)),
    ),
    Stage(
        name="as-milled",
        function="service.job.stages.as_milled:run_as_milled",
        reads=("heightfield.npz", "map.npz", *_ALL_PROGRAMS),
        spec=_MILLED,
        parts=(("as milled: surface", 0.15), ("as milled: light", 0.7), ("as milled: causes", 0.15)),
    ),
    Stage(
        name="as-finished",
        function="service.job.stages.as_finished:run_as_finished",
        reads=("heightfield.npz", "map.npz", *_ALL_PROGRAMS),
        spec=(*_MILLED, *_PIT),
        parts=(("as finished: surface", 0.5), ("as finished: light", 0.15), ("as finished: tolerance", 0.35)),
    ),
    Stage(
        name="report",
        function="service.job.stages.check:run_report",
        reads=(
            "target.png",
            "caustic.png",
            "caustic-as-milled.png",
            "caustic-as-finished.png",
            "finish-tolerance.png",
        ),
        spec=("",),
        sheet=True,
    ),
)
_ROWS = {stage.name: stage for stage in (*_BEFORE, _FACE, _WITNESS, _CUT_OUT, *_AFTER)}


def plan(spec: JobSpec) -> tuple[str, ...]:
    """Return the names of a job's stages, in order. If the passes are still to be planned, the names are those of
    typical passes; they are final after the stage `passes`: see `with_plan`.
    """
    passes = (f"pass-{number}" for number in range(1, len(_rows(spec)) + 1))
    before = (stage.name for stage in _BEFORE if stage.name != "passes" or spec.preset == "recommended")
    first = (_FACE.name,) if spec.stock.face is not None else ()
    witness = (_WITNESS.name,) if spec.finish.witnessed else ()
    last = (_CUT_OUT.name,) if spec.stock.cut_out is not None else ()
    after = (stage.name for stage in _AFTER if stage.name != "as-finished" or spec.finish.finishes)
    return (*before, *first, *passes, *witness, *last, *after)


def _rows(spec: JobSpec) -> tuple[PassRow, ...]:
    return spec.passes or USUAL_ROWS


def stage_of(name: str) -> Stage:
    """Return the row of a stage; KeyError if there is none."""
    kind, _, number = name.partition("-")
    if kind != "pass" or not number.isdecimal():
        return _ROWS[name]
    return _pass(int(number))


def is_of_programs(stage: str) -> bool:
    """Return whether a stage writes programs, or checks them or their tools."""
    return stage.startswith("pass-") or stage in ("fit", "check")


def _pass(number: int) -> Stage:
    """Return the stage of a pass, which cuts the stock that the pass before has left."""
    own = (*_PASS.spec, f"passes.{number - 1}")
    if number == 1:
        reads = (*_PASS.reads, ".stock-0.npz")
        spec = (*own, "faced", "own_beginning")
        return replace(_PASS, name="pass-1", number=1, spec=spec, reads=reads)
    reads = (*_PASS.reads, f".stock-{number - 1}.npz")
    return replace(_PASS, name=f"pass-{number}", number=number, spec=own, reads=reads)


def reads(stage: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return the files of earlier stages that a stage reads."""
    patterns = stage_of(stage).reads
    return tuple(name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns))


def shares(spec: JobSpec) -> dict[str, float]:
    """Return the part of the whole job's time that each stage takes; they add up to 1."""
    seconds = usual_seconds(spec)
    whole = sum(seconds.values())
    return {name: own / whole for name, own in seconds.items()}


def usual_seconds(spec: JobSpec) -> dict[str, float]:
    """Return the time of each stage on two cores for a 512 x 512 photograph. Passes are estimated by the length of
    their rows; the first metres cost most, because samples of long passes are limited.
    """
    pixels = spec.image.pixels * spec.pixel_rows / 512**2
    light = spec.optics.light
    beams = 4.0 if light.size_deg or light.size_mm else 1.0  # simulated light takes most of the time
    descent_s = POLISH_S if spec.optics.polish or spec.finish.finishes else 0.0
    method_s = (1.0 + 0.8 * spec.optics.corrections + descent_s) * beams
    method_s = method_s if spec.optics.method == "transport" else 30.0
    seconds = {
        "image": 0.1 + 0.1 * pixels,
        "irradiance": 0.1,
        "passes": PLAN_S if spec.preset == "recommended" else 0.0,
        "map": 0.1 + method_s * pixels,
        "heightfield": 0.7 + 0.8 * pixels,
        "caustic": 1.0 + 4.0 * beams * pixels,
        "fit": 0.2 + 0.2 * pixels,
        "check": 0.7,
        "as-milled": 1.0,
        "as-finished": 3.0 + 8.0 * pixels,
        "report": 0.1,
    }
    block = spec.optics.width_mm * spec.optics.height_mm / 100**2
    seconds[_FACE.name] = seconds[_WITNESS.name] = seconds[_CUT_OUT.name] = AROUND_S
    for number, row in enumerate(_rows(spec), 1):
        path_m = _path_m(spec, row) * (REST_SHARE if row.where == "rest" else 1.0)
        finishes = row.stock_to_leave_mm == 0
        layers_s = 3.5 + 8.0 * block if number == 1 else 1.5  # the first one takes off most
        seconds[f"pass-{number}"] = layers_s + (min(8.0, 0.25 * path_m) + 0.035 * path_m if finishes else 0.01 * path_m)
        seconds["check"] += 0.012 * path_m if finishes else 0.0
        seconds["as-milled"] += MILLED_S_PER_M * beams * path_m if finishes else 0.0
        seconds["as-milled"] += min(20.0, 0.6 * path_m) + AS_MILLED_S_PER_M * path_m if finishes else 0.0
        seconds["as-finished"] += AS_FINISHED_S_PER_M * path_m if finishes else 0.0
    return {name: seconds[name] for name in plan(spec)}


def _path_m(spec: JobSpec, row: PassRow) -> float:
    """Return the total length of a pass's rows in all layers."""
    around_mm = 2 * row.radius_mm
    return (spec.optics.width_mm + around_mm) * (spec.optics.height_mm + around_mm) / row.pitch_mm / 1000


def stage_key(
    stage: str, job: ResolvedJob, *, image_sha256: str, image_name: str, outputs: Mapping[str, FileRef]
) -> str:
    """Return the hash of everything on which the outputs of a stage can depend.

    outputs : files of the job's earlier stages by name; of them only those that the stage reads count.
    """
    row = stage_of(stage)
    facts = facts_of(job)
    names = outputs if row.sheet else reads(stage, outputs)
    depends = {
        "stage": stage,
        "sources": state_of_sources(row.function.partition(":")[0], _READ_AS_CODE),
        "libraries": libraries(),
        "spec": {key: part_of(facts, key) for key in row.spec},
        "files": {name: outputs[name].sha256 for name in names},
        "picture": image_sha256 if row.picture else None,
        "name": image_name if row.sheet else None,
    }
    return hashlib.sha256(json.dumps(depends, sort_keys=True, allow_nan=False).encode()).hexdigest()


def facts_of(job: ResolvedJob) -> dict[str, Any]:
    """Return the spec as data, with what follows from it: the screen size; the ball that the lens is shaped for; the
    block's thickness where light slants through it or a branch is chosen for it; all that a picture is prepared for,
    where it is; the figures of mill, tools and finish; whether the stock is
    faced; how the spindle is warmed up and which outline is traced in the air, in the job's first program, and in that
    of the first pass; and of each pass whether it is the last one, whose stock nothing reads, and whether a rest pass
    comes after it, which takes what it cannot reach.
    """
    spec = job.spec
    facts = spec.model_dump(mode="json")
    facts["screen_mm"] = list(spec.optics.screen_size_mm)
    if not spec.to_be_planned:
        facts["optics"]["min_radius_mm"] = spec.lens_radius_mm
    facts["light_path_mm"] = spec.stock.thickness_mm if spec.optics.light_crosses_block else None
    facts["block_for_branch_mm"] = spec.stock.thickness_mm if spec.optics.branch == "auto" else None
    is_prepared = spec.image.prepare != "none"
    facts["preparation"] = [facts["image"], facts["optics"], spec.stock.thickness_mm] if is_prepared else None
    process = spec.finish.process
    facts["finish_process"] = None if process == NONE else repr(job.figures.processes.get(process))
    facts["finishes"] = spec.finish.finishes
    facts["witness"] = facts["finish"].pop("witness")  # neither lens nor light depends on it
    facts["machine_as_given"] = facts["machine"]
    facts["machine"] = asdict(job.machine)
    facts["tools"] = [asdict(tool) for tool in job.figures.tools] if spec.to_be_planned else None
    facts["faced"] = spec.stock.face is not None
    warm_up_s, slowest_rpm = facts["machine"]["warm_up_s"], facts["machine"]["spindle_rpm"][0]
    warm_up = [warm_up_s, slowest_rpm] if warm_up_s else None
    facts["beginning"] = [warm_up, facts["optics"]["outline"] if facts["machine"]["trace_outline"] else None]
    facts["own_beginning"] = None if facts["faced"] else facts["beginning"]
    facts["programs_before_cut_out"] = len(facts["passes"]) + spec.finish.witnessed
    tools = number_tools(spec) if job.machine.tool_change else {}
    around = (spec.stock.face, spec.stock.cut_out)
    facts["tools_around"] = [None if one is None else tools.get(tool_key(one)) for one in around]
    for row, given in zip(facts["passes"], spec.passes, strict=True):
        row["tool"] = tools.get(tool_key(given))
        row["last"] = row is facts["passes"][-1] and not spec.goes_on_after_passes
    for number, row in enumerate(facts["passes"], 1):
        row["rest_follows"] = any(later["where"] == "rest" for later in facts["passes"][number:])
    return facts


def part_of(facts: Any, key: str) -> Any:
    """Return the value at a dotted key; * stands for each row of a list."""
    step, _, rest = key.partition(".")
    if not step:
        return facts
    if step == "*":
        return [part_of(row, rest) for row in facts]
    return part_of(facts[int(step) if isinstance(facts, list) else step], rest)


@cache
def libraries() -> dict[str, str]:
    """Return the versions of the libraries that make the numbers and pictures."""
    return {"python": platform.python_version(), **{name: version(name) for name in _LIBRARIES}}


@dataclass
class JobSoFar:
    """job: with its passes, once they are planned; report, notes: of the stages that are done, merged."""

    job: ResolvedJob
    report: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)

    def stages(self) -> Iterator[str]:
        """Yield every stage in order, each after the one before has been added. Planning only changes later stages."""
        done = 0
        while done < len(stages := plan(self.job.spec)):
            yield stages[done]
            done += 1

    def add(self, report: Mapping[str, Any], notes: Mapping[str, list[str]]) -> None:
        """Add the result of a stage."""
        self.report = merge_reports((self.report, report))
        self.notes = merge_notes((self.notes, notes))
        self.job = self.job.with_spec(with_plan(self.job.spec, self.report))
