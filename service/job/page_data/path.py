"""pass-N.path: a whole pass to draw, from a picture of it at a glance to every move, read by ranges.

Theory of operation: the full level has a point for every move. Each coarser one is made from the one before it by
chords, four times as coarse; errors add up to what its tolerance says. The coarsest also leaves out what runs beside
what is drawn, and is made coarser still until it is small. A short pass has the full level alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np

from cam.duration import Kinematics
from cam.reading.gcode import MoveBatch
from optics.heightfield import Array
from service.job.files import atomic_file
from service.job.page_data.header import header_line
from service.job.page_data.level import Level
from service.job.page_data.points import HIDDEN, PAUSE, RAPID, Chords, MovePoints, Points, no_box, widen
from service.job.page_data.thinning import Thinner

MOST_POINTS = 60_000
"""Of the coarsest level."""

_VERSION = 1
_GLANCE = 1 / 400  # of the longer side: what cannot be told apart in a picture of the whole
_RATIO = 4.0
_STEPS = 3  # levels between the full one and the coarsest
_THINNED = 1  # of them, counted from the finest: what the coarsest is made from
_SMALLER = 0.6  # than the level before it, or it is left out
_EXACT = 0.98  # of a tolerance; the rest is for the raster of the file


class PathDrawing:
    """Takes the moves of a pass as they are read; `write` makes the file. Use it in a `with`."""

    def __init__(self, folder: Path, *, kinematics: Kinematics, side_mm: float) -> None:
        """Begin. folder: for what does not fit into memory; side_mm: the longer one of the lens."""
        self._folder = folder
        self._side_mm = side_mm
        self._moves = MovePoints(kinematics)
        self._files = ExitStack()
        self._full = self._level(0.0)
        steps = [self._side_mm * _GLANCE / _RATIO**step for step in range(_STEPS, 0, -1)]
        self._levels = [self._level(tolerance_mm) for tolerance_mm in steps]
        self._chords = [
            Chords(_EXACT * _share(number) * level.tolerance_mm) for number, level in enumerate(self._levels)
        ]
        self._bounds = {moves: no_box() for moves in ("all", "cuts")}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def add(self, batch: MoveBatch) -> None:
        self._take(self._moves.add(batch))

    def write(self, path: Path, facts: Mapping[str, Any]) -> None:
        """Write the file; facts: of the pass, for its header."""
        self._take(self._moves.rest())
        self._finish()
        levels = self._worth_having()
        facts = {
            "version": _VERSION,
            **facts,
            "bounds_mm": _as_bounds(self._bounds["all"]),
            "cut_bounds_mm": _as_bounds(self._bounds["cuts"]),
            "time_s": self._moves.seconds,
            "points": self._full.points,
        }
        with atomic_file(path) as file:
            file.write(_header(facts, levels))
            for level in levels:
                file.write(level.index.tobytes())
                for block in level.blocks():
                    file.write(block)

    def _take(self, points: Points) -> None:
        widen(self._bounds["all"], points.mm, points.kind, HIDDEN)
        widen(self._bounds["cuts"], points.mm, points.kind, RAPID | PAUSE)
        self._full.add(points)
        for level, chords in zip(self._levels, self._chords, strict=True):
            points = chords.add(points)
            level.add(points)

    def _finish(self) -> None:
        """Pass what the chords still hold from each level to the next."""
        self._full.finish()
        points = Points.none()
        for level, chords in zip(self._levels, self._chords, strict=True):
            points = Points.joined([chords.add(points), chords.rest()])
            level.add(points)
            level.finish()

    def _worth_having(self) -> list[Level]:
        """Return the levels of the file, coarsest first."""
        levels = [self._full, *self._levels]
        small = next((n for n, level in enumerate(levels) if level.points <= MOST_POINTS), None)
        levels = levels[: small + 1] if small is not None else [*levels, self._glance()]
        chosen = [self._full]
        for level in levels[1:]:
            if level.points <= _SMALLER * chosen[-1].points or level is levels[-1]:
                chosen.append(level)
        return chosen[::-1]

    def _glance(self) -> Level:
        """Return the level for a picture of the whole."""
        tolerance_mm = self._side_mm * _GLANCE
        while (level := self._thin(tolerance_mm)).points > MOST_POINTS:
            level.close()
            tolerance_mm *= 2
        return level

    def _thin(self, tolerance_mm: float) -> Level:
        """Thin out from a level so fine that neighbouring rows still are alike: half of the tolerance for what is left
        out, the rest for that level's error and for chords.
        """
        level, finer = self._level(tolerance_mm), self._levels[_THINNED]
        thinner = Thinner(_EXACT * tolerance_mm / 2, self._bounds["all"][:, :2])
        chords = Chords(_EXACT * (tolerance_mm / 2 - finer.tolerance_mm))
        for points in finer.chunks():
            level.add(chords.add(thinner.add(points)))
        level.add(chords.add(thinner.rest()))
        level.add(chords.rest())
        level.finish()
        return level

    def _level(self, tolerance_mm: float) -> Level:
        level = Level(self._folder, tolerance_mm)
        self._files.callback(level.close)
        return level


def _share(number: int) -> float:
    """Return the share of a level's tolerance that its own chords may use: the level before has had the rest."""
    return 1.0 if number == 0 else 1.0 - 1.0 / _RATIO


def _as_bounds(corners_mm: Array) -> dict[str, list[float]] | None:
    if not np.isfinite(corners_mm).all():
        return None
    return {axis: [float(corners_mm[0, k]), float(corners_mm[1, k])] for k, axis in enumerate("xyz")}


def _header(facts: Mapping[str, Any], levels: list[Level]) -> bytes:
    """Make the header. Its offsets depend on its length, which grows with their digits: a few rounds settle it."""
    length = 0
    while True:
        line = header_line({**facts, "levels": list(_rows(levels, length))})
        if len(line) == length:
            return line
        length = len(line)


def _rows(levels: list[Level], offset: int) -> Iterator[dict[str, Any]]:
    for level in levels:
        index = level.index
        yield {
            "tolerance_mm": level.tolerance_mm,
            "points": level.points,
            "chunks": len(index),
            "index_offset_bytes": offset,
            "offset_bytes": offset + index.nbytes,
        }
        offset += index.nbytes + 8 * level.points
