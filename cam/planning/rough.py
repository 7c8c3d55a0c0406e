"""Plans the quickest roughing from a block to a lens's finish: one or two passes in layers, with a ball or a flat
cutter.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import atan, ceil, cos, floor, sqrt

import numpy as np

from cam.passes import PassSpec
from cam.planning.pass_time import LensForm, finish_layers_s
from cam.planning.sampled_time import first_pass_s, layers_after_s, planes_s, rows_s
from cam.planning.shop import CLEAR_MM, Shop
from cam.rows.layers import STAIR_SHARE
from cam.tools import Tool, tool_pass

_ROUGH_LEAVES_MM, _ROUGH_LEAVES_SHARE, _ROUGH_PITCH_SHARE = 0.2, 0.2, 1 / 3
_SEMI_LEAVES_MM, _SEMI_CUSP_MM = 0.03, 0.01
_GUESS_SHARE = 1.25  # of the lowest estimate: first passes of tools above it are not computed
_STEEP_SHARE = 0.8  # of the pitch that a coarse lens allows: a fine one is steeper
_STAIRS_SHARE = 0.35  # of a whole layer's time, for the stairs of flat ends; 0.16 to 0.49 in six jobs
_CHANGE_S = 300.0  # seconds that one more tool must save
_LEAST_LEFT_MM, _LAYER_SHARE = 0.1, 0.9
"""Least stock that a first pass leaves; and the most, in layers of the finish, if the finish is to need no layers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Before:
    """Passes before the finish, and the deepest stock that they leave to it, measured along Z.

    form    : the form for which the first was made
    quickly : the layers after flat ends are estimated
    """

    passes: tuple[PassSpec, ...]
    seconds: tuple[float, ...]
    depth_mm: float
    form: LensForm
    quickly: bool = False

    def layers_s(self, form: LensForm, after: PassSpec, shop: Shop) -> float:
        """Return the seconds that the next pass needs where there is too much stock for one move."""
        last = self.passes[-1]
        if last.is_ball:
            return finish_layers_s(form, after, self.depth_mm, shop.mill)
        if self.quickly:
            stairs_mm = last.pitch_mm * float(form.slopes[-1]) / 2
            return _STAIRS_SHARE * finish_layers_s(form, after, last.stock_to_leave_mm + stairs_mm, shop.mill)
        return layers_after_s(self.form, after, last, shop.mill, safe_z_mm=shop.safe_z_mm)


class Roughing:
    """The quickest roughing to a lens's finish, for repeated queries.

    like    : for a lens that differs only in its filled valleys: first passes take as long
    quickly : one first pass is computed, and the error of its estimate is assumed for the others
    """

    def __init__(self, *, form: LensForm, shop: Shop, like: Roughing | None = None, quickly: bool = False) -> None:
        self.form, self.shop, self._quickly = form, shop, quickly
        self._off: list[float] = [] if like is None else like._off
        self._steep = cos(atan(float(np.quantile(form.slopes, 0.999))))
        self._firsts: dict[Tool, Before] = {} if like is None else like._firsts
        self._guesses_s: dict[Tool, float] = {} if like is None else like._guesses_s
        self._roughs: dict[float, list[Before]] = {}
        self._known: dict[tuple[float, float], Before | None] = {}

    def plan_before(self, finish: PassSpec) -> Before | None:
        """Plan a rough, and a second rough if that is quicker than layers of the finish; None if no tool can."""
        key = (finish.radius_mm, finish.step_down_mm)
        if key not in self._known:
            self._known[key] = self._choose_quickest(finish)
        return self._known[key]

    def _choose_quickest(self, finish: PassSpec) -> Before | None:
        ways = self._plan_roughs(finish)
        for rough in [way for way in ways if way.passes[0].is_ball]:
            ways += [*self._plan_leaving_less(rough, finish), *self._plan_with_second(rough, finish)]
        return min(ways, key=lambda way: self._count_s(way, finish), default=None)

    def _count_s(self, way: Before, finish: PassSpec) -> float:
        """Return the cost of a roughing in seconds. A flat cutter cannot finish, so its tool change counts."""
        change_s = 0.0 if way.passes[0].is_ball else _CHANGE_S
        return sum(way.seconds) + way.layers_s(self.form, finish, self.shop) + change_s

    def _plan_roughs(self, finish: PassSpec) -> list[Before]:
        """Plan the rough by the quickest ball, and by the quickest flat cutter; beside its walls the shank of the
        finish must have room.
        """
        if finish.radius_mm not in self._roughs:
            room_mm = finish.radius_mm + max(finish.shank_radius_mm or 0.0, finish.radius_mm)
            tools = [
                tool
                for tool in self.shop.tools
                if self.shop.holds(tool)
                and tool.radius_mm >= finish.radius_mm
                and 2 * tool.radius_mm >= min(room_mm, self.shop.margin_mm - CLEAR_MM, 2 * self.shop.room_mm)
                and self.shop.has_room_for(tool)
                and tool.reaches(self.form.deepest_mm)
                and self.shop.least_stick_out_mm(tool, self.form) <= tool.stick_out_mm
            ]
            tools = [tool for tool in tools if self.shop.cuts_chips(tool)] or tools
            flat = [one for one in tools if not one.is_ball and one.radius_mm <= 2 * finish.radius_mm]
            found = map(self._find_quickest, ([one for one in tools if one.is_ball], flat))
            self._roughs[finish.radius_mm] = [way for way in found if way is not None]
        return list(self._roughs[finish.radius_mm])

    def _find_quickest(self, tools: list[Tool]) -> Before | None:
        most_s = _GUESS_SHARE * min(map(self._guess_first_s, tools), default=0.0)
        ways = [self._plan_first(tool) for tool in tools if self._guess_first_s(tool) <= most_s]
        return min(ways, key=lambda way: sum(way.seconds), default=None)

    def _plan_first(self, tool: Tool) -> Before:
        if tool not in self._firsts:
            self._firsts[tool] = self._make_way((), self._first_spec(tool))
        return self._firsts[tool]

    def _guess_first_s(self, tool: Tool) -> float:
        if tool not in self._guesses_s:
            self._guesses_s[tool] = planes_s(self.form, self._first_spec(tool), self.shop.mill)
        return self._guesses_s[tool]

    def _first_spec(self, tool: Tool) -> PassSpec:
        pitch_mm = _pitch_share(tool) * tool.radius_mm
        if not tool.is_ball:  # stairs that are within the step-down of every move
            stair_mm = STAIR_SHARE * self.shop.layer_step_down_mm(tool, pitch_mm)
            pitch_mm = min(
                pitch_mm, floor(100 * _STEEP_SHARE * stair_mm / max(1e-9, float(self.form.slopes[-1]))) / 100
            )
        return self._make_spec(tool, pitch_mm, _rough_leaves(tool))

    def _plan_leaving_less(self, rough: Before, finish: PassSpec) -> Iterator[Before]:
        """Yield the same first pass with a little less stock to leave, if the finish then needs no layers. It takes as
        long.
        """
        spec = rough.passes[0]
        left_mm = _LAYER_SHARE * finish.layer_mm * self._steep - _cusp_mm(spec)
        left_mm = floor(left_mm * 100 + 1e-9) / 100
        if _LEAST_LEFT_MM <= left_mm < spec.stock_to_leave_mm:
            spec = replace(spec, stock_to_leave_mm=left_mm)
            yield replace(rough, passes=(spec,), depth_mm=self._depth_mm(spec))

    def _plan_with_second(self, rough: Before, finish: PassSpec) -> Iterator[Before]:
        for tool in self.shop.balls:
            if self.shop.holds(tool) and finish.radius_mm <= tool.radius_mm <= rough.passes[0].radius_mm:
                pitch_mm = sqrt(8 * tool.radius_mm * _SEMI_CUSP_MM)
                yield self._make_way((rough,), self._make_spec(tool, pitch_mm, _SEMI_LEAVES_MM))

    def _make_spec(self, tool: Tool, pitch_mm: float, leaves_mm: float) -> PassSpec:
        speeds = self.shop.speeds(tool)
        pitch_mm = max(0.01, ceil(pitch_mm * 100 - 1e-9) / 100)
        step_down_mm = self.shop.layer_step_down_mm(tool, pitch_mm)
        return tool_pass("rough", tool, speeds, pitch_mm=pitch_mm, leaves_mm=leaves_mm, step_down_mm=step_down_mm)

    def _make_way(self, after: tuple[Before, ...], spec: PassSpec) -> Before:
        if after:
            seconds = rows_s(self.form, spec, self.shop.mill)
            seconds += after[0].layers_s(self.form, spec, self.shop)
        else:
            seconds = self._time_first_s(spec)
        return Before(
            passes=(*(spec for way in after for spec in way.passes), spec),
            seconds=(*(part for way in after for part in way.seconds), seconds),
            depth_mm=self._depth_mm(spec),
            form=after[0].form if after else self.form,
            quickly=self._quickly,
        )

    def _time_first_s(self, spec: PassSpec) -> float:
        if self._quickly and self._off:
            return self._off[0] * planes_s(self.form, spec, self.shop.mill)
        seconds = first_pass_s(self.form, spec, self.shop.mill, safe_z_mm=self.shop.safe_z_mm)
        if self._quickly:
            self._off.append(seconds / planes_s(self.form, spec, self.shop.mill))
        return seconds

    def _depth_mm(self, spec: PassSpec) -> float:
        """Return the deepest stock after a pass, along Z."""
        return (spec.stock_to_leave_mm + _cusp_mm(spec)) / self._steep


def _cusp_mm(spec: PassSpec) -> float:
    return spec.pitch_mm**2 / (8 * spec.radius_mm)


def _rough_leaves(tool: Tool) -> float:
    """Return the stock that a first pass leaves: a flat end mill also leaves stairs."""
    leaves_mm = min(_ROUGH_LEAVES_MM, _ROUGH_LEAVES_SHARE * tool.radius_mm)
    return leaves_mm / 2 if tool.corner_radius_mm == 0 else leaves_mm


def _pitch_share(tool: Tool) -> float:
    return _ROUGH_PITCH_SHARE / 2 if tool.corner_radius_mm == 0 else _ROUGH_PITCH_SHARE
