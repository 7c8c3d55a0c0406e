"""The last look at all programs together: each read as the mill's streamer will read it, and drawn from its text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cam.passes import PassSpec, Stock
from cam.reading.gcode import LANGUAGES, read_parts
from machines.errors import ProgramRefusedError
from machines.preflight.preflight import MillLimits, limits_of
from phrases.phrase import Phrase
from service.errors import FailedError
from service.job.files import TOOLPATH, files_of_pass, names_of_pass, path_name, programs_in_order, read_chunks
from service.job.page_data.path import PathDrawing
from service.job.report.figures.contour_sample import ContourSample
from service.job.report.figures.path_sample import PathSample
from service.job.spec.kinematics import kinematics_of
from service.job.spec.resolve import cam_passes_of, cam_stock_of, warn_of_removal
from service.job.stages.context import StageContext
from service.milling.preflight_child import examine


def run_final_check(context: StageContext) -> None:
    """Raise FailedError unless the job's mill may run every program, and each is the one simulated; draw
    toolpath.png.
    """
    rows = context.so_far["passes"]
    limits = limits_of(context.machine)
    for sentence in warn_of_removal(context.spec, context.machine):
        context.note("passes", sentence)
    with context.watch.stage("pre-flight") as on_progress:
        files = [file for row in programs_in_order(context.so_far) for file in files_of_pass(row)]
        for number, (name, sha256) in enumerate(files):
            for warning in _warnings(context.folder / name, sha256, limits, _part(on_progress, number, len(files))):
                context.note("passes", Phrase("{file}: {warning}", file=name, warning=warning))
    _draw(context, [[context.folder / name for name in names_of_pass(row)] for row in rows])


def _warnings(path: Path, sha256: str, limits: MillLimits, on_share: Callable[[float], None]) -> tuple[str, ...]:
    try:
        found = examine(path, limits, on_share)
    except ProgramRefusedError as error:
        raise FailedError(Phrase("{name}: {cause}", name=path.name, cause=str(error))) from error
    if found.sha256 != sha256:
        raise FailedError(
            Phrase("{name}: is not the program that was checked; its content has changed since", name=path.name)
        )
    if found.faults:
        raise FailedError(*(Phrase("{name}: {fault}", name=path.name, fault=fault) for fault in found.faults))
    return found.warnings


def _draw(context: StageContext, programs: list[list[Path]]) -> None:
    """Draw toolpath.png and, for the operator page, pass-N.path, from the text of the programs."""
    from service.job.report.figures.paths import toolpath_png  # what it stands on is slow to import

    stock = cam_stock_of(context.spec)
    with context.watch.stage("toolpath picture") as on_progress:
        samples = []
        for number, (paths, spec) in enumerate(zip(programs, cam_passes_of(context.spec), strict=True), 1):
            sample = _sample(number, spec, stock)
            _follow(context, paths, number, sample)
            samples.append(sample)
            on_progress(number / (len(programs) + 1))
        picture = toolpath_png(
            samples,
            width_mm=stock.width_mm,
            height_mm=stock.height_mm,
            margin_mm=stock.margin_mm,
            outline_mm=context.spec.optics.outline_mm,
        )
        context.save(TOOLPATH, picture)


def _sample(number: int, spec: PassSpec, stock: Stock) -> PathSample:
    of_strategy = ContourSample if spec.strategy == "contour" else PathSample
    return of_strategy(
        label=f"pass {number} {spec.name}",
        pitch_mm=spec.pitch_mm,
        radius_mm=spec.radius_mm,
        width_mm=stock.width_mm,
        height_mm=stock.height_mm,
        along=spec.direction,
        everywhere=spec.where == "everywhere",
    )


def _follow(context: StageContext, paths: list[Path], number: int, sample: PathSample) -> None:
    """Read the programs of a pass once, for both drawings."""
    stock, machine = cam_stock_of(context.spec), context.machine
    side_mm = max(stock.width_mm, stock.height_mm)
    with PathDrawing(context.folder, kinematics=kinematics_of(machine), side_mm=side_mm) as drawing:
        for batch in read_parts(map(read_chunks, paths), LANGUAGES[machine.dialect]):
            seen = batch.is_rapid | batch.spindle_on  # without a trace in the air, which cuts nothing
            sample.add(batch.start_mm[seen], batch.end_mm[seen], batch.is_rapid[seen])
            if context.is_shown:
                drawing.add(batch)
        if context.is_shown:
            drawing.write(context.folder / path_name(number), _facts(context, number))


def _facts(context: StageContext, number: int) -> dict[str, Any]:
    """Return what stands at the beginning of pass-N.path."""
    settings, row = context.spec.passes[number - 1], context.so_far["passes"][number - 1]
    keys = {"name", "strategy", "direction", "pitch_mm", "radius_mm", "feed_mm_per_min", "stock_to_leave_mm"}
    programs = [{"file": part["file"], "lines": part["lines"]} for part in row.get("parts") or [row]]
    return {"pass": number, **settings.model_dump(mode="json", include=keys), "programs": programs}


def _part(on_progress: Callable[[float], None], number: int, count: int) -> Callable[[float], None]:
    return lambda share: on_progress((number + share) / count)
