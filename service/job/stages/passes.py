"""The stage that finds a job's passes where its preset is "recommended": before the lens, which its ball shapes.

The passes go into report `plan`; `spec.resolve.with_plan` puts them into the spec that all later stages get.
"""

from __future__ import annotations

from service.job import arrays
from service.job.files import HEIGHTFIELD, MAP, PLAN
from service.job.planning.planner import plan_for_lens
from service.job.spec.lens_task import facts_of_light
from service.job.stages.context import StageContext
from service.job.stages.kept_plans import KeptPlans, MadePlan, describe_plan
from service.job.stages.lens import TARGET


def choose_passes(context: StageContext) -> None:
    """Plan passes for the picture; report `plan`, plan.png. Nothing where the passes stand in the spec already."""
    if not context.spec.to_be_planned:
        return
    target = context.receive(TARGET, arrays.load_target)
    if context.desk is not None:
        context.desk[TARGET] = target  # the lens is made from it as well
    with context.watch.stage("plan") as on_progress:
        plan = KeptPlans(context.plans).make(context.job, target, on_progress=on_progress)
        report_plan(context, plan)


def plan_passes_for_lens(context: StageContext) -> None:
    """Plan passes for a lens that exists; report `plan`, plan.png."""
    lens, target = context.receive(HEIGHTFIELD, arrays.load_heightfield), context.receive(MAP, arrays.load_target)
    with context.watch.stage("plan") as on_progress:
        planned = plan_for_lens(context.job, lens, target, on_progress=on_progress)
        report_plan(context, describe_plan(planned, viewed_from=context.spec.optics.viewed_from))


def report_plan(context: StageContext, plan: MadePlan) -> None:
    """Report `plan`, with the light that its scores hold under, and draw plan.png."""
    context.report["plan"] = {**plan.figures, "light": facts_of_light(context.spec)}
    for sentence in plan.notes:
        context.note("passes", sentence)
    context.draw(PLAN, plan.draw)
