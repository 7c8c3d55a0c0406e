"""The last two stages. The first reads all programs as the mill's streamer will and draws them from their text. The
second writes spec.json, report.json, and the setup sheet made from them, complete and as one page for the mill.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cam.duration import Kinematics
from cam.passes import PassSpec, Stock
from cam.reading.gcode import LANGUAGES as DIALECTS
from cam.reading.gcode import read_parts
from machines.errors import ProgramRefusedError
from machines.preflight.preflight import MillLimits, Preflight, limits_of
from phrases.phrase import Phrase
from service.errors import FailedError
from service.job import files as job_files
from service.job.files import (
    ENVELOPE,
    TOOLPATH,
    files_of_pass,
    names_of_pass,
    path_name,
    programs_in_order,
    read_chunks,
)
from service.job.page_data.path import PathDrawing
from service.job.report.envelope import describe_envelope
from service.job.report.figures.path_sample import ContourSample, PathSample
from service.job.spec.finish_library import instruct_finishing
from service.job.spec.resolve import cam_passes_of, cam_stock_of, warn_of_removal
from service.job.stages.context import THE_PICTURE, StageContext, peak_rss_mb, versions
from service.job.stages.one_program import write_one_program
from service.job.stages.order import merge_notes, merge_reports
from service.job.stages.restarts import list_restarts
from service.milling.preflight_child import examine


def run_final_check(context: StageContext) -> None:
    """Raise FailedError unless the job's mill may run every program, and each is the one simulated; draw
    toolpath.png.
    """
    rows = context.so_far["passes"]
    limits = limits_of(context.machine)
    for sentence in warn_of_removal(context.spec, context.machine):
        context.note("passes", sentence)
    asked = frozenset({"stops"} if context.machine.optional_stop else ())
    with context.watch.stage("pre-flight") as on_progress:
        found: dict[str, Preflight] = {}
        files = [file for row in programs_in_order(context.so_far) for file in files_of_pass(row)]
        for number, (name, sha256) in enumerate(files):
            found[name] = _examine(context.folder / name, sha256, limits, _part(on_progress, number, len(files)))
            for one in found[name].findings:
                if one.code not in asked:
                    context.note("passes", Phrase("{file}: {warning}", file=name, warning=one.words))
        if context.machine.one_program:
            whole = write_one_program(context.folder, context.so_far, context.machine)
            _examine(context.folder / whole["file"], whole["sha256"], limits, lambda share: None)
            context.report["one_program"] = whole
        context.report["restarts"] = {
            name: list_restarts(context.folder / name, found[name], spec, context.machine)
            for row, spec in zip(rows, cam_passes_of(context.spec), strict=True)
            for name in names_of_pass(row)
        }
    _draw_envelope(context)
    _draw(context, [[context.folder / name for name in names_of_pass(row)] for row in rows])


def _draw_envelope(context: StageContext) -> None:
    """Put table and head into the report, and draw them with the tool that sticks out farthest."""
    from service.job.report.figures.envelope import envelope_png  # its dependencies are slow to import

    figures, envelope, reaches = describe_envelope(context.spec, context.machine, context.so_far)
    context.report["envelope"] = figures
    file = max(reaches, key=lambda name: figures["stick_out_mm"][name])
    base_mm = figures["base_mm"][0] if envelope.base_mm is None else envelope.base_mm
    picture = envelope_png(envelope, reaches[file], file=file, machine=context.machine.name, base_mm=base_mm)
    context.save(ENVELOPE, picture)


def _examine(path: Path, sha256: str, limits: MillLimits, on_share: Callable[[float], None]) -> Preflight:
    """Return the pre-flight of a program; FailedError if a mill may not run it, or it is not the one simulated."""
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
    return found


def _draw(context: StageContext, programs: list[list[Path]]) -> None:
    """Draw toolpath.png and, for the operator page, pass-N.path, from the text of the programs."""
    from service.job.report.figures.paths import toolpath_png  # its dependencies are slow to import

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
    with PathDrawing(context.folder, kinematics=Kinematics.of(machine), side_mm=side_mm) as drawing:
        for batch in read_parts(map(read_chunks, paths), DIALECTS[machine.dialect]):
            seen = batch.is_rapid | batch.spindle_on  # without a trace in the air, which cuts nothing
            sample.add(batch.start_mm[seen], batch.end_mm[seen], batch.is_rapid[seen])
            if context.is_shown:
                drawing.add(batch)
        if context.is_shown:
            drawing.write(context.folder / path_name(number), _facts(context, number))


def _facts(context: StageContext, number: int) -> dict[str, Any]:
    """Return the facts for the header of pass-N.path."""
    settings, row = context.spec.passes[number - 1], context.so_far["passes"][number - 1]
    keys = {"name", "strategy", "direction", "pitch_mm", "radius_mm", "feed_mm_per_min", "stock_to_leave_mm"}
    programs = [{"file": part["file"], "lines": part["lines"]} for part in row.get("parts") or [row]]
    return {"pass": number, **settings.model_dump(mode="json", include=keys), "programs": programs}


def _part(on_progress: Callable[[float], None], number: int, count: int) -> Callable[[float], None]:
    return lambda share: on_progress((number + share) / count)


def run_report(context: StageContext) -> None:
    """Complete the report and write the files; report.json comes last and marks the job as complete."""
    from service.job.report.setup_pdf import SHOWN, render_setup_pdf  # drawing and optics are slow to import
    from service.job.report.setup_sheet import LANGUAGES, describe_setup, render_page

    notes = merge_notes(({"optics": [], "passes": []}, context.earlier_notes))
    by_part = {
        part: [sentence.replace(THE_PICTURE, context.picture_name) for sentence in sentences]
        for part, sentences in notes.items()
    }
    context.report.update(
        {
            "phrases": _with_name(context.so_far.get("phrases", {}), context.picture_name),
            "passes": [],
            "warnings": [sentence for sentences in by_part.values() for sentence in sentences],
            "warnings_by_part": by_part,
            "peak_rss_mb": peak_rss_mb(),
            "versions": versions(),
        }
    )
    if context.picture_name:
        context.report["source"] = {"file": context.picture_name}
    spec = context.spec.plain()
    area_mm2 = context.spec.optics.width_mm * context.spec.optics.height_mm
    if instructions := instruct_finishing(spec.get("finish", {}), context.job.figures.processes, area_mm2=area_mm2):
        context.report["finishing"] = instructions
    report = merge_reports((context.so_far, context.finish_report()))
    job_files.write_json(context.folder / job_files.SPEC, spec)
    spec["machine"] = {**asdict(context.machine), **spec["machine"]}
    files = {path.name for path in context.folder.iterdir()} | context.files | {job_files.REPORT, job_files.REPORT_PAGE}
    setup = describe_setup(report, spec=spec, files=files)
    context.save(job_files.REPORT_PAGE, render_page(setup).encode())
    for language in LANGUAGES if context.is_shown else ():
        context.save(job_files.page_in(language), render_page(setup, language).encode())
    name = next((name for name in SHOWN if (context.folder / name).is_file()), None)
    picture = None if name is None else (context.folder / name).read_bytes()
    context.save(job_files.SETUP_PDF, render_setup_pdf(setup, picture, beside=1 if name is None else SHOWN[name]))
    job_files.write_json(context.folder / job_files.REPORT, report)


def _with_name(phrases: Mapping[str, Mapping[str, Any]], picture_name: str) -> dict[str, Any]:
    """Return the phrases of notes on the picture with its name in its place."""
    return {
        text.replace(THE_PICTURE, picture_name): {**phrase, "values": {**phrase["values"], "picture": picture_name}}
        for text, phrase in phrases.items()
        if THE_PICTURE in text
    }
