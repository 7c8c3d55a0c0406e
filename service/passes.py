"""Passes of a job: presets, speeds and feeds the person left out, and the mill that runs them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

from cam import passes as cam_passes
from cam.materials import PMMA, Material
from cam.passes import PassSpec, Stock
from machines.profiles import MachineProfile, ProfileError, UnknownProfileError, load_profile
from service.errors import SpecError
from service.job.finish_spec import resolve_finish
from service.spec import JobSpec, PassRow

LoadProfile = Callable[[str], MachineProfile]
_MATERIALS: dict[str, Material] = {"pmma": PMMA}
_PROFILE_KEYS = {
    "travel_mm", "max_rate_mm_per_min", "acceleration_mm_per_s2", "step_mm", "z_noise_mm", "junction_deviation_mm",
    "planner_blocks", "lines_per_s", "safe_z_mm", "spindle_rpm", "whole_steps", "most_program_mb", "most_program_hours",
}  # fmt: skip


def preset_rows(preset: str) -> list[dict[str, Any]]:
    """A preset's passes as plain data, speeds left open. What leaves stock is called rough, the rest finish.

    Those of "recommended" are none: they are planned once the picture is known.
    """
    rows = []
    for spec in cam_passes.PRESETS.get(preset, ()):
        row = {key: value for key, value in asdict(spec).items() if not key.endswith(("_per_min", "_rpm"))}
        rows.append({**row, "name": "finish" if spec.finishes else "rough"})
    return rows


def machine_of(spec: JobSpec, load: LoadProfile = load_profile) -> MachineProfile:
    """The named profile with the job's own figures in place of its."""
    try:
        profile = load(spec.machine.profile)
    except UnknownProfileError as error:
        allowed = ", ".join(f"'{name}'" for name in error.known)
        raise SpecError([("machine.profile", f"'{error.name}' is not known; allowed: {allowed}")]) from None
    except ProfileError as error:
        raise SpecError([("machine.profile", f"'{spec.machine.profile}' cannot be used: {error}")]) from None
    own: dict[str, Any] = {}
    for key in _PROFILE_KEYS:
        value = getattr(spec.machine, key)
        if value is not None:
            own[key] = tuple(value) if isinstance(value, list) else value
    return replace(profile, **own)


def with_feeds(spec: JobSpec, load: LoadProfile = load_profile) -> JobSpec:
    """The same spec with every speed, feed and step-down filled in from the material's start values, and the ball that
    the lens is shaped for.

    What the person wrote must suit the mill (SpecError); what is filled in is kept within the mill's reach, a slower
    spindle taking the feed down with it.
    """
    machine = machine_of(spec, load)
    rows, problems = [], []
    for number, row in enumerate(spec.passes):
        problems += _beyond_the_mill(row, machine, f"passes.{number}")
        rows.append(_filled(row, machine, _MATERIALS[spec.stock.material]))
    if problems:
        raise SpecError(problems)
    area_mm2 = spec.optics.width_mm * spec.optics.height_mm
    finish = resolve_finish(spec.finish, area_mm2=area_mm2, to_be_planned=spec.to_be_planned)
    spec = spec.model_copy(update={"finish": finish})
    if spec.to_be_planned:
        return spec
    optics = spec.optics.model_copy(update={"min_radius_mm": spec.lens_radius_mm})
    return spec.model_copy(update={"optics": optics, "passes": tuple(rows)})


def without_derived(spec: JobSpec) -> dict[str, Any]:
    """The spec as plain data without the speeds, feeds and step-downs that `with_feeds` would fill in as they are.

    What stands in spec.json because the program chose it is no wish of the person, and is chosen anew for another mill
    or another ball.
    """
    machine, material = machine_of(spec), _MATERIALS[spec.stock.material]
    rows = []
    for row in spec.passes:
        for keys in (("feed_mm_per_min", "plunge_mm_per_min", "step_down_mm"), ("spindle_rpm",)):  # feeds follow it
            chosen = _filled(row.model_copy(update=dict.fromkeys(keys)), machine, material)
            same = [key for key in keys if getattr(chosen, key) == getattr(row, key)]
            row = row.model_copy(update=dict.fromkeys(same))
        rows.append(row)
    return spec.model_copy(update={"passes": tuple(rows)}).plain()


def with_plan(spec: JobSpec, report: Mapping[str, Any]) -> JobSpec:
    """The spec with the passes that its stage `passes` has planned; itself where they stand already, or not yet."""
    if not spec.to_be_planned or "plan" not in report:
        return spec
    planned = report["plan"]
    optics = spec.optics
    if not any(optics.foreseen_blur_mm):
        optics = optics.model_copy(update={"foreseen_blur_mm": planned["foreseen_blur_mm"]})
    if optics.min_radius_mm is None and not optics.creases:
        optics = optics.model_copy(update={"min_radius_mm": planned["min_radius_mm"]})
    machine = spec.machine
    if machine.whole_steps is None and planned["whole_steps"]:
        machine = machine.model_copy(update={"whole_steps": True})
    rows = tuple(PassRow.model_validate(row) for row in planned["passes"])
    return spec.model_copy(update={"optics": optics, "passes": rows, "machine": machine})


def cam_passes_of(spec: JobSpec) -> tuple[PassSpec, ...]:
    """The passes as the CAM package takes them."""
    return tuple(PassSpec(**row.model_dump()) for row in spec.passes)


def cam_stock_of(spec: JobSpec) -> Stock:
    """The block as the CAM package takes it."""
    return Stock(
        width_mm=spec.optics.width_mm,
        height_mm=spec.optics.height_mm,
        thickness_mm=spec.stock.thickness_mm,
        margin_mm=spec.stock.margin_mm,
    )


def _filled(row: PassRow, machine: MachineProfile, material: Material) -> PassRow:
    start = material.start_values(row.radius_mm)
    spindle = row.spindle_rpm
    if spindle is None:
        spindle = min(max(float(start.spindle_rpm), machine.spindle_rpm[0]), machine.spindle_rpm[1])
    slower = min(1.0, spindle / start.spindle_rpm)
    feed = min(start.feed_mm_per_min * slower, *machine.max_rate_mm_per_min[:2])
    plunge = min(start.plunge_mm_per_min * slower, machine.max_rate_mm_per_min[2])
    return row.model_copy(
        update={
            "spindle_rpm": spindle,
            "feed_mm_per_min": row.feed_mm_per_min or float(round(feed)),
            "plunge_mm_per_min": row.plunge_mm_per_min or float(round(plunge)),
            "step_down_mm": row.step_down_mm or start.step_down_mm,
        }
    )


def _beyond_the_mill(row: PassRow, machine: MachineProfile, place: str) -> list[tuple[str, str]]:
    limits = {
        "spindle_rpm": (*machine.spindle_rpm, "rpm"),
        "feed_mm_per_min": (0.0, min(machine.max_rate_mm_per_min[:2]), "mm/min"),
        "plunge_mm_per_min": (0.0, machine.max_rate_mm_per_min[2], "mm/min"),
    }
    problems = []
    for key, (low, high, unit) in limits.items():
        value = getattr(row, key)
        if value is not None and not low <= value <= high:
            allowed = f"{low:g} to {high:g} {unit} on machine '{machine.name}'"
            problems.append((f"{place}.{key}", f"{value:g} is not allowed; allowed: {allowed}"))
    return problems
