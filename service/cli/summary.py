"""The lines printed at the end of a command: key numbers, times, warnings, and the folder of the files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from machines.profile import load_profile
from service.job.files import REPORT_PAGE, programs_in_order
from service.job.spec.finish import BEST, NONE
from service.job.spec.model import JobSpec
from service.wording import ball, duration


def target_line(spec: JobSpec) -> str:
    """Return for which mill and which finish a job is planned or made: the first line of make and plan."""
    name = spec.machine.profile
    process = {NONE: "as it comes from the mill", BEST: "finished by hand, by the best process for it"}
    finish = process.get(spec.finish.process, f"finished by hand, by {spec.finish.process}")
    if spec.finish.process == NONE and spec.finish.k0_rad_per_mm is not None:
        finish = "finished by hand, by your own figures"
    return f"for the mill {name} ({load_profile(name).description}), {finish}"


def summary_lines(folder: Path, report: Mapping[str, Any]) -> Iterator[str]:
    optics = report.get("optics", {})
    if optics:
        yield _optics_line(optics)
        yield from _light_lines(optics)
    yield from _wall_lines(report)
    rows = programs_in_order(report)
    for row in rows:
        deepest = row["bounds"]["z"][0]
        parts = row.get("parts") or [row]
        names = row["file"] if len(parts) == 1 else f"{row['file']} to {parts[-1]['file']}"
        yield (
            f"{names}: {sum(part['lines'] for part in parts)} lines, "
            f"{row['path_length_mm'] / 1000:.1f} m, {duration(row['time_s'])}, "
            f"{row['entries']} entr{'y' if row['entries'] == 1 else 'ies'}, deepest Z {deepest:.3f} mm, checked"
        )
    if len(rows) > 1:
        yield f"machine time of all passes: {duration(sum(row['time_s'] for row in rows))}"
    if whole := report.get("one_program"):
        changes = len(whole["changes"])
        yield f"{whole['file']}: all of them in one program, {whole['lines']} lines, {changes} tool changes"
    for sentence in report.get("warnings", []):
        yield f"warning: {sentence}"
    made = "pictures, programs and" if report.get("passes") else "pictures and"
    yield f"{made} the setup sheet: {folder / REPORT_PAGE}"


def _wall_lines(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield the light on the wall: as milled, and as finished if the job has a finish."""
    for key, words in (("as_milled", "as milled"), ("as_finished", "as finished")):
        if (seen := report.get(key) or {}).get("psnr_db") is not None:
            detail_mm = seen.get("smallest_detail_mm")
            detail = "" if detail_mm is None else f", details from {detail_mm:.2g} mm"
            yield f"wall, {words}: PSNR {seen['psnr_db']:.1f} dB, SSIM {seen['ssim']:.3f}{detail}"


def _light_lines(optics: Mapping[str, Any]) -> Iterator[str]:
    """Yield the light of the scores, the picture's preparation, and the tolerances of the set-up."""
    done = []
    if light := optics.get("light"):
        done.append(f"all figures hold under {light['words']}")
    if closing := optics.get("closing"):
        lost = closing["psnr_db_without"] - closing["psnr_db_with"]
        done.append(f"shaped for a ball {ball(closing['radius_mm'])} ({-lost:+.1f} dB)")
    if polish := optics.get("polish"):
        done.append(f"polished ({polish['psnr_db_after'] - polish['psnr_db_before']:+.1f} dB)")
    if optics.get("dark_leak"):
        done.append(f"dark leak {100 * optics['dark_leak']:.2f} %")
    if optics.get("branch") == "inverted":
        done.append("rays cross before the screen")
    if done:
        yield "light: " + ", ".join(done)
    if tolerances := optics.get("tolerances"):
        near, far = tolerances["focus_range_mm"]
        yield f"set-up: 3 dB are lost with the wall {-near:.2g} mm too near or {far:.2g} mm too far"


def _optics_line(optics: Mapping[str, Any]) -> str:
    parts = []
    if optics.get("psnr_db") is not None:
        parts.append(f"PSNR {optics['psnr_db']:.1f} dB")
    if "ssim" in optics:
        parts += [f"SSIM {optics['ssim']:.3f}", f"misplaced light {100 * optics['misplaced_light']:.2f} %"]
    parts += [f"relief {optics['relief_mm']:.2f} mm", f"steepest slope {optics['max_slope_deg']:.1f} degrees"]
    if optics.get("min_concave_radius_mm") is not None:
        parts.append(f"tightest valley {optics['min_concave_radius_mm']:.2f} mm radius")
    return "lens: " + ", ".join(parts)
