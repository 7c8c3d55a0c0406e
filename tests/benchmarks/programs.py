"""Programs: lines written and lines read back per second, full-size finish pass of the paper on a stand-in lens."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from cam.moves import cut
from cam.passes import PAPER_PASSES, Stock
from cam.posts.dialects import GRBL
from cam.posts.writers import create_writer
from cam.surface.stock_grid import StockGrid
from tests.benchmarks.pictures import bumps
from tests.benchmarks.timing import Figure, seconds
from tests.cam.programs import generate_program, read_program

FORMATTED = 2_000_000  # points


def figures() -> Iterator[Figure]:
    yield from _written()
    yield from _whole_pass()


def _written() -> Iterator[Figure]:
    """Formatting alone: a path on which all three words change with every line, as on contours."""
    angle = np.linspace(0, 900, FORMATTED)
    points = 50 + np.column_stack([40 * np.cos(angle), 40 * np.sin(angle), np.sin(3 * angle) - 55])
    path = cut(points, 600.0)
    wall, cpu = seconds(lambda: [len(piece) for piece in create_writer(GRBL).write(path)])
    pieces = list(create_writer(GRBL).write(path))
    size = sum(map(len, pieces))
    lines = sum(piece.count(b"\n") for piece in pieces)
    note = f"X, Y and Z on each, {size / lines:.0f} bytes a line, {size / wall / 1e6:.0f} MB/s; asked: 2, or the disk's"
    yield Figure("lines formatted", lines / cpu / 1e6, "M lines/s/thread", note)
    with tempfile.TemporaryDirectory(dir=".") as folder:
        formatted_s = _to_disk(Path(folder) / "path.nc", create_writer(GRBL).write(path))
        plain_s = _to_disk(Path(folder) / "plain", pieces)
    yield Figure("lines formatted and on the disk", lines / formatted_s / 1e6, "M lines/s", "flushed and synced")
    yield Figure(
        "the disk alone, the same bytes", size / plain_s / 1e6, "MB/s", f"{lines / plain_s / 1e6:.1f} M lines/s"
    )


def _to_disk(path: Path, pieces) -> float:  # type: ignore[no-untyped-def]
    started = time.perf_counter()
    with path.open("wb") as file:
        for piece in pieces:
            file.write(piece)
        file.flush()
        os.fsync(file.fileno())
    return time.perf_counter() - started


def _whole_pass() -> Iterator[Figure]:
    lens = bumps()
    stock = Stock(width_mm=100.0, height_mm=100.0, thickness_mm=40.0, margin_mm=5.0)
    finish = PAPER_PASSES[2]
    # what rough 2 leaves: a thin skin everywhere, so that the finish is one layer
    left = StockGrid.block(stock, 0.25)
    skin = lens.spline().extend(12.0).heights_mm(left.x_mm[None, :], left.y_mm[:, None]) + 0.05
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
