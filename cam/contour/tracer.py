"""Traces level lines of f as polylines, wherever places beside them must be covered.

Several lines cross one cell: the grid need not resolve the pitch. Triangles are listed per line; from any of them the
line is followed both ways until it closes or ends. Raw points lie where edges are crossed, see `levels`, and most of
them are left out: the next point kept is the farthest one whose chord passes all points between within the sag.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cam.contour.field import REACH_PITCHES, ContourField
from cam.contour.levels import fill_corners, follow, level_tree, other_edge, sort_by_line
from cam.moves import Array
from cam.rows.raster import THREAD_NAME, THREADS
from cam.rows.vertices import TICKS_PER_MM

CHUNKS = 16
SHORTEST_PITCHES = 6.0
"""Shorter tracks are dropped: strokes cover their places better."""

SAG_PITCHES = 0.015
SHORTEST_CHORD_PITCHES = 1.5
LONGEST_CHORD_PITCHES = 25.0
SHARP = math.cos(math.radians(50.0))
"""Tracks that turn more than this at a vertex, as level lines do at saddles, are split there; the tour joins the parts.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContourLines:
    """Polylines one after the other: track k is xy_mm[start[k] : start[k + 1]]; a closed one ends where it began."""

    xy_mm: Array
    start: NDArray[np.int64]

    @property
    def count(self) -> int:
        return self.start.size - 1

    @classmethod
    def join(cls, parts: list[ContourLines]) -> ContourLines:
        before = np.cumsum([0, *(len(part.xy_mm) for part in parts)])
        starts = [part.start[:-1] + count for part, count in zip(parts, before[:-1], strict=True)]
        xy = np.concatenate([part.xy_mm for part in parts])
        return cls(xy_mm=xy, start=np.concatenate([*starts, [len(xy)]]).astype(np.int64))


def trace(field: ContourField, *, pitch_mm: float) -> ContourLines:
    """Trace all level lines, as far as places beside them must be covered."""
    classes = int(np.ceil(field.density.max())) + 2
    levels = level_tree(float(field.f.min()), float(field.f.max()), field.level_mm, classes)
    grid = field.f, field.density, field.traced, levels
    counts = np.zeros(levels.birth.size + 1, np.int64)
    sort_by_line(*grid, counts, np.empty(0, np.int32), True)
    offset = np.concatenate([[0], np.cumsum(counts)])
    triangles = np.empty(offset[-1], np.int32)
    sort_by_line(*grid, offset[:-1].copy(), triangles, False)
    shares = np.searchsorted(offset, np.linspace(0, offset[-1], CHUNKS + 1))
    shares[-1] = levels.birth.size

    def chunk(first: int, last: int) -> ContourLines:
        room = int(offset[last] - offset[first])
        xy, start = np.empty((2 * room + 4, 2)), np.empty(room + 4, np.int64)
        origin = field.x0_mm, field.y0_mm, field.step_mm
        count = _trace_lines(*grid, *origin, field.wanted, offset, triangles, first, last, pitch_mm, xy, start)
        return ContourLines(xy_mm=xy[: start[count]].copy(), start=start[: count + 1].copy())

    with ThreadPoolExecutor(THREADS, thread_name_prefix=THREAD_NAME) as pool:
        return ContourLines.join(list(pool.map(chunk, shares[:-1].tolist(), shares[1:].tolist())))


@njit(cache=True, nogil=True)
def _trace_lines(f, density, cells, levels, x0, y0, step, wanted, offset, triangles, first, last, pitch, xy, start):  # type: ignore[no-untyped-def]
    """Write tracks of the lines first..last - 1, thinned, into xy and start; return how many."""
    stamp = np.full(2 * cells.size, -1, np.int32)
    longest = 0
    for line in range(first, last):
        longest = max(longest, offset[line + 1] - offset[line])
    raw = np.empty((2 * longest + 8, 2))
    middle = longest + 4
    fs, cs, nodes = np.empty(3), np.empty(3), np.empty((3, 2), np.int64)
    tracks, reach = 0, REACH_PITCHES * pitch
    start[0] = 0
    for line in range(first, last):
        for k in range(offset[line], offset[line + 1]):
            t = triangles[k]
            if stamp[t] == line:
                continue
            stamp[t] = line
            fill_corners(f, density, t, fs, cs, nodes)
            edge = other_edge(levels, line, fs, cs, -1)
            end, closed = follow(f, density, cells, levels, line, t, edge, stamp, raw, middle, 1)
            begin = middle
            if closed:
                raw[end] = raw[middle]
                end += 1
            else:
                edge = other_edge(levels, line, fs, cs, edge)
                begin, _ = follow(f, density, cells, levels, line, t, edge, stamp, raw, middle - 1, -1)
                begin += 1
                begin, end = _find_needed(raw, begin, end, wanted, reach / step)
            if _place_points(raw[begin:end], x0, y0, step) >= SHORTEST_PITCHES * pitch:
                tracks = thin_line(raw[begin:end], pitch, xy, start, tracks)
    return tracks


@njit(cache=True, nogil=True)
def _find_needed(raw, begin, end, wanted, reach):  # type: ignore[no-untyped-def]
    """Return (begin, end) of an open line's part beside which places are wanted, with a point more on either side."""
    first = begin
    while first + 2 < end and not _beside(raw[first + 1], raw[first + 2], wanted, reach):
        first += 1
    last = end
    while last - 2 > first and not _beside(raw[last - 2], raw[last - 3], wanted, reach):
        last -= 1
    return first, last


@njit(cache=True, nogil=True)
def _beside(a, b, wanted, reach):  # type: ignore[no-untyped-def]
    """Return whether there is a wanted place within the reach, perpendicular to the line from a to b."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.hypot(dx, dy) + 1e-12
    for k in range(-4, 5):
        i = int(math.floor(a[0] - 0.25 * k * reach * dy / length))
        j = int(math.floor(a[1] + 0.25 * k * reach * dx / length))
        if 0 <= j < wanted.shape[0] and 0 <= i < wanted.shape[1] and wanted[j, i]:
            return True
    return False


@njit(cache=True, nogil=True)
def _place_points(points, x0, y0, step):  # type: ignore[no-untyped-def]
    """Convert steps of the grid to mm, in place; return the length."""
    length = 0.0
    for n in range(points.shape[0]):
        points[n, 0] = x0 + step * points[n, 0]
        points[n, 1] = y0 + step * points[n, 1]
        if n:
            length += math.hypot(points[n, 0] - points[n - 1, 0], points[n, 1] - points[n - 1, 1])
    return length


@njit(cache=True, nogil=True)
def thin_line(points, pitch, xy, start, tracks):  # type: ignore[no-untyped-def]
    """Write the points kept, on the raster, into xy[start[tracks]:]; return the new number of tracks.

    All points since the anchor lie within the sag of a chord whose direction is in a cone; it narrows with each.
    """
    sag, shortest = SAG_PITCHES * pitch, SHORTEST_CHORD_PITCHES * pitch
    ax, ay = points[0, 0], points[0, 1]
    first, count = tracks, start[tracks]
    tracks, count = _put(ax, ay, xy, start, tracks, count)
    low, high, ahead = -math.pi, math.pi, 0.0
    far = 0.0  # of the candidate, from the anchor
    n = points.shape[0]
    i = 1
    while i < n:
        dx, dy = points[i, 0] - ax, points[i, 1] - ay
        away = math.hypot(dx, dy)
        if away > sag:
            if low == -math.pi:
                ahead = math.atan2(dy, dx)
            turn = math.atan2(dy, dx) - ahead
            turn -= 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5)
            if far >= shortest and (not low <= turn <= high or away > LONGEST_CHORD_PITCHES * pitch):
                ax, ay = points[i - 1, 0], points[i - 1, 1]
                tracks, count = _put(ax, ay, xy, start, tracks, count)
                low, high, far = -math.pi, math.pi, 0.0
                continue
            wide = math.asin(sag / away)
            low, high = max(low, turn - wide), min(high, turn + wide)
        far = away
        i += 1
    if far < shortest and count > start[tracks] + 1:  # avoid a tiny piece at the end
        count -= 1
    tracks, count = _put(points[n - 1, 0], points[n - 1, 1], xy, start, tracks, count)
    if tracks == first and _closes_sharply(xy, start[tracks], count):
        middle = (start[tracks] + count) // 2
        for k in range(count, middle, -1):
            xy[k] = xy[k - 1]
        tracks, count = tracks + 1, count + 1
        start[tracks] = middle + 1
    start[tracks + 1] = count
    return tracks + 1


@njit(cache=True, nogil=True)
def _sharp(a, b, c):  # type: ignore[no-untyped-def]
    """Return whether a path from a by b to c turns too much at b."""
    ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1]
    return ux * vx + uy * vy < SHARP * math.hypot(ux, uy) * math.hypot(vx, vy)


@njit(cache=True, nogil=True)
def _closes_sharply(xy, begin, end):  # type: ignore[no-untyped-def]
    """Return whether a track is closed and turns too much where it closes, which no other test covers."""
    last = end - 1
    closed = begin + 2 < last and xy[begin, 0] == xy[last, 0] and xy[begin, 1] == xy[last, 1]
    return closed and _sharp(xy[last - 1], xy[last], xy[begin + 1])


@njit(cache=True, nogil=True)
def _put(x, y, xy, start, tracks, count):  # type: ignore[no-untyped-def]
    """Add a vertex; a new track begins where it turns sharply at the last one. Returns (tracks, vertices)."""
    x, y = math.floor(x * TICKS_PER_MM + 0.5) / TICKS_PER_MM, math.floor(y * TICKS_PER_MM + 0.5) / TICKS_PER_MM
    if count > start[tracks] + 1 and _sharp(xy[count - 2], xy[count - 1], (x, y)):
        tracks += 1
        start[tracks] = count
        xy[count] = xy[count - 1]
        count += 1
    xy[count, 0], xy[count, 1] = x, y
    return tracks, count + 1
