"""Tool paths to draw, made without a program: rows over a wavy lens, in the levels that a drawing has."""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, Route

from service.job.page_data.path import Level, make_header
from service.job.page_data.points import HIDDEN, RAPID, Points

FEED_MM_PER_S = 25.0
SIDE_MM = 10.0  # of the shop's lens


@dataclass(frozen=True, slots=True)
class Thinned:
    """A level: every so many rows of the path, with points so far apart."""

    every: int
    step_mm: float
    tolerance_mm: float


def write_path(path: Path, *, side_mm: float, pitch_mm: float, levels: tuple[Thinned, ...]) -> int:
    """A pass of rows along X, the coarsest level first; points of the full one."""
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        made = []
        for thinned in levels:
            level = Level(Path(folder), thinned.tolerance_mm)
            stack.callback(level.close)
            for row in _rows(side_mm, pitch_mm, thinned, lines=round(side_mm / levels[-1].step_mm) + 1):
                level.add(row)
            level.finish()
            made.append(level)
        seconds = (round(side_mm / pitch_mm) + 1) * side_mm / FEED_MM_PER_S
        bounds = {"x": [0.0, side_mm], "y": [0.0, side_mm], "z": [-2.0, -0.1]}
        facts = {
            "version": 1, "pass": 1, "name": "finish", "strategy": "raster", "direction": "x", "pitch_mm": pitch_mm,
            "radius_mm": 1.5, "feed_mm_per_min": 60 * FEED_MM_PER_S, "stock_to_leave_mm": 0.0, "bounds_mm": bounds,
            "cut_bounds_mm": bounds, "time_s": seconds, "points": made[-1].points,
            "programs": [{"file": "pass-1-finish.nc", "lines": made[-1].points}],
        }  # fmt: skip
        with path.open("wb") as file:
            file.write(make_header(facts, made))
            for level in made:
                file.write(level.index.tobytes())
                file.writelines(level.blocks())
        return made[-1].points


_HUGE = (Thinned(16, 0.025, 0.08), Thinned(4, 0.01, 0.02), Thinned(2, 0.004, 0.01), Thinned(1, 0.002, 0.0))


def write_huge_path(path: Path) -> int:
    """A finish pass of more than five million points over the shop's lens; their number."""
    return write_path(path, side_mm=SIDE_MM, pitch_mm=0.01, levels=_HUGE)


def _rows(side_mm: float, pitch_mm: float, thinned: Thinned, *, lines: int) -> Iterator[Points]:
    """lines: of each row of the program."""
    x_mm = np.arange(0.0, side_mm + 1e-9, thinned.step_mm)
    row_s = side_mm / FEED_MM_PER_S
    for number in range(0, round(side_mm / pitch_mm) + 1, thinned.every):
        y_mm = number * pitch_mm
        along = x_mm if (number // thinned.every) % 2 == 0 else x_mm[::-1]
        z_mm = -1.0 - 0.9 * np.sin(6.3 * along / side_mm) * np.cos(5.0 * y_mm / side_mm)
        kind = np.zeros(along.size, dtype=np.uint8)
        kind[0] = HIDDEN if thinned.every > 1 else RAPID if number else 0
        line = number * lines + np.linspace(0, lines - 1, along.size).astype(np.int64)
        time_s = number * row_s + np.linspace(0.0, 0.99 * row_s, along.size)
        mm = np.stack([along, np.full(along.size, y_mm), z_mm], axis=1)
        yield Points(mm=mm, time_s=time_s, line=line, kind=kind)


class Served:
    """A file as an artifact of a job: answered by ranges; `fetched` are those that were asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fetched: list[tuple[int, int]] = []

    @property
    def bytes(self) -> int:
        return sum(end - start for start, end in self.fetched)

    def answer(self, route: Route) -> None:
        size = self.path.stat().st_size
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", route.request.headers.get("range", ""))
        assert asked, "the whole file was asked for"
        start, end = int(asked[1]), min(size, int(asked[2]) + 1)
        self.fetched.append((start, end))
        with self.path.open("rb") as file:
            file.seek(start)
            body = file.read(end - start)
        headers = {"Content-Range": f"bytes {start}-{end - 1}/{size}", "Content-Type": "application/octet-stream"}
        route.fulfill(status=206, body=body, headers=headers)

    def on(self, page: Page, address: str) -> None:
        page.route(f"**{address}", self.answer)
