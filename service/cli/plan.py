"""The command `plan`: plan a picture or a folder; print a table or JSON, write a picture and a spec."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cam.passes import PassSpec
from cam.planning.planner import Candidate
from service.cli.summary import target_line
from service.errors import InputError
from service.job import arrays
from service.job import files as job_files
from service.job.errors import translate_errors
from service.job.picture import OWN_PICTURE
from service.job.planning.plan import Planned
from service.job.planning.plan_report import plan_figures
from service.job.planning.planner import plan_for_lens, plan_for_picture
from service.job.planning.sentences import blur_warnings, reasons
from service.job.spec.lens_task import facts_of_light
from service.job.spec.loading import default_layer, load_stored_spec, override_machine, read_spec_file, resolve_job
from service.job.spec.model import JobSpec
from service.job.spec.resolve import ResolvedJob
from service.job.spec.tools import load_tools
from service.wording import RECOGNISABLE_DB, align, duration, likeness_in_words


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanRequest:
    """goal: hours, blur_mm, psnr_db, of which one may be given."""

    source: Path
    machine: str | None
    goal: dict[str, float | None]
    tools: Path | None
    output: Path | None
    spec: Path | None
    overrides: tuple[str, ...]


def run_plan(request: PlanRequest, *, as_json: bool) -> Iterator[str]:
    """Plan, write picture and spec if asked for, and print the result."""
    if request.output is not None and request.output.suffix.lower() != ".png":
        raise InputError(f"--output: {request.output} must end in .png; the spec is written beside it, in .toml")
    with translate_errors():
        job, make = _prepare_plan(request)
        if not as_json:
            yield target_line(job.spec)
        planned = make()
    spec = job.spec
    fragment = spec_fragment(planned, spec)
    written = []
    if request.output is not None:
        from service.job.report.figures.plan import plan_png

        pictured = plan_png(planned, viewed_from=spec.optics.viewed_from)
        beside = request.output.with_suffix(".toml")
        job_files.write_bytes(request.output, pictured)
        job_files.write_bytes(beside, fragment.encode())
        written = [f"picture: {request.output}", f"spec: {beside} (causticmill make --spec {beside})"]
    if as_json:
        yield json.dumps({**plan_figures(planned), "light": facts_of_light(spec)}, indent=2)
        return
    yield from table(planned)
    yield f"under {facts_of_light(spec)['words']}"
    yield ""
    yield from reasons(planned)
    yield from (f"warning: {sentence}" for sentence in blur_warnings(planned))
    if request.source.is_file() and planned.score(planned.chosen).seen_db < RECOGNISABLE_DB:
        yield from _suggest_changes(job, request.source)
    yield from (written or ["", *fragment.splitlines()])


def _suggest_changes(job: ResolvedJob, picture: Path) -> Iterator[str]:
    from service.job.planning.estimate import suggest_changes

    found = sorted(suggest_changes(job, picture, limits=OWN_PICTURE), key=lambda one: -one[1]["psnr_db"])
    yield "what shows more:" if found else "no single change shows clearly more"
    for change, seen in found:
        values = " ".join(
            f"--set {key}={value:g}" if isinstance(value, float) else f"--set {key}={value}"
            for key, value in change.values.items()
        )
        yield (
            f"  {change.what}: {likeness_in_words(seen['seen_db'])} ({seen['psnr_db']:.1f} dB), details from "
            f"{seen['smallest_detail_mm']:.2g} mm, {duration(3600 * seen['hours'])} ({values})"
        )


def _prepare_plan(request: PlanRequest) -> tuple[ResolvedJob, Callable[[], Planned]]:
    """Return the job, and the function that plans it."""
    if request.source.is_dir():
        base: dict[str, Any] = {**load_stored_spec(request.source).plain(), "preset": "recommended"}
        base.pop("passes", None)
        job = _resolve_plan_job(request, base)
        lens = arrays.load_heightfield(request.source / job_files.HEIGHTFIELD)
        target = arrays.load_target(request.source / job_files.MAP)
        return job, lambda: plan_for_lens(job, lens, target)
    from service.job.picture.reading import read_picture
    from service.job.planning.preparation import aim_at_picture

    job = _resolve_plan_job(request, default_layer(file=request.spec, preset=None, overrides=request.overrides))
    spec = job.spec
    width_mm, height_mm = spec.optics.screen_size_mm
    picture = read_picture(request.source, spec.image, rows=spec.pixel_rows, aspect=width_mm / height_mm)
    return job, lambda: plan_for_picture(job, aim_at_picture(spec, picture.linear).target)


def _resolve_plan_job(request: PlanRequest, base: dict[str, Any]) -> ResolvedJob:
    """Resolve the job to plan from the given options, with its passes left open."""
    given = read_spec_file(request.spec) if request.spec is not None else {}
    given.pop("passes", None)
    goal = {key: value for key, value in request.goal.items() if value is not None}
    overrides = [*request.overrides, *(f"plan.{key}={value!r}" for key, value in goal.items())]
    overrides = [*override_machine(request.machine), *overrides]
    merged = {**base, **given, "preset": "recommended"}
    job = resolve_job(base=merged, overrides=overrides)
    if request.tools is None:
        return job
    return replace(job, figures=replace(job.figures, tools=load_tools(request.tools)))


def table(planned: Planned) -> Iterator[str]:
    """Yield the best plans by time; the chosen one is marked."""
    head = ("", "TIME", "PSNR dB", "SSIM", "BLUR mm", "px", "FINISH", "REST", "BEFORE")
    rows = [head, *(_row(planned, one) for one in planned.plan.front)]
    if all(one.rest is None for one in planned.plan.front):
        rows = [(*row[:-2], row[-1]) for row in rows]
    yield from align(rows)
    for name, why in planned.plan.left_out:
        yield f"without {name}: {why}"


def _row(planned: Planned, one: Candidate) -> tuple[str, ...]:
    finish = one.finish
    rows = "contours" if finish.strategy == "contour" else f"rows along {finish.direction.upper()}"
    return (
        "->" if one is planned.chosen else "",
        duration(3600 * one.hours),
        f"{one.psnr_db:.1f}",
        f"{planned.score(one).ssim:.3f}",
        f"{one.blur_mm:.2f}",
        f"{planned.blur_px(one):.1f}",
        f"R{finish.radius_mm:g} / {finish.pitch_mm:g}, {rows}",
        _balls([] if one.rest is None else [one.rest.spec]),
        _balls(one.before),
    )


def _balls(passes: Sequence[PassSpec]) -> str:
    return ", ".join(f"R{spec.radius_mm:g} / {spec.pitch_mm:g}" for spec in passes)


def spec_fragment(planned: Planned, spec: JobSpec) -> str:
    """Return TOML for `make --spec`: the given values of the lens and the chosen passes."""
    usual = JobSpec(passes=(), preset="recommended").model_dump(mode="json", exclude_none=True)
    data = spec.plain()
    lines = [
        "# Made by `causticmill plan`.",
        *(f"# {sentence}" for sentence in reasons(planned)),
        'preset = "recommended"',
    ]
    tables: dict[str, dict[str, Any]] = {name: {} for name in ("image", "optics", "stock", "machine", "finish")}
    for name, found in tables.items():
        found.update({key: value for key, value in data.get(name, {}).items() if usual[name].get(key) != value})
    fragment = planned.fragment()
    for name in ("optics", "machine", "finish"):
        tables[name].update(fragment[name])
    for name, values in tables.items():
        lines += _toml_table(name, values)
    for row in fragment["passes"]:
        lines += ["", "[[passes]]", *(f"{key} = {json.dumps(value)}" for key, value in row.items())]
    return "\n".join(lines) + "\n"


def _toml_table(name: str, values: dict[str, Any]) -> Sequence[str]:
    if not values:
        return []
    plain = {key: value for key, value in values.items() if not isinstance(value, dict)}
    below = {key: value for key, value in values.items() if isinstance(value, dict)}
    lines = ["", f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in plain.items())]
    for key, value in below.items():
        lines += _toml_table(f"{name}.{key}", value)
    return lines
