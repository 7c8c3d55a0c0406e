"""The stage that finds a job's passes where its preset is "recommended": before the lens, which its ball shapes.

The passes go into report `plan`; `spec.resolve.with_plan` puts them into the spec that all later stages get.
"""

from __future__ import annotations

from service.job import arrays
from service.job.files import HEIGHTFIELD, MAP, PLAN
from service.job.planning.plan import Planned
from service.job.planning.plan_report import plan_figures
from service.job.planning.planner import plan_for_lens, plan_for_picture
from service.job.planning.sentences import blur_warnings
from service.job.spec.lens_task import facts_of_light
from service.job.stages.context import StageContext
from service.job.stages.lens import TARGET


def choose_passes(context: StageContext) -> None:
    """Plan passes for the picture; report `plan`, plan.png. Nothing where the passes stand in the spec already."""
    if not context.spec.to_be_planned:
        return
    target = context.receive(TARGET, arrays.load_target)
    if context.desk is not None:
        context.desk[TARGET] = target  # the lens is made from it as well
    with context.watch.stage("plan") as on_progress:
        tell_of_plan(context, plan_for_picture(context.job, target, on_progress=on_progress))


def plan_passes_for_lens(context: StageContext) -> None:
    """Plan passes for a lens that exists; report `plan`, plan.png."""
    lens, target = context.receive(HEIGHTFIELD, arrays.load_heightfield), context.receive(MAP, arrays.load_target)
    with context.watch.stage("plan") as on_progress:
        tell_of_plan(context, plan_for_lens(context.job, lens, target, on_progress=on_progress))


def tell_of_plan(context: StageContext, planned: Planned) -> None:
    """Report `plan`, with the light that its scores hold under, and draw plan.png."""
    from service.job.report.figures.plan import plan_png  # what it stands on is slow to import

    context.report["plan"] = {**plan_figures(planned), "light": facts_of_light(context.spec)}
    for sentence in blur_warnings(planned, milled_next=True):
        context.note("passes", sentence)
    context.draw(PLAN, lambda: plan_png(planned, viewed_from=context.spec.optics.viewed_from))
