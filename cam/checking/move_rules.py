"""Rules for every move on the stock: depth of cut, rapids clear of it, spindle, gouge; and the running totals.

Findings are gathered move by move: the number, the first and the worst of each kind, as one sentence. The rules of the
mill, which do not depend on the stock, are in `machines.preflight.rules`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from cam.checking.clearance import Overlaps
from cam.checking.removal import Drops, RemovalGrid
from cam.passes import PassSpec, Stock
from cam.reading.gcode import MoveBatch
from optics.heightfield import Array, Heightfield
from phrases.phrase import Phrase


@dataclass(slots=True, kw_only=True)
class Finding:
    """One kind of fault. `says` puts its value into words: "cuts 2.10 µm below the lens (allowed 1 µm)"."""

    says: Callable[[float], Phrase]
    count: int = 0
    first_line: int = 0
    worst_line: int = 0
    worst: float = 0.0
    x_mm: float = float("nan")
    y_mm: float = float("nan")

    def note(self, value: float, line: int, x_mm: float, y_mm: float, *, count: int = 1) -> None:
        """Note one offending move, or the worst of `count` of them."""
        if self.count == 0:
            self.first_line = line
        if self.count == 0 or value > self.worst:
            self.worst, self.worst_line, self.x_mm, self.y_mm = value, line, x_mm, y_mm
        self.count += count

    def note_moves(self, guilty: np.ndarray, values: np.ndarray, lines: np.ndarray, places: np.ndarray) -> None:
        """Note all offending moves of a batch: guilty (n,) bool, values (n,), lines (n,), places (n, 2 or 3)."""
        where = np.flatnonzero(guilty)
        if where.size == 0:
            return
        if self.count == 0:
            self.first_line = int(lines[where[0]])
            first = self.first_line
        else:
            first = self.first_line
        k = where[values[where].argmax()]
        self.note(float(values[k]), int(lines[k]), float(places[k][0]), float(places[k][1]), count=where.size)
        self.first_line = first

    @property
    def sentences(self) -> list[Phrase]:
        if self.count == 0:
            return []
        worst = Phrase(
            "line {line} at X{x_mm:.3f} Y{y_mm:.3f} {what}",
            line=self.worst_line,
            x_mm=self.x_mm,
            y_mm=self.y_mm,
            what=self.says(self.worst),
        )
        if self.count == 1:
            return [worst]
        return [
            Phrase(
                "{worst}; the worst of {count} lines, the first of them is line {first_line}",
                worst=worst,
                count=self.count,
                first_line=self.first_line,
            )
        ]


_TOUCH_MM = 1e-6  # a drop smaller than this is rounding, not a cut
_AXES = "xyz"


@njit(cache=True, nogil=True)
def _count_entries(airborne, clear, drops, touch):  # type: ignore[no-untyped-def]
    """Count the entries from the air into stock. clear: moves in the air. Returns (entries, still airborne)."""
    entries = 0
    for k in range(clear.size):
        if clear[k]:
            airborne = True
        elif airborne and drops[k] > touch:
            entries += 1
            airborne = False
    return entries, airborne


def engagement_allowance_mm(spec: PassSpec, steepest: float) -> float:
    """Return how much a move may take off beyond the step-down: the cusps of the layer before on the steepest slope,
    and 5 %. A flat cutter leaves stairs, and its moves between them must take these off too.

    steepest : greatest slope |grad h| of the lens
    """
    cusp_mm = spec.pitch_mm**2 / (8 * spec.radius_mm) * math.sqrt(1 + steepest**2) ** 3 if spec.is_ball else 0.0
    return 2 * cusp_mm + 0.05 * spec.step_down_mm


def describe_spindle_off(depth_mm: float) -> Phrase:
    return Phrase("cuts {depth_mm:.3f} mm with the spindle off (allowed: only after M3)", depth_mm=depth_mm)


class MoveRules:
    """Judges batches in order. A move's drop may be known one batch later (slot 0 of Drops), so its line is kept."""

    def __init__(
        self,
        heightfield: Heightfield,
        spec: PassSpec,
        stock: Stock,
        *,
        highest_mm: float,
        safe_z_mm: float,
        rapid_clearance_mm: float,
        gouge_allowed_um: float,
    ) -> None:
        self.allowed_drop_mm = spec.step_down_mm + engagement_allowance_mm(spec, heightfield.steepest)
        self._spec, self._stock = spec, stock
        self._highest_mm, self._safe_z_mm = highest_mm, safe_z_mm
        self._gouge_allowed_mm = gouge_allowed_um / 1000
        self._gouge = Finding(
            says=lambda v: Phrase(
                "cuts {depth_um:.2f} µm below the lens (allowed {allowed_um:g} µm)",
                depth_um=1000 * v,
                allowed_um=gouge_allowed_um,
            )
        )
        self._deep = Finding(
            says=lambda v: Phrase(
                "takes off {depth_mm:.3f} mm in one cut (allowed {allowed_mm:.3f} mm: the step-down of "
                "{step_down_mm:g} mm and the cusps of the layer before)",
                depth_mm=v,
                allowed_mm=self.allowed_drop_mm,
                step_down_mm=spec.step_down_mm,
            )
        )
        self._rapid = Finding(
            says=lambda v: Phrase(
                "is a rapid through stock or near it, {depth_mm:.3f} mm too deep (allowed: none in stock; straight "
                "down to {above_mm:g} mm above it)",
                depth_mm=v,
                above_mm=rapid_clearance_mm,
            )
        )
        self._low = Finding(
            says=lambda v: Phrase(
                "is a rapid across at Z{z_mm:.3f}, below the safe height (allowed: at least Z{safe_z_mm:g})",
                z_mm=-v,
                safe_z_mm=safe_z_mm,
            )
        )
        self._still = Finding(says=describe_spindle_off)
        self._bottom = Finding(
            says=lambda v: Phrase(
                "goes to Z{z_mm:.3f}, below the block (allowed: at least Z{least_mm:g})",
                z_mm=-v,
                least_mm=-stock.thickness_mm,
            )
        )
        run_out_mm = max(stock.margin_mm, spec.radius_mm) + spec.pitch_mm
        self._region = (-run_out_mm, stock.width_mm + run_out_mm, -run_out_mm, stock.height_mm + run_out_mm)
        self._outside = Finding(
            says=lambda v: Phrase(
                "is {beyond_mm:.3f} mm beyond the block and its run-out (allowed: X{x0_mm:g} to X{x1_mm:g}, Y{y0_mm:g} "
                "to Y{y1_mm:g})",
                beyond_mm=v,
                **dict(zip(("x0_mm", "x1_mm", "y0_mm", "y1_mm"), self._region, strict=True)),
            )
        )
        self._extra: list[Phrase] = []
        self.notes: list[Phrase] = []
        self.lines = self.bytes = self.moves = self.entries = 0
        self.path_length_mm = self.max_engagement_mm = self.gouge_mm = 0.0
        self._low_corner, self._high_corner = np.full(3, np.inf), np.full(3, -np.inf)
        self._low_cut, self._high_cut = np.full(3, np.inf), np.full(3, -np.inf)
        self._airborne = True
        # The last move of the batch before: line, is rapid, spindle on, in the air, end point.
        self._last_line, self._last_rapid, self._last_spindle, self._last_clear = 0, True, False, True
        self._last_point = np.zeros(3)

    @property
    def faults(self) -> list[Phrase]:
        """All faults so far; append further sentences with `add_fault`."""
        kinds = (self._gouge, self._deep, self._rapid, self._low, self._still, self._bottom, self._outside)
        return [sentence for kind in kinds for sentence in kind.sentences] + self._extra

    def add_fault(self, sentence: Phrase) -> None:
        self._extra.append(sentence)

    @property
    def bounds(self) -> dict[str, list[float]]:
        if not self.moves:
            return {axis: [0.0, 0.0] for axis in _AXES}
        return {a: [float(self._low_corner[d]), float(self._high_corner[d])] for d, a in enumerate(_AXES)}

    @property
    def cut_bounds(self) -> dict[str, list[float]]:
        """The bounds of moves at a feed that reach the stock, without moves in the air."""
        if not np.isfinite(self._low_cut).all():
            return self.bounds
        return {a: [float(self._low_cut[d]), float(self._high_cut[d])] for d, a in enumerate(_AXES)}

    def judge(self, batch: MoveBatch, drops: Drops, overlaps: Overlaps, whole: RemovalGrid) -> None:
        self.lines, self.bytes = batch.lines_read, batch.bytes_read
        if len(batch) == 0:
            return
        start, end = batch.start_mm, batch.end_mm
        step = end - start
        is_motion = batch.pause_s < 0
        low_z = np.minimum(start[:, 2], end[:, 2])
        clear = batch.is_rapid | (low_z > self._highest_mm) | ~is_motion
        self.moves += int(is_motion.sum())
        self.path_length_mm += float(np.sqrt(np.einsum("ij,ij->i", step, step)).sum())
        self._low_corner = np.minimum(self._low_corner, batch.points_mm.min(axis=0))
        self._high_corner = np.maximum(self._high_corner, batch.points_mm.max(axis=0))
        low = ~clear
        if low.any():
            self._low_cut = np.minimum(self._low_cut, np.minimum(start[low], end[low]).min(axis=0))
            self._high_cut = np.maximum(self._high_cut, np.maximum(start[low], end[low]).max(axis=0))
        self._judge_drops(
            drops,
            whole,
            lines=np.concatenate([[self._last_line], batch.line]),
            rapid=np.concatenate([[self._last_rapid], batch.is_rapid]),
            spindle=np.concatenate([[self._last_spindle], batch.spindle_on]),
            clear=np.concatenate([[self._last_clear], clear & is_motion]),
        )
        self._judge_places(batch, low_z, step)
        gouges = overlaps.depth_mm > self._gouge_allowed_mm
        self._gouge.note_moves(gouges, overlaps.depth_mm, batch.line, overlaps.place_mm)
        self.gouge_mm = max(self.gouge_mm, float(overlaps.depth_mm.max()))
        moving = np.flatnonzero(is_motion & (step != 0).any(axis=1))
        if moving.size:
            k = moving[-1]
            self._last_line, self._last_clear = int(batch.line[k]), bool(clear[k])
            self._last_rapid, self._last_spindle = bool(batch.is_rapid[k]), bool(batch.spindle_on[k])

    def judge_rest(self, drops: Drops, whole: RemovalGrid) -> None:
        """Judge the removal where the ball stops."""
        one = np.array([True])
        self._judge_drops(
            drops,
            whole,
            lines=np.array([self._last_line]),
            rapid=one & self._last_rapid,
            spindle=one & self._last_spindle,
            clear=one & self._last_clear,
        )

    def _judge_drops(
        self,
        drops: Drops,
        whole: RemovalGrid,
        *,
        lines: np.ndarray,
        rapid: np.ndarray,
        spindle: np.ndarray,
        clear: np.ndarray,
    ) -> None:
        depth = drops.depth_mm
        touched = depth > _TOUCH_MM
        entries, self._airborne = _count_entries(self._airborne, clear, depth, _TOUCH_MM)
        self.entries += entries
        if not touched.any():
            return
        cutting = touched & ~rapid
        self.max_engagement_mm = max(self.max_engagement_mm, float(depth[cutting].max(initial=0.0)))
        for kind, guilty in (
            (self._deep, cutting & (depth > self.allowed_drop_mm)),
            (self._rapid, touched & rapid),
            (self._still, cutting & ~spindle),
        ):
            if guilty.any():
                x, y = whole.places_mm(drops.cell)
                kind.note_moves(guilty, depth, lines, np.column_stack([x, y]))

    def _judge_places(self, batch: MoveBatch, low_z: Array, step: Array) -> None:
        end = batch.end_mm
        across = (step[:, :2] != 0).any(axis=1)
        low_rapid = batch.is_rapid & across & (low_z < self._safe_z_mm - 1e-6)
        self._low.note_moves(low_rapid, -low_z, batch.line, end)
        self._bottom.note_moves(low_z < -self._stock.thickness_mm - 1e-6, -low_z, batch.line, end)
        x_lo, x_hi, y_lo, y_hi = self._region
        beyond = np.maximum.reduce([x_lo - end[:, 0], end[:, 0] - x_hi, y_lo - end[:, 1], end[:, 1] - y_hi])
        self._outside.note_moves(beyond > 1e-6, beyond, batch.line, end)

    def note_gouge(self, depth_mm: float, line: int, place_mm: tuple[float, float]) -> None:
        """Add a gouge that shows in a cell and not by contact; it counts only if it is the worst."""
        if depth_mm > self._gouge_allowed_mm and depth_mm > self._gouge.worst:
            self._gouge.note(depth_mm, line, *place_mm)
        self.gouge_mm = max(self.gouge_mm, depth_mm)
