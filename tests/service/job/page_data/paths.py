"""Paths to draw: batches of moves made up, and a .path file read as the page reads it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from cam.duration import Kinematics
from cam.reading.gcode import MoveBatch
from optics.heightfield import Array
from service.job.page_data.path import PathDrawing

MILL = Kinematics(
    max_rate_mm_per_min=(5000.0, 5000.0, 1500.0),
    acceleration_mm_per_s2=(400.0, 400.0, 200.0),
    junction_deviation_mm=0.01,
    planner_blocks=16,
    lines_per_s=400.0,
)


def split_header(data: bytes) -> tuple[dict[str, Any], int]:
    """The facts at the beginning of a file for the page, and where its arrays begin."""
    end = data.index(b"\n") + 1
    facts: dict[str, Any] = json.loads(data[:end])
    return facts, end


def batch_of(points_mm: Any, *, rapid: Any = False, pause_s: Any = -1.0, first_line: int = 1) -> MoveBatch:
    points = np.asarray(points_mm, dtype=np.float64)
    n = len(points) - 1
    return MoveBatch(
        points_mm=points,
        is_rapid=np.broadcast_to(np.asarray(rapid, dtype=np.bool_), n).copy(),
        feed_mm_per_min=np.full(n, 600.0),
        line=np.arange(first_line, first_line + n),
        spindle_rpm=np.full(n, 1e4),
        pause_s=np.broadcast_to(np.asarray(pause_s, dtype=np.float64), n).copy(),
        lines_read=first_line + n - 1,
        bytes_read=0,
        ended=False,
    )


def cut_in(batch: MoveBatch, pieces: int) -> list[MoveBatch]:
    """The same moves as several batches."""
    ends = np.unique(np.linspace(0, len(batch), pieces + 1).astype(int))
    return [
        MoveBatch(
            points_mm=batch.points_mm[a : b + 1],
            is_rapid=batch.is_rapid[a:b],
            feed_mm_per_min=batch.feed_mm_per_min[a:b],
            line=batch.line[a:b],
            spindle_rpm=batch.spindle_rpm[a:b],
            pause_s=batch.pause_s[a:b],
            lines_read=int(batch.line[b - 1]),
            bytes_read=0,
            ended=False,
        )
        for a, b in pairwise(ends)
    ]


def rows(count: int, *, length_mm: float = 20.0, pitch_mm: float = 0.02, step_mm: float = 0.1) -> Array:
    """A raster over a wavy surface, to and fro."""
    x = np.linspace(0.0, length_mm, round(length_mm / step_mm) + 1)
    parts = []
    for number in range(count):
        y = np.full(x.size, number * pitch_mm)
        along = x if number % 2 == 0 else x[::-1]
        parts.append(np.stack([along, y, -1.0 + 0.3 * np.sin(along / 2) * np.cos(y / 3)], axis=1))
    return np.concatenate(parts)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawn:
    """One level as the page reads it, point by point."""

    mm: Array
    time_s: Array
    rapid: np.ndarray
    hidden: np.ndarray
    first_of_chunk: np.ndarray
    index: list[dict[str, Any]]
    tolerance_mm: float

    def segments(self) -> tuple[Array, Array]:
        """Starts and ends (k, 3) of the lines that are drawn."""
        shown = ~self.hidden[1:]
        return self.mm[:-1][shown], self.mm[1:][shown]


def written(folder: Path, batches: list[MoveBatch], *, side_mm: float = 20.0) -> bytes:
    with PathDrawing(folder, kinematics=MILL, side_mm=side_mm) as drawing:
        for batch in batches:
            drawing.add(batch)
        drawing.write(folder / "pass-1.path", {"pass": 1})
    return (folder / "pass-1.path").read_bytes()


def header(data: bytes) -> dict[str, Any]:
    return split_header(data)[0]


def level(data: bytes, number: int) -> Drawn:
    """By nothing but what formats say, without the code that writes them."""
    facts = header(data)["levels"][number]
    names = ("first", "count", "line0", "line1", "x0", "y0", "z0", "x1", "y1", "z1", "t0", "t1")
    index, mm, time_s, raw_t, firsts = [], [], [], [], []
    for chunk in range(facts["chunks"]):
        at = facts["index_offset_bytes"] + 48 * chunk
        whole, real = np.frombuffer(data, "<u4", 4, at), np.frombuffer(data, "<f4", 8, at + 16)
        row = dict(zip(names, [*map(int, whole), *map(float, real)], strict=True))
        raw = np.frombuffer(data, "<u2", 4 * row["count"], facts["offset_bytes"] + 8 * row["first"]).reshape(-1, 4)
        low, high = real[:3].astype(float), real[3:6].astype(float)
        mm.append(low + raw[:, :3] / 65535 * (high - low))
        time_s.append(row["t0"] + (raw[:, 3] >> 2) / 16383 * (row["t1"] - row["t0"]))
        raw_t.append(raw[:, 3])
        firsts.append(np.arange(row["count"]) == 0)
        index.append(row)
    flags = np.concatenate(raw_t)
    return Drawn(
        mm=np.concatenate(mm),
        time_s=np.concatenate(time_s),
        rapid=flags & 1 > 0,
        hidden=flags & 2 > 0,
        first_of_chunk=np.concatenate(firsts),
        index=index,
        tolerance_mm=facts["tolerance_mm"],
    )


def farthest_mm(points: Array, starts: Array, ends: Array) -> float:
    """Of the points, the greatest distance to the nearest of the segments."""
    worst = 0.0
    way = ends - starts
    square = np.maximum((way**2).sum(axis=1), 1e-30)
    for point in points:
        share = np.clip(((point - starts) * way).sum(axis=1) / square, 0.0, 1.0)
        gaps = np.linalg.norm(point - starts - share[:, None] * way, axis=1)
        worst = max(worst, float(gaps.min()))
    return worst


def along(starts: Array, ends: Array, step_mm: float) -> Array:
    """Points along segments, that close together at least."""
    parts = [
        start + np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(end - start) / step_mm))[:, None] * (end - start)
        for start, end in zip(starts, ends, strict=True)
    ]
    return np.concatenate(parts)
