"""Which balls, pitches, directions and passes: every sensible way to mill a lens, what each costs, and the choice.

What the light will be is asked of the caller (`Light`), for this package knows no light. A lens is shaped for the ball
that finishes it, so each ball has a lens of its own: a larger one leaves finer traces of itself, its steps and its
noise, and fills more of the valleys that make the picture's darkest places.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import atan, ceil, cos, inf, sqrt
from typing import Protocol

import numpy as np

from cam.duration import Kinematics
from cam.materials import Material
from cam.pass_time import LensForm, finish_layers_s, layers_s, rows_s
from cam.passes import Direction, PassSpec, Strategy
from cam.row_slopes import RowSlopes, row_slopes
from cam.tools import Speeds, Tool, tool_pass

PITCHES_MM = (0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1, 0.12, 0.14, 0.17, 0.2, 0.24, 0.28, 0.34, 0.4, 0.56, 0.8)
PITCH_SHARE = 1 / 8  # of the radius, at most
TOLERATED_DB = 0.2
_WORTH_DB = 0.03
_GUESS_DB, _GOOD_DB = 0.25, 2.0
LEAST_FIT = 0.99
_FINISH_STEP_DOWN_MM, _FINISH_STEP_DOWN_SHARE = 0.5, 1 / 3
_ROUGH_LEAVES_MM, _ROUGH_LEAVES_SHARE, _ROUGH_PITCH_SHARE = 0.2, 0.2, 1 / 3
_SEMI_LEAVES_MM, _SEMI_CUSP_MM = 0.03, 0.01
_CLEAR_MM = 1.0  # of the margin that must stay beside what a ball clears


@dataclass(frozen=True, slots=True, kw_only=True)
class Shop:
    """What there is to mill with.

    spindle_rpm       : slowest and fastest of the mill
    step_mm, noise_mm : smallest move of its axes; sigma of the height error from row to row
    whole_steps       : vertices of finishing passes are put where the path goes through whole steps
    margin_mm         : of the block around the lens
    strategies        : that finishing passes may take
    """

    tools: tuple[Tool, ...]
    material: Material
    mill: Kinematics
    spindle_rpm: tuple[float, float]
    step_mm: float
    noise_mm: float
    margin_mm: float
    whole_steps: bool = False
    strategies: tuple[Strategy, ...] = ("raster",)

    def speeds(self, tool: Tool) -> Speeds:
        return Speeds.of(
            tool,
            self.material,
            spindle_rpm=self.spindle_rpm,
            max_rate_mm_per_min=self.mill.max_rate_mm_per_min,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """What is wanted; all None: the least time that comes within TOLERATED_DB of the best picture."""

    hours: float | None = None
    blur_mm: float | None = None
    psnr_db: float | None = None


class Light(Protocol):
    """What a lens shows as milled."""

    def psnr_db(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> float:
        """Of the lens for that ball, its rows leaving those slopes; quick, a guess."""
        ...

    def settle(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> None:
        """Make the lens for that ball once more, sharper by as much as those rows will blur."""
        ...

    def aimed_db(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> float:
        """As `psnr_db`, of a lens made so for its own rows; slow, for a few of the best."""
        ...

    def blur_mm(self, slopes: RowSlopes) -> float:
        """Root mean square on the screen, across and along the rows together."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """One way to mill the lens."""

    tool: Tool
    passes: tuple[PassSpec, ...]
    seconds: tuple[float, ...]  # of each pass
    slopes: RowSlopes
    blur_mm: float
    psnr_db: float

    @property
    def finish(self) -> PassSpec:
        return self.passes[-1]

    @cached_property
    def hours(self) -> float:
        return sum(self.seconds) / 3600


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The choice. front: the best picture for each time, quickest first; left_out: tool and reason."""

    chosen: Candidate
    front: tuple[Candidate, ...]
    left_out: tuple[tuple[str, str], ...]
    met: bool  # the goal, as far as hours, blur or PSNR were given

    @property
    def best(self) -> Candidate:
        return self.front[-1]

    @property
    def quickest(self) -> Candidate:
        return self.front[0]


class NoPlanError(ValueError):
    """No tool of the shop can finish the lens; `left_out` says of each why."""

    def __init__(self, left_out: tuple[tuple[str, str], ...]) -> None:
        super().__init__("; ".join(f"{name}: {reason}" for name, reason in left_out) or "there are no tools")
        self.left_out = left_out


def make_plan(shop: Shop, lenses: Mapping[float, LensForm], light: Light, goal: Goal) -> Plan:
    """The choice among all candidates.

    lenses : by radius of the finishing ball; a tool without one is not considered
    """
    left_out: list[tuple[str, str]] = []
    candidates: list[Candidate] = []
    for tool in shop.tools:
        form = lenses.get(tool.radius_mm)
        reason = "no lens was shaped for it" if form is None else _why_not(tool, form, shop)
        if form is None or reason is not None:
            left_out.append((tool.name, reason or ""))
            continue
        rough = Roughing(form=form, shop=shop)
        candidates += [
            _candidate(rough, tool, finish, light)
            for finish in _finishes(tool, shop)
            if rough.before(finish) is not None
        ]
    if not candidates:
        raise NoPlanError(tuple(left_out))
    near = _near_front(candidates)
    for best in {one.finish.radius_mm: one for one in sorted(near, key=lambda one: one.psnr_db)}.values():
        light.settle(best.finish.radius_mm, best.slopes, best.finish)
    front = _front(
        [replace(one, psnr_db=light.aimed_db(one.finish.radius_mm, one.slopes, one.finish)) for one in near], _WORTH_DB
    )
    chosen, met = choose(front, goal)
    return Plan(chosen=chosen, front=front, left_out=tuple(left_out), met=met)


def choose(front: tuple[Candidate, ...], goal: Goal) -> tuple[Candidate, bool]:
    """The candidate that suits the goal best, and whether it meets it. front: quickest first, each better."""
    if goal.hours is not None:
        in_time = [one for one in front if one.hours <= goal.hours]
        return (in_time[-1], True) if in_time else (front[0], False)
    if goal.blur_mm is not None:
        sharp = [one for one in front if one.blur_mm <= goal.blur_mm]
        return (sharp[0], True) if sharp else (min(front, key=lambda one: one.blur_mm), False)
    wanted = front[-1].psnr_db - TOLERATED_DB if goal.psnr_db is None else goal.psnr_db
    good = [one for one in front if one.psnr_db >= wanted]
    return (good[0], True) if good else (front[-1], False)


def _front(candidates: list[Candidate], worth_db: float) -> tuple[Candidate, ...]:
    """Those that are better than all that are quicker, or as quick and cheaper, by more than worth_db."""
    front: list[Candidate] = []
    for one in sorted(candidates, key=lambda one: (one.hours, -one.psnr_db, one.tool.cost_class)):
        if not front or one.psnr_db > front[-1].psnr_db + worth_db:
            front.append(one)
    return tuple(front)


def _near_front(candidates: list[Candidate]) -> list[Candidate]:
    """Those that a guess puts on the front; of good ones also those so little behind that a closer look may."""
    good_db = max(one.psnr_db for one in candidates) - _GOOD_DB
    near: list[Candidate] = []
    best_db = -inf
    for one in sorted(candidates, key=lambda one: (one.hours, -one.psnr_db, one.tool.cost_class)):
        if one.psnr_db > best_db + (-_GUESS_DB if one.psnr_db > good_db else _GUESS_DB):
            near.append(one)
        best_db = max(best_db, one.psnr_db)
    return near


def _why_not(tool: Tool, form: LensForm, shop: Shop) -> str | None:
    """Why a tool cannot finish a lens, as a clause."""
    if 2 * tool.radius_mm + _CLEAR_MM > shop.margin_mm:
        need_mm = 2 * tool.radius_mm + _CLEAR_MM
        return f"it clears {2 * tool.radius_mm:g} mm around the lens; that needs stock.margin_mm = {need_mm:g}"
    if (share := form.reached_share(tool.radius_mm)) < LEAST_FIT:
        return f"its ball fits {100 * share:.1f} % of the lens; {100 * LEAST_FIT:.0f} % are needed"
    steepest = float(form.slopes[-1])
    if tool.shank_radius_mm > tool.radius_mm and steepest * tool.shank_radius_mm > tool.flute_length_mm:
        return f"its shank would touch slopes of {steepest:.2g}"
    if form.deepest_mm > tool.stick_out_mm:
        return f"it sticks out {tool.stick_out_mm:g} mm; the lens is {form.deepest_mm:.1f} mm deep"
    return None


def _finishes(tool: Tool, shop: Shop) -> Iterator[PassSpec]:
    speeds = shop.speeds(tool)
    step_down = min(_FINISH_STEP_DOWN_MM, _FINISH_STEP_DOWN_SHARE * speeds.step_down_mm)
    directions: tuple[Direction, ...] = ("x", "y")
    for strategy in shop.strategies:
        for direction in directions if strategy == "raster" else directions[:1]:
            for pitch_mm in PITCHES_MM:
                if pitch_mm <= PITCH_SHARE * tool.radius_mm:
                    yield tool_pass(
                        "finish", tool, speeds, pitch_mm=pitch_mm, leaves_mm=0.0, step_down_mm=round(step_down, 3),
                        direction=direction, strategy=strategy,
                    )  # fmt: skip


def _candidate(rough: Roughing, tool: Tool, finish: PassSpec, light: Light) -> Candidate:
    before = rough.before(finish)
    assert before is not None
    shop = rough.shop
    own_s = rows_s(rough.form, finish, shop.mill) + finish_layers_s(rough.form, finish, before.depth_mm, shop.mill)
    slopes = row_slopes(
        radius_mm=finish.radius_mm,
        pitch_mm=finish.pitch_mm,
        step_mm=shop.step_mm,
        noise_mm=shop.noise_mm,
        vertex_mm=rough.form.usual_chord_mm(finish),
        whole_steps=shop.whole_steps,
        steepness=rough.form.steepness(finish),
    )
    return Candidate(
        tool=tool,
        passes=(*before.passes, finish),
        seconds=(*before.seconds, own_s),
        slopes=slopes,
        blur_mm=light.blur_mm(slopes),
        psnr_db=light.psnr_db(finish.radius_mm, slopes, finish),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Before:
    """Passes before the finish, and the deepest stock that they leave to it, measured along Z."""

    passes: tuple[PassSpec, ...]
    seconds: tuple[float, ...]
    depth_mm: float


class Roughing:
    """The quickest way from the block to a lens's finish, asked for again and again."""

    def __init__(self, *, form: LensForm, shop: Shop) -> None:
        self.form, self.shop = form, shop
        self._steep = cos(atan(float(np.quantile(form.slopes, 0.999))))
        self._firsts: dict[Tool, Before] = {}
        self._rough: dict[float, Before | None] = {}
        self._known: dict[tuple[float, float], Before | None] = {}

    def before(self, finish: PassSpec) -> Before | None:
        """Rough, and a second rough where that is quicker than layers of the finish; None: no tool can."""
        key = (finish.radius_mm, finish.step_down_mm)
        if key not in self._known:
            self._known[key] = self._quickest(finish)
        return self._known[key]

    def _quickest(self, finish: PassSpec) -> Before | None:
        rough = self._roughed(finish)
        if rough is None:
            return None
        ways = [rough, *self._with_second(rough, finish)]
        return min(
            ways,
            key=lambda way: sum(way.seconds) + finish_layers_s(self.form, finish, way.depth_mm, self.shop.mill),
        )

    def _roughed(self, finish: PassSpec) -> Before | None:
        """By the ball that is quickest; beside its walls the shank of the finish must have room."""
        if finish.radius_mm not in self._rough:
            room_mm = finish.radius_mm + max(finish.shank_radius_mm or 0.0, finish.radius_mm)
            ways = [
                self._first(tool)
                for tool in self.shop.tools
                if tool.radius_mm >= finish.radius_mm
                and 2 * tool.radius_mm >= min(room_mm, self.shop.margin_mm - _CLEAR_MM)
                and 2 * tool.radius_mm + _CLEAR_MM <= self.shop.margin_mm
                and tool.reaches(self.form.deepest_mm)
            ]
            self._rough[finish.radius_mm] = min(ways, key=lambda way: sum(way.seconds), default=None)
        return self._rough[finish.radius_mm]

    def _first(self, tool: Tool) -> Before:
        if tool not in self._firsts:
            pitch_mm = _ROUGH_PITCH_SHARE * tool.radius_mm
            self._firsts[tool] = self._way((), tool, pitch_mm=pitch_mm, leaves_mm=_rough_leaves(tool))
        return self._firsts[tool]

    def _with_second(self, rough: Before, finish: PassSpec) -> Iterator[Before]:
        for tool in self.shop.tools:
            if finish.radius_mm <= tool.radius_mm <= rough.passes[0].radius_mm:
                yield self._way(
                    (rough,), tool, pitch_mm=sqrt(8 * tool.radius_mm * _SEMI_CUSP_MM), leaves_mm=_SEMI_LEAVES_MM
                )

    def _way(self, after: tuple[Before, ...], tool: Tool, *, pitch_mm: float, leaves_mm: float) -> Before:
        speeds = self.shop.speeds(tool)
        pitch_mm = max(0.01, ceil(pitch_mm * 100 - 1e-9) / 100)
        spec = tool_pass(
            "rough", tool, speeds, pitch_mm=pitch_mm, leaves_mm=leaves_mm, step_down_mm=speeds.step_down_mm
        )
        if after:
            depth_mm = after[0].depth_mm
            seconds = rows_s(self.form, spec, self.shop.mill)
            seconds += finish_layers_s(self.form, spec, depth_mm, self.shop.mill)
        else:
            seconds = layers_s(self.form, spec, self.shop.mill)
        cusp_mm = spec.pitch_mm**2 / (8 * spec.radius_mm)
        return Before(
            passes=(*(spec for way in after for spec in way.passes), spec),
            seconds=(*(part for way in after for part in way.seconds), seconds),
            depth_mm=(leaves_mm + cusp_mm) / self._steep,
        )


def _rough_leaves(tool: Tool) -> float:
    return min(_ROUGH_LEAVES_MM, _ROUGH_LEAVES_SHARE * tool.radius_mm)
