"""Finds the lines at which a program may be entered again after a break: before each layer, before other entries from
the safe height, and where rows turn, which raster rows do outside the lens.

A line depends on the lines before it for the place of the tool, the motion word and the feed, so each point states
them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from cam.reading.gcode import MoveBatch
from optics.heightfield import Array

MOST_POINTS = 12
LEAST_GAP_S = 60.0  # of machine time, between two points
_LOWER_MM = 0.1  # that begins a layer
_ROW_SHARE = 0.5  # of the longest run along the rows: shorter ones are ramps or corners


@dataclass(frozen=True, slots=True, kw_only=True)
class RestartPoint:
    """Before `line` the tool stands at `at_mm`; G0 (is_rapid) or G1, this feed and this speed are in force."""

    line: int
    kind: Literal["layer", "entry", "row"]
    at_mm: tuple[float, float, float]
    is_rapid: bool
    feed_mm_per_min: float
    spindle_rpm: float


class RestartFinder:
    """Gathers the points of one program from its moves. axis: along which its rows run, 0 or 1"""

    def __init__(self, *, safe_z_mm: float, axis: int) -> None:
        self._safe_z_mm, self._axis = safe_z_mm, axis
        self._entries: list[RestartPoint] = []
        self._lowest_mm: list[float] = [np.inf]  # reached before the first of them, and after each
        self._turns: list[tuple[float, RestartPoint]] = []  # with the length of the run before
        self._sign, self._run_mm = 0.0, 0.0

    def add(self, batch: MoveBatch) -> None:
        """Add consecutive moves of the program."""
        start, end = batch.start_mm, batch.end_mm
        moves = (batch.pause_s < 0.0) & ~np.isnan(start).any(axis=1)
        across = moves & batch.is_rapid & (start[:, 2] >= self._safe_z_mm - 1e-9)
        across &= batch.spindle_on & (start[:, :2] != end[:, :2]).any(axis=1)
        self._add_entries(batch, np.flatnonzero(across), np.where(moves, end[:, 2], np.inf))
        self._add_turns(batch, np.flatnonzero(moves & ~batch.is_rapid & batch.spindle_on))

    def list_points(self) -> list[RestartPoint]:
        """Return all points, in the order of their lines."""
        points, lowest_mm = [], self._lowest_mm[0]
        for point, own_mm in zip(self._entries, self._lowest_mm[1:], strict=True):
            points.append(replace(point, kind="layer") if own_mm < lowest_mm - _LOWER_MM else point)
            lowest_mm = min(lowest_mm, own_mm)
        longest_mm = max((run_mm for run_mm, _ in self._turns), default=0.0)
        points += [point for run_mm, point in self._turns if run_mm >= _ROW_SHARE * longest_mm]
        return sorted(points, key=lambda point: point.line)

    def _add_entries(self, batch: MoveBatch, at: np.ndarray, z_mm: Array) -> None:
        for k, (low, high) in enumerate(pairwise([0, *at.tolist(), len(z_mm)])):
            if k:
                self._lowest_mm.append(np.inf)
                self._entries.append(_point(batch, low, "entry"))
            if high > low:
                self._lowest_mm[-1] = min(self._lowest_mm[-1], float(z_mm[low:high].min()))

    def _add_turns(self, batch: MoveBatch, at: np.ndarray) -> None:
        """Add the moves with which the way along the rows turns back."""
        way_mm = (batch.end_mm - batch.start_mm)[at, self._axis]
        at, way_mm = at[way_mm != 0.0], way_mm[way_mm != 0.0]
        if not len(at):
            return
        signs = np.sign(way_mm)
        turns = np.flatnonzero(signs != np.concatenate([[self._sign or signs[0]], signs[:-1]]))
        run_mm = np.concatenate([[0.0], np.cumsum(np.abs(way_mm))])
        begin_mm = -self._run_mm
        for k in turns:
            self._turns.append((float(run_mm[k] - begin_mm), _point(batch, int(at[k]), "row")))
            begin_mm = run_mm[k]
        self._sign, self._run_mm = float(signs[-1]), float(run_mm[-1] - begin_mm)


def _point(batch: MoveBatch, k: int, kind: Literal["entry", "row"]) -> RestartPoint:
    x, y, z = map(float, batch.start_mm[k])
    return RestartPoint(
        line=int(batch.line[k]),
        kind=kind,
        at_mm=(x, y, z),
        is_rapid=bool(batch.is_rapid[k]),
        feed_mm_per_min=float(batch.feed_mm_per_min[k]),
        spindle_rpm=float(batch.spindle_rpm[k]),
    )


def choose_points(
    points: Sequence[RestartPoint], time_at_s: Callable[[int], float], whole_s: float
) -> list[tuple[RestartPoint, float]]:
    """Return at most MOST_POINTS points, each with its time from the start [s]: the layers, and others that divide the
    longest times between them.

    time_at_s : of a line; whole_s: of the program
    """
    timed = [(point, time_at_s(point.line)) for point in points]
    layers = [one for one in timed if one[0].kind == "layer"]
    chosen = layers[:: -(-len(layers) // MOST_POINTS)] if layers else []
    while len(chosen) < MOST_POINTS and (found := _divide_longest_gap(timed, [at_s for _, at_s in chosen], whole_s)):
        chosen.append(found)
    return sorted(chosen, key=lambda one: one[0].line)


def _divide_longest_gap(
    timed: Sequence[tuple[RestartPoint, float]], chosen_s: Sequence[float], whole_s: float
) -> tuple[RestartPoint, float] | None:
    """Look for the longest gap that has a point in it, and return the one nearest to its middle; None without any."""
    ends_s = sorted([0.0, *chosen_s, whole_s])
    for low_s, high_s in sorted(pairwise(ends_s), key=lambda gap: gap[0] - gap[1]):
        within = [one for one in timed if low_s + LEAST_GAP_S <= one[1] <= high_s - LEAST_GAP_S]
        if within:
            return min(within, key=lambda one: abs(one[1] - (low_s + high_s) / 2))
    return None
