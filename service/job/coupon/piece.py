"""The test piece as a job: its spec, its files, and the setup sheet in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cam.posts.dialects import POSTS
from optics.coupon.layout import HEIGHT_MM, THROW_MM, WIDTH_MM, Coupon
from service.errors import InputError
from service.job_files import COUPON_FILES, COUPON_FIT_FILES, names_of_pass, read_report
from service.passes import machine_of
from service.report_words import ball, duration
from service.spec import JobSpec
from service.spec_files import parse_override, resolve_spec, stored_spec

PREDICTED, PREDICTED_FINISHED, SHEET, PROFILES = COUPON_FILES
FIT, FIT_PICTURE, FIT_SNIPPET = COUPON_FIT_FILES
RADIUS_MM, ROUGH_PITCH_MM, PITCH_MM, LEFT_MM = 1.0, 0.4, 0.06, 0.05
"""One ball for both passes, so that nothing is changed between them."""

_FIXED = {"width_mm": WIDTH_MM, "height_mm": HEIGHT_MM}
_STOCK_MM = 10.0


def coupon_spec(
    *, machine: str | None, throw_mm: float | None, file: Path | None, overrides: Sequence[str]
) -> JobSpec:
    """The spec of a test piece: defaults, then the file, then --set. SpecError; InputError where its size is set."""
    for text in overrides:
        steps, _ = parse_override(text)
        if steps[0] == "optics" and steps[-1] in _FIXED:
            raise InputError(f"--set: {text}: a test piece is {WIDTH_MM:g} x {HEIGHT_MM:g} mm; allowed: leave it out")
    base: dict[str, Any] = {
        "optics": {**_FIXED, "throw_mm": THROW_MM, "viewed_from": "behind"},
        "stock": {"thickness_mm": _STOCK_MM, "skim_mm": 0.05},
        "passes": [
            {"name": "rough", "radius_mm": RADIUS_MM, "pitch_mm": ROUGH_PITCH_MM, "stock_to_leave_mm": LEFT_MM},
            {"name": "finish", "radius_mm": RADIUS_MM, "pitch_mm": PITCH_MM},
        ],
        "machine": {"whole_steps": True},
    }
    given = [] if machine is None else [f"machine.profile={machine}"]
    given += [] if throw_mm is None else [f"optics.throw_mm={throw_mm!r}"]
    spec = resolve_spec(base=base, file=file, overrides=[*given, *overrides])
    if (spec.optics.width_mm, spec.optics.height_mm) != (WIDTH_MM, HEIGHT_MM):
        raise InputError(f"--spec: optics.width_mm, height_mm: allowed: {WIDTH_MM:g} and {HEIGHT_MM:g}, or none")
    if not spec.passes[-1].stock_to_leave_mm == 0.0 or any(row.direction != "x" for row in spec.passes):
        raise InputError("passes: the last pass of a test piece must finish it, in rows along X")
    return spec


def coupon_of(spec: JobSpec) -> Coupon:
    """The piece for this mill, wall and material; its ripples are whole steps of the mill high where it has steps."""
    machine = machine_of(spec)
    digits = POSTS[machine.dialect].digits.coarsened(machine.step_mm if machine.whole_steps else 0.0)
    return Coupon(
        throw_mm=spec.optics.throw_mm,
        refractive_index=spec.optics.refractive_index,
        step_mm=digits.z_mm,
        skim_mm=spec.stock.skim_mm,
    )


def require_coupon(folder: Path) -> JobSpec:
    """The spec of the test piece in a folder; InputError where there is none."""
    if not (folder / PROFILES).is_file():
        raise InputError(
            f"--output: {folder} holds no test piece ({PROFILES}); allowed: the folder that "
            f"`causticmill coupon -o DIR` has written"
        )
    return stored_spec(folder)


def finishing_programs(folder: Path, spec: JobSpec) -> list[Path]:
    """The programs of the last pass, in the order in which they are run."""
    rows = read_report(folder).get("passes", [])
    return [folder / name for name in names_of_pass(rows[len(spec.passes) - 1])]


def sheet_lines(spec: JobSpec, report: Mapping[str, Any]) -> Iterator[str]:
    """The setup sheet: block, mill, finish, photograph."""
    stock, machine, row = spec.stock, machine_of(spec), spec.passes[-1]
    wide, high = WIDTH_MM + 2 * stock.margin_mm, HEIGHT_MM + 2 * stock.margin_mm
    minutes = duration(sum(one["time_s"] for one in report["passes"]))
    files = ", then ".join(name for one in report["passes"] for name in names_of_pass(one))
    yield "TEST PIECE: measures what your mill leaves and what your finish takes off"
    yield ""
    yield f"1. Block: {wide:g} x {high:g} mm, {stock.thickness_mm:g} mm thick, of the material your lenses are made of,"
    yield "   both faces clear. Z0: the top of the block. X0 Y0: the lower left corner of the piece, which lies"
    yield f"   {stock.margin_mm:g} mm inside the block's own corner."
    yield f"2. Mill '{machine.name}': ball {ball(row.radius_mm)} for all programs; run {files}: {minutes} in all."
    yield "   Wash it with mild soap and water, and dry it by dabbing."
    yield "3. Finish one half: cover the right half (X from 20 to 40 mm) with tape, its edge straight along Y at X 20.0,"
    yield "   and finish the left half exactly as you finish lenses: same paper, block, strokes, minutes. Go on over the"
    yield "   block's margin, so that rims are not rounded. The half with the two small lenses at its rim is the left one."
    yield "   Take the tape off and clean both halves."
    yield f"4. Screen: tracing paper on a clear pane, {spec.optics.throw_mm:g} mm from the milled face (two spacers), parallel"
    yield f"   to it. Cover the block around the piece with black tape: only {WIDTH_MM:g} x {HEIGHT_MM:g} mm may let light through."
    yield "5. Light: one small bright LED without lens or reflector, 2 m or more away, straight behind the flat face, in a"
    yield "   dark room. The sun is too wide: its disc blurs what has to be measured."
    yield "6. Photograph the light on the paper from the side that the block is not on, from a hand's breadth of distance"
    yield "   or as near as the camera focuses; a little askew does no harm. Nothing should be white in it: make it"
    yield "   darker by a stop or two if in doubt. At least 1500 pixels across the piece; no filter, no portrait mode."
    yield "7. causticmill coupon --photo PHOTO -o THIS_FOLDER"
