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
from service.job.stages.context import Workshop
from service.job.stages.lens import TARGET


def choose_passes(shop: Workshop) -> None:
    """Passes for the picture; report `plan`, plan.png. Nothing where the passes stand in the spec already."""
    if not shop.spec.to_be_planned:
        return
    target = shop.receive(TARGET, arrays.load_target)
    if shop.desk is not None:
        shop.desk[TARGET] = target  # the lens is made from it as well
    with shop.watch.stage("plan") as reached:
        _tell(shop, plan_for_picture(shop.job, target, on_progress=reached))


def passes_for_lens(shop: Workshop) -> None:
    """Passes for a lens that exists; report `plan`, plan.png."""
    lens, target = shop.receive(HEIGHTFIELD, arrays.load_heightfield), shop.receive(MAP, arrays.load_target)
    with shop.watch.stage("plan") as reached:
        _tell(shop, plan_for_lens(shop.job, lens, target, on_progress=reached))


def _tell(shop: Workshop, planned: Planned) -> None:
    from service.job.report.figures import plan as figures_plan  # what it stands on is slow to import

    shop.report["plan"] = plan_figures(planned)
    for sentence in blur_warnings(planned, milled_next=True):
        shop.note("passes", sentence)
    shop.draw(PLAN, lambda: figures_plan.plan_png(planned, viewed_from=shop.spec.optics.viewed_from))
