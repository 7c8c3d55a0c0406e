"""The check of a polishing program: reads it back, and judges where the bob stands against the lens and the stock left.

Of the generator only the surface of a ball over the lens is used: at each sample of a move its tip must lie as deep as
the bob may be pressed. The stock that all programs before have left shows walls: no cell of it may come deeper into the
bob. The time at each place is that of the mill's kinematics, from which `optics.bob` computes the removal. A program's
samples are held in memory, some 60 bytes each: a path of 40 m has half a million.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from cam.around.watch import AroundCheck, CheckedMill, Watch
from cam.checking.move_rules import Finding
from cam.duration import is_block
from cam.moves import Array
from cam.passes import Stock
from cam.polish.cut import PolishCut
from cam.polish.path import cover
from cam.reading.gcode import MoveBatch, read_parts
from cam.surface.stock_grid import StockGrid
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield
from phrases.phrase import Phrase

_DEEPER, _SHALLOWER = 1.15, 0.85  # of the compression
_WALL_MM = 0.05  # by which cells of the stock may come deeper into the bob, beside the compression
_SAMPLE_MM = 0.2  # between two samples of a move
_WALL_SAMPLES = 3  # every so many are compared with the stock


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PolishCheck:
    """verdict: as of the other programs around the passes; its max_engagement_mm is the greatest compression.

    at_mm (n, 2), tip_mm (n, 3), dwell_s (n,) : contact point, tip and time of every sample, in order
    compression_mm     : least and greatest along the path
    fastest_mm_per_s   : greatest surface speed in the contact
    """

    verdict: AroundCheck
    at_mm: Array = field(default_factory=lambda: np.empty(0))
    tip_mm: Array = field(default_factory=lambda: np.empty(0))
    dwell_s: Array = field(default_factory=lambda: np.empty(0))
    compression_mm: tuple[float, float] = (0.0, 0.0)
    fastest_mm_per_s: float = 0.0

    @property
    def ok(self) -> bool:
        return self.verdict.ok

    @property
    def faults(self) -> tuple[Phrase, ...]:
        return self.verdict.faults


def check_polish(
    parts: Iterable[Iterable[bytes]],
    task: PolishCut,
    *,
    lens: Heightfield,
    stock: Stock,
    stock_top: StockGrid,
    mill: CheckedMill,
) -> PolishCheck:
    """Judge the programs, run one after the other on what the passes have left."""
    run = _Run(task, lens, stock, stock_top, mill)
    for batch in read_parts(parts, mill.language):
        run.add(batch)
    return run.judge()


class _Run:
    def __init__(
        self, task: PolishCut, lens: Heightfield, stock: Stock, stock_top: StockGrid, mill: CheckedMill
    ) -> None:
        self._task, self._mill, self._stock_top = task, mill, stock_top
        self._surface: ToolSurface = cover(task, lens)
        self._entries, self._airborne = 0, True
        self._ends: list[Array] = []
        self._polishing: list[tuple[Array, Array, np.ndarray]] = []  # start, end, line of moves on the lens
        self._block: list[np.ndarray] = []  # their numbers among the blocks of the duration model
        self._blocks = 0
        low, high = task.compression_mm * _SHALLOWER, task.compression_mm * _DEEPER
        kinds = {
            "deep": Finding(
                says=lambda v: Phrase(
                    "presses the bob {depth_mm:.3f} mm deep (allowed: {least_mm:.3f} to {most_mm:.3f} mm)",
                    depth_mm=v,
                    least_mm=low,
                    most_mm=high,
                )
            ),
            "shallow": Finding(
                says=lambda v: Phrase(
                    "presses the bob {depth_mm:.3f} mm deep (allowed: {least_mm:.3f} to {most_mm:.3f} mm)",
                    depth_mm=-v,
                    least_mm=low,
                    most_mm=high,
                )
            ),
            "wall": Finding(
                says=lambda v: Phrase(
                    "presses the bob {depth_mm:.3f} mm into the wall beside the lens (allowed: none); a smaller bob "
                    "(finish.bob.radius_mm), or a larger ball to finish with, makes room",
                    depth_mm=v,
                )
            ),
            "fast": Finding(
                says=lambda v: Phrase(
                    "rubs at {speed_m_per_s:.1f} m/s, where felt burns the lens (allowed: {most_m_per_s:.1f} m/s): "
                    "turn it more slowly (finish.bob.spindle_rpm)",
                    speed_m_per_s=v / 1000,
                    most_m_per_s=task.most_mm_per_s / 1000,
                )
            ),
        }
        self._watch = Watch(kinds, stock=stock, stock_top=stock_top, mill=mill, radius_mm=task.radius_mm)
        self._kinds = self._watch.kinds

    def add(self, batch: MoveBatch) -> None:
        self._ends.append(self._watch.count(batch))
        if len(batch) == 0:
            return
        start, end, line = batch.start_mm, batch.end_mm, batch.line
        across = (end[:, :2] != start[:, :2]).any(axis=1)
        self._watch.judge_rapids(batch, np.zeros(len(batch)))
        cuts = ~batch.is_rapid & (batch.pause_s < 0)
        pressed = np.full(len(batch), self._task.compression_mm)
        self._kinds["still"].note_moves(cuts & ~batch.spindle_on, pressed, line, end)
        polishing = np.flatnonzero(cuts & across)
        aloft = batch.is_rapid | ~across
        self._entries += int((polishing.size > 0) and (self._airborne or bool(aloft[: polishing[0]].any())))
        self._airborne = bool(aloft[-1])
        numbers = self._blocks + np.cumsum(is_block(batch)) - 1
        self._blocks = int(numbers[-1]) + 1
        self._polishing.append((start[polishing], end[polishing], line[polishing]))
        self._block.append(numbers[polishing])
        down = np.flatnonzero(cuts & ~across)
        if down.size:
            self._judge_depth(end[down], line[down], may_be_above=True)

    def _judge_depth(self, tip: Array, line: np.ndarray, *, may_be_above: bool) -> tuple[Array, Array]:
        """Note tips (n, 3) that press too much or too little; return contact points (n, 2) and compressions (n,)."""
        task = self._task
        met = self._surface.contacts_mm(tip[:, 0], tip[:, 1])
        across = np.hypot(*(tip[:, :2] - met[:, :2]).T) / (task.radius_mm - task.compression_mm)
        deep = task.compression_mm + (met[:, 2] - tip[:, 2]) * np.sqrt(np.maximum(0.0, 1.0 - across**2))
        digits = 1.5 * self._mill.digit_mm
        self._kinds["deep"].note_moves(deep > _DEEPER * task.compression_mm + digits, deep, line, tip)
        if not may_be_above:
            self._kinds["shallow"].note_moves(deep < _SHALLOWER * task.compression_mm - digits, -deep, line, tip)
        return met[:, :2], deep

    def judge(self) -> PolishCheck:
        task = self._task
        if not any(line.size for _, _, line in self._polishing):
            never = Phrase("the bob never moves along the lens (allowed: only a program that polishes)")
            self._watch.faults.append(never)
            return PolishCheck(verdict=self._verdict(0.0))
        ends = np.concatenate([*self._ends, self._watch.duration.list_waiting_s()])
        took_s = np.diff(ends, prepend=0.0)
        start, end, line = (np.concatenate(column) for column in zip(*self._polishing, strict=True))
        dwell_s = took_s[np.concatenate(self._block)]
        parts = np.maximum(1, np.ceil(np.linalg.norm(end - start, axis=1) / _SAMPLE_MM)).astype(int)
        move = np.repeat(np.arange(parts.size), parts)
        share = (np.arange(move.size) - np.repeat(np.cumsum(parts) - parts, parts) + 0.5) / parts[move]
        tip = start[move] + share[:, None] * (end - start)[move]
        self._judge_depth(end, line, may_be_above=False)
        at, deep = self._judge_depth(tip, line[move], may_be_above=False)
        turn, contact = task.spindle_rpm * math.pi / 30, np.sqrt(task.radius_mm * np.maximum(deep, 0.0))
        fast = turn * (np.hypot(*(at - tip[:, :2]).T) + contact)
        self._kinds["fast"].note_moves(fast > task.most_mm_per_s, fast, line[move], tip)
        some = slice(None, None, _WALL_SAMPLES)
        into = np.zeros(tip[some].shape[0])
        top = self._stock_top
        _press_stock(
            *(top.top_mm, top.x0_mm, top.y0_mm, top.cell_mm, np.ascontiguousarray(tip[some])),
            *(task.radius_mm, into),
        )
        beyond = into - deep[some] - _WALL_MM - top.cell_mm / 2
        self._kinds["wall"].note_moves(beyond > 0, beyond, line[move][some], tip[some])
        return PolishCheck(
            verdict=self._verdict(float(deep.max())),
            at_mm=at,
            tip_mm=tip,
            dwell_s=dwell_s[move] / parts[move],
            compression_mm=(float(deep.min()), float(deep.max())),
            fastest_mm_per_s=float(fast.max()),
        )

    def _verdict(self, deepest_mm: float) -> AroundCheck:
        return self._watch.verdict(self._stock_top, entries=self._entries, engagement_mm=deepest_mm)


@njit(cache=True, nogil=True)
def _press_stock(top, x0, y0, cell, tip, radius, into):  # type: ignore[no-untyped-def]
    """Set into (n,) to how deep the stock, columns up to top (ny, nx), comes into the bob at each tip (n, 3); above its
    centre the bob counts as a cylinder.
    """
    ny, nx = top.shape
    for k in range(into.size):
        cx, cy, cz = tip[k, 0], tip[k, 1], tip[k, 2] + radius
        i0, i1 = max(0, int((cx - radius - x0) / cell)), min(nx - 1, int((cx + radius - x0) / cell))
        j0, j1 = max(0, int((cy - radius - y0) / cell)), min(ny - 1, int((cy + radius - y0) / cell))
        for j in range(j0, j1 + 1):
            dy = y0 + (j + 0.5) * cell - cy
            for i in range(i0, i1 + 1):
                dx = x0 + (i + 0.5) * cell - cx
                under = max(0.0, cz - top[j, i])
                left = radius * radius - dx * dx - dy * dy - under * under
                if left > 0.0:
                    into[k] = max(into[k], radius - math.sqrt(dx * dx + dy * dy + under * under))
