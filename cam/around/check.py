"""Checks facing, witness marks and cutting out: reads the written program back and simulates the cut.

Nothing of the generator is used, as in the check of passes: text -> moves (cam.reading) -> stock left, time
(cam.duration), rules for single moves. Two tests show that the lens is not touched: the cells of the remaining stock,
and the distance of every move in stock from the outline, which does not depend on cells.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from cam.around.paths import segment_distances
from cam.around.specs import BESIDE_MM, CutOut, Facing, WitnessCut
from cam.checking.collision import Clamps
from cam.checking.flat_removal import removal_of
from cam.checking.move_rules import Finding, describe_spindle_off
from cam.cutters import BALL, CUTTERS, CutterShape
from cam.duration import DurationModel, Kinematics
from cam.moves import Array
from cam.passes import Stock
from cam.reading.gcode import GRBL, Language, MoveBatch, read_parts
from cam.surface.stock_grid import StockGrid
from phrases.phrase import Phrase

_FLAT = CUTTERS["flat"]
_TOUCH_MM = 1e-6
_RAPID_CLEARANCE_MM = 0.5
_GOUGE_ALLOWED_MM = 1e-6
_BITE_ALLOWED = 1.05  # of the step-down
_TAB_ALLOWED_MM = 0.01
_WITNESS_ALLOWED_MM = 1e-4
_AXES = "xyz"


@dataclass(frozen=True, slots=True, kw_only=True)
class Tab:
    """A tab as the simulated program leaves it: where, and how high above the block's bottom."""

    x_mm: float
    y_mm: float
    height_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AroundCheck:
    """The result for a program before or after the passes. `faults` are sentences; a program without any is `ok`.

    gouge_um   : how far a facing cuts below Z0, or a cut-out into the lens
    left_um    : of a facing: the highest stock above Z0 that it leaves; of a cut-out: in the slot beside the tabs
    clear_um   : of a cut-out: between the cutter and the lens, where it comes nearest
    tabs       : of a cut-out
    stock_top  : what is left
    """

    faults: tuple[Phrase, ...]
    lines: int
    bytes: int
    moves: int
    path_length_mm: float
    time_s: float
    entries: int
    max_engagement_mm: float
    gouge_um: float
    left_um: float
    bounds: dict[str, list[float]]
    stock_top: StockGrid
    clear_um: float | None = None
    tabs: tuple[Tab, ...] = ()

    @property
    def ok(self) -> bool:
        return not self.faults


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckedMill:
    """The mill's data for the check. digit_mm, xy_digit_mm: resolution of the written positions."""

    kinematics: Kinematics
    safe_z_mm: float
    language: Language = GRBL
    digit_mm: float = 0.0
    xy_digit_mm: float = 0.0


def check_facing(
    parts: Iterable[Iterable[bytes]], facing: Facing, *, stock: Stock, stock_top: StockGrid, mill: CheckedMill
) -> AroundCheck:
    """Cut the programs, run one after the other, into stock_top: nothing below Z0, nothing left above the cusps."""
    reach_mm = stock.margin_mm + facing.radius_mm + BESIDE_MM
    run = _FlatRun(facing, stock, stock_top, mill, reach_mm=reach_mm, lowest_mm=0.0, cutter=facing.cutter)
    for batch in read_parts(parts, mill.language):
        run.add(batch)
    after = run.stock()
    left_mm, below_mm = float(after.top_mm.max()), max(0.0, -float(after.top_mm.min()))
    allowed_mm = facing.cusp_mm + 1.5 * mill.digit_mm + _TOUCH_MM
    if left_mm > allowed_mm:
        run.faults.append(
            Phrase(
                "{left_mm:.4f} mm are left above Z0 (allowed {allowed_mm:.4f} mm)",
                left_mm=left_mm,
                allowed_mm=allowed_mm,
            )
        )
    if below_mm > _TOUCH_MM:
        run.faults.append(Phrase("{below_mm:.4f} mm are taken off below Z0 (allowed: none)", below_mm=below_mm))
    return run.verdict(gouge_mm=below_mm, left_mm=max(0.0, left_mm))


def check_cut_out(
    parts: Iterable[Iterable[bytes]],
    cut_out: CutOut,
    *,
    stock: Stock,
    stock_top: StockGrid,
    mill: CheckedMill,
    corners_mm: Array,
    loop_mm: Array,
) -> AroundCheck:
    """Cut the programs into stock_top: the lens untouched, the slot through, every tab there and as high as asked.

    corners_mm (k, 2) : of the lens, counter-clockwise; loop_mm (n, 2): where the slot and its tabs are expected
    """
    lowest_mm = -stock.thickness_mm - cut_out.through_mm
    run = _FlatRun(cut_out, stock, stock_top, mill, reach_mm=stock.margin_mm, lowest_mm=lowest_mm, lens_mm=corners_mm)
    for batch in read_parts(parts, mill.language):
        run.add(batch)
    after = run.stock()
    touched = after.top_mm < stock_top.top_mm
    inside = _inside(corners_mm, after)
    if (touched & inside).any():
        depth_mm = float((stock_top.top_mm - after.top_mm)[inside].max())
        run.faults.append(
            Phrase("{depth_mm:.3f} mm of the lens itself are taken off (allowed: none)", depth_mm=depth_mm)
        )
    tabs = _tabs(cut_out, after, loop_mm, stock.thickness_mm)
    for tab in tabs:
        if abs(tab.height_mm - cut_out.tab_height_mm) > _TAB_ALLOWED_MM + 1.5 * mill.digit_mm:
            run.faults.append(
                Phrase(
                    "the tab at X{x_mm:.3f} Y{y_mm:.3f} is {height_mm:.3f} mm high (asked for: {asked_mm:g} mm)",
                    x_mm=tab.x_mm,
                    y_mm=tab.y_mm,
                    height_mm=tab.height_mm,
                    asked_mm=cut_out.tab_height_mm,
                )
            )
    left_mm = _measure_left_in_slot(cut_out, after, loop_mm) - lowest_mm
    if left_mm > _TOUCH_MM + 1.5 * mill.digit_mm:
        run.faults.append(
            Phrase("{left_mm:.4f} mm are left in the slot between the tabs (allowed: none)", left_mm=left_mm)
        )
    clear_mm = run.nearest_mm - cut_out.radius_mm
    return run.verdict(
        gouge_mm=max(0.0, -clear_mm), left_mm=max(0.0, left_mm), clear_um=1000 * max(0.0, clear_mm), tabs=tabs
    )


def check_witness(
    parts: Iterable[Iterable[bytes]],
    task: WitnessCut,
    *,
    stock: Stock,
    stock_top: StockGrid,
    mill: CheckedMill,
    corners_mm: Array,
) -> AroundCheck:
    """Cut the program into stock_top: only the strip is touched, and each row is there, at its height.

    corners_mm (k, 2) : of the lens, counter-clockwise
    """
    run = _FlatRun(
        *(task, stock, stock_top, mill),
        reach_mm=stock.margin_mm,
        lowest_mm=task.lowest_mm,
        cutter=BALL,
        lens_mm=corners_mm,
    )
    for batch in read_parts(parts, mill.language):
        run.add(batch)
    after = run.stock()
    left, right, front, back = task.box_mm
    x, y, rim_mm = after.x_mm, after.y_mm, 2 * mill.xy_digit_mm + _TOUCH_MM
    beside = (x < left - rim_mm) | (x > right + rim_mm) | ((y < front - rim_mm) | (y > back + rim_mm))[:, None]
    if (after.top_mm < stock_top.top_mm)[beside].any():
        run.faults.append(Phrase("stock is taken off beside the strip of witness marks (allowed: none)"))
    off_mm = _off_witness(task, after)
    allowed_mm = 1.5 * mill.digit_mm + _WITNESS_ALLOWED_MM
    if off_mm > allowed_mm:
        run.faults.append(
            Phrase(
                "the witness marks are {off_um:.2f} µm off their heights (allowed: {allowed_um:.2f} µm)",
                off_um=1000 * off_mm,
                allowed_um=1000 * allowed_mm,
            )
        )
    clear_mm = run.nearest_mm - task.radius_mm
    return run.verdict(gouge_mm=max(0.0, -clear_mm), left_mm=0.0, clear_um=1000 * max(0.0, clear_mm))


def _off_witness(task: WitnessCut, after: StockGrid) -> float:
    """Return the deviation of the stock in the middle of the strip from what a ball leaves in its rows."""
    u, other = (after.x_mm, after.y_mm) if task.along == "x" else (after.y_mm, after.x_mm)
    inside = (u > task.places_mm[0]) & (u < task.places_mm[-1])
    middle = int(np.abs(other - sum(task.across_mm) / 2).argmin())
    cut = after.top_mm[middle] if task.along == "x" else after.top_mm[:, middle]
    places, tips = np.array(task.places_mm), np.array(task.tips_mm)
    away = np.minimum(np.abs(u[inside, None] - places), task.radius_mm)
    made = (tips + task.radius_mm - np.sqrt(task.radius_mm**2 - away**2)).min(axis=1)
    return float(np.abs(cut[inside] - made).max(initial=0.0))


class _FlatRun:
    """The state of one check: rules each move must keep, totals, and the stock."""

    def __init__(
        self,
        spec: Facing | WitnessCut | CutOut,
        stock: Stock,
        stock_top: StockGrid,
        mill: CheckedMill,
        *,
        reach_mm: float,
        lowest_mm: float,
        cutter: CutterShape = _FLAT,
        lens_mm: Array | None = None,
    ) -> None:
        self.faults: list[Phrase] = []
        self.nearest_mm = np.inf
        self._spec, self._mill, self._lens_mm, self._before = spec, mill, lens_mm, stock_top
        self._lowest_mm, self._highest_mm = lowest_mm, float(stock_top.top_mm.max())
        self._removal = removal_of(cutter, stock_top, radius_mm=spec.radius_mm, rim_mm=2 * mill.xy_digit_mm)
        self._low = np.array([-reach_mm, -reach_mm])
        self._high = np.array([stock.width_mm, stock.height_mm]) + reach_mm
        self._duration = DurationModel(mill.kinematics)
        self._clamps = Clamps(stock.clamps, radius_mm=spec.radius_mm)
        self._lines = self._bytes = self._moves = self._entries = 0
        self._length_mm = self._bite_mm = 0.0
        self._airborne = True
        self._least, self._most = np.full(3, np.inf), np.full(3, -np.inf)
        self._kinds = {
            "rapid": Finding(
                says=lambda v: Phrase("is a rapid {into_mm:.3f} mm into stock or too near (allowed: none)", into_mm=v)
            ),
            "low": Finding(says=lambda v: Phrase("is a rapid across at Z{z_mm:.3f}, below the safe height", z_mm=-v)),
            "deep": Finding(
                says=lambda v: Phrase(
                    "takes off {depth_mm:.3f} mm in one cut (allowed: the step-down of {step_down_mm:g} mm)",
                    depth_mm=v,
                    step_down_mm=spec.step_down_mm,
                )
            ),
            "still": Finding(says=describe_spindle_off),
            "bottom": Finding(
                says=lambda v: Phrase(
                    "goes to Z{z_mm:.4f} (allowed: at least Z{least_mm:g})", z_mm=-v, least_mm=lowest_mm
                )
            ),
            "outside": Finding(
                says=lambda v: Phrase(
                    "is {beyond_mm:.3f} mm beyond the block and its run-out (allowed: none)", beyond_mm=v
                )
            ),
            "lens": Finding(
                says=lambda v: Phrase("cuts {depth_um:.1f} µm into the lens (allowed: none)", depth_um=1000 * v)
            ),
        }

    def add(self, batch: MoveBatch) -> None:
        """Cut one batch and judge its moves."""
        self._lines, self._bytes = batch.lines_read, batch.bytes_read
        if len(batch) == 0:
            return
        self._duration.add(batch)
        self._clamps.add(batch)
        drops, places = self._cut(batch)
        start, end, line = batch.start_mm, batch.end_mm, batch.line
        step = end - start
        low_z = np.minimum(start[:, 2], end[:, 2])
        cuts, touched = ~batch.is_rapid & (batch.pause_s < 0), drops > _TOUCH_MM
        self._moves += int((batch.pause_s < 0).sum())
        self._length_mm += float(np.linalg.norm(step, axis=1).sum())
        self._least = np.minimum(self._least, batch.points_mm.min(axis=0))
        self._most = np.maximum(self._most, batch.points_mm.max(axis=0))
        self._bite_mm = max(self._bite_mm, float(drops[cuts].max(initial=0.0)))
        for aloft, bites in zip(batch.is_rapid | (low_z > self._highest_mm), touched, strict=True):
            self._entries += int(self._airborne and bites)
            self._airborne = bool(aloft) or (self._airborne and not bites)
        spot = np.column_stack([*self._places_mm(places)])
        note = self._kinds
        near = self._highest_mm + _RAPID_CLEARANCE_MM - end[:, 2]
        down = (near > _TOUCH_MM) & (step[:, 2] < 0)
        note["rapid"].note_moves(batch.is_rapid & (down | touched), np.maximum(near, drops), line, end)
        across = batch.is_rapid & (step[:, :2] != 0).any(axis=1)
        note["low"].note_moves(across & (low_z < self._mill.safe_z_mm - 1e-6), -low_z, line, end)
        allowed_mm = _BITE_ALLOWED * self._spec.step_down_mm + 1.5 * self._mill.digit_mm
        note["deep"].note_moves(cuts & (drops > allowed_mm), drops, line, spot)
        note["still"].note_moves(cuts & touched & ~batch.spindle_on, drops, line, spot)
        note["bottom"].note_moves(low_z < self._lowest_mm - _TOUCH_MM - self._mill.digit_mm / 2, -low_z, line, end)
        beyond = np.maximum(self._low - end[:, :2], end[:, :2] - self._high).max(axis=1)
        note["outside"].note_moves(beyond > 1e-3, beyond, line, end)
        in_stock = np.flatnonzero(low_z < self._highest_mm)
        if self._lens_mm is not None and in_stock.size:
            self._judge_lens(start[in_stock], end[in_stock], line[in_stock])

    def _judge_lens(self, start: Array, end: Array, line: np.ndarray) -> None:
        assert self._lens_mm is not None
        away = segment_distances(start[:, :2], end[:, :2], self._lens_mm)
        self.nearest_mm = min(self.nearest_mm, float(away.min()))
        into = self._spec.radius_mm - away
        self._kinds["lens"].note_moves(into > _GOUGE_ALLOWED_MM, into, line, end)

    def _cut(self, batch: MoveBatch) -> tuple[Array, np.ndarray]:
        drops = self._removal.cut(batch)
        return drops.depth_mm[1:], drops.cell[1:]

    def stock(self) -> StockGrid:
        """Return what is left after all moves."""
        self._removal.cut_at_rest()
        return self._removal.stock()

    def _places_mm(self, cells: np.ndarray) -> tuple[Array, Array]:
        rows, columns = np.divmod(cells, self._before.top_mm.shape[1])
        return self._before.x_mm[columns], self._before.y_mm[np.maximum(rows, 0)]

    def verdict(
        self, *, gouge_mm: float, left_mm: float, clear_um: float | None = None, tabs: tuple[Tab, ...] = ()
    ) -> AroundCheck:
        faults = [sentence for kind in self._kinds.values() for sentence in kind.sentences]
        return AroundCheck(
            faults=(*faults, *self.faults, *self._clamps.faults),
            lines=self._lines,
            bytes=self._bytes,
            moves=self._moves,
            path_length_mm=self._length_mm,
            time_s=self._duration.seconds,
            entries=self._entries,
            max_engagement_mm=self._bite_mm,
            gouge_um=1000 * gouge_mm,
            left_um=1000 * left_mm,
            bounds={axis: [float(self._least[d]), float(self._most[d])] for d, axis in enumerate(_AXES)},
            stock_top=self.stock(),
            clear_um=clear_um,
            tabs=tabs,
        )


def _inside(corners: Array, grid: StockGrid) -> np.ndarray:
    """Return (ny, nx) cells whose centres lie within a closed outline: edges to their left are odd."""
    inside = np.zeros(grid.top_mm.shape, dtype=np.bool_)
    x, y = grid.x_mm, grid.y_mm
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            rows = np.flatnonzero((y >= min(y0, y1)) & (y < max(y0, y1)))
            at = x0 + (y[rows] - y0) * (x1 - x0) / (y1 - y0)
            inside[rows] ^= x[None, :] > at[:, None]
    return inside


def _along(loop_mm: Array, places_mm: Array) -> Array:
    """Return (n, 2) points of a closed way at lengths from its beginning."""
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(loop_mm, axis=0).T))])
    around = places_mm % run[-1]
    return np.column_stack([np.interp(around, run, loop_mm[:, axis]) for axis in (0, 1)])


def _heights(grid: StockGrid, points: Array) -> Array:
    """Return (n,) height of the cells that the points lie in."""
    ny, nx = grid.top_mm.shape
    columns = np.clip(((points[:, 0] - grid.x0_mm) / grid.cell_mm).astype(int), 0, nx - 1)
    rows = np.clip(((points[:, 1] - grid.y0_mm) / grid.cell_mm).astype(int), 0, ny - 1)
    return np.asarray(grid.top_mm[rows, columns])


def _length_mm(loop_mm: Array) -> float:
    return float(np.hypot(*np.diff(loop_mm, axis=0).T).sum())


def _tabs(cut_out: CutOut, after: StockGrid, loop_mm: Array, thickness_mm: float) -> tuple[Tab, ...]:
    """Return the tabs by the lowest cell along each one's whole width."""
    found = []
    for centre in cut_out.tab_centres_mm(_length_mm(loop_mm)):
        half_mm = max(0.0, cut_out.tab_width_mm / 2 - after.cell_mm)
        lowest = _heights(after, _along(loop_mm, centre + np.linspace(-half_mm, half_mm, 9))).min()
        x, y = _along(loop_mm, np.array([centre]))[0]
        found.append(Tab(x_mm=float(x), y_mm=float(y), height_mm=float(lowest) + thickness_mm))
    return tuple(found)


def _measure_left_in_slot(cut_out: CutOut, after: StockGrid, loop_mm: Array) -> float:
    """Return the highest stock on the middle line of the slot, feet of tabs left out."""
    length_mm = _length_mm(loop_mm)
    places = np.arange(0.0, length_mm, after.cell_mm)
    free = np.ones(places.shape, dtype=np.bool_)
    for centre in cut_out.tab_centres_mm(length_mm):
        away = np.abs((places - centre + length_mm / 2) % length_mm - length_mm / 2)
        free &= away > cut_out.tab_foot_mm() + after.cell_mm
    return float(_heights(after, _along(loop_mm, places[free])).max())
