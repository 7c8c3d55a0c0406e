"""Which finish, and for how many minutes: every way of the library that the job allows, beside milling alone."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from cam.planning.planner import WORTH_DB, Candidate, Goal, Plan, plan_by_score
from optics.finish import Finish
from optics.threads import thread_count
from phrases.phrase import Phrase
from service.job.planning.finished_light import Design, FinishedLight, Spectra
from service.job.planning.predicted_light import PictureLight
from service.job.spec.finish import BEST, NONE
from service.job.spec.finish_library import Process, say
from service.job.spec.lens_task import finish_of
from service.job.spec.resolved import ResolvedJob

_NEAR = 6  # of such steps, within which a lens is as good a sample
_FINER = 1.12  # minutes, from one that is tried to the next
_LEAST_K0, _MOST_K0 = 1.2, 25.0  # rad/mm: beyond, no picture or no finish is left
_FINER_LACKS = 1.6  # times as much as a lens of 96 pixels, of the light of one as fine as the picture
_WORTH_DB = 0.1
_ALIKE_DB = 0.2  # PSNR hardly changes near its best, where longer work still levels what is seen in even areas
_CLOSE_DB = 40.0  # very close to the target: nobody works by hand for more


@dataclass(frozen=True, slots=True, kw_only=True)
class Finishing:
    """A way to finish by hand: a process of the library, or one's own figures, and the work on the whole lens."""

    process: str
    title: str
    finish: Finish
    minutes: float | None
    depth_um: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FinishedPlan:
    """A plan, the finish after it, and the light that it was made with."""

    plan: Plan
    finishing: Finishing
    light: FinishedLight


def list_finishings(job: ResolvedJob) -> list[Finishing]:
    """Return what the job allows: one where its transfer function is given, else one for each time of work worth
    trying.
    """
    spec, processes = job.spec, job.figures.processes
    given = spec.finish
    if not given.finishes:
        return []
    if (finish := finish_of(spec)) is not None:
        title = Phrase("Your own finish") if given.process == NONE else say(processes[given.process].title)
        return [
            Finishing(process=given.process, title=title, finish=finish, minutes=given.minutes, depth_um=given.depth_um)
        ]
    area_mm2 = spec.optics.width_mm * spec.optics.height_mm
    names = [one.name for one in processes.values() if one.offered] if given.process == BEST else [given.process]
    return [one for name in names for one in _by_minutes(processes[name], area_mm2)]


def _by_minutes(process: Process, area_mm2: float) -> Iterator[Finishing]:
    least, most = process.least_and_most_minutes(area_mm2)
    steps = int(np.log(most / least) / np.log(_FINER))
    for minutes in least * _FINER ** np.arange(steps + 1):
        minutes = round(float(minutes), 1)
        k0 = process.k0_rad_per_mm(minutes, area_mm2)
        if _LEAST_K0 <= k0 <= _MOST_K0:
            yield Finishing(
                process=process.name,
                title=say(process.title),
                finish=Finish(k0_rad_per_mm=round(k0, 4), order=process.order, pad_mm=min(process.pad_mm, 5000.0)),
                minutes=minutes,
                depth_um=round(process.depth_after_um(minutes, area_mm2), 2),
            )


def plan_finish(
    finishings: list[Finishing],
    candidates: list[Candidate],
    left_out: tuple[tuple[str, Phrase], ...],
    milled: PictureLight,
    design: Design,
    goal: Goal,
    *,
    exactly: bool,
) -> FinishedPlan:
    """Return the best plan of all finishings, its guesses corrected by a lens designed for one of the best of them.

    exactly    : and by one as fine as the picture for each of the two best: creases cost more there than on a coarse
    candidates : of milling, whose time and marks they take over; those with a rest pass are passed over
    """
    rows, best_of = _quickest_alike(candidates), find_best if exactly else _find_best_by_merit
    spectra = Spectra(milled)
    ways = [(one, FinishedLight(milled, one.finish, spectra)) for one in finishings]
    first = best_of(_plan_all(rows, left_out, ways[::_NEAR], goal), goal)
    first.light.calibrate(first.plan.chosen.marks, design, finer_lacks=1.0 if exactly else _FINER_LACKS)
    for _, light in ways:
        if light is not first.light:
            light.trust(first.light)
    if not exactly:
        best = best_of(_plan_all(rows, left_out, ways[::_NEAR], goal), goal)
        at = next(number for number, (_, light) in enumerate(ways) if light is best.light)
        return best_of(_plan_all(rows, left_out, ways[max(0, at - _NEAR) : at + _NEAR + 1], goal), goal)
    plans = _plan_all(rows, left_out, ways, goal)
    best = find_best(plans, goal)
    two = sorted(plans, key=lambda one: (one is best, merit(one.plan, goal)))[-2:]  # some lenses turn out badly
    for one in two:
        one.light.calibrate(one.plan.chosen.marks, design, fine=True)
    return find_best(_plan_all(rows, left_out, [(one.finishing, one.light) for one in two], goal), goal)


def _quickest_alike(candidates: list[Candidate]) -> list[Candidate]:
    """Return, of finishes without a rest pass that leave the same, the quickest, whatever their strategy; sorted."""
    found: dict[tuple[object, ...], Candidate] = {}
    for one in sorted(candidates, key=lambda one: (one.hours, one.tool.cost_class)):
        if one.rest is None:
            finish = one.finish
            found.setdefault((finish.radius_mm, finish.pitch_mm, finish.direction, one.slopes.off_mm), one)
    return list(found.values())


def _plan_all(
    candidates: list[Candidate],
    left_out: tuple[tuple[str, Phrase], ...],
    ways: list[tuple[Finishing, FinishedLight]],
    goal: Goal,
) -> list[FinishedPlan]:
    return [
        FinishedPlan(
            plan=plan_by_score(_score_better(candidates, light), left_out, goal), finishing=finishing, light=light
        )
        for finishing, light in ways
    ]


def _find_best_by_merit(plans: list[FinishedPlan], goal: Goal) -> FinishedPlan:
    return max(plans, key=lambda one: merit(one.plan, goal))


def find_best(plans: list[FinishedPlan], goal: Goal) -> FinishedPlan:
    """Return the best by merit; of those whose PSNR is like its, where that decides, the one of the greatest SSIM."""
    best = _find_best_by_merit(plans, goal)
    if goal.is_quality:
        return best
    met, most_db = merit(best.plan, goal)
    least = (met, most_db - _ALIKE_DB)
    alike = [one for one in plans if merit(one.plan, goal) >= least]
    if len(alike) == 1:
        return best
    with ThreadPoolExecutor(thread_count()) as pool:
        return alike[int(np.argmax(list(pool.map(_ssim, alike))))]


def _ssim(one: FinishedPlan) -> float:
    return one.light.score(one.light.picture(one.plan.chosen.marks)).ssim


def _score_better(candidates: list[Candidate], light: FinishedLight) -> list[Candidate]:
    """Return, scored, those that come on a front, quickest first."""
    found: list[Candidate] = []
    for one, psnr_db in zip(candidates, light.psnrs_db([one.marks for one in candidates]), strict=True):
        if not found or psnr_db > found[-1].psnr_db + WORTH_DB:
            found.append(replace(one, psnr_db=psnr_db, blur_mm=light.blur_mm(one.slopes)))
    return found


def merit(plan: Plan, goal: Goal) -> tuple[bool, float]:
    """Return the merit, larger is better: a goal that is met, then less time where a quality was asked for, the picture
    where a time was, else what of both is worth more.
    """
    chosen = plan.chosen
    if goal.is_quality:
        return plan.met, -chosen.hours if plan.met else chosen.psnr_db
    return plan.met, chosen.value_db if goal.hours is None else chosen.psnr_db


def is_worth_it(finished: Plan, milled: Plan, goal: Goal) -> bool:
    """Return whether finishing makes the picture better, or the same goal quicker to reach."""
    if goal.is_quality:
        return merit(finished, goal) > merit(milled, goal)
    with_db, without_db = (min(plan.chosen.psnr_db, _CLOSE_DB) for plan in (finished, milled))
    return (finished.met, with_db) > (milled.met, without_db + _WORTH_DB)
