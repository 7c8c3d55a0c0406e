"""The last look at all programs together: each read as the mill's streamer will read it, and drawn from its text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cam.passes import PassSpec, Stock
from cam.reading.gcode import LANGUAGES, read_parts
from machines.errors import ProgramRefusedError
from machines.preflight.limits import MillLimits, limits_of
from service.errors import FailedError
from service.job.files import TOOLPATH, files_of_pass, names_of_pass, path_name, programs_in_order, read_chunks
from service.job.page_data.path import PathDrawing
from service.job.report.figures.contour_sample import ContourSample
from service.job.report.figures.path_sample import PathSample
from service.job.spec.kinematics import kinematics_of
from service.job.spec.resolve import cam_passes_of, cam_stock_of
from service.job.stages.context import Workshop
from service.milling.preflight_child import examine


def final_check(shop: Workshop) -> None:
    """FailedError unless the job's mill may run every program, and each is the one that was simulated; toolpath.png."""
    rows = shop.so_far["passes"]
    limits = limits_of(shop.machine)
    with shop.watch.stage("pre-flight") as reached:
        files = [file for row in programs_in_order(shop.so_far) for file in files_of_pass(row)]
        for number, (name, sha256) in enumerate(files):
            for warning in _warnings(shop.folder / name, sha256, limits, _part(reached, number, len(files))):
                shop.note("passes", f"{name}: {warning}")
    _draw(shop, [[shop.folder / name for name in names_of_pass(row)] for row in rows])


def _warnings(path: Path, sha256: str, limits: MillLimits, on_share: Callable[[float], None]) -> tuple[str, ...]:
    try:
        found = examine(path, limits, on_share)
    except ProgramRefusedError as error:
        raise FailedError(f"{path.name}: {error}") from error
    if found.sha256 != sha256:
        raise FailedError(f"{path.name}: is not the program that was checked; its content has changed since")
    return found.warnings


def _draw(shop: Workshop, programs: list[list[Path]]) -> None:
    """toolpath.png and, for the operator page, pass-N.path: drawn from the text of the programs."""
    from service.job.report.figures import paths as figures_paths  # what it stands on is slow to import

    stock = cam_stock_of(shop.spec)
    with shop.watch.stage("toolpath picture") as reached:
        samples = []
        for number, (paths, spec) in enumerate(zip(programs, cam_passes_of(shop.spec), strict=True), 1):
            sample = _sample(number, spec, stock)
            _follow(shop, paths, number, sample)
            samples.append(sample)
            reached(number / (len(programs) + 1))
        picture = figures_paths.toolpath_png(
            samples,
            width_mm=stock.width_mm,
            height_mm=stock.height_mm,
            margin_mm=stock.margin_mm,
            outline_mm=shop.spec.optics.outline_mm,
        )
        shop.save(TOOLPATH, picture)


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


def _follow(shop: Workshop, paths: list[Path], number: int, sample: PathSample) -> None:
    """Read the programs of a pass once, for both drawings."""
    stock, machine = cam_stock_of(shop.spec), shop.machine
    side_mm = max(stock.width_mm, stock.height_mm)
    with PathDrawing(shop.folder, kinematics=kinematics_of(machine), side_mm=side_mm) as drawing:
        for batch in read_parts(map(read_chunks, paths), LANGUAGES[machine.dialect]):
            seen = batch.is_rapid | batch.spindle_on  # without a trace in the air, which cuts nothing
            sample.add(batch.start_mm[seen], batch.end_mm[seen], batch.is_rapid[seen])
            if shop.is_shown:
                drawing.add(batch)
        if shop.is_shown:
            drawing.write(shop.folder / path_name(number), _facts(shop, number))


def _facts(shop: Workshop, number: int) -> dict[str, Any]:
    """What stands at the beginning of pass-N.path."""
    settings, row = shop.spec.passes[number - 1], shop.so_far["passes"][number - 1]
    keys = {"name", "strategy", "direction", "pitch_mm", "radius_mm", "feed_mm_per_min", "stock_to_leave_mm"}
    programs = [{"file": part["file"], "lines": part["lines"]} for part in row.get("parts") or [row]]
    return {"pass": number, **settings.model_dump(mode="json", include=keys), "programs": programs}


def _part(reached: Callable[[float], None], number: int, count: int) -> Callable[[float], None]:
    return lambda share: reached((number + share) / count)
