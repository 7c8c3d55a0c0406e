"""The last stage: report.json, and the setup sheet report.html made from it."""

from __future__ import annotations

from dataclasses import asdict

from service import job_files
from service.passes import machine_of
from service.report import render_report
from service.workshop import Workshop, peak_rss_mb, versions


def report_stage(shop: Workshop) -> None:
    """Complete the report and write both files; report.json comes last and says that the job is whole."""
    report = shop.report
    report.setdefault("passes", [])
    report["warnings"] = shop.warnings
    report["warnings_by_part"] = {part: list(sentences) for part, sentences in shop.notes.items()}
    report["timings_s"] = dict(shop.watch.timings_s)
    report["peak_rss_mb"] = peak_rss_mb()
    report["versions"] = versions()
    spec = shop.spec.plain()
    spec["machine"] = {**asdict(machine_of(shop.spec)), **spec["machine"]}
    files = {path.name for path in shop.folder.iterdir()} | {job_files.REPORT, job_files.REPORT_PAGE}
    page = render_report(report, spec=spec, files=files)
    job_files.write_bytes(shop.folder / job_files.REPORT_PAGE, page.encode())
    job_files.write_json(shop.folder / job_files.REPORT, report)
