"""What every program around the passes is watched for: its totals, its extent, rapids, the spindle and the clamps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cam.checking.collision import Clamps
from cam.checking.move_rules import Finding, describe_spindle_off
from cam.duration import DurationModel, Kinematics
from cam.moves import Array
from cam.passes import Stock
from cam.reading.gcode import GRBL, Language, MoveBatch
from cam.surface.stock_grid import StockGrid
from phrases.phrase import Phrase

TOUCH_MM = 1e-6
_RAPID_CLEARANCE_MM = 0.5
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


class Watch:
    """Watches one program, batch by batch. kinds: findings by name, its own and those of the check."""

    def __init__(
        self, kinds: Mapping[str, Finding], *, stock: Stock, stock_top: StockGrid, mill: CheckedMill, radius_mm: float
    ) -> None:
        self.faults: list[Phrase] = []
        self.highest_mm = float(stock_top.top_mm.max())
        self.duration = DurationModel(mill.kinematics)
        self._mill, self._clamps = mill, Clamps(stock.clamps, radius_mm=radius_mm)
        self._lines = self._bytes = self._moves = 0
        self._length_mm = 0.0
        self._least, self._most = np.full(3, np.inf), np.full(3, -np.inf)
        self.kinds = {
            "rapid": Finding(
                says=lambda v: Phrase("is a rapid {into_mm:.3f} mm into stock or too near (allowed: none)", into_mm=v)
            ),
            "low": Finding(says=lambda v: Phrase("is a rapid across at Z{z_mm:.3f}, below the safe height", z_mm=-v)),
            "still": Finding(says=describe_spindle_off),
            **kinds,
        }

    def count(self, batch: MoveBatch) -> Array:
        """Count a batch; return the ends of blocks as `DurationModel.add_batch` does."""
        self._lines, self._bytes = batch.lines_read, batch.bytes_read
        if len(batch):
            self._clamps.add(batch)
            self._moves += int((batch.pause_s < 0).sum())
            self._length_mm += float(np.linalg.norm(np.diff(batch.points_mm, axis=0), axis=1).sum())
            self._least = np.minimum(self._least, batch.points_mm.min(axis=0))
            self._most = np.maximum(self._most, batch.points_mm.max(axis=0))
        return self.duration.add_batch(batch)

    def judge_rapids(self, batch: MoveBatch, drops_mm: Array) -> None:
        """Note rapids that come near stock or are low. drops_mm (n,): what moves take off."""
        step, end, line = batch.end_mm - batch.start_mm, batch.end_mm, batch.line
        near = self.highest_mm + _RAPID_CLEARANCE_MM - end[:, 2]
        down = (near > TOUCH_MM) & (step[:, 2] < 0)
        touched = drops_mm > TOUCH_MM
        self.kinds["rapid"].note_moves(batch.is_rapid & (down | touched), np.maximum(near, drops_mm), line, end)
        across, low_z = batch.is_rapid & (step[:, :2] != 0).any(axis=1), np.minimum(batch.start_mm[:, 2], end[:, 2])
        self.kinds["low"].note_moves(across & (low_z < self._mill.safe_z_mm - 1e-6), -low_z, line, end)

    def verdict(
        self,
        stock_top: StockGrid,
        *,
        entries: int,
        engagement_mm: float,
        gouge_mm: float = 0.0,
        left_mm: float = 0.0,
        clear_um: float | None = None,
        tabs: tuple[Tab, ...] = (),
    ) -> AroundCheck:
        found = [sentence for kind in self.kinds.values() for sentence in kind.sentences]
        return AroundCheck(
            faults=(*found, *self.faults, *self._clamps.faults),
            lines=self._lines,
            bytes=self._bytes,
            moves=self._moves,
            path_length_mm=self._length_mm,
            time_s=self.duration.seconds,
            entries=entries,
            max_engagement_mm=engagement_mm,
            gouge_um=1000 * gouge_mm,
            left_um=1000 * left_mm,
            bounds={axis: [float(self._least[d]), float(self._most[d])] for d, axis in enumerate(_AXES)},
            stock_top=stock_top,
            clear_um=clear_um,
            tabs=tabs,
        )
