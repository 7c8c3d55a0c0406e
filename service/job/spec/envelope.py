"""Compares the extent of a job with the travel of the mill's axes: one rule for a submitted job, an estimate, the
command line and a plan.

Width and height are checked as soon as a job is resolved; the depth, when the lens is computed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import floor

from cam.around.specs import BESIDE_MM
from machines.profile import MachineProfile
from phrases.phrase import Phrase
from service.errors import SpecError
from service.job.spec.model import JobSpec

Problem = tuple[str, Phrase]
_ROUNDING_MM = 1e-6


def require_travel(spec: JobSpec, machine: MachineProfile, *, depth_mm: float) -> None:
    """Raise SpecError if the passes of a job need more than the mill's travel. depth_mm : of the lens"""
    problems = list(find_beyond_travel(spec, machine, [row.radius_mm for row in spec.passes], depth_mm=depth_mm))
    if problems:
        raise SpecError([one for one, _ in problems], {key: use for (key, _), use in problems if use is not None})


def find_beyond_travel(
    spec: JobSpec, machine: MachineProfile, radii_mm: Sequence[float], *, depth_mm: float = 0.0
) -> Iterator[tuple[Problem, float | None]]:
    """Yield each axis of the mill that is too short: key, sentence, and a value of that key that would fit.

    radii_mm : of the cutters that cover the whole lens, each one radius beyond its rim
    depth_mm : of the lens under Z0, as far as it is known
    """
    stock, optics = spec.stock, spec.optics
    sides = (("optics.width_mm", "X", optics.width_mm), ("optics.height_mm", "Y", optics.height_mm))
    for number, (key, axis, side_mm) in enumerate(sides):
        beside_mm, what = max(_list_overhangs(spec, machine, radii_mm, axis), key=lambda one: one[0])
        need_mm, have_mm = side_mm + 2 * beside_mm, machine.travel_mm[number]
        if need_mm <= have_mm + _ROUNDING_MM:
            continue
        most_mm = floor(have_mm - 2 * beside_mm)
        words = Phrase(
            "the job moves {need_mm:.6g} mm along {axis}: the lens of {side_mm:g} mm and, on either side of it, "
            "{beside_mm:.6g} mm for {what}; {machine} travels {travel_mm:g} mm (machine.travel_mm.{number})",
            need_mm=need_mm,
            axis=axis,
            side_mm=side_mm,
            beside_mm=beside_mm,
            what=what,
            machine=machine.name,
            travel_mm=have_mm,
            number=number,
        )
        if most_mm > 0:
            words = Phrase("{problem}; allowed: at most {most_mm} mm on this mill", problem=words, most_mm=most_mm)
        yield (key, words), most_mm if most_mm > 0 else None
    through_mm = 0.0 if stock.cut_out is None else stock.thickness_mm + stock.cut_out.through_mm
    deepest_mm = max(depth_mm, through_mm, stock.skim_mm)
    if machine.safe_z_mm + deepest_mm > machine.travel_mm[2] + _ROUNDING_MM:
        words = Phrase(
            "the job moves {need_mm:.6g} mm along Z, from the safe height of {safe_z_mm:g} mm to {deepest_mm:.4g} mm "
            "under the stock top; {machine} travels {travel_mm:g} mm; allowed: at least that",
            need_mm=machine.safe_z_mm + deepest_mm,
            safe_z_mm=machine.safe_z_mm,
            deepest_mm=deepest_mm,
            machine=machine.name,
            travel_mm=machine.travel_mm[2],
        )
        yield ("machine.travel_mm.2", words), None


def _list_overhangs(
    spec: JobSpec, machine: MachineProfile, radii_mm: Sequence[float], axis: str
) -> Iterator[tuple[float, Phrase]]:
    """Yield what moves beyond the lens, and how far at either side."""
    stock = spec.stock
    radius_mm = max(radii_mm, default=0.0)
    yield radius_mm, Phrase("a cutter of radius {radius_mm:g} mm", radius_mm=radius_mm)
    if machine.trace_outline:
        yield stock.margin_mm, Phrase("the trace around the block (machine.trace_outline)")
    if stock.cut_out is not None:
        yield stock.margin_mm, Phrase("cutting the lens out of its margin (stock.cut_out)")
    if stock.face is not None:
        beyond_mm = stock.face.radius_mm + BESIDE_MM if axis == "X" else 0.0
        yield stock.margin_mm + beyond_mm, Phrase("facing the block (stock.face)")
