"""The last stage: spec.json, report.json, and the setup sheet made from them, whole and as one page for the mill."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from service.job import files as job_files
from service.job.report.setup_pdf import SHOWN, render_setup_pdf
from service.job.report.setup_sheet import LANGUAGES, describe_setup, render_page
from service.job.spec.finish_library import instruct_finishing
from service.job.stages.context import THE_PICTURE, StageContext, peak_rss_mb, versions
from service.job.stages.order import merge_notes, merge_reports


def run_report(context: StageContext) -> None:
    """Complete the report and write the files; report.json comes last and says that the job is whole."""
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
