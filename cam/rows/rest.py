"""Rest passes: a small ball cuts only where the bigger ball before it has left stock in a hollow.

Where the stock stands higher than regular cusps explain is the core. Tips cover the core grown by the ball's reach, on
the exact surface, and a band around it, in which they rise off the surface ever faster until the ball touches nothing:
the small ball's surface runs out into the big one's without a step, though its cusps are lower and its length is known
to a few micrometres only. Rows run back and forth through each region, with one entry; the ball crosses gaps between
the rows of a region just above all stock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import ceil, pi

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from cam.moves import Array, Path, cut
from cam.passes import PassSpec
from cam.rows.entries import enter, leave
from cam.rows.layers import Run, chain_spans, spans
from cam.rows.raster import Rows, climbs_rightward, on_ticks
from cam.rows.vertices import VertexRule, march_row, most_vertices
from cam.surface.stock_grid import StockGrid
from cam.surface.stock_left import StockLeft
from cam.surface.stock_touch import StockTouch
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield

Mask = npt.NDArray[np.bool_]

LEAST_MM = 0.001
"""Height above the cusps of the pass before, or above its own if they are higher: less stock than this is ignored."""

CUSPS = 6.0
"""Regular cusps end at four times their median; half as much again on slopes and in hollows."""

BLEND_MM, BLEND_LIFT_MM = 1.0, 0.002
"""Width of the band, or two radii of a larger ball; and the height of the tips above all cusps at its end."""

HOP_MM = 0.01
"""Clearance above all stock from the end of one row to the start of another."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RestAreas:
    """The places where a rest pass cuts, cell by cell of the stock it meets.

    core (ny, nx)       : cells with too much stock
    beyond_mm (ny, nx)  : distance of a tip from the area in which it must follow the surface; 0 or less: inside
    blend_mm, lift_mm   : tips are lift_mm (d / blend_mm)^2 above it at the distance d, up to blend_mm
    """

    grid: StockGrid
    core: Mask
    beyond_mm: Array
    blend_mm: float
    lift_mm: float

    @classmethod
    def of(cls, stock_top: StockGrid, heightfield: Heightfield, spec: PassSpec) -> RestAreas:
        left = StockLeft.of(stock_top, heightfield, spec)
        regular_mm = CUSPS * max(0.0, float(np.nanmedian(left.over_mm)))
        with np.errstate(invalid="ignore"):
            core = np.asarray(left.over_mm > LEAST_MM + np.maximum(regular_mm, 1.5 * left.cusp_mm))
        steepest = heightfield.steepest
        lean_mm = (spec.radius_mm + spec.stock_to_leave_mm) * steepest / np.hypot(1.0, steepest)  # from contact to tip
        grow_mm = lean_mm + spec.pitch_mm + 2 * stock_top.cell_mm
        beyond = np.full(core.shape, np.inf)
        if core.any():
            beyond = ndimage.distance_transform_edt(~core) * stock_top.cell_mm - grow_mm
        blend_mm, lift_mm = max(BLEND_MM, 2 * spec.radius_mm), regular_mm + BLEND_LIFT_MM
        return cls(grid=stock_top, core=core, beyond_mm=beyond, blend_mm=blend_mm, lift_mm=lift_mm)

    @property
    def area_mm2(self) -> float:
        """Area of the tips, including the band."""
        return float((self.beyond_mm <= self.blend_mm).sum()) * self.grid.cell_mm**2

    @property
    def regions(self) -> int:
        return int(ndimage.label(self.beyond_mm <= self.blend_mm, structure=np.ones((3, 3)))[1])

    def as_report(self) -> dict[str, float]:
        return {"area_mm2": self.area_mm2, "regions": self.regions}

    def distances_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Return `beyond_mm` at points (n,), between the cells; beside the block, the value at its rim."""
        grid = self.grid
        places = [(y_mm - grid.y0_mm) / grid.cell_mm - 0.5, (x_mm - grid.x0_mm) / grid.cell_mm - 0.5]
        return np.asarray(ndimage.map_coordinates(self.beyond_mm, places, order=1, mode="nearest"))

    def lifts_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Return (n,) how far above the surface the tips are."""
        share = np.clip(self.distances_mm(x_mm, y_mm) / self.blend_mm, 0.0, 2.0)
        return np.asarray(self.lift_mm * share**2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Ground:
    """Inputs for the rows of a rest pass."""

    areas: RestAreas
    surface: ToolSurface
    met: StockTouch
    rows: Rows
    rule: VertexRule
    x_mm: Array

    def lift_over(self, points_mm: Array) -> Array:
        points_mm[:, 2] += self.areas.lifts_mm(points_mm[:, 0], points_mm[:, 1])
        return points_mm

    def row(self, run: Run) -> Array:
        """Return the exact surface along a run, lifted off towards the ends."""
        start, end = float(self.x_mm[run.start]), float(self.x_mm[run.end])
        out = np.empty((most_vertices(abs(end - start), self.rule), 3))
        filled = march_row(self.surface.kernel, self.rule, self.rows.y_mm[run.row], start, end, out, 0)
        return self.lift_over(out[:filled].copy())

    def turn(self, start: Array, end: Array) -> Array:
        """Return half a turn from one row's end to the next one's start."""
        angle = np.linspace(0.0, pi, self._parts(start, end))[1:-1]
        x = on_ticks(start[0] + (end[0] - start[0]) * angle / pi)
        y = on_ticks(start[1] + (end[1] - start[1]) * (1 - np.cos(angle)) / 2)
        return self.lift_over(np.column_stack([x, y, self.surface.tip_heights_mm(x, y)]))

    def hop(self, start: Array, end: Array) -> Array:
        """Return the straight path across, above all stock there."""
        share = np.linspace(0.0, 1.0, self._parts(start, end))[1:-1]
        x, y = (on_ticks(start[a] + share * (end[a] - start[a])) for a in (0, 1))
        stock = self.met.under(np.column_stack([x, y])) + self.met.slack_mm
        tips = self.surface.tip_heights_mm(x, y) + self.areas.lift_mm
        return np.column_stack([x, y, np.maximum(stock, tips) + HOP_MM])

    def _parts(self, start: Array, end: Array) -> int:
        """Return chords so short that in the tightest hollow they sag by less than 1/28 000 of the radius."""
        return max(8, ceil(60 * float(np.hypot(*(end - start)[:2])) / self.surface.radius_mm))


def rest_paths(
    areas: RestAreas,
    surface: ToolSurface,
    met: StockTouch,
    rows: Rows,
    rule: VertexRule,
    spec: PassSpec,
    *,
    most_mm: float,
    safe_z_mm: float,
    on_progress: Callable[[float], None],
) -> Iterator[Path]:
    """Yield the regions one after the other, each entered once, from and to safe height; nothing if no stock is left.

    most_mm : the most stock above the surface now, after the layers
    """
    count = max(2, ceil(rows.length_mm / surface.kernel.node_step) + 1)
    x_mm = on_ticks(np.linspace(rows.left_mm, rows.right_mm, count))
    ground = _Ground(areas=areas, surface=surface, met=met, rows=rows, rule=rule, x_mm=x_mm)
    near = np.empty((rows.y_mm.size, count), dtype=np.bool_)
    for row, y in enumerate(rows.y_mm):
        near[row] = areas.distances_mm(x_mm, np.full(count, y)) <= areas.blend_mm
    labels, regions = ndimage.label(near, structure=np.ones((3, 3)))
    for index, where in enumerate(ndimage.find_objects(labels), start=1):
        inside = labels[where] == index
        yield from _region(ground, inside, where[0].start, where[1].start, spec, most_mm, safe_z_mm)
        on_progress(index / regions)


def _region(
    ground: _Ground, inside: Mask, first_row: int, first_sample: int, spec: PassSpec, most_mm: float, safe_z_mm: float
) -> Iterator[Path]:
    """Yield one region: its rows back and forth, or all in the climbing direction, with hops between those that do not
    join.
    """
    linked = spec.link == "u-turn"
    reach = max(2, round(2 * spec.radius_mm / ground.surface.kernel.node_step))
    by_row = spans(inside, pad=1, gap=reach)
    last = np.empty(0)
    for local in chain_spans(by_row, most_samples=reach, link=linked, first_upward=linked or climbs_rightward(spec)):
        run = Run(
            local.row + first_row, local.first + first_sample, local.last + first_sample, local.upward, local.joined
        )
        points = ground.row(run)
        if not last.size:
            height = ground.met.at(points[0, 0], points[0, 1]) + ground.met.slack_mm
            height = min(height, points[0, 2] + most_mm)
            yield from enter(points, height, spec, safe_z_mm=safe_z_mm)
        else:
            way = ground.turn(last, points[0]) if run.joined else ground.hop(last, points[0])
            yield cut(way, spec.feed_mm_per_min)
        yield cut(points, spec.feed_mm_per_min)
        last = points[-1]
    yield leave(last[0], last[1], safe_z_mm=safe_z_mm)
