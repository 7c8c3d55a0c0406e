"""A job's passes from its picture, its lens, the shop's tools and its mill: what `cam.planner` needs, and what it means
in words."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from cam.materials import PMMA
from cam.planner import Candidate, Goal, NoPlanError, Plan, find_candidates, plan_among, plan_by_score
from cam.posts.dialects import POSTS
from cam.shop import CLEAR_MM, Shop
from cam.tools import Tool
from machines.profiles import MachineProfile
from optics.heightfield import Array, Heightfield
from optics.metrics import CausticScore
from service.errors import InputError
from service.job.planning.finish_choice import (
    FinishedPlan,
    Finishing,
    is_surely_worth_it,
    is_worth_it,
    list_finishings,
    plan_finish,
)
from service.job.planning.finished_light import Design
from service.job.spec.finish import NONE
from service.passes import machine_of
from service.plan_lenses import finished_designs, lit_designs, lit_lens
from service.plan_light import PictureLight
from service.plan_words import blur_warning, blur_warnings, candidate_words, hopeful_db, reasons
from service.spec import JobSpec, PassRow
from service.stages.optical_task import bench_of, branch_of, lens_settings
from service.stages.plain import plain
from service.stages.programs import kinematics_of
from service.tools import load_tools

Progress = Callable[[float], None]
COARSE_STEP_MM = 0.0005
"""Steps from which the light shows that heights between them are not reached."""


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A plan with the eyes it was made with."""

    plan: Plan
    light: PictureLight
    machine: MachineProfile
    goal: Goal
    shapes_lens: bool  # the lens is shaped for the ball that is chosen
    tools: tuple[Tool, ...]
    finishing: Finishing | None = None  # what is done by hand after milling
    unfinished: Plan | None = None  # the best without that

    @cached_property
    def radius_of(self) -> dict[str, float]:
        return {tool.name: tool.radius_mm for tool in self.tools}

    @property
    def chosen(self) -> Candidate:
        return self.plan.chosen

    def picture(self, candidate: Candidate) -> Array:
        """Predicted light (ny, nx) on the screen of one of the plan's front, work frame."""
        return self._pictures[self.plan.front.index(candidate)]

    @cached_property
    def _pictures(self) -> tuple[Array, ...]:
        return tuple(self.light.picture(one.marks) for one in self.plan.front)

    @cached_property
    def _scores(self) -> tuple[CausticScore, ...]:
        return tuple(map(self.light.score, self._pictures))

    def score(self, candidate: Candidate) -> CausticScore:
        """PSNR, SSIM and the rest of the predicted light of one of the plan's front."""
        return self._scores[self.plan.front.index(candidate)]

    def foreseen_blur_mm(self, candidate: Candidate | None = None) -> list[float]:
        """What the lens is to be made sharper for, to the micrometre."""
        return [round(value, 3) for value in self.light.foreseen_blur_mm((candidate or self.chosen).marks)]

    def blur_px(self, candidate: Candidate) -> float:
        return candidate.blur_mm / min(self.light.pixel_mm)

    def rows(self, candidate: Candidate | None = None) -> list[dict[str, Any]]:
        """The passes as the job spec takes them."""
        passes = (candidate or self.chosen).passes
        rows = [{key: value for key, value in asdict(spec).items() if key in PassRow.model_fields} for spec in passes]
        return [{key: value for key, value in row.items() if value is not None} for row in rows]

    def fragment(self, candidate: Candidate | None = None) -> dict[str, Any]:
        """What laid over the job's spec, section by section, makes it this plan."""
        one = candidate or self.chosen
        optics: dict[str, Any] = {"min_radius_mm": one.finish.radius_mm} if self.shapes_lens else {}
        if any(blur_mm := self.foreseen_blur_mm(one)):
            optics["foreseen_blur_mm"] = blur_mm
        machine = {"whole_steps": True} if self.machine.whole_steps else {}
        return {"passes": self.rows(one), "optics": optics, "machine": machine, "finish": self.finish_table()}

    def finish_table(self) -> dict[str, Any]:
        """The finish as the job spec takes it."""
        if (chosen := self.finishing) is None:
            return {"process": NONE}
        table = {
            "process": chosen.process,
            "k0_rad_per_mm": chosen.finish.k0_rad_per_mm,
            "order": chosen.finish.order,
            "depth_um": chosen.depth_um,
            "minutes": chosen.minutes,
            "pad_mm": chosen.finish.pad_mm,
        }
        return {key: value for key, value in table.items() if value is not None}

    def figures(self) -> dict[str, Any]:
        """For report.json: what was chosen and what else there was, each with all that it takes to have it."""
        chosen = self.chosen
        return plain(
            {
                **self._figures(chosen),
                "passes": self.rows(),
                "min_radius_mm": chosen.marks.smallest_mm,
                "foreseen_blur_mm": self.foreseen_blur_mm(),
                "whole_steps": self.machine.whole_steps,
                "finish": self.finish_table(),
                "psnr_db_unfinished": None if self.unfinished is None else self.unfinished.chosen.psnr_db,
                "goal": {key: value for key, value in asdict(self.goal).items() if value is not None},
                "goal_met": self.plan.met,
                "perfect_psnr_db": self.light.perfect_db(chosen.marks.smallest_mm),
                "best_psnr_db": self.plan.best.psnr_db,
                "hopeful_db": hopeful_db(self),
                "chosen": self.plan.front.index(chosen),
                "candidates": [self._line(one) for one in self.plan.front],
                "left_out": [{"tool": name, "why": why} for name, why in self.plan.left_out],
                "why": self.why(),
                "warnings": self.warnings(),
            }
        )

    def rest_gain_db(self, one: Candidate) -> float:
        """What its rest pass brings; 0 without one."""
        if one.rest is None:
            return 0.0
        return one.psnr_db - self.light.aimed_db(replace(one.marks, rest=None))

    def _rest(self, one: Candidate) -> dict[str, Any] | None:
        """Of the pass that takes out what the finishing ball leaves in valleys."""
        if one.rest is None:
            return None
        lens = self.light.forms[one.finish.radius_mm]
        return {
            "tool": one.rest.tool.name,
            "radius_mm": one.rest.spec.radius_mm,
            "pitch_mm": one.rest.spec.pitch_mm,
            "area_mm2": one.rest.extent.area_mm2,
            "area_share": one.rest.extent.area_mm2 / (lens.width_mm * lens.height_mm),
            "length_mm": one.rest.extent.length_mm,
            "regions": one.rest.extent.regions,
            "hours": one.rest.extent.seconds / 3600,
            "gain_db": self.rest_gain_db(one),
        }

    def _figures(self, one: Candidate) -> dict[str, Any]:
        return {
            "hours": one.hours,
            "hours_by_pass": [seconds / 3600 for seconds in one.seconds],
            "psnr_db": one.psnr_db,
            "ssim": self.score(one).ssim,
            "blur_mm": one.blur_mm,
            "blur_px": self.blur_px(one),
            "rest": self._rest(one),
        }

    def _line(self, one: Candidate) -> dict[str, Any]:
        finish = one.finish
        return {
            **self._figures(one),
            "tool": one.tool.name,
            "radius_mm": finish.radius_mm,
            "pitch_mm": finish.pitch_mm,
            "direction": finish.direction,
            "strategy": finish.strategy,
            "words": candidate_words(one),
            "warning": blur_warning(self, one),
            "spec": self.fragment(one),
        }

    def why(self) -> list[str]:
        """Why these passes, in sentences."""
        return reasons(self)

    def warnings(self, *, milled_next: bool = False) -> list[str]:
        """What the chosen passes cannot do, and what would help; milled_next: but for what the job itself will tell."""
        return blur_warnings(self, milled_next=milled_next)


def plan_for_picture(
    spec: JobSpec,
    target: Array,
    *,
    whole: Array | None = None,
    tools: Path | None = None,
    on_progress: Progress | None = None,
) -> Planned:
    """Passes for a lens that is still to be designed, for the ball that finishes it.

    target : (ny, nx) work frame, mean 1
    whole  : the same with more pixels, where finishes are to be compared by that
    """
    shop = shop_of(spec, load_tools(tools))
    settings = lens_settings(spec, branch=branch_of(spec, target))
    aims = not any(spec.optics.foreseen_blur_mm)
    shapes = spec.optics.min_radius_mm is None and not spec.optics.creases
    light = lit_designs(target, settings, _radii(shop), as_given=not shapes, aims=aims, on_progress=on_progress)
    return _planned(spec, shop, light, finished_designs(target, settings), shapes_lens=shapes, whole=whole)


def plan_for_lens(
    spec: JobSpec, lens: Heightfield, target: Array, *, tools: Path | None = None, on_progress: Progress | None = None
) -> Planned:
    """Passes for a lens that exists."""
    shop = shop_of(spec, load_tools(tools))
    bench = replace(bench_of(spec), branch=branch_of(spec, target))
    light = lit_lens(lens, target, bench, _radii(shop), on_progress=on_progress)
    return _planned(spec, shop, light, lambda finish, radius_mm, fine: (lens, target), shapes_lens=False)


def _score_by(light: PictureLight, plan: Plan) -> Plan:
    """The plan, its choice scored by another light, without its rest pass."""
    seen_db = light.aimed_db(replace(plan.chosen.marks, rest=None))
    return replace(plan, chosen=replace(plan.chosen, psnr_db=seen_db))


def mill_of(spec: JobSpec) -> MachineProfile:
    """The mill as a plan has it run: heights in whole steps where these are coarse, unless the job says otherwise."""
    machine = machine_of(spec)
    if spec.machine.whole_steps is not None:
        return machine
    return replace(machine, whole_steps=machine.whole_steps or machine.step_mm >= COARSE_STEP_MM)


def shop_of(spec: JobSpec, tools: tuple[Tool, ...]) -> Shop:
    """Tools, material and mill of a job."""
    machine = mill_of(spec)
    digit_mm = POSTS[machine.dialect].digits.z_mm
    return Shop(
        tools=tools,
        material=PMMA,
        mill=kinematics_of(machine),
        spindle_rpm=machine.spindle_rpm,
        step_mm=max(machine.step_mm, digit_mm),
        whole_steps=machine.whole_steps or digit_mm >= machine.step_mm,
        noise_mm=machine.z_noise_mm,
        margin_mm=spec.stock.margin_mm,
        strategies=("raster", "contour"),
    )


def _radii(shop: Shop) -> list[float]:
    """Of the balls that the block has room for; of all, where it has room for none, so that each is refused by name."""
    radii = {tool.radius_mm for tool in shop.tools}
    return sorted({r for r in radii if 2 * r + CLEAR_MM <= shop.margin_mm} or radii)


def _planned(
    spec: JobSpec, shop: Shop, light: PictureLight, design: Design, *, shapes_lens: bool, whole: Array | None = None
) -> Planned:
    goal = Goal(**spec.plan.model_dump())
    finished: FinishedPlan | None = None
    try:
        candidates, left_out = find_candidates(shop, light.forms, light, fillings=light.fillings)
        finishings, given = list_finishings(spec), spec.finish.k0_rad_per_mm is not None
        if finishings and whole is None:
            finished = plan_finish(finishings, candidates, left_out, light, design, goal, exactly=True)
        if finishings and whole is not None:
            seen, plan = light.against(whole), plan_by_score(candidates, left_out, goal)
            with ThreadPoolExecutor(1) as beside:
                guessed = beside.submit(_score_by, seen, plan)
                finished = plan_finish(finishings, candidates, left_out, seen, design, goal, exactly=False)
                milled = guessed.result()
            if not given and not is_surely_worth_it(finished.plan, milled, goal):
                plan = plan_among(candidates, left_out, light, goal)
                milled = _score_by(seen, plan)
        else:
            milled = plan = plan_among(candidates, left_out, light, goal)
    except NoPlanError as error:
        raise InputError(
            "none of the tools can finish this lens", *(f"{name}: {why}" for name, why in error.left_out)
        ) from None
    if goal.hours is not None and not plan.met:
        raise InputError(
            f"plan.hours: {goal.hours:g} is too little: the quickest of all plans takes {plan.quickest.hours:.2g} hours"
        )
    planned = Planned(
        plan=plan, light=light, machine=mill_of(spec), goal=goal, shapes_lens=shapes_lens, tools=shop.tools
    )
    if finished is None or not (given or is_worth_it(finished.plan, milled, goal)):
        return planned
    return replace(planned, plan=finished.plan, light=finished.light, finishing=finished.finishing, unfinished=milled)
