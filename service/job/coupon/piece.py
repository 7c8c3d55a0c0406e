"""The test piece as a job: its spec, its files, and the setup sheet in words."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from optics.coupon.layout import HALF_MM, HEIGHT_MM, THROW_MM, WIDTH_MM, Coupon
from phrases.phrase import Phrase
from service.errors import InputError
from service.job.files import COUPON_FILES, COUPON_FIT_FILES, names_of_pass, read_report
from service.job.spec.loading import load_stored_job, parse_override, resolve_job
from service.job.spec.model import JobSpec
from service.job.spec.resolve import ResolvedJob, digits_of
from service.wording import ball, duration

PREDICTED, PREDICTED_FINISHED, SHEET, PROFILES = COUPON_FILES
FIT, FIT_PICTURE, FIT_SNIPPET = COUPON_FIT_FILES
RADIUS_MM, ROUGH_PITCH_MM, PITCH_MM, LEFT_MM = 1.0, 0.4, 0.06, 0.05
"""One ball for both passes, so that the tool is not changed between them."""

USUAL_FINISH = "sanding"  # predicted if none is named
_FIXED = {"width_mm": WIDTH_MM, "height_mm": HEIGHT_MM}
_STOCK_MM = 10.0


def coupon_job(
    *, machine: str | None, throw_mm: float | None, file: Path | None, overrides: Sequence[str]
) -> ResolvedJob:
    """Return the job of a test piece: defaults, then the file, then --set. SpecError; InputError if its size is
    set.
    """
    for text in overrides:
        steps, _ = parse_override(text)
        if steps[0] == "optics" and steps[-1] in _FIXED:
            raise InputError(f"--set: {text}: a test piece is {WIDTH_MM:g} x {HEIGHT_MM:g} mm; allowed: leave it out")
    base: dict[str, Any] = {
        "optics": {**_FIXED, "throw_mm": THROW_MM, "viewed_from": "behind"},
        "stock": {"thickness_mm": _STOCK_MM, "margin_mm": 8.0, "skim_mm": 0.05},
        "passes": [
            {"name": "rough", "radius_mm": RADIUS_MM, "pitch_mm": ROUGH_PITCH_MM, "stock_to_leave_mm": LEFT_MM},
            {"name": "finish", "radius_mm": RADIUS_MM, "pitch_mm": PITCH_MM},
        ],
        "machine": {"whole_steps": True},
    }
    if not any(text.partition("=")[0].strip().startswith("finish.") for text in overrides):
        base["finish"] = {"process": USUAL_FINISH}
    given = [] if machine is None else [f"machine.profile={json.dumps(machine)}"]
    given += [] if throw_mm is None else [f"optics.throw_mm={throw_mm!r}"]
    job = resolve_job(base=base, file=file, overrides=[*given, *overrides])
    spec = job.spec
    if (spec.optics.width_mm, spec.optics.height_mm) != (WIDTH_MM, HEIGHT_MM):
        raise InputError(f"--spec: optics.width_mm, height_mm: allowed: {WIDTH_MM:g} and {HEIGHT_MM:g}, or none")
    if not spec.passes[-1].stock_to_leave_mm == 0.0 or any(row.direction != "x" for row in spec.passes):
        raise InputError(Phrase("passes: the last pass of a test piece must finish it, in rows along X"))
    return job


def coupon_of(job: ResolvedJob) -> Coupon:
    """Make the piece for this mill, wall and material; its ripples are whole steps high, if the mill has steps."""
    spec, machine = job.spec, job.machine
    digits = digits_of(machine)
    return Coupon(
        throw_mm=spec.optics.throw_mm,
        refractive_index=spec.optics.refractive_index,
        step_mm=digits.z_mm,
        skim_mm=spec.stock.skim_mm,
    )


def require_coupon(folder: Path) -> ResolvedJob:
    """Return the job of the test piece in a folder; InputError if there is none."""
    if not (folder / PROFILES).is_file():
        raise InputError(
            f"--output: {folder} holds no test piece ({PROFILES}); allowed: the folder that "
            f"`causticmill coupon -o DIR` has written"
        )
    return load_stored_job(folder)


def list_finish_programs(folder: Path, spec: JobSpec) -> list[Path]:
    """Return the programs of the last pass, in the order in which they are run."""
    rows = read_report(folder).get("passes", [])
    return [folder / name for name in names_of_pass(rows[len(spec.passes) - 1])]


def sheet_lines(job: ResolvedJob, report: Mapping[str, Any]) -> Iterator[str]:
    """Yield the setup sheet: block, mill, finish, photograph."""
    yield "TEST PIECE: measures what your mill leaves and what your finish takes off"
    yield ""
    for number, step in enumerate(_steps(job, report), 1):
        yield from textwrap.wrap(
            step, 100, initial_indent=f"{number}. ", subsequent_indent="   ", break_on_hyphens=False
        )


def _steps(job: ResolvedJob, report: Mapping[str, Any]) -> Iterator[str]:
    spec, machine = job.spec, job.machine
    stock, row = spec.stock, spec.passes[-1]
    wide, high = WIDTH_MM + 2 * stock.margin_mm, HEIGHT_MM + 2 * stock.margin_mm
    time = duration(sum(one["time_s"] for one in report["passes"]))
    files = ", then ".join(name for one in report["passes"] for name in names_of_pass(one))
    yield (
        f"Block: {wide:g} x {high:g} mm, {stock.thickness_mm:g} mm thick, of the material of your lenses, "
        f"both faces clear. Z0 is the top of the block; X0 Y0 the lower left corner of the piece, "
        f"{stock.margin_mm:g} mm inside the block's own corner."
    )
    yield (
        f"Mill '{machine.name}': ball {ball(row.radius_mm)} for all programs. Run {files}: {time} in all. "
        "Wash the piece with mild soap and water, and dry it by dabbing."
    )
    yield (
        f"Finish one half: cover the right half (X {HALF_MM:g} to {WIDTH_MM:g} mm) with tape whose edge lies straight "
        f"along Y at X {HALF_MM:g}, and finish the left half exactly as you finish lenses: same paper, block, strokes, "
        "and minutes for an area of that size. Go on over the block's margin, so that rims are not rounded. The left "
        "half is the one with three small lenses along its rim. Take the tape off and clean both halves."
    )
    yield (
        f"Screen: tracing paper on a clear pane, parallel to the milled face and {spec.optics.throw_mm:g} mm from it "
        f"(two spacers). Cover the block around the piece with black tape: only {WIDTH_MM:g} x {HEIGHT_MM:g} mm let "
        "light through."
    )
    yield (
        "Light: one small bright LED without lens or reflector, 2 m or more away, straight behind the flat face, in a "
        "dark room. The sun is too wide: its disc blurs what has to be measured."
    )
    yield (
        "Photograph the paper from the side that the block is not on, as near as the camera focuses; a little askew "
        "does no harm. At least 1500 pixels across the piece, no filter, no portrait mode. Nothing but the small "
        "lenses should be white: if in doubt, expose one or two stops shorter."
    )
    yield "Then: causticmill coupon --photo PHOTO -o THIS_FOLDER"


def summary_lines(folder: Path, report: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines that the command prints when the programs are written."""
    for row in report["passes"]:
        yield (
            f"{', '.join(names_of_pass(row))}: {row['lines']} lines, {row['path_length_mm'] / 1000:.1f} m, "
            f"{duration(row['time_s'])}, deepest Z {row['bounds']['z'][0]:.3f} mm, checked"
        )
    yield f"machine time of all programs: {duration(sum(row['time_s'] for row in report['passes']))}"
    for sentence in report["warnings"]:
        yield f"warning: {sentence}"
    yield f"what to do, step by step: {folder / SHEET}; what the screen will show: {folder / PREDICTED_FINISHED}"
