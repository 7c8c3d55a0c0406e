"""Single changes of a job that may show more of its picture; an estimate computes the gain of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import hypot
from typing import Any

from machines.profile import MachineProfile, ProfileError, load_profile, profile_names
from phrases.phrase import Phrase
from service.errors import SpecError
from service.job.spec.loading import resolve_job
from service.job.spec.resolve import ResolvedJob, without_derived

_LARGER, _NEARER, _LONGER = 1.5, 2 / 3, 2.0
_LEAST_THROW = 0.75  # of the lens's width: nearer, slopes are hard to mill
_ROUND_MM = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """what: a sentence; values: of the spec, by dotted key."""

    what: Phrase
    values: dict[str, Any]

    def apply_to(self, job: ResolvedJob) -> ResolvedJob:
        """Return the job with the change; SpecError if the change is not allowed."""
        data = without_derived(job)
        for key, value in self.values.items():
            table, _, name = key.rpartition(".")
            data |= {table: data[table] | {name: value}} if table else {name: value}
        if "preset" in self.values:
            del data["passes"]
        return resolve_job(base=data)


def changes_of(job: ResolvedJob, detail_mm: float) -> Iterator[Change]:
    """Yield the changes that the job's mill allows and that the job does not have yet.

    detail_mm : the smallest detail that shows on the wall now
    """
    for change in _possible_changes(job, detail_mm):
        try:
            change.apply_to(job)
        except SpecError:
            continue
        yield change


def _possible_changes(job: ResolvedJob, detail_mm: float) -> Iterator[Change]:
    spec = job.spec
    if not spec.to_be_planned:
        yield Change(what=Phrase("passes as recommended"), values={"preset": "recommended"})
    elif spec.finish.process == "none":
        yield Change(what=Phrase("finished by hand"), values={"finish.process": "best"})
    width_mm, height_mm = (_to_fives(_LARGER * side) for side in (spec.optics.width_mm, spec.optics.height_mm))
    larger = {"optics.width_mm": width_mm, "optics.height_mm": height_mm}
    yield Change(
        what=Phrase("a lens of {width_mm:g} x {height_mm:g} mm", width_mm=width_mm, height_mm=height_mm), values=larger
    )
    throw_mm = _to_fives(_NEARER * spec.optics.throw_mm)
    if throw_mm >= _LEAST_THROW * spec.optics.width_mm:
        nearer = Phrase("the wall {throw_mm:g} mm away", throw_mm=throw_mm)
        yield Change(what=nearer, values={"optics.throw_mm": throw_mm})
    if spec.plan.hours is not None:
        hours = _LONGER * spec.plan.hours
        yield Change(what=Phrase("{hours:g} hours of milling", hours=hours), values={"plan.hours": hours})
    if (finer := _finer_mill(job.machine)) is not None:
        yield Change(what=Phrase("a mill as exact as {mill}", mill=finer), values={"machine.profile": finer})
    if spec.image.prepare == "none":
        coarser = {"image.prepare": "detail", "image.prepare_detail_mm": float(f"{detail_mm:.2g}")}
        yield Change(what=Phrase("a picture prepared for what will show"), values=coarser)


def _to_fives(length_mm: float) -> float:
    return _ROUND_MM * round(length_mm / _ROUND_MM)


def _finer_mill(own: MachineProfile) -> str | None:
    """Return the profile with the most exact heights, by steps and errors; None if the job's own is as good."""
    best, best_mm = None, 0.9 * hypot(own.step_mm, own.z_noise_mm)
    for name in profile_names():
        try:
            profile = load_profile(name)
        except ProfileError:  # a person's own file; if it is chosen, the error is reported
            continue
        is_usable = "top_z_mm" not in profile.guesses  # otherwise every job for it is refused
        if is_usable and (off_mm := hypot(profile.step_mm, profile.z_noise_mm)) < best_mm:
            best, best_mm = name, off_mm
    return best
