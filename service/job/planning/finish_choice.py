"""Chooses the finish and its minutes: compares every process of the library that the job allows with milling alone."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby
from math import inf

import numpy as np

from cam.planning.planner import WORTH_DB, Candidate, Goal, Plan, plan_by_score
from optics.finish import Finish
from optics.threads import thread_count
from phrases.phrase import Phrase
from service.job.planning.finished_light import Design, FinishedLight, Spectra
from service.job.planning.predicted_light import PictureLight
from service.job.planning.rim_room import measure_rim_room
from service.job.spec.finish import BEST, NONE, FinishSpec, fill_figures
from service.job.spec.finish_library import Process, say
from service.job.spec.lens_task import build_finish
from service.job.spec.resolve import ResolvedJob

_FINER = 1.12  # ratio of the minutes of two neighbours among the finishes
_NEAR = 3  # neighbours on either side for which one lens stands
_MOST_TRIALS = 4  # lenses beside the first of each process
_LEAST_K0, _MOST_K0 = 1.2, 25.0  # rad/mm: outside, no picture or no finish is left
_WORTH_DB = 0.1
_ALIKE_DB = 0.2  # PSNR hardly changes near its best, but longer work still levels visible marks in even areas
_CLOSE_DB = 40.0  # very close to the target: more is not worth hand work


@dataclass(frozen=True, slots=True, kw_only=True)
class Finishing:
    """A finish by hand: a process of the library, or one's own figures, and the minutes of work on the whole lens."""

    process: str
    title: str
    finish: Finish
    minutes: float | None
    depth_um: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FinishedPlan:
    """A plan, the finish after it, and the light model that it was made with."""

    plan: Plan
    finishing: Finishing
    light: FinishedLight


def list_finishings(job: ResolvedJob) -> list[Finishing]:
    """Return the finishes that the job allows: one if its transfer function is given, otherwise one for each duration
    worth trying.
    """
    spec, processes = job.spec, job.figures.processes
    given = spec.finish
    if not given.finishes:
        return []
    if build_finish(given) is not None:
        return [
            _build(given, Phrase("Your own finish") if given.process == NONE else say(processes[given.process].title))
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
            given = FinishSpec(process=process.name, minutes=minutes)
            yield _build(fill_figures(given, process, area_mm2=area_mm2), say(process.title))


def _build(given: FinishSpec, title: str) -> Finishing:
    finish = build_finish(given)
    assert finish is not None
    return Finishing(process=given.process, title=title, finish=finish, minutes=given.minutes, depth_um=given.depth_um)


def plan_finish(
    finishings: list[Finishing],
    candidates: list[Candidate],
    left_out: tuple[tuple[str, Phrase], ...],
    milled: PictureLight,
    design: Design,
    goal: Goal,
    *,
    exactly: bool,
    margin_mm: float,
) -> FinishedPlan:
    """Return the best plan of all finishes whose tool reaches the rims, or of all finishes if none does.

    A lens corrects the guess of one finish of each process, then of the best one, until a similar one has been
    corrected.

    exactly    : also simulate the best with a lens as fine as the picture
    candidates : plans of milling, whose time and marks are reused; those with a rest pass are skipped
    margin_mm  : of the block around the lens
    """
    rows, best_of = _quickest_alike(candidates), find_best if exactly else _find_best_by_merit
    spectra = Spectra(milled)
    ways = [(one, FinishedLight(milled, one.finish, spectra)) for one in finishings]
    reaching = {light: _select_with_room(rows, light, margin_mm) for _, light in ways}
    ways = [way for way in ways if reaching[way[1]]] or ways
    rows_of = {light: reaching[light] or rows for _, light in ways}
    lights, tried = [light for _, light in ways], set[int]()

    def try_best_of(numbers: Iterable[int]) -> FinishedPlan:
        """Return the best plan of these finishes; a lens corrects its guess unless a similar finish was corrected
        before.
        """
        best = best_of(_plan_all(rows_of, left_out, [ways[number] for number in numbers], goal), goal)
        number = lights.index(best.light)
        if find_nearest(number, ways, tried, within=_NEAR) is None:
            best.light.calibrate(best.plan.chosen.marks, design)
            tried.add(number)
            trust_nearest(ways, tried)
        return best

    for _, alike in groupby(range(len(ways)), lambda number: ways[number][0].process):
        try_best_of(alike)
    for _ in range(_MOST_TRIALS):
        before = len(tried)
        best = try_best_of(range(len(ways)))
        if len(tried) == before:
            break
    else:
        best = try_best_of(sorted(tried))
    if not exactly:
        best.light.look_at(best.plan.chosen.marks, design)
        return best
    best.light.calibrate(best.plan.chosen.marks, design, fine=True)
    (found,) = _plan_all(rows_of, left_out, [(best.finishing, best.light)], goal)
    for one in found.plan.front:
        if not best.light.is_lit(one.marks):
            best.light.look_at(one.marks, design)
    return found


def trust_nearest(ways: Sequence[tuple[Finishing, FinishedLight]], tried: Collection[int]) -> None:
    """Apply to each finish the corrections of the nearest tried finish of the same process: places that one tool does
    not reach say nothing about other tools.
    """
    for number, (_, light) in enumerate(ways):
        nearest = find_nearest(number, ways, tried)
        if nearest is not None and number not in tried:
            light.trust(ways[nearest][1])


def find_nearest(
    number: int, ways: Sequence[tuple[Finishing, FinishedLight]], tried: Collection[int], *, within: float = inf
) -> int | None:
    """Return the nearest of the tried finishes of the same process in the list; None if none is near enough."""
    alike = (one for one in tried if ways[one][0].process == ways[number][0].process and abs(one - number) <= within)
    return min(alike, key=lambda one: abs(one - number), default=None)


def _quickest_alike(candidates: list[Candidate]) -> list[Candidate]:
    """Return the quickest of the finishes in rows and without a rest pass that leave the same marks; sorted.

    Contour paths are excluded: a lens for a finish is wavier than the coarse one from which their speed is known, and
    they have left gaps on it (`chelsea`, 60 mm, R 3, 0.05 mm: tracks 0.137 mm apart), which the check of the program
    refuses.
    """
    found: dict[tuple[object, ...], Candidate] = {}
    for one in sorted(candidates, key=lambda one: (one.hours, one.tool.cost_class)):
        if one.rest is None and one.finish.strategy == "raster":
            finish = one.finish
            found.setdefault((finish.radius_mm, finish.pitch_mm, finish.direction, one.slopes.off_mm), one)
    return list(found.values())


def _select_with_room(candidates: list[Candidate], light: FinishedLight, margin_mm: float) -> list[Candidate]:
    """Return the finishes whose tool reaches the rims after their passes."""
    found: dict[tuple[object, ...], bool] = {}

    def is_reached(one: Candidate) -> bool:
        shapes = tuple((spec.radius_mm, spec.corner_radius_mm, spec.stock_to_leave_mm) for spec in one.passes)
        if shapes not in found:
            lens = light.lenses[one.marks.radius_mm].form.lens
            room = measure_rim_room(lens, one.passes, light.finish, margin_mm=margin_mm)
            found[shapes] = room is None or room.is_reached
        return found[shapes]

    return [one for one in candidates if is_reached(one)]


def _plan_all(
    rows_of: Mapping[FinishedLight, list[Candidate]],
    left_out: tuple[tuple[str, Phrase], ...],
    ways: list[tuple[Finishing, FinishedLight]],
    goal: Goal,
) -> list[FinishedPlan]:
    return [
        FinishedPlan(
            plan=plan_by_score(_score_better(rows_of[light], light), left_out, goal), finishing=finishing, light=light
        )
        for finishing, light in ways
    ]


def _find_best_by_merit(plans: list[FinishedPlan], goal: Goal) -> FinishedPlan:
    return max(plans, key=lambda one: merit(one.plan, goal))


def find_best(plans: list[FinishedPlan], goal: Goal) -> FinishedPlan:
    """Return the best by merit; among plans of like PSNR, if that decides, the one with the greatest SSIM."""
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
    return one.light.score(one.light.clear_picture(one.plan.chosen.marks)).ssim


def _score_better(candidates: list[Candidate], light: FinishedLight) -> list[Candidate]:
    """Return the plans of a Pareto front, scored, quickest first."""
    found: list[Candidate] = []
    for one, psnr_db in zip(candidates, light.psnrs_db([one.marks for one in candidates]), strict=True):
        if not found or psnr_db > found[-1].psnr_db + WORTH_DB:
            found.append(replace(one, psnr_db=psnr_db, blur_mm=light.blur_mm(one.slopes)))
    return found


def merit(plan: Plan, goal: Goal) -> tuple[bool, float]:
    """Return the merit; larger is better. First counts whether the goal is met, then the time for a goal of quality,
    the picture for a goal of time, and without a goal the better balance of both.
    """
    chosen = plan.chosen
    if goal.is_quality:
        return plan.met, -chosen.hours if plan.met else chosen.psnr_db
    return plan.met, chosen.value_db if goal.hours is None else chosen.psnr_db


def is_worth_it(finished: Plan, milled: Plan, goal: Goal) -> bool:
    """Return whether finishing makes the picture better or reaches the same goal sooner."""
    if goal.is_quality:
        return merit(finished, goal) > merit(milled, goal)
    with_db, without_db = (min(plan.chosen.psnr_db, _CLOSE_DB) for plan in (finished, milled))
    return (finished.met, with_db) > (milled.met, without_db + _WORTH_DB)
