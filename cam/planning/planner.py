"""Plans balls, pitches, directions and passes: finds every sensible way to mill a lens, its cost, and chooses one.

The caller predicts the light (`Light`), because this package does not model light. A lens is shaped for the ball that
finishes it, so each ball has its own lens: a larger ball leaves finer cusps, steps and noise, and fills more of the
valleys that make the darkest parts of the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import inf, log2
from typing import Protocol

from cam.passes import Direction, PassSpec
from cam.planning.pass_time import LensForm
from cam.planning.rest import Filled, RestPass, RestWork
from cam.planning.rough import Roughing
from cam.planning.row_slopes import RowSlopes
from cam.planning.sampled_time import FEW_ROWS, ROWS, first_pass_s, rows_s
from cam.planning.shop import Shop, find_exclusion, find_unheld, pitches_mm
from cam.tools import Tool, tool_pass
from phrases.phrase import Phrase

DOUBLING_DB = 0.75
"""The gain in the picture that is worth twice the time; an eye sees about 1. After a finish the optimum is flat: within
0.3 dB from 1.2 to 6.8 h for `chelsea`, 60 mm. With 1, finishing small lenses would not pay.
"""

WORTH_DB = 0.03
"""Smaller differences do not count."""
_GUESS_DB, _GOOD_DB = 0.25, 2.0
LEAST_FIT = 0.95
"""Share of the lens that a ball must fit to finish it: then its filled valleys are known well enough to predict the
light.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """The goal. If all are None: the picture beyond which no doubling of the time gains DOUBLING_DB."""

    hours: float | None = None
    blur_mm: float | None = None
    psnr_db: float | None = None

    @property
    def is_quality(self) -> bool:
        """Whether the goal is a picture of a given quality in the least time."""
        return self.psnr_db is not None or self.blur_mm is not None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Marks:
    """Slope errors that finishing leaves on a lens: by the rows of a pass, and by those of a rest pass after it."""

    spec: PassSpec
    slopes: RowSlopes
    rest: Marks | None = None

    @property
    def radius_mm(self) -> float:
        return self.spec.radius_mm

    @property
    def smallest_mm(self) -> float:
        """Radius of the ball that decides which valleys stay filled."""
        return self.spec.radius_mm if self.rest is None else self.rest.radius_mm


class Light(Protocol):
    """Predicts the light of milled lenses. Each ball has a lens: made for that ball, or as that ball leaves it."""

    def psnr_db(self, marks: Marks) -> float:
        """Return a quick estimate of the PSNR."""
        ...

    def settle(self, several: Iterable[Marks]) -> None:
        """Design the lenses for those balls again, sharpened by the blur of those rows."""
        ...

    def aimed_db(self, marks: Marks) -> float:
        """Compute the PSNR of a lens made for its own rows; slow, for a few of the best."""
        ...

    def blur_mm(self, slopes: RowSlopes) -> float:
        """Return the blur on the screen, root mean square across and along the rows together."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """One way to mill the lens.

    rest    : the last of the passes, if a rest pass follows the finish
    blur_mm : of the finish alone
    """

    tool: Tool
    passes: tuple[PassSpec, ...]
    seconds: tuple[float, ...]  # of each pass
    marks: Marks
    blur_mm: float
    psnr_db: float
    rest: RestPass | None = None

    @property
    def finish(self) -> PassSpec:
        return self.marks.spec

    @property
    def slopes(self) -> RowSlopes:
        return self.marks.slopes

    @property
    def before(self) -> tuple[PassSpec, ...]:
        """The passes before the finish."""
        return self.passes[: -1 if self.rest is None else -2]

    @cached_property
    def hours(self) -> float:
        return sum(self.seconds) / 3600

    @property
    def value_db(self) -> float:
        """Its PSNR, less DOUBLING_DB for each doubling of an hour."""
        return self.psnr_db - DOUBLING_DB * log2(self.hours)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The choice. front: the best picture for each time, quickest first; left_out: tool and reason."""

    chosen: Candidate
    front: tuple[Candidate, ...]
    left_out: tuple[tuple[str, Phrase], ...]
    met: bool  # whether the goal (hours, blur or PSNR) is met

    @property
    def best(self) -> Candidate:
        return self.front[-1]

    @property
    def quickest(self) -> Candidate:
        return self.front[0]


class NoPlanError(ValueError):
    """No tool of the shop can finish the lens; `left_out` has the reason for each."""

    def __init__(self, left_out: tuple[tuple[str, Phrase], ...]) -> None:
        super().__init__("; ".join(f"{name}: {reason}" for name, reason in left_out) or "there are no tools")
        self.left_out = left_out


def find_candidates(
    shop: Shop,
    lenses: Mapping[float, LensForm],
    light: Light,
    *,
    fillings: Mapping[float, Filled],
    quickly: bool = False,
) -> tuple[list[Candidate], tuple[tuple[str, Phrase], ...]]:
    """Return all candidates with their estimated light, and the tools left out, each with its reason.

    quickly : estimate times from fewer moves, within a tenth or two minutes
    NoPlanError if all are left out.
    """
    reasons = {tool: _find_reason(tool, lenses.get(tool.radius_mm), shop) for tool in shop.balls}
    left_out = tuple((tool.name, reason) for tool, reason in reasons.items() if reason is not None)
    fitting = [(tool, lenses[tool.radius_mm]) for tool, reason in reasons.items() if reason is None]
    candidates: list[Candidate] = []
    rough: Roughing | None = None
    for tool, form in fitting:
        rests = RestWork(tool, form=form, shop=shop, fillings=fillings)
        if rough is None or rough.form is not form:
            rough = Roughing(form=form, shop=shop, like=rough, quickly=quickly)
        if quickly and not candidates:
            _plan_beside_rows(rough, fitting)
        candidates += _generate_candidates(tool, rough, rests, light, FEW_ROWS if quickly else ROWS)
    if not candidates:
        raise NoPlanError(left_out)
    return candidates, left_out


def _find_reason(tool: Tool, form: LensForm | None, shop: Shop) -> Phrase | None:
    """Return why a tool is left out, as a clause; None if it is not."""
    if form is None:
        return find_unheld(tool, shop) or Phrase("no lens was shaped for it")
    return find_exclusion(tool, form, shop) or _find_misfit(tool, form)


def _plan_beside_rows(rough: Roughing, fitting: list[tuple[Tool, LensForm]]) -> None:
    """Plan the first roughing, in Python, while kernels make the rows of all balls; both results are cached."""
    shop = rough.shop

    def make_rows(tool: Tool, form: LensForm) -> None:
        for finish in _generate_finishes(tool, form, shop):
            rows_s(form, finish, shop.mill, shop.digits, made_rows=FEW_ROWS)

    with ThreadPoolExecutor(2) as beside:
        made = [beside.submit(make_rows, tool, form) for tool, form in fitting]
        rough.plan_before(next(_generate_finishes(*fitting[0], shop)))
        for one in made:
            one.result()


def plan_among(
    candidates: list[Candidate],
    left_out: tuple[tuple[str, Phrase], ...],
    light: Light,
    goal: Goal,
    *,
    shop: Shop,
    lenses: Callable[[], Mapping[float, LensForm]],
    quickly: bool = False,
) -> Plan:
    """Choose among candidates whose light has been estimated.

    lenses  : the present ones, by radius of the finishing ball
    quickly : estimate times from fewer moves, as in `find_candidates`
    """
    near = _select_near_front(candidates)
    best = {one.finish.radius_mm: one for one in sorted(near, key=lambda one: one.psnr_db)}
    guessed = dict(lenses())
    light.settle(one.marks for one in best.values())
    settled = lenses()
    near = [
        replace(
            _time_again(one, guessed[one.finish.radius_mm], settled[one.finish.radius_mm], shop, quickly=quickly),
            psnr_db=light.aimed_db(one.marks),
        )
        for one in near
    ]
    return plan_by_score(near, left_out, goal)


def _time_again(
    one: Candidate, guessed: LensForm, settled: LensForm, shop: Shop, *, quickly: bool = False
) -> Candidate:
    """Return the candidate with its finish timed on another lens: a sharper lens has shorter chords."""
    made_rows = FEW_ROWS if quickly else ROWS
    before_s, now_s = (
        rows_s(lens, one.finish, shop.mill, shop.digits, made_rows=made_rows) for lens in (guessed, settled)
    )
    seconds = list(one.seconds)
    seconds[len(one.before)] += now_s - before_s
    return replace(one, seconds=tuple(seconds))


def time_by_lens(plan: Plan, lens: LensForm, goal: Goal, *, guessed: LensForm, shop: Shop) -> Plan:
    """Return the plan with times from its actual lens; the other candidates of that ball are scaled in proportion.

    lens    : of the choice, at the job's resolution: fine detail has shorter chords and its own walls
    guessed : the coarse lens with which the plan was made
    """
    chosen = plan.chosen
    timed = _time_again(chosen, guessed, lens, shop)
    first_s = first_pass_s(lens, chosen.passes[0], shop.mill, shop.digits, safe_z_mm=shop.safe_z_mm)
    timed = replace(timed, seconds=(first_s, *timed.seconds[1:]))
    longer = timed.hours / chosen.hours
    front = [
        replace(one, seconds=tuple(longer * part_s for part_s in one.seconds))
        if one.finish.radius_mm == chosen.finish.radius_mm
        else one
        for one in plan.front
        if one is not chosen
    ]
    return plan_by_score([*front, timed], plan.left_out, goal)


def plan_by_score(candidates: list[Candidate], left_out: tuple[tuple[str, Phrase], ...], goal: Goal) -> Plan:
    """Choose among candidates by their own scores."""
    front = _select_front(candidates)
    chosen, met = choose(front, goal)
    return Plan(chosen=chosen, front=front, left_out=left_out, met=met)


def choose(front: tuple[Candidate, ...], goal: Goal) -> tuple[Candidate, bool]:
    """Choose the candidate that suits the goal best, and whether it meets it. front: quickest first, each better."""
    if goal.hours is not None:
        in_time = [one for one in front if one.hours <= goal.hours]
        return (in_time[-1], True) if in_time else (front[0], False)
    if goal.blur_mm is not None:
        sharp = [one for one in front if one.blur_mm <= goal.blur_mm]
        return (sharp[0], True) if sharp else (min(front, key=lambda one: one.blur_mm), False)
    if goal.psnr_db is None:
        return max(front, key=lambda one: one.value_db), True
    good = [one for one in front if one.psnr_db >= goal.psnr_db]
    return (good[0], True) if good else (front[-1], False)


def _select_front(candidates: list[Candidate]) -> tuple[Candidate, ...]:
    """Select candidates that are better by more than WORTH_DB than all that are quicker, or as quick but cheaper."""
    front: list[Candidate] = []
    for one in sorted(candidates, key=lambda one: (one.hours, -one.psnr_db, one.tool.cost_class)):
        if not front or one.psnr_db > front[-1].psnr_db + WORTH_DB:
            front.append(one)
    return tuple(front)


def _select_near_front(candidates: list[Candidate]) -> list[Candidate]:
    """Select the candidates that an estimate puts on the front, and good ones so close to it that a closer look may."""
    good_db = max(one.psnr_db for one in candidates) - _GOOD_DB
    near: list[Candidate] = []
    best_db = -inf
    for one in sorted(candidates, key=lambda one: (one.hours, -one.psnr_db, one.tool.cost_class)):
        if one.psnr_db > best_db + (-_GUESS_DB if one.psnr_db > good_db else _GUESS_DB):
            near.append(one)
        best_db = max(best_db, one.psnr_db)
    return near


def _find_misfit(tool: Tool, form: LensForm) -> Phrase | None:
    """Return a clause about the small share of the lens that a ball fits; None if it fits enough."""
    if (share := form.reached_share(tool.radius_mm)) >= LEAST_FIT:
        return None
    return Phrase(
        "its ball fits {percent:.1f} % of the lens; {least_percent:.0f} % are needed",
        percent=100 * share,
        least_percent=100 * LEAST_FIT,
    )


def _generate_candidates(
    tool: Tool, rough: Roughing, rests: RestWork, light: Light, made_rows: int
) -> Iterator[Candidate]:
    """Yield every finish with a tool, alone and, if it leaves stock, with a rest pass."""
    for finish in _generate_finishes(tool, rough.form, rough.shop):
        if rough.plan_before(finish) is None:
            continue
        yield _make_candidate(rough, tool, finish, None, light, made_rows)
        if (rest := rests.plan_after(finish)) is not None:
            yield _make_candidate(rough, tool, finish, rest, light, made_rows)


def _generate_finishes(tool: Tool, form: LensForm, shop: Shop) -> Iterator[PassSpec]:
    """Yield finishing passes, at feeds for which the link carries the lines of this lens."""
    step_down_mm = shop.finish_step_down_mm(tool)
    directions: tuple[Direction, ...] = ("x", "y")
    for strategy in shop.strategies:
        for direction in directions if strategy == "raster" else directions[:1]:
            speeds, pitches = shop.speeds(tool, finishes=True), pitches_mm(tool)
            asked = partial(
                tool_pass, "finish", tool, leaves_mm=0.0, step_down_mm=step_down_mm, direction=direction,
                strategy=strategy,
            )  # fmt: skip
            if pitches:
                speeds = shop.speeds(tool, finishes=True, like=(form, asked(speeds, pitch_mm=pitches[0])))
            for pitch_mm in pitches:
                yield asked(speeds, pitch_mm=pitch_mm)


def _make_candidate(
    rough: Roughing, tool: Tool, finish: PassSpec, rest: RestPass | None, light: Light, made_rows: int
) -> Candidate:
    before = rough.plan_before(finish)
    assert before is not None
    shop, form = rough.shop, rough.form
    own_s = rows_s(form, finish, shop.mill, shop.digits, made_rows=made_rows) + before.layers_s(form, finish, shop)
    slopes = shop.slopes(form, finish)
    after = () if rest is None else (rest,)
    marks = Marks(spec=finish, slopes=slopes, rest=None if rest is None else Marks(spec=rest.spec, slopes=rest.slopes))
    return Candidate(
        tool=tool,
        passes=(*before.passes, finish, *(one.spec for one in after)),
        seconds=(*before.seconds, own_s, *(one.extent.seconds for one in after)),
        marks=marks,
        blur_mm=light.blur_mm(slopes),
        psnr_db=light.psnr_db(marks),
        rest=rest,
    )
