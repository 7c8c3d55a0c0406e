"""pass-N.path: a whole pass for drawing, in levels from an overview to every move, read by byte ranges.

Theory of operation: the full level has a point for every move. Each coarser level is made of chords of the one before
it and is four times as coarse; its errors add up to its tolerance. The coarsest also leaves out tracks beside drawn
ones, and is coarsened further until it is small. A short pass has only the full level.

A level is written as chunks of points, eight bytes each, and an index of their boxes and times. A chunk's first point
repeats the last one of the chunk before, and is not drawn to.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from cam.duration import Kinematics
from cam.reading.gcode import MoveBatch
from optics.heightfield import Array
from service.job.files import atomic_file, make_header_line
from service.job.page_data.points import HIDDEN, PAUSE, RAPID, Chords, MovePoints, Points, Thinner, no_box, widen

MOST_POINTS = 60_000
"""Of the coarsest level."""

_VERSION = 1
_GLANCE = 1 / 400  # of the longer side: not resolved in a picture of the whole
_RATIO = 4.0
_STEPS = 3  # levels between the full one and the coarsest
_THINNED = 1  # the one of them, counted from the finest, from which the coarsest is made
_SMALLER = 0.6  # than the level before it, or it is left out
_EXACT = 0.98  # of a tolerance; the rest is for the raster of the file
CHUNK_POINTS = 8192
INDEX = np.dtype(
    [("first", "<u4"), ("count", "<u4"), ("lines", "<u4", 2), ("low", "<f4", 3), ("high", "<f4", 3), ("time", "<f4", 2)]
)
_PLACES, _TIMES, _TIME_SHIFT = 65535, 16383, 2


class PathDrawing:
    """Collects the moves of a pass as they are read; `write` makes the file. Use it in a `with`."""

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
            file.write(make_header(facts, levels))
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
        """Flush the chords of each level into the next."""
        self._full.finish()
        points = Points.none()
        for level, chords in zip(self._levels, self._chords, strict=True):
            points = Points.join([chords.add(points), chords.rest()])
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
        """Thin out a level that is so fine that neighbouring rows are still alike. Half of the tolerance is for the
        tracks left out, the rest for that level's error and for chords.
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
    """Return the share of a level's tolerance that its own chords may use; the level before has used the rest."""
    return 1.0 if number == 0 else 1.0 - 1.0 / _RATIO


def _as_bounds(corners_mm: Array) -> dict[str, list[float]] | None:
    if not np.isfinite(corners_mm).all():
        return None
    return {axis: [float(corners_mm[0, k]), float(corners_mm[1, k])] for k, axis in enumerate("xyz")}


def make_header(facts: Mapping[str, Any], levels: list[Level]) -> bytes:
    """Make the header. Its offsets depend on its length, which depends on their digits, so it takes a few rounds."""
    length = 0
    while True:
        line = make_header_line({**facts, "levels": list(_rows(levels, length))})
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


class Level:
    """Chunks go to an unnamed file, which disappears when it is closed; only the index is kept in memory."""

    def __init__(self, folder: Path, tolerance_mm: float) -> None:
        self.tolerance_mm = tolerance_mm
        self.points = 0
        self.path_points = 0  # without those that are repeated
        self._file: BinaryIO = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by close()
        self._rows: list[NDArray[np.void]] = []
        self._held: list[Points] = []
        self._held_points = 0

    def add(self, points: Points) -> None:
        if not len(points):
            return
        self.path_points += len(points)
        self._held.append(points)
        self._held_points += len(points)
        if self._held_points >= CHUNK_POINTS:
            self._write_chunks(Points.join(self._held), least=CHUNK_POINTS)

    def finish(self) -> None:
        """Write the remaining points; no more will come."""
        if self._held:
            self._write_chunks(Points.join(self._held), least=1)
        self._held = []

    @property
    def index(self) -> NDArray[np.void]:
        return np.concatenate(self._rows) if self._rows else np.empty(0, dtype=INDEX)

    def blocks(self, size: int = 1 << 22) -> Iterator[bytes]:
        """Yield the points as they are in the file."""
        self._file.seek(0)
        while piece := self._file.read(size):
            yield piece

    def chunks(self) -> Iterator[Points]:
        """Yield the points of the file once more, without repetitions."""
        self._file.seek(0)
        for number, row in enumerate(self.index):
            data = self._file.read(8 * int(row["count"]))
            points = decode_chunk(row, np.frombuffer(data, dtype="<u2").reshape(-1, 4))
            yield points[1:] if number else points

    def close(self) -> None:
        self._file.close()

    def _write_chunks(self, held: Points, *, least: int) -> None:
        start = 0
        while len(held) - start >= max(least, 2) or (len(held) - start == 1 and not self._rows and least == 1):
            chunk = held[start : start + CHUNK_POINTS]
            row, data = encode_chunk(chunk, first=self.points)
            self._file.write(data)
            self._rows.append(row)
            self.points += len(chunk)
            start += len(chunk) - 1
        self._held, self._held_points = [held[start:]], len(held) - start


def encode_chunk(chunk: Points, *, first: int) -> tuple[NDArray[np.void], bytes]:
    """Return a chunk's row of the index, and its points."""
    low, high = _box(chunk)
    times = chunk.time_s[[0, -1]].astype("<f4")
    row = np.array([(first, len(chunk), chunk.line[[0, -1]], low, high, times)], dtype=INDEX)
    out = np.empty((len(chunk), 4), dtype="<u2")
    out[:, :3] = _shares(chunk.mm, low, high, _PLACES)
    flags = chunk.kind & (RAPID | HIDDEN)
    flags[0] |= HIDDEN
    out[:, 3] = _shares(chunk.time_s, times[0], times[1], _TIMES) << _TIME_SHIFT | flags
    return row, out.tobytes()


def decode_chunk(row: NDArray[np.void], data: NDArray[np.uint16]) -> Points:
    """Decode the points of a chunk. Only its first and last line numbers are stored; the others are interpolated."""
    low, high, (begin_s, end_s) = (row[name].astype(np.float64) for name in ("low", "high", "time"))
    time_s = begin_s + (data[:, 3] >> _TIME_SHIFT) / _TIMES * (end_s - begin_s)
    line0, line1 = (int(line) for line in row["lines"])
    still = np.zeros(len(data), dtype=np.bool_)
    still[1:] = (data[1:, :3] == data[:-1, :3]).all(axis=1)
    return Points(
        mm=low + data[:, :3] / _PLACES * (high - low),
        time_s=time_s,
        line=np.rint(np.linspace(line0, line1, len(data))).astype(np.int64),
        kind=((data[:, 3] & (RAPID | HIDDEN)) | still * PAUSE).astype(np.uint8),
    )


def _box(chunk: Points) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return corners in single precision that hold all points."""
    low, high = corners = no_box()
    widen(corners, chunk.mm, chunk.kind, 0)
    low4, high4 = low.astype("<f4"), high.astype("<f4")
    down, up = np.nextafter(low4, np.float32(-np.inf)), np.nextafter(high4, np.float32(np.inf))
    return np.where(low4 > low, down, low4), np.where(high4 < high, up, high4)


def _shares(values: Array, low: NDArray[np.float32], high: NDArray[np.float32], levels: int) -> NDArray[np.uint16]:
    """Return the positions of values between low and high, as whole numbers from 0 to levels."""
    from_, span = np.float64(low), np.float64(high) - np.float64(low)
    share = (values - from_) * (levels / np.where(span > 0, span, 1.0))
    return np.asarray(np.clip(np.rint(share), 0, levels), dtype=np.uint16)
