"""Programs: lines written and lines read back per second, full-size finish pass of the paper on a stand-in lens."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

from cam.gcode import read_program
from cam.passes import PAPER_PASSES, Stock
from cam.posts.grbl import GRBL
from cam.program import generate_program
from cam.stock_grid import StockGrid
from tests.benchmarks.pictures import bumps
from tests.benchmarks.timing import Figure


def figures() -> Iterator[Figure]:
    lens = bumps()
    stock = Stock(width_mm=100.0, height_mm=100.0, thickness_mm=40.0, margin_mm=5.0)
    finish = PAPER_PASSES[2]
    # what rough 2 leaves: a thin skin everywhere, so that the finish is one layer
    left = StockGrid.block(stock, 0.25)
    skin = lens.spline().extended(12.0).heights_mm(left.x_mm[None, :], left.y_mm[:, None]) + 0.05
    top = replace(left, top_mm=skin)
    for run in ("first", "second"):
        started, cpu = time.perf_counter(), time.process_time()
        pieces = list(generate_program(lens, finish, stock, stock_top=top, post=GRBL))
        wall, cpu = time.perf_counter() - started, time.process_time() - cpu
        lines = sum(piece.count(b"\n") for piece in pieces)
        size = sum(map(len, pieces)) / 1e6
        if run == "second":
            note = f"{lines:,} lines, {size:.0f} MB in {wall:.1f} s wall, contact and formatting"
            yield Figure("finish pass made and formatted", lines / cpu / 1e6, "M lines/s/thread", note)
    started = time.perf_counter()
    moves = sum(len(batch) for batch in read_program(pieces))
    wall = time.perf_counter() - started
    yield Figure("program read back", lines / wall / 1e6, "M lines/s/thread", f"{moves:,} moves")
