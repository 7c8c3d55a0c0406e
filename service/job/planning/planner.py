"""Plans a job's passes: gives picture, lens, tools and mill to `cam.planning.planner`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from math import ceil, floor, inf

from cam.checking.envelope import Envelope, Reach
from cam.duration import Kinematics
from cam.materials import MATERIALS
from cam.planning.pass_time import LensForm
from cam.planning.planner import (
    Goal,
    Marks,
    NoPlanError,
    Plan,
    find_candidates,
    plan_among,
    time_by_lens,
)
from cam.planning.shop import Shop
from cam.tools import Tool
from machines.profile import MachineProfile
from optics.heightfield import Array, Heightfield
from phrases.phrase import Phrase
from service.errors import InputError, SpecError
from service.job.planning.finish_choice import (
    FinishedPlan,
    Finishing,
    is_worth_it,
    list_finishings,
    plan_finish,
)
from service.job.planning.finished_light import Design
from service.job.planning.lenses import FinishDesigns, design_whole, predict_designs, predict_lens
from service.job.planning.plan import Planned
from service.job.planning.predicted_light import PictureLight
from service.job.planning.rim_room import RimRoom, measure_rim_room
from service.job.spec.envelope import envelope_of
from service.job.spec.finish import BEST
from service.job.spec.lens_task import bench_of, branch_of, lens_settings, require_contrast
from service.job.spec.model import JobSpec
from service.job.spec.resolve import ResolvedJob, digits_of, most_removal_mm3_per_min, post_of
from service.wording import duration

Progress = Callable[[float], None]
OwnLens = Callable[[Marks], Heightfield]
"""Designs the lens for those rows, at the job's resolution."""
COARSE_STEP_MM = 0.0005
"""Steps from which the light shows that heights between them are not reached."""
CONTOUR_FROM_MM = 15.0
"""Least size of a lens's narrower side: on less, half the path is joints, and one left a gap (R 1.5, 5 mm)."""


def plan_for_picture(
    job: ResolvedJob,
    target: Array,
    *,
    whole: Array | None = None,
    on_progress: Progress | None = None,
) -> Planned:
    """Plan passes for a picture, together with the ball for which the lens will be shaped.

    target : (ny, nx) work frame, mean 1
    whole  : the same target with more pixels, if finishes are compared by it
    """
    require_contrast(job.spec, target)
    spec, shop = job.spec, shop_of(job)
    settings = lens_settings(spec, branch=branch_of(spec, target))
    aims = not any(spec.optics.foreseen_blur_mm)
    shapes = spec.optics.min_radius_mm is None and not spec.optics.creases
    light = predict_designs(target, settings, _radii(shop), as_given=not shapes, aims=aims, on_progress=on_progress)
    design = FinishDesigns(target, settings)
    own_lens = None if whole is not None else partial(design_whole, light, settings=settings, as_given=not shapes)
    planned = _choose_plan(job, shop, light, design, shapes_lens=shapes, whole=whole, own_lens=own_lens)
    return replace(planned, polished=None if planned.finishing is None else design.polished)


def plan_for_lens(
    job: ResolvedJob, lens: Heightfield, target: Array, *, on_progress: Progress | None = None
) -> Planned:
    """Plan passes for an existing lens."""
    shop = shop_of(job)
    bench = replace(bench_of(job.spec), branch=branch_of(job.spec, target))
    light = predict_lens(lens, target, bench, _radii(shop), on_progress=on_progress)
    return _choose_plan(job, shop, light, lambda finish, radius_mm, fine: (lens, target), shapes_lens=False)


def _score_by(light: PictureLight, plan: Plan) -> Plan:
    """Return the plan without its rest pass, its choice scored by another light model."""
    seen_db = light.aimed_db(replace(plan.chosen.marks, rest=None))
    return replace(plan, chosen=replace(plan.chosen, psnr_db=seen_db))


def _rim_room(light: PictureLight, plan: Plan, finishing: Finishing, margin_mm: float) -> RimRoom | None:
    lens = light.forms[plan.chosen.marks.radius_mm].lens
    return measure_rim_room(lens, plan.chosen.passes, finishing.finish, margin_mm=margin_mm)


def mill_of(job: ResolvedJob) -> MachineProfile:
    """Return the mill as a plan uses it: with heights in whole steps if the steps are coarse, unless the job says
    otherwise.
    """
    machine = job.machine
    if job.spec.machine.whole_steps is not None:
        return machine
    return replace(machine, whole_steps=machine.whole_steps or machine.step_mm >= COARSE_STEP_MM)


def shop_of(job: ResolvedJob) -> Shop:
    """Return tools, material and mill of a job."""
    machine = mill_of(job)
    digit_mm = post_of(machine).digits.z_mm
    optics = job.spec.optics
    narrowest_mm = min(optics.width_mm, optics.height_mm)
    envelope = envelope_of(job.spec, machine)
    return Shop(
        tools=tuple(_clamp_under_head(tool, envelope) for tool in job.figures.tools),
        material=MATERIALS[job.spec.stock.material],
        mill=Kinematics.of(machine),
        spindle_rpm=machine.spindle_rpm,
        step_mm=max(machine.step_mm, digit_mm),
        whole_steps=machine.whole_steps or digit_mm >= machine.step_mm,
        noise_mm=machine.z_noise_mm,
        margin_mm=_free_margin_mm(job.spec, envelope),
        strategies=("raster", "contour") if narrowest_mm >= CONTOUR_FROM_MM else ("raster",),
        collet_mm=inf if machine.collet_mm is None else machine.collet_mm,
        removal_mm3_per_min=most_removal_mm3_per_min(machine, MATERIALS[job.spec.stock.material]),
        digits=digits_of(machine),
        safe_z_mm=machine.safe_z_mm,
        room_mm=min(machine.travel_mm[0] - optics.width_mm, machine.travel_mm[1] - optics.height_mm) / 2,
        envelope=envelope,
    )


def _clamp_under_head(tool: Tool, envelope: Envelope) -> Tool:
    """Return the tool clamped shorter where the mill's head has no room for all of its length."""
    reach = Reach(radius_mm=tool.radius_mm, beyond_mm=(0.0, 0.0), lowest_mm=0.0, stick_out_mm=tool.stick_out_mm)
    base_mm = max(envelope.through_mm, 0.0) if envelope.base_mm is None else envelope.base_mm
    over_mm = base_mm - replace(envelope, gantry_mm=None).base_range_mm([reach])[1]
    return tool if over_mm <= 0 else replace(tool, stick_out_mm=max(0.0, floor(tool.stick_out_mm - over_mm)))


def _free_margin_mm(spec: JobSpec, envelope: Envelope) -> float:
    """Return the width of the margin that plans may clear: up to the nearest clamp."""
    at_rim = Reach(radius_mm=0.0, beyond_mm=(0.0, 0.0), lowest_mm=0.0)
    return min([spec.stock.margin_mm, *(envelope.distance_mm(at_rim, clamp) for clamp in envelope.clamps)])


def _radii(shop: Shop) -> list[float]:
    """Return the radii of the balls that the spindle holds and the block has room for; if there are none, all radii, so
    that each is refused by name.
    """
    radii = {tool.radius_mm for tool in shop.balls}
    return sorted({tool.radius_mm for tool in shop.balls if shop.holds(tool) and shop.has_room_for(tool)} or radii)


@contextmanager
def _refuse_without_plan() -> Iterator[None]:
    """Raise InputError with the reason for each tool if none of them can finish a lens."""
    try:
        yield
    except NoPlanError as error:
        raise InputError(
            Phrase("none of the tools can finish this lens"),
            *(Phrase("{name}: {why}", name=name, why=why) for name, why in error.left_out),
        ) from None


def _choose_plan(
    job: ResolvedJob,
    shop: Shop,
    light: PictureLight,
    design: Design,
    *,
    shapes_lens: bool,
    whole: Array | None = None,
    own_lens: OwnLens | None = None,
) -> Planned:
    goal, is_free = Goal(**job.spec.plan.model_dump()), job.spec.finish.process == BEST
    finishings, quickly = list_finishings(job), whole is not None
    finished: FinishedPlan | None = None
    margin_mm = job.spec.stock.margin_mm
    with _refuse_without_plan(), ThreadPoolExecutor(1) as beside:
        coming = beside.submit(light.retarget, whole) if finishings and whole is not None else None
        candidates, left_out = find_candidates(shop, light.forms, light, fillings=light.fillings, quickly=quickly)
        choose_milled = partial(
            plan_among, candidates, left_out, light, goal, shop=shop, lenses=lambda: light.forms, quickly=quickly
        )
        finish_among = partial(plan_finish, finishings, candidates, left_out, margin_mm=margin_mm)
        if coming is not None:
            seen = coming.result()

            def settle() -> tuple[Plan, Plan]:
                settled = choose_milled()
                return settled, _score_by(seen, settled)

            settling = beside.submit(settle)
            finished = finish_among(seen, design, goal, exactly=False)
            plan, milled = settling.result()
        else:
            if finishings:
                finished = finish_among(light, design, goal, exactly=True)
            milled = plan = choose_milled()
    finishing = None
    if finished is not None and (not is_free or is_worth_it(finished.plan, milled, goal)):
        plan, light, finishing = finished.plan, finished.light, finished.finishing
    elif own_lens is not None:  # before a finish, whose heights are shaped, the coarse lens predicts better: 1 %, not 4
        coarse = light.forms[plan.chosen.finish.radius_mm]
        plan = time_by_lens(plan, LensForm.of(own_lens(plan.chosen.marks)), goal, guessed=coarse, shop=shop)
    if goal.hours is not None and not plan.met:
        least = ceil(10 * plan.quickest.hours) / 10
        words = Phrase(
            "no plan takes {most_hours:g} h or less; the quickest: {quickest}",
            most_hours=goal.hours,
            quickest=duration(3600 * plan.quickest.hours),
        )
        raise SpecError([("plan.hours", words)], {"plan.hours": least})
    return Planned(
        plan=plan,
        light=light,
        machine=mill_of(job),
        goal=goal,
        shapes_lens=shapes_lens,
        tools=shop.tools,
        finishing=finishing,
        unfinished=None if finishing is None else milled,
        rim_room=None if finishing is None else _rim_room(light, plan, finishing, margin_mm),
    )
