"""Fills in what a person left out of a job (presets, speeds, feeds, the index), checks it against the mill, and
converts it for `cam`.

The figures of mill, tools and finishing processes are looked up once, when a job is submitted, and stored with it: the
computer that works on it later may have other files under the same names, or a later version of them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from math import ceil, inf
from typing import Any, cast

from pydantic import TypeAdapter, ValidationError

from cam.around.specs import CutOut, Facing
from cam.checking.envelope import Reach
from cam.cutters import CUTTERS
from cam.materials import MATERIALS, SLOT_FEED, Material, limit_step_down_mm
from cam.passes import PRESETS, PassSpec, Stock
from cam.posts.dialects import POSTS, Dialect, find_unsupported
from cam.posts.post import MM_PER_INCH, Coolant, Digits, HighPrecision, ProgramSetup
from cam.tools import Tool
from machines.profile import MachineProfile, ProfileError, UnknownProfileError, load_profile, replace_figures
from phrases.phrase import Phrase
from service.errors import FailedError, SpecError
from service.job.spec.cutting import CutOutSpec, FaceSpec, MachineSpec, StockSpec
from service.job.spec.envelope import (
    find_beyond_travel,
    find_misfits,
    find_unstated,
    list_clamps,
    list_reaches,
    safe_z_over_clamps_mm,
)
from service.job.spec.finish import FinishSpec, find_processes, resolve_finish
from service.job.spec.finish_library import Process
from service.job.spec.light import index_of
from service.job.spec.model import JobSpec, PassRow
from service.job.spec.section import unknown_name
from service.job.spec.tools import load_tools

LoadProfile = Callable[[str], MachineProfile]
_PROFILE_KEYS = MachineSpec.model_fields.keys() - {"profile"}
Cutter = PassRow | FaceSpec | CutOutSpec
_AROUND = ("face", "cut_out")
_ROUNDING = 0.01  # of step-downs and feeds
_CHOSEN = {"pitch_mm", "flutes", "step_down_mm", "feed_mm_per_min", "plunge_mm_per_min", "spindle_rpm"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Contents of the files that a spec names.

    profile   : of the mill
    tools     : of the shop, if the passes are planned; otherwise none
    processes : finishing processes that the job may use, by name
    """

    profile: MachineProfile
    tools: tuple[Tool, ...] = ()
    processes: Mapping[str, Process]

    def to_text(self) -> str:
        """Return JSON, with Infinity for infinite figures."""
        return json.dumps(asdict(self), separators=(",", ":"))

    @classmethod
    def from_text(cls, text: str) -> Figures:
        """Parse the text; FailedError if another version wrote it."""
        try:
            return _FIGURES.validate_python(json.loads(text))
        except ValidationError as error:
            place = ".".join(map(str, error.errors()[0]["loc"]))
            raise FailedError(
                Phrase("the figures kept with this job are of another version ({place}): submit it again", place=place)
            ) from None


_FIGURES = TypeAdapter(Figures)


@dataclass(frozen=True, kw_only=True)
class ResolvedJob:
    """A spec without gaps, and the figures behind the names in it."""

    spec: JobSpec
    figures: Figures

    @cached_property
    def machine(self) -> MachineProfile:
        """The mill's profile with the job's own figures; SpecError if its control does not support them."""
        spec, own = self.spec, dict[str, Any]()
        for key in _PROFILE_KEYS:
            value = getattr(spec.machine, key)
            if value is not None:
                own[key] = tuple(value) if isinstance(value, list) else value
        if spec.finish.finishes and spec.machine.whole_steps is None:
            own["whole_steps"] = True  # a finish removes errors that alternate from row to row, not the control's
        own.setdefault("safe_z_mm", safe_z_over_clamps_mm(spec, self.figures.profile.safe_z_mm))
        machine = replace(self.figures.profile, **_changed_figures(self.figures.profile, own))
        if machine.units == "inch":  # rapids travel at whole tenths of an inch, which any resolution can state
            machine = replace(machine, safe_z_mm=ceil(10 * machine.safe_z_mm / MM_PER_INCH) / 10 * MM_PER_INCH)
        unsupported = find_unsupported(
            machine.dialect,
            setup_of(machine, tool=1),
            units=machine.units,
            number_every=machine.number_every,
            one_program=machine.one_program,
        )
        problems = [
            (f"machine.{key}", Phrase("{value} is not allowed; allowed: {allowed}", value=value, allowed=allowed))
            for key, value, allowed in unsupported
        ]
        if spec.machine.top_z_mm is not None and not machine.homing:
            words = Phrase("{value:g} is unknown to a mill without homing; allowed: left out", value=machine.top_z_mm)
            problems.append(("machine.top_z_mm", words))
        if machine.one_program and not problems and (allowed := _find_obstacle_to_one_program(machine)):
            problems.append(("machine.one_program", Phrase("true is not allowed; allowed: {allowed}", allowed=allowed)))
        if problems:
            raise SpecError(problems)
        return machine

    def with_spec(self, spec: JobSpec) -> ResolvedJob:
        """Return the same figures for another spec that names the same mill, tools and processes."""
        return replace(self, spec=spec)


def _find_obstacle_to_one_program(machine: MachineProfile) -> Phrase | None:
    """Return the setting that prevents the job's programs from following one another without a person; None if nothing
    does.
    """
    limits = ("most_program_mb", "most_program_hours")
    if not machine.tool_change:
        return Phrase("with machine.tool_change = true, where the control's table has the length of each tool")
    if machine.top_z_mm is None:
        return Phrase("with machine.top_z_mm, to which the head goes before a longer tool comes into it")
    if limit := next((key for key in limits if getattr(machine, key) is not None), None):
        return Phrase("without machine.{key}, which splits programs", key=limit)
    return None


def _changed_figures(profile: MachineProfile, own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the mill figures that the job sets, and drop figures of the profile that no longer hold beside them."""
    base = {field.name: getattr(profile, field.name) for field in fields(profile)}
    changed = replace_figures(base, own)
    return {key: value for key, value in changed.items() if value is not base[key]}


def look_up(spec: JobSpec, load: LoadProfile = load_profile) -> ResolvedJob:
    """Return the job of a spec with the present figures of this computer's files.

    load : reads a mill's profile
    SpecError: the spec names something that does not exist. InputError: a file of tools or processes has a fault.
    """
    try:
        profile = load(spec.machine.profile)
    except UnknownProfileError as error:
        raise SpecError([("machine.profile", unknown_name(error.name, error.known))]) from None
    except ProfileError as error:
        words = Phrase("'{name}' cannot be used: {cause}", name=spec.machine.profile, cause=str(error))
        raise SpecError([("machine.profile", words)]) from None
    tools = load_tools() if spec.to_be_planned else ()
    processes = find_processes(spec.finish)
    return ResolvedJob(spec=spec, figures=Figures(profile=profile, tools=tools, processes=processes))


def post_of(machine: MachineProfile) -> Dialect:
    """Return the dialect of programs for this mill, as its shop keeps them."""
    return POSTS[machine.dialect].adapt(units=machine.units, number_every=machine.number_every)


def number_tools(spec: JobSpec) -> dict[tuple[object, ...], int]:
    """Return the tools of all programs, in the order of their first use, from 1; the keys are those of `tool_key`."""
    rows = (spec.stock.face, *spec.passes, spec.stock.cut_out)
    keys = dict.fromkeys(tool_key(row) for row in rows if row is not None)
    return {key: number for number, key in enumerate(keys, 1)}


def tool_key(row: Cutter) -> tuple[object, ...]:
    """Return the values that distinguish one tool of a job from another."""
    names = ("shape", "radius_mm", "corner_radius_mm", "flute_length_mm", "shank_radius_mm")
    return "ball" if isinstance(row, PassRow) else "flat", *(getattr(row, name, None) for name in names)


def setup_of(machine: MachineProfile, *, tool: int) -> ProgramSetup:
    """Return the set-up of programs for this mill: what they switch on before cutting, and off afterwards.

    tool : its number, where programs change tools
    """
    return ProgramSetup(
        coolant=cast(Coolant, machine.coolant),
        work_offset=machine.work_offset,
        blend_tolerance_mm=machine.blend_tolerance_mm,
        high_precision=cast(HighPrecision, machine.high_precision),
        warm_up_s=machine.warm_up_s,
        slowest_rpm=machine.spindle_rpm[0],
        tool=tool if machine.tool_change else 0,
        optional_stop=machine.optional_stop,
        top_z_mm=machine.top_z_mm,
    )


def preset_rows(preset: str) -> list[dict[str, Any]]:
    """Return a preset's passes as plain data, without speeds. A pass that leaves stock is named rough, others finish.

    "recommended" has none: its passes are planned once the picture is known.
    """
    rows = []
    for spec in PRESETS.get(preset, ()):
        row = {
            key: value
            for key, value in asdict(spec).items()
            if key in PassRow.model_fields and key != "flutes" and not key.endswith(("_per_min", "_rpm"))
        }
        rows.append({**row, "name": "finish" if spec.finishes else "rough"})
    return rows


def complete_job(job: ResolvedJob) -> ResolvedJob:
    """Return the job with every speed, feed and step-down filled in from the material's start values, with its index of
    refraction, and with the ball for which the lens is shaped.

    The person's values must suit the mill (SpecError); filled-in values are kept within the mill's limits, and a slower
    spindle reduces the feed in proportion.
    """
    spec, machine = job.spec, job.machine
    rows, problems = [], []
    for number, row in enumerate(spec.passes):
        problems += [*_beyond_the_mill(row, machine, f"passes.{number}"), *_unheld(row, machine, f"passes.{number}")]
        rows.append(_fill_row(row, machine, MATERIALS[spec.stock.material]))
    for name in _AROUND:
        if (tool := getattr(spec.stock, name)) is not None:
            problems += [*_beyond_the_mill(tool, machine, f"stock.{name}"), *_unheld(tool, machine, f"stock.{name}")]
    problems += find_unstated(machine)
    radii = _radii_mm(job)
    reaches = list_reaches(spec, depth_mm=0.0)
    if spec.to_be_planned:  # the least that any plan needs
        least = Reach(radius_mm=radii[0], beyond_mm=(radii[0],) * 2, lowest_mm=-spec.stock.skim_mm, flute_length_mm=0.0)
        reaches["passes"] = least
    beyond = [*find_beyond_travel(spec, machine, radii), *find_misfits(spec, machine, reaches)]
    problems += [problem for problem, _ in beyond]
    if problems:
        raise SpecError(problems, {key: use for (key, _), use in beyond if use is not None})
    area_mm2 = spec.optics.width_mm * spec.optics.height_mm
    finish = resolve_finish(spec.finish, job.figures.processes, area_mm2=area_mm2, to_be_planned=spec.to_be_planned)
    spec = spec.model_copy(update={"stock": _stock_filled(spec.stock, machine), "finish": finish})
    if "refractive_index" not in spec.optics.model_fields_set:
        spec = _with_optics(spec, refractive_index=index_of(MATERIALS[spec.stock.material], spec.optics.light))
    if not spec.to_be_planned:
        spec = _with_optics(spec, min_radius_mm=spec.lens_radius_mm).model_copy(update={"passes": tuple(rows)})
    return job.with_spec(spec)


def _radii_mm(job: ResolvedJob) -> list[float]:
    """Return the radii of the job's cutters; for passes still to be planned, the smallest possible."""
    if not job.spec.to_be_planned:
        return [row.radius_mm for row in job.spec.passes]
    collet_mm = job.machine.collet_mm or inf
    balls = [tool.radius_mm for tool in job.figures.tools if tool.is_ball and 2 * tool.shank_radius_mm <= collet_mm]
    return [min(balls, default=0.0)]


def _with_optics(spec: JobSpec, **values: float | None) -> JobSpec:
    return spec.model_copy(update={"optics": spec.optics.model_copy(update=values)})


def without_derived(job: ResolvedJob) -> dict[str, Any]:
    """Return the spec as plain data without the speeds, feeds and step-downs that `complete_job` would fill in with the
    same values.

    Values in spec.json that the program chose are not the person's wishes; they are chosen again for another mill or
    another ball.
    """
    spec, machine, material = job.spec, job.machine, MATERIALS[job.spec.stock.material]
    rows = []
    for row in spec.passes:
        speeds = ("spindle_rpm", "feed_mm_per_min", "plunge_mm_per_min", "step_down_mm")
        for keys in (speeds, speeds[1:], speeds[:1], ("flutes",)):  # each of them follows from the others
            chosen = _fill_row(row.model_copy(update=dict.fromkeys(keys)), machine, material)
            same = [key for key in keys if getattr(chosen, key) == getattr(row, key)]
            row = row.model_copy(update=dict.fromkeys(same))
        rows.append(row)
    stock = spec.stock
    for name in _AROUND:
        if (tool := getattr(stock, name)) is not None:
            chosen_keys = sorted(_CHOSEN & set(type(tool).model_fields))
            bare = stock.model_copy(update={name: tool.model_copy(update=dict.fromkeys(chosen_keys))})
            chosen = getattr(_stock_filled(bare, machine), name)
            same = [key for key in chosen_keys if getattr(chosen, key) == getattr(tool, key)]
            stock = stock.model_copy(update={name: tool.model_copy(update=dict.fromkeys(same))})
    plain = spec.model_copy(update={"passes": tuple(rows), "stock": stock}).plain()
    if spec.optics.refractive_index == index_of(material, spec.optics.light):
        del plain["optics"]["refractive_index"]
    return plain


def with_plan(spec: JobSpec, report: Mapping[str, Any]) -> JobSpec:
    """Return the spec with the passes that its stage `passes` has planned; unchanged if they are there already, or not
    planned yet.
    """
    if not spec.to_be_planned or "plan" not in report:
        return spec
    planned = report["plan"]
    optics = spec.optics
    if optics.branch == "auto":  # the planner has lit lenses of one branch
        optics = optics.model_copy(update={"branch": planned.get("branch", optics.branch)})
    if not any(optics.foreseen_blur_mm):
        optics = optics.model_copy(update={"foreseen_blur_mm": planned["foreseen_blur_mm"]})
    if optics.min_radius_mm is None and not optics.creases:
        optics = optics.model_copy(update={"min_radius_mm": planned["min_radius_mm"]})
    kept = spec.finish.model_dump(include={"witness"})
    finish = FinishSpec.model_validate({**kept, **planned.get("finish", {})})
    machine = spec.machine
    if machine.whole_steps is None and planned["whole_steps"]:
        machine = machine.model_copy(update={"whole_steps": True})
    rows = tuple(PassRow.model_validate(row) for row in planned["passes"])
    return spec.model_copy(update={"optics": optics, "passes": rows, "machine": machine, "finish": finish})


def cam_passes_of(spec: JobSpec) -> tuple[PassSpec, ...]:
    """Return the passes in the form of the CAM package."""
    material = MATERIALS[spec.stock.material]
    return tuple(
        PassSpec(**row.model_dump(exclude_none=True), chip_mm=material.start_values(row.radius_mm).chip_mm)
        for row in spec.passes
    )


def cam_stock_of(spec: JobSpec) -> Stock:
    """Return the block in the form of the CAM package."""
    return Stock(
        width_mm=spec.optics.width_mm,
        height_mm=spec.optics.height_mm,
        thickness_mm=spec.stock.thickness_mm,
        margin_mm=spec.stock.margin_mm,
        clamps=list_clamps(spec),
    )


def facing_task_of(spec: JobSpec) -> Facing | None:
    """Return the facing of the stock's top in the form of the CAM package; None if there is none."""
    face = spec.stock.face
    if face is None:
        return None
    assert face.pitch_mm is not None and face.step_down_mm is not None and face.feed_mm_per_min is not None
    assert face.plunge_mm_per_min is not None and face.spindle_rpm is not None  # by complete_job
    return Facing(
        above_mm=face.above_mm,
        shape=face.tool,
        radius_mm=face.radius_mm,
        pitch_mm=face.pitch_mm,
        step_down_mm=face.step_down_mm,
        feed_mm_per_min=face.feed_mm_per_min,
        plunge_mm_per_min=face.plunge_mm_per_min,
        spindle_rpm=face.spindle_rpm,
    )


def cut_out_of(spec: JobSpec) -> CutOut | None:
    """Return the cut-out of the lens in the form of the CAM package; None if there is none."""
    return (
        None
        if spec.stock.cut_out is None
        else CutOut(**spec.stock.cut_out.model_dump(exclude={"shank_radius_mm", "flute_length_mm", "flutes"}))
    )


def _stock_filled(stock: StockSpec, machine: MachineProfile) -> StockSpec:
    """Fill in facing and cutting out with pitch, steps, feeds and speeds. The whole slot is cut at half the feed."""
    material = MATERIALS[stock.material]
    filled: dict[str, Any] = {}
    if stock.face is not None:
        share = CUTTERS[stock.face.tool].pitch_share
        pitch_mm = stock.face.pitch_mm or round(share * stock.face.radius_mm, 3)
        filled["face"] = stock.face.model_copy(update={"pitch_mm": pitch_mm, **_speeds(stock.face, machine, material)})
    if stock.cut_out is not None:
        slot = _speeds(stock.cut_out, machine, material, feed_share=SLOT_FEED)
        filled["cut_out"] = stock.cut_out.model_copy(update=slot)
    return stock.model_copy(update=filled)


def _fill_row(row: PassRow, machine: MachineProfile, material: Material) -> PassRow:
    values = _speeds(row, machine, material)
    if row.step_down_mm is None:
        most = most_removal_mm3_per_min(machine, material)
        values["step_down_mm"] = limit_step_down_mm(
            values["step_down_mm"], row.pitch_mm, values["feed_mm_per_min"], removal_mm3_per_min=most
        )
    return row.model_copy(update=values)


def most_removal_mm3_per_min(machine: MachineProfile, material: Material) -> float:
    """Return the highest removal rate of rows, limited by the frame and the spindle's power [mm^3/min]."""
    by_frame = inf if machine.removal_cm3_per_min is None else 1000 * machine.removal_cm3_per_min
    by_spindle = inf if machine.spindle_w is None else material.removal_mm3_per_min(machine.spindle_w)
    return min(by_frame, by_spindle)


def warn_of_removal(spec: JobSpec, machine: MachineProfile) -> Iterator[Phrase]:
    """Yield warnings of passes with a person's own figures that exceed the mill's removal rate."""
    most = most_removal_mm3_per_min(machine, MATERIALS[spec.stock.material])
    for number, row in enumerate(spec.passes):
        assert row.step_down_mm is not None and row.feed_mm_per_min is not None  # by complete_job
        asked = row.pitch_mm * row.step_down_mm * row.feed_mm_per_min
        if asked > (1 + _ROUNDING) * most:
            yield Phrase(
                "passes.{number} ({name}) takes off {asked_cm3_per_min:.2g} cm3/min in rows; '{mill}' can take "
                "about {most_cm3_per_min:.2g} (machine.removal_cm3_per_min, spindle_w): choose a smaller "
                "step_down_mm, or expect chatter and lost steps",
                number=number,
                name=row.name,
                asked_cm3_per_min=asked / 1000,
                mill=machine.name,
                most_cm3_per_min=most / 1000,
            )


def _speeds(row: Cutter, machine: MachineProfile, material: Material, *, feed_share: float = 1.0) -> dict[str, Any]:
    """Return flutes, feeds, speed and step-down. The feed follows the flutes and the fastest speed, or the one given;
    then a speed that is not given follows the feed, so that chips are neither too thin nor too thick.
    """
    start = material.start_values(row.radius_mm)
    flutes = row.flutes or start.flutes
    fastest = row.spindle_rpm or min(max(float(start.spindle_rpm), machine.spindle_rpm[0]), machine.spindle_rpm[1])
    part = min(1.0, fastest / start.spindle_rpm) * flutes / start.flutes
    feed = min(feed_share * start.feed_mm_per_min * part, *machine.max_rate_mm_per_min[:2])
    feed = row.feed_mm_per_min or max(1.0, float(round(feed)))
    plunge = min(start.plunge_mm_per_min * part, machine.max_rate_mm_per_min[2], feed)
    steady = not isinstance(row, PassRow) or row.stock_to_leave_mm == 0
    return {
        "flutes": flutes,
        "spindle_rpm": row.spindle_rpm
        or start.choose_rpm(feed, flutes, finishes=steady, spindle_rpm=machine.spindle_rpm),
        "feed_mm_per_min": feed,
        "plunge_mm_per_min": row.plunge_mm_per_min or max(1.0, float(round(plunge))),
        "step_down_mm": row.step_down_mm or start.step_down_mm,
    }


def _unheld(row: Cutter, machine: MachineProfile, place: str) -> list[tuple[str, Phrase]]:
    """Return a problem if the spindle cannot hold a pass's cutter; an unknown shank is as thick as the cutter."""
    shank_mm = 2 * (row.radius_mm if row.shank_radius_mm is None else row.shank_radius_mm)
    if machine.collet_mm is None or shank_mm <= machine.collet_mm:
        return []
    words = Phrase(
        "{cutter} R {radius_mm:g} with a shank of {shank_mm:g} mm: the collet of machine '{machine}' takes "
        "{collet_mm:g} mm; allowed: at most {most_mm:g}",
        cutter=Phrase("a ball") if isinstance(row, PassRow) and row.is_ball else Phrase("a cutter"),
        radius_mm=row.radius_mm,
        shank_mm=shank_mm,
        machine=machine.name,
        collet_mm=machine.collet_mm,
        most_mm=machine.collet_mm / 2,
    )
    if row.shank_radius_mm is not None:
        return [(f"{place}.shank_radius_mm", words)]
    if isinstance(row, PassRow):
        words = Phrase("{allowed}, or a thinner shank as shank_radius_mm with its flute_length_mm", allowed=words)
    else:
        words = Phrase("{allowed}, or a thinner shank as shank_radius_mm", allowed=words)
    return [(f"{place}.radius_mm", words)]


def _beyond_the_mill(row: Cutter, machine: MachineProfile, place: str) -> list[tuple[str, Phrase]]:
    limits = {
        "spindle_rpm": (*machine.spindle_rpm, "rpm"),
        "feed_mm_per_min": (0.0, min(machine.max_rate_mm_per_min[:2]), "mm/min"),
        "plunge_mm_per_min": (0.0, machine.max_rate_mm_per_min[2], "mm/min"),
    }
    problems = []
    for key, (low, high, unit) in limits.items():
        value = getattr(row, key)
        if value is not None and not low <= value <= high:
            words = Phrase(
                "{value:g} is not allowed; allowed: {least:g} to {most:g} {unit} on machine '{machine}'",
                value=value,
                least=low,
                most=high,
                unit=unit,
                machine=machine.name,
            )
            problems.append((f"{place}.{key}", words))
    return problems


def digits_of(machine: MachineProfile) -> Digits:
    """Return the resolution of the mill's dialect, or whole steps if programs are to use them."""
    return post_of(machine).digits.coarsen(machine.step_mm if machine.whole_steps else 0.0)
