"""Layers: too much stock above the target for one move is taken off in steps.

On a flat block the layers are planes one step-down apart, and each follows the target where that is higher. On stock
that has a shape already they run parallel to the target, only where something stands above them, and the exact rows
come last over everything. No layer takes off more than step_down plus the cusps of the layer before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from math import ceil, inf, pi, sqrt

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter1d

from cam.cutters import FLAT_STEP
from cam.errors import PassValueError
from cam.materials import SLOT_FEED
from cam.moves import Array, Path, cut
from cam.passes import PassSpec
from cam.rows.entries import Pocket, enter, leave
from cam.rows.loads import Runs, choose_feeds, choose_link_feeds, measure_cuts
from cam.rows.raster import Rows, climbs_rightward, map_in_order, on_ticks
from cam.rows.vertices import rough_sag_mm, thin_pieces, thin_points
from cam.surface.stock_touch import StockTouch
from cam.surface.tool_surface import Surface
from phrases.phrase import Phrase

SKIM_MM = 0.05
"""Stock that layers leave for the exact rows when a finishing pass meets an uncut block."""

CUSP_MM = 0.05
"""More than the layers' tolerance and cusps can leave above a ball's tips."""

TOUCH_MM = 1e-6
"""Less stock than this above a tip is not cut."""

LAYER_CUSP_SHARE, PLANE_CUSP_SHARE, LAYER_SAG_SHARE = 0.02, 0.03, 0.01
"""Of the step-down: a layer's cusps, those of planes, and its chords. Those of two layers may add up, and the check
allows 5 % for them, and the cusps of the pass's own pitch besides."""

STAIR_SHARE = 0.8
"""Share of the step-down: the highest stairs, which the rows between those of the layers take off at once."""

_AT_ONCE = 64
"""Runs that are made together: one array each for all their samples needs little memory."""

_HERE_AND_THERE = 0.1
"""Share of all samples: if more of them have too much stock above them, the reason is not a wall."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """Tips at the target plus offset_mm, but not below level_mm."""

    offset_mm: float
    level_mm: float

    def tips_mm(self, target_mm: Array) -> Array:
        tips: Array = np.maximum(target_mm + self.offset_mm, self.level_mm)
        return tips


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Field:
    """Target tips and the tips at which the ball meets stock, (n rows, n samples), along rows sampled at x_mm."""

    rows: Rows
    x_mm: Array
    target_mm: Array
    stock_mm: Array

    @classmethod
    def along(cls, rows: Rows, surface: Surface, stock: StockTouch) -> Field:
        """Sample as finely as the lens and at least eight times per radius, over all places that turns may touch.

        So a later turn, of another layer or of the exact rows, meets no stock that the layer above did not clear.
        """
        left, right = rows.left_mm - rows.turn_mm, rows.right_mm + rows.turn_mm
        count = ceil((right - left) / surface.node_step_mm) + 1
        x = on_ticks(np.linspace(left, right, count))
        target = np.empty((rows.y_mm.size, x.size))
        blocks = np.array_split(np.arange(rows.y_mm.size), max(1, rows.y_mm.size // 64))
        heights = map_in_order(lambda block: surface.tip_rows_mm(x, rows.y_mm[block]), blocks)
        for block, part in zip(blocks, heights, strict=True):
            target[block] = part
        return cls(rows=rows, x_mm=x, target_mm=target, stock_mm=stock.over(x, rows.y_mm))

    @property
    def step_mm(self) -> float:
        return float(self.x_mm[1] - self.x_mm[0])

    def refine(self, stock: StockTouch, most_mm: float) -> Field:
        """Compute exact heights where there seems to be more than most_mm of stock, if there are only a few such
        places: beside walls that another ball has left.
        """
        rows, columns = np.nonzero(self.stock_mm - self.target_mm > most_mm)
        if stock.flat or not 0 < rows.size <= _HERE_AND_THERE * self.stock_mm.size:
            return self
        exact = self.stock_mm.copy()
        exact[rows, columns] = stock.exactly(self.x_mm[columns], self.rows.y_mm[rows])
        return replace(self, stock_mm=exact)

    def every(self, stride: int) -> Field:
        """Return every stride-th row, and the last; the stock over each is the most up to its neighbours, so that
        nothing between two rows is overlooked.
        """
        if stride == 1:
            return self
        rows = self.rows.every(stride)
        chosen = np.searchsorted(self.rows.y_mm, rows.y_mm)
        above = maximum_filter1d(self.stock_mm - self.target_mm, 2 * stride + 1, axis=0, mode="nearest")
        target = self.target_mm[chosen]
        return Field(rows=rows, x_mm=self.x_mm, target_mm=target, stock_mm=target + above[chosen])


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerPlan:
    """Layers from the top down, on every stride-th row, and whether exact rows follow over everything: all of them, or
    only those between the rows of the layers.

    stair_mm : height of the stairs that layers of a flat cutter leave between their rows on a slope
    """

    layers: tuple[Layer, ...]
    exact_rows: bool
    stride: int = 1
    only_between: bool = False
    stair_mm: float = 0.0


def plan_layers(field: Field, stock: StockTouch, spec: PassSpec) -> LayerPlan:
    """Return the fewest layers that keep every engagement within the step-down."""
    depth = float((field.stock_mm - field.target_mm).max()) + stock.slack_mm
    if depth <= spec.step_down_mm:
        return LayerPlan(layers=(), exact_rows=True)
    if not stock.flat:
        count = ceil(depth / spec.layer_mm) - 1
        parallel = (Layer(offset_mm=k * spec.layer_mm, level_mm=-inf) for k in range(count, 0, -1))
        return LayerPlan(
            layers=tuple(parallel), exact_rows=True, stride=field.rows.stride_within(layer_row_distance_mm(spec))
        )
    exact = spec.finishes or spec.strategy == "contour"
    keep = min(SKIM_MM, spec.step_down_mm / 2) if exact else 0.0
    top = float(stock.height_mm.max())
    lowest = float(field.target_mm[field.stock_mm > field.target_mm].min()) + keep
    stride = field.rows.stride_within(plane_row_distance_mm(spec))
    stair_mm = 0.0
    if not spec.is_ball:
        stride, stair_mm = _limit_stairs(field, stride, spec.step_down_mm)
    count = ceil((top - lowest) / spec.step_down_mm)
    planes = (Layer(offset_mm=keep, level_mm=top - (k + 1) * spec.step_down_mm) for k in range(count))
    if exact:
        return LayerPlan(
            layers=tuple(planes), exact_rows=True, stride=field.rows.stride_within(layer_row_distance_mm(spec))
        )
    between = field.rows.between(stride).y_mm.size > 0
    return LayerPlan(layers=tuple(planes), exact_rows=between, stride=stride, only_between=between, stair_mm=stair_mm)


def plane_row_distance_mm(spec: PassSpec) -> float:
    """Return the greatest distance of rows of planes; the rows between them take off the stock that these leave."""
    shape, radius_mm = spec.shape, spec.radius_mm
    cusped_mm = sqrt(8 * shape.corner_mm(radius_mm) * PLANE_CUSP_SHARE * spec.step_down_mm)
    return min(FLAT_STEP * radius_mm, 2 * shape.flat_mm(radius_mm) + cusped_mm)


def _limit_stairs(field: Field, most: int, step_down_mm: float) -> tuple[int, float]:
    """Return the widest stride of rows at which a flat cutter's stairs on a slope are within the limit, and their
    height; PassValueError if even single rows are too far apart.
    """
    target = field.target_mm
    for stride in range(max(1, min(most, len(target) - 1)), 0, -1):
        stair_mm = float(np.abs(target[stride:] - target[:-stride]).max())
        if stair_mm <= (STAIR_SHARE if stride > 1 else 1.0) * step_down_mm:
            return stride, stair_mm
    pitch_mm = float(np.diff(field.rows.y_mm).max())
    most_mm = pitch_mm * STAIR_SHARE * step_down_mm / stair_mm
    allowed = Phrase("at most {most_mm:.2g} mm, because a flat end leaves stairs on a lens this steep", most_mm=most_mm)
    raise PassValueError(name="pitch_mm", value=pitch_mm, allowed=allowed)


def layer_row_distance_mm(spec: PassSpec) -> float:
    """Return the greatest row distance of layers that exact rows of the pass's own pitch follow: cusps of p^2 / 8R."""
    return min(spec.radius_mm / 5, sqrt(8 * spec.radius_mm * LAYER_CUSP_SHARE * spec.step_down_mm))


@dataclass(frozen=True, slots=True)
class Run:
    """Samples first..last of one row, cut upward in x or downward; joined to the run before or entered anew."""

    row: int
    first: int
    last: int
    upward: bool
    joined: bool

    @property
    def start(self) -> int:
        return self.first if self.upward else self.last

    @property
    def end(self) -> int:
        return self.last if self.upward else self.first


def _as_arrays(before: Iterable[Run], runs: Iterable[Run]) -> Runs:
    """Return the runs as arrays, in order."""
    ways = [
        (run.row, run.first, run.last, 1 if run.upward else -1, last.end if run.joined else -1)
        for last, run in zip(before, runs, strict=False)
    ]
    return Runs(*np.array(ways, dtype=np.int64).T.copy())


def spans(active: npt.NDArray[np.bool_], *, pad: int, gap: int) -> list[list[tuple[int, int]]]:
    """Return by row stretches (first, last) of True, grown by pad samples and merged across at most gap samples."""
    merged: list[list[tuple[int, int]]] = [[] for _ in active]
    edges = np.diff(np.pad(active, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, firsts = np.nonzero(edges > 0)
    lows = np.maximum(0, firsts - pad).tolist()
    highs = np.minimum(active.shape[1] - 1, np.nonzero(edges < 0)[1] - 1 + pad).tolist()
    for row, low, high in zip(rows.tolist(), lows, highs, strict=True):
        found = merged[row]
        if found and low - found[-1][1] <= gap:
            found[-1] = (found[-1][0], high)
        else:
            found.append((low, high))
    return merged


def chain_spans(
    by_row: list[list[tuple[int, int]]], *, most_samples: int, link: bool, first_upward: bool = True
) -> Iterator[Run]:
    """Yield every span once: up the rows from neighbour to neighbour, there and back, while the next start is near
    enough.

    link : False cuts every span by itself, all of them the first way
    """
    for bottom in range(len(by_row)):
        while by_row[bottom]:
            row, upward = bottom, first_upward
            first, last = by_row[bottom].pop(0)
            run = Run(row, first, last, upward, False)
            yield run
            while link and row + 1 < len(by_row):
                row, upward = row + 1, not upward
                starts = [abs((span[0] if upward else span[1]) - run.end) for span in by_row[row]]
                if not starts or min(starts) > most_samples:
                    break
                first, last = by_row[row].pop(int(np.argmin(starts)))
                run = Run(row, first, last, upward, True)
                yield run


def layer_paths(
    field: Field,
    surface: Surface,
    stock: StockTouch,
    layer: Layer,
    above: Layer | None,
    spec: PassSpec,
    *,
    stair_mm: float = 0.0,
    safe_z_mm: float,
    on_progress: Callable[[float], None],
) -> Iterator[Path]:
    """Yield one layer, cut only where stock stands above it; starts and ends at safe height.

    A link on the layer's own surface is always allowed: nothing stands higher above it than a step-down. It is taken
    while it is shorter than four radii, and a row's gap is crossed the same way while it is shorter than two. Between
    rows there may also be stairs of stair_mm: moves there stay that much higher.
    """
    left, tips = _stock_and_tips(field, layer, above)
    per_radius = surface.radius_mm / field.step_mm
    pad, gap, reach = ceil(per_radius / 4), round(2 * per_radius), round(4 * per_radius)
    sag = _sag_mm(surface, layer, spec)
    standing = _stands_above(left, tips, stock, above)
    by_row = spans(_with_neighbours(standing), pad=pad, gap=gap)
    work = _Work(
        field=field, surface=surface, layer=layer, spec=spec, tips_mm=tips, now_mm=left.copy(),
        top_mm=float(stock.height_mm.max()), sag_mm=sag, stair_mm=stair_mm, pad=pad,
    )  # fmt: skip
    pocket = _pocket(field, surface, layer)
    turns: list[Array] = []
    place: Array | None = None
    linked = spec.link == "u-turn"
    chained = chain_spans(by_row, most_samples=reach, link=linked, first_upward=linked or climbs_rightward(spec))
    runs = _leave_out_idle(chained, standing) if stock.flat else list(chained)
    for done, (run, link, points, cuts) in enumerate(work.cut_runs(runs), start=1):
        if link is not None:
            turns.append(link.points_mm)
            yield link
        else:
            if place is not None:
                yield leave(place[0], place[1], safe_z_mm=safe_z_mm)
            height = float(left[run.row, run.start]) + stock.slack_mm + 2 * sag
            yield from enter(thin_points(points, sag), height, spec, safe_z_mm=safe_z_mm, pocket=pocket)
        yield from cuts
        place = points[-1]
        on_progress(done / len(runs))
    if place is not None:
        yield leave(place[0], place[1], safe_z_mm=safe_z_mm)
        walls = replace(layer, offset_mm=layer.offset_mm + stair_mm)
        yield from _end_walls(field, surface, stock, walls, above, turns, spec, safe_z_mm=safe_z_mm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Work:
    """A layer while it is cut: its tips, and the tips at which the cutter would meet the present stock (n rows, n
    samples).

    pad : samples beside the stock that are cut as well
    """

    field: Field
    surface: Surface
    layer: Layer
    spec: PassSpec
    tips_mm: Array
    now_mm: Array
    top_mm: float
    sag_mm: float
    stair_mm: float
    pad: int

    def cut_runs(self, order: list[Run]) -> Iterator[tuple[Run, Path | None, Array, list[Path]]]:
        """Yield each run, the way to it from the one before where they join, its points (n, 3), and its cuts."""
        for done in range(0, len(order), _AT_ONCE):
            some = order[done : done + _AT_ONCE]
            runs = _as_arrays([order[done - 1], *some], some)
            points, feeds, link_feeds = self._choose_feeds(runs)
            links = zip(self._make_links(runs), link_feeds[runs.is_joined].tolist(), strict=True)
            ends = np.append(0, np.cumsum(runs.counts))
            edges = np.union1d(np.flatnonzero(np.diff(feeds)) + 1, ends)
            cuts = map(cut, thin_pieces(points, edges, self.sag_mm), feeds[edges[:-1]].tolist())
            pieces = np.diff(np.searchsorted(edges, ends)).tolist()
            for run, count, own in zip(some, pieces, np.split(points, ends[1:-1]), strict=True):
                link = cut(*next(links)) if run.joined else None
                yield run, link, own, list(islice(cuts, count))

    def _choose_feeds(self, runs: Runs) -> tuple[Array, Array, Array]:
        """Return points (n, 3) of the runs, each from its start to its end, their feeds (n,), and those of the ways to
        them (m,).
        """
        field, spec, counts = self.field, self.spec, runs.counts
        rows, samples = runs.samples()
        along = self.tips_mm[rows, samples]
        bite, depth_mm = measure_cuts(
            self.now_mm, self.tips_mm, field.rows.y_mm, runs, spec, top_mm=self.top_mm, beside=self.pad
        )
        feeds = choose_feeds(bite, along, runs, spec, step_mm=field.step_mm)
        first, last = np.repeat(runs.first, counts), np.repeat(runs.last, counts)
        if self.stair_mm > 0:  # beside its ends there is stock that the links between rows have left
            near_end = np.minimum(samples - first, last - samples) < ceil(self.surface.radius_mm / field.step_mm)
            feeds[near_end] = np.minimum(feeds[near_end], SLOT_FEED * spec.feed_mm_per_min)
        points = np.column_stack([field.x_mm[samples], field.rows.y_mm[rows], along])
        onward = np.arange(samples.size) + np.where(np.repeat(runs.way, counts) > 0, 0, first + last - 2 * samples)
        return points[onward], feeds[onward], choose_link_feeds(depth_mm, spec)

    def _make_links(self, runs: Runs) -> list[Array]:
        """Return half turns on the layer's surface from one run's end to the next one's start, bulging the way the tool
        went as far as the run-out allows.

        At the end of the run-out turns go straight across: rows cannot end earlier, because the next layer's ball would
        then meet a wall beside this layer's turns that reaches up to the top of the block.
        """
        field, joined = self.field, runs.is_joined
        if not joined.any():
            return []
        x0, x1 = field.x_mm[runs.came[joined]], field.x_mm[runs.start[joined]]
        y0, y1 = field.rows.y_mm[runs.row[joined] - 1], field.rows.y_mm[runs.row[joined]]
        counts = np.maximum(6, np.ceil(2 * np.hypot(x1 - x0, y1 - y0) / field.step_mm)).astype(np.int64)
        ends = np.cumsum(counts + 1)
        turn = np.repeat(np.arange(counts.size), counts + 1)
        angle = (np.arange(ends[-1]) - (ends - counts - 1)[turn]) * (pi / counts)[turn]
        angle[ends - 1] = pi
        bulge = field.rows.turn_mm * np.sin(angle) * -runs.way[joined][turn]
        x = on_ticks(np.clip(x0[turn] + (x1 - x0)[turn] * angle / pi + bulge, field.x_mm[0], field.x_mm[-1]))
        y = on_ticks(y0[turn] + (y1 - y0)[turn] * (1 - np.cos(angle)) / 2)
        stairs = np.full(x.size, self.stair_mm)
        stairs[ends - counts - 1] = stairs[ends - 1] = 0.0
        each = zip(np.split(x, ends[:-1]), np.split(y, ends[:-1]), strict=True)
        lowest = np.concatenate([self.surface.tip_heights_mm(*one) for one in each])  # only from its own neighbours
        found = np.split(np.column_stack([x, y, self.layer.tips_mm(lowest + stairs)]), ends[:-1])
        return [thin_points(one, self.sag_mm, along=1) if np.ptp(one[:, 0]) == 0 else one for one in found]


def _sag_mm(surface: Surface, layer: Layer, spec: PassSpec) -> float:
    """Return the tolerance of a layer's chords: a small share of the stock that it leaves and of the stock that the
    next one may meet.
    """
    return min(rough_sag_mm(surface.allowance_mm + layer.offset_mm), LAYER_SAG_SHARE * spec.step_down_mm)


def _pocket(field: Field, surface: Surface, layer: Layer) -> Pocket:
    """Return the layer's own surface, over all that its rows and turns may touch."""
    rows = field.rows
    return Pocket(
        floor_mm=lambda x, y: layer.tips_mm(surface.tip_heights_mm(x, y)),
        region_mm=(float(field.x_mm[0]), float(field.x_mm[-1]), float(rows.y_mm[0]), float(rows.y_mm[-1])),
    )


def _stock_and_tips(field: Field, layer: Layer, above: Layer | None) -> tuple[Array, Array]:
    """Return the tips at which the ball meets the stock that the layer above has left, and the layer's own tips."""
    left = field.stock_mm if above is None else np.minimum(field.stock_mm, above.tips_mm(field.target_mm))
    return left, layer.tips_mm(field.target_mm)


def _stands_above(left: Array, tips: Array, stock: StockTouch, above: Layer | None) -> npt.NDArray[np.bool_]:
    """Return (n rows, n samples) whether there is anything to cut."""
    return np.asarray(left + (stock.slack_mm if above is None else 0.0) > tips + TOUCH_MM)


def _with_neighbours(active: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return active rows and the rows before and after them: a last row leaves stock up to the next."""
    grown = active.copy()
    grown[1:] |= active[:-1]
    grown[:-1] |= active[1:]
    return grown


def _leave_out_idle(runs: Iterable[Run], standing: npt.NDArray[np.bool_]) -> list[Run]:
    """Return the runs without chains that cut nothing because they only lie beside stock. This holds under planes; for
    stock that has a shape, the stock between two rows is less well known.
    """
    chains: list[list[Run]] = []
    for run in runs:
        if not run.joined:
            chains.append([])
        chains[-1].append(run)
    cutting = (chain for chain in chains if any(standing[one.row, one.first : one.last + 1].any() for one in chain))
    return [run for chain in cutting for run in chain]


def _end_walls(
    field: Field,
    surface: Surface,
    stock: StockTouch,
    layer: Layer,
    above: Layer | None,
    turns: list[Array],
    spec: PassSpec,
    *,
    safe_z_mm: float,
) -> Iterator[Path]:
    """Yield the ways along the walls at which the rows end, where stock stood above the layer: both sides, front to
    back. None if turns (n, 3) of the layer's own rows already went along all of it.

    Row ends alone leave flakes on the wall, in other places than a layer whose rows turn at the other side; the ball of
    a later layer, or a later pass, would take flakes of several layers off at once.
    """
    y = _between(field.rows.y_mm, field.step_mm)
    for x_mm in (field.x_mm[0], field.x_mm[-1]):
        x = np.full_like(y, x_mm)
        column = Field(
            rows=field.rows,
            x_mm=y,
            target_mm=surface.tip_heights_mm(x, y)[None, :],
            stock_mm=stock.over(x[:1], y).T,
        )
        left, tips = _stock_and_tips(column, layer, above)
        sag = _sag_mm(surface, layer, spec)
        standing = _stands_above(left, tips, stock, above)
        if not (standing[0] & ~_went_along(turns, x_mm, y)).any():
            continue
        for first, last in spans(standing, pad=1, gap=y.size)[0]:
            points = thin_points(np.column_stack([x, y, tips[0]])[first : last + 1], sag, along=1)
            height = float(left[0, first]) + stock.slack_mm + 2 * sag
            yield from enter(points, height, spec, safe_z_mm=safe_z_mm)
            yield cut(points, SLOT_FEED * spec.feed_mm_per_min)
            yield leave(points[-1, 0], points[-1, 1], safe_z_mm=safe_z_mm)


def _went_along(turns: list[Array], x_mm: float, y_mm: Array) -> npt.NDArray[np.bool_]:
    """Return (n,) whether the places y_mm of a wall at x_mm lie on a turn (m, 3) that runs straight along it."""
    passed = np.zeros(y_mm.size, dtype=np.bool_)
    for turn in turns:
        if (turn[:, 0] == x_mm).all():
            passed |= (turn[0, 1] <= y_mm) & (y_mm <= turn[-1, 1])
    return passed


def _between(y_mm: Array, step_mm: float) -> Array:
    """Return the positions of the rows, and of points between them no farther apart than step_mm."""
    return np.asarray(on_ticks(np.linspace(y_mm[0], y_mm[-1], ceil((y_mm[-1] - y_mm[0]) / step_mm) + 1)))
