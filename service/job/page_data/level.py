"""One level of a path on its way to a file: chunks of points, eight bytes each, and an index of their boxes and times.

A chunk's first point repeats the last one of the chunk before, and is not drawn to.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from optics.heightfield import Array
from service.job.page_data.points import HIDDEN, PAUSE, RAPID, Points, no_box, widen

CHUNK_POINTS = 8192
INDEX = np.dtype(
    [("first", "<u4"), ("count", "<u4"), ("lines", "<u4", 2), ("low", "<f4", 3), ("high", "<f4", 3), ("time", "<f4", 2)]
)
_PLACES, _TIMES, _TIME_SHIFT = 65535, 16383, 2


class Level:
    """Chunks go to a file without a name, which is gone when this is closed; only the index is held."""

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
            self._write_chunks(Points.joined(self._held), least=CHUNK_POINTS)

    def finish(self) -> None:
        """Write what is held; nothing more is coming."""
        if self._held:
            self._write_chunks(Points.joined(self._held), least=1)
        self._held = []

    @property
    def index(self) -> NDArray[np.void]:
        return np.concatenate(self._rows) if self._rows else np.empty(0, dtype=INDEX)

    def blocks(self, size: int = 1 << 22) -> Iterator[bytes]:
        """Yield the points as they stand in the file."""
        self._file.seek(0)
        while piece := self._file.read(size):
            yield piece

    def chunks(self) -> Iterator[Points]:
        """Yield the points again, as the file has them; none twice."""
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
    """Decode the points of a chunk; of its lines only the first and the last are known, the others are spread
    between.
    """
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
    """Return where values lie between low and high, as whole numbers from 0 to levels."""
    from_, span = np.float64(low), np.float64(high) - np.float64(low)
    share = (values - from_) * (levels / np.where(span > 0, span, 1.0))
    return np.asarray(np.clip(np.rint(share), 0, levels), dtype=np.uint16)
