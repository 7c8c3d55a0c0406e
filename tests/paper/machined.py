"""Lenses milled in the computer for docs/paper.md: programs as text, read back, measured and cut, once per run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from cam.checking.check import PassCheck, check_program
from cam.checking.path_quality import PathMeasures
from cam.checking.removal import RemovalGrid
from cam.duration import DurationModel, Kinematics
from cam.passes import PAPER_PASSES, PassSpec, Stock
from cam.posts.dialects import GRBL
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid
from machines.profile import load_profile
from optics.heightfield import Heightfield
from tests.cam.programs import generate_program, measure_program, read_program
from tests.paper.cases import SIDE_MM, by_transport

SKIN_MM = 0.03  # what the second rough pass leaves
CELL_MM = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class FinishPath:
    """A finishing program: how it runs, and how long a usual small mill takes."""

    measures: PathMeasures
    time_s: float
    lines: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MilledPass:
    """One of three passes: its verdict, and the fine stock of a place after it."""

    spec: PassSpec
    verdict: PassCheck
    place: StockGrid
    section: StockGrid


@cache
def lens_to_mill(name: str, pixels: int, side_mm: float) -> Heightfield:
    """The lens of a picture, or a square from its middle."""
    lens = by_transport(name, pixels).heightfield
    if side_mm >= SIDE_MM:
        return lens
    count = round(side_mm / lens.dx_mm)
    first = (lens.x_mm.size - count) // 2
    part = slice(first, first + count + 1)
    return Heightfield.on_aperture(lens.z_mm[part, part], width_mm=count * lens.dx_mm, height_mm=count * lens.dy_mm)


def block_of(lens: Heightfield) -> Stock:
    return Stock(width_mm=lens.width_mm, height_mm=lens.height_mm, thickness_mm=60.0, margin_mm=5.0)


def skin_over(lens: Heightfield) -> StockGrid:
    block = StockGrid.block(block_of(lens), 0.25)
    top = lens.spline().extend(12.0).heights_mm(block.x_mm[None, :], block.y_mm[:, None]) + SKIN_MM
    return replace(block, top_mm=np.minimum(top, 0.0))


def moves_of(lens: Heightfield, spec: PassSpec, stock_top: StockGrid) -> Iterator[MoveBatch]:
    """The pass as its program has it."""
    return read_program(generate_program(lens, spec, block_of(lens), stock_top=stock_top, post=GRBL))


def finish_path(lens: Heightfield, spec: PassSpec) -> FinishPath:
    duration, lines = DurationModel(Kinematics.of(load_profile("grbl"))), 0

    def timed() -> Iterator[MoveBatch]:
        nonlocal lines
        for batch in moves_of(lens, spec, skin_over(lens)):
            duration.add(batch)
            lines = batch.lines_read
            yield batch

    measures = measure_program(timed(), lens, spec)
    return FinishPath(measures=measures, time_s=duration.seconds, lines=lines)


@cache
def three_passes(lens: Heightfield, corner_mm: float, sides_mm: tuple[float, ...]) -> tuple[MilledPass, ...]:
    """The paper's passes one after the other on the whole block; each finely on a square from (corner, corner), and
    along its side across the rows.
    """
    machine = load_profile("grbl")
    stock, before = block_of(lens), StockGrid.block(block_of(lens), CELL_MM)
    done = []
    for spec, side_mm in zip(PAPER_PASSES, sides_mm, strict=True):
        text = list(generate_program(lens, spec, stock, stock_top=before, post=GRBL))
        verdict = check_program(
            text,
            heightfield=lens,
            spec=spec,
            stock=stock,
            stock_top=before,
            kinematics=Kinematics.of(machine),
            safe_z_mm=machine.safe_z_mm,
        )
        place = _cut(text, spec, _bare(corner_mm, side_mm / 400, 400, 400))
        section = _cut(text, spec, _bare(corner_mm, side_mm / 3000, 3000, 3))
        done.append(MilledPass(spec=spec, verdict=verdict, place=place, section=section))
        before = verdict.stock_top
    return tuple(done)


def _bare(corner_mm: float, cell_mm: float, rows: int, columns: int) -> StockGrid:
    return StockGrid(x0_mm=corner_mm, y0_mm=corner_mm, cell_mm=cell_mm, top_mm=np.zeros((rows, columns)))


def _cut(text: Iterable[bytes], spec: PassSpec, stock: StockGrid) -> StockGrid:
    grid = RemovalGrid(stock, radius_mm=spec.radius_mm)
    for batch in read_program(text):
        grid.cut(batch)
    return grid.stock()
