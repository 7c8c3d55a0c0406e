"""The stage that plans a job's passes if its preset is "recommended". It runs before the lens, whose shape depends on
the ball. The passes go into report `plan`; `spec.resolve.with_plan` puts them into the spec that all later stages get.

An exact estimate and a job of the same input share one plan, as do two estimates or two jobs.

A plan is kept in a folder under the planning stage's key, which covers picture, spec, mill, tools, sources and
libraries. The file holds the plan's report and picture, and the light that an estimate shows.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cam.planning.planner import Candidate
from optics.heightfield import Array
from optics.polish import Polished
from phrases.phrase import Phrase, phrases_in, restore
from service.errors import FailedError, InputError
from service.job import arrays
from service.job.arrays import npz_bytes
from service.job.files import HEIGHTFIELD, MAP, PLAN, plain, write_bytes
from service.job.planning.plan import Planned
from service.job.planning.plan_report import plan_figures
from service.job.planning.planner import Progress, plan_for_lens, plan_for_picture
from service.job.planning.predicted_light import PredictedPicture, describe_light, draw_wall
from service.job.planning.sentences import blur_warnings
from service.job.spec.lens_task import facts_of_light
from service.job.spec.resolve import ResolvedJob
from service.job.stages.context import StageContext
from service.job.stages.lens import POLISHED, TARGET
from service.job.stages.order import FileRef
from service.job.stages.table import stage_key
from service.processes.files import forget_oldest, make_private

_STAGE = "passes"
KEPT_BYTES = 200_000_000  # of all plans; one of a 512 x 512 picture takes 3 MB


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanChoice:
    """One of the plans that a person chooses from.

    spec    : the values that select it, merged into the job's section by section
    wall    : its light, a data URL; the other figures are those of this light
    """

    is_chosen: bool
    seconds: tuple[float, ...]  # of each pass
    spec: dict[str, Any]
    psnr_db: float
    seen_db: float
    detail_mm: float
    wall: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MadePlan:
    """A plan for its users, whether made now or read from a file.

    figures : report `plan`
    notes   : of the passes, for the setup sheet
    draw    : returns plan.png
    see     : returns what the wall will show
    choices : returns the quickest, the chosen and the best plan, each once, quickest first
    polished: the lens for its finish, so that the next stage need not make it again
    """

    figures: dict[str, Any]
    notes: list[Phrase]
    draw: Callable[[], bytes]
    see: Callable[[], PredictedPicture]
    choices: Callable[[], tuple[PlanChoice, ...]] = tuple
    polished: Polished | None = None


class KeptPlans:
    """Finds, makes and keeps plans; folder: where, or None: nothing is kept."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def make(
        self, job: ResolvedJob, target: Array, *, on_progress: Progress | None = None, at_once: bool = False
    ) -> MadePlan:
        """Return the plan of a job for a target (ny, nx), work frame, mean 1. A new plan is kept once it is drawn, or
        at once.
        """
        path = self._path(job, target)
        if path is not None and (found := _load(path, target)) is not None:
            return found
        planned = plan_for_picture(job, target, on_progress=on_progress)
        made = describe_plan(planned, viewed_from=job.spec.optics.viewed_from)
        if path is None:
            return made
        if at_once:
            _keep(path, made)
            return made
        return replace(made, draw=lambda: _keep(path, made))

    def _path(self, job: ResolvedJob, target: Array) -> Path | None:
        if self._folder is None:
            return None
        digest = hashlib.sha256(f"{target.shape} {target.dtype}".encode() + np.ascontiguousarray(target).data)
        outputs = {TARGET: FileRef(sha256=digest.hexdigest(), bytes=target.nbytes)}
        return self._folder / f"{stage_key(_STAGE, job, image_sha256='', image_name='', outputs=outputs)}.npz"


NO_PLANS = KeptPlans(None)


def describe_plan(planned: Planned, *, viewed_from: Literal["lens", "behind"]) -> MadePlan:
    """Return a plan that was just made, for its users."""

    def draw() -> bytes:
        from service.job.report.figures.plan import plan_png  # its dependencies are slow to import

        return plan_png(planned, viewed_from=viewed_from)

    return MadePlan(
        figures=plan_figures(planned),
        notes=blur_warnings(planned, milled_next=True),
        draw=draw,
        see=lambda: describe_light(planned.light, planned.chosen.marks),
        choices=cache(lambda: tuple(_describe_choice(planned, one, viewed_from) for one in planned.choices)),
        polished=planned.polished,
    )


def _describe_choice(planned: Planned, one: Candidate, viewed_from: Literal["lens", "behind"]) -> PlanChoice:
    seen = describe_light(planned.light, one.marks)
    return PlanChoice(
        is_chosen=one is planned.chosen,
        seconds=one.seconds,
        spec=plain(planned.fragment(one)),
        psnr_db=seen.psnr_db,
        seen_db=seen.seen_db,
        detail_mm=seen.detail_mm,
        wall=draw_wall(seen, viewed_from),
    )


def _load(path: Path, target: Array) -> MadePlan | None:
    """Load a plan; None if there is none or the file is damaged."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            words, picture, light, lens = (stored[name] for name in ("words", "picture", "light", "lens"))
        stored_words = json.loads(words.tobytes())
        seen = PredictedPicture(light=light, target=target, **stored_words["seen"])
        found = restore(stored_words["plan"], stored_words["phrases"])
        choices = tuple(PlanChoice(**one | {"seconds": tuple(one["seconds"])}) for one in stored_words["choices"])
        os.utime(path)  # in use: see `forget_oldest`
        return MadePlan(
            figures=found["figures"],
            notes=found["notes"],
            draw=picture.tobytes,
            see=lambda: seen,
            choices=lambda: choices,
            polished=arrays.load_polished(io.BytesIO(lens)) if lens.size else None,
        )
    except (InputError, OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None


def _keep(path: Path, made: MadePlan) -> bytes:
    """Keep a plan and return its picture. A plan that cannot be kept will be made again."""
    picture, seen = made.draw(), asdict(made.see())
    light = seen.pop("light")
    del seen["target"]  # the caller has it already
    plan = {"figures": made.figures, "notes": made.notes}
    choices = [asdict(one) for one in made.choices()]
    words = json.dumps({"plan": plan, "phrases": phrases_in(plan), "seen": seen, "choices": choices}).encode()
    lens = b"" if made.polished is None else arrays.polished_bytes(made.polished)
    files = {"words": words, "picture": picture, "lens": lens}
    kept = {"light": light, **{name: np.frombuffer(data, np.uint8) for name, data in files.items()}}
    with suppress(OSError, FailedError):
        make_private(path.parent)
        write_bytes(path, npz_bytes(kept))
        forget_oldest(path.parent, KEPT_BYTES)
    return picture


def choose_passes(context: StageContext) -> None:
    """Plan passes for the picture; report `plan`, plan.png. Do nothing if the spec already has passes."""
    if not context.spec.to_be_planned:
        return
    target = context.receive(TARGET, arrays.load_target)
    with context.watch.stage("plan") as on_progress:
        plan = KeptPlans(context.plans).make(context.job, target, on_progress=on_progress)
        report_plan(context, plan)
    if plan.polished is not None:
        context.hand_over(POLISHED, plan.polished, arrays.polished_bytes)


def plan_passes_for_lens(context: StageContext) -> None:
    """Plan passes for a lens that exists; report `plan`, plan.png."""
    lens, target = context.receive(HEIGHTFIELD, arrays.load_heightfield), context.receive(MAP, arrays.load_target)
    with context.watch.stage("plan") as on_progress:
        planned = plan_for_lens(context.job, lens, target, on_progress=on_progress)
        report_plan(context, describe_plan(planned, viewed_from=context.spec.optics.viewed_from))


def report_plan(context: StageContext, plan: MadePlan) -> None:
    """Report `plan` with the light for which its scores hold, and draw plan.png."""
    context.report["plan"] = {**plan.figures, "light": facts_of_light(context.spec)}
    for sentence in plan.notes:
        context.note("passes", sentence)
    context.draw(PLAN, plan.draw)
