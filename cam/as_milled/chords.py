"""Chords of all tracks in square boxes by their middles, so that the neighbours of one are found at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from cam.as_milled.tracks import Tracks


class Chords(NamedTuple):
    """What kernels need. Chord k runs from tip k - 1 to tip k, where `joined[k]`.

    group (n,) uint8 : which ball runs it; radii (groups,)
    start (boxes + 1,), member : CSR of chords by box; boxes (rows, columns) of `side` from (x0, y0)
    half_x, half_y             : no chord reaches farther from its middle than this
    """

    tips: Any
    joined: Any
    group: Any
    radii: Any
    half_x: float
    half_y: float
    start: Any
    member: Any
    x0: float
    y0: float
    side: float
    columns: int
    rows: int


def sort_chords(tracks: Sequence[Tracks], *, side_mm: float) -> Chords:
    tips = tracks[0].tips_mm if len(tracks) == 1 else np.concatenate([one.tips_mm for one in tracks])
    joined = tracks[0].joined if len(tracks) == 1 else np.concatenate([one.joined for one in tracks])
    group = np.repeat(np.arange(len(tracks), dtype=np.uint8), [one.joined.size for one in tracks])
    if not joined.any():
        raise ValueError("there are no cutting moves")
    low, high = tips.min(axis=0), tips.max(axis=0)
    columns, rows = (int((high[d] - low[d]) / side_mm) + 1 for d in (0, 1))
    start = np.zeros(columns * rows + 1, dtype=np.int32)
    member = np.empty(int(joined.sum()), dtype=np.int32)
    _sort(tips, joined, float(low[0]), float(low[1]), side_mm, columns, start, member)
    half_x, half_y = _half_sizes(tips, joined)
    return Chords(
        tips=tips,
        joined=joined,
        group=group,
        radii=np.array([one.radius_mm for one in tracks]),
        half_x=half_x,
        half_y=half_y,
        start=start,
        member=member,
        x0=float(low[0]),
        y0=float(low[1]),
        side=side_mm,
        columns=columns,
        rows=rows,
    )


@njit(cache=True, nogil=True)
def _half_sizes(tips, joined):  # type: ignore[no-untyped-def]
    wide = high = 0.0
    for k in range(1, joined.size):
        if joined[k]:
            wide = max(wide, 0.5 * abs(tips[k, 0] - tips[k - 1, 0]))
            high = max(high, 0.5 * abs(tips[k, 1] - tips[k - 1, 1]))
    return wide, high


@njit(cache=True, nogil=True)
def _box(tips, k, x0, y0, side, columns):  # type: ignore[no-untyped-def]
    i = int((0.5 * (tips[k, 0] + tips[k - 1, 0]) - x0) / side)
    j = int((0.5 * (tips[k, 1] + tips[k - 1, 1]) - y0) / side)
    return j * columns + i


@njit(cache=True, nogil=True)
def _sort(tips, joined, x0, y0, side, columns, start, member):  # type: ignore[no-untyped-def]
    """Sort by counting, in the order of the tracks within a box."""
    for k in range(1, joined.size):
        if joined[k]:
            start[_box(tips, k, x0, y0, side, columns) + 1] += 1
    for b in range(start.size - 1):
        start[b + 1] += start[b]
    for k in range(1, joined.size):
        if joined[k]:
            b = _box(tips, k, x0, y0, side, columns)
            member[start[b]] = k
            start[b] += 1
    for b in range(start.size - 1, 0, -1):
        start[b] = start[b - 1]
    start[0] = 0


@njit(cache=True, nogil=True)
def gather(c, k, nx, ny, reach, room, out):  # type: ignore[no-untyped-def]
    """Gather chords other than k that cut within about `reach` of where it does; return their number, at most `room`.

    nx, ny : of the surface's unit normal there. A ball that is larger by d touches the same place d (nx, ny) aside
    """
    ax, ay = c.tips[k - 1, 0], c.tips[k - 1, 1]
    bx, by = c.tips[k, 0], c.tips[k, 1]
    half = 0.5 * math.hypot(bx - ax, by - ay)
    far_x, far_y = reach + c.half_x + 0.5 * abs(bx - ax), reach + c.half_y + 0.5 * abs(by - ay)
    ex, ey = (bx - ax) / (2.0 * half), (by - ay) / (2.0 * half)
    count = 0
    for group in range(c.radii.size):
        larger = c.radii[group] - c.radii[c.group[k]]
        mx, my = 0.5 * (ax + bx) + larger * nx, 0.5 * (ay + by) + larger * ny
        i0 = max(int((mx - far_x - c.x0) / c.side), 0)
        i1 = min(int((mx + far_x - c.x0) / c.side), c.columns - 1)
        j0 = max(int((my - far_y - c.y0) / c.side), 0)
        j1 = min(int((my + far_y - c.y0) / c.side), c.rows - 1)
        for j in range(j0, j1 + 1):
            for m in range(c.start[j * c.columns + i0], c.start[j * c.columns + max(i1, i0 - 1) + 1]):
                n = c.member[m]
                if n == k or c.group[n] != group:
                    continue
                px, py = c.tips[n - 1, 0] - mx, c.tips[n - 1, 1] - my
                qx, qy = c.tips[n, 0] - mx, c.tips[n, 1] - my
                u0, w0 = px * ex + py * ey, py * ex - px * ey
                u1, w1 = qx * ex + qy * ey, qy * ex - qx * ey
                beside = min(w0, w1) > reach or max(w0, w1) < -reach
                if beside or min(u0, u1) > half + reach or max(u0, u1) < -half - reach:
                    continue
                if count < room:
                    out[count] = n
                    count += 1
    return count
