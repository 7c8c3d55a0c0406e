"""Rounds positions to the raster that a control can state, or a mill can reach, so that the light suffers least.

A vertex rounded to the nearest digit q is off by up to q / 2, and two of them s apart make a slope error of
q / (sqrt 6 s) rms along the line and of q / (sqrt 6 p) between lines p apart: with three decimals, tens of
milliradians. But a vertex may be anywhere on its line. Where the path crosses a whole digit, a vertex needs no
rounding, and the remaining error is the slope times the digit of X: a tenth or a hundredth of that. So each vertex has
up to four places: on the nearest such crossing before and after, and at its own position one digit down or up; or it is
left out. The best choice for a whole line is found in one pass, as in Viterbi's algorithm. It minimises the squared
error of the slope along the line, plus that of the height over the pitch, which is the slope to the neighbouring lines,
integrated along the line. The tool is never more than half a digit below its path, nor more than one digit above it.
Memory does not grow with the path.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit

from cam.moves import Array, Motion, Path
from cam.posts.post import Digits

COARSE_MM = 0.5e-4
"""A digit of Z below this is not visible in the light."""

Place = Callable[[Array, Array], Array]
"""(n, 3) a line, (3,) the present place of its first point -> (m, 3) vertices on the raster after that point."""

_LONGEST_MM = 1.0  # longest straight move that replaces several
LOWEST_DIGITS = 0.5
"""The tool is never farther below its path than this."""

_LOOK_BACK = 6  # most vertices that one move may replace
_ASIDE_PITCHES, _ASIDE_MM = 0.02, 1e-3
_AT_ONCE = 8192
_CHOICES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Rounding:
    """digits, and the pitch_mm of the lines."""

    digits: Digits
    pitch_mm: float = math.inf

    @property
    def matters(self) -> bool:
        return self.digits.z_mm > COARSE_MM

    @property
    def aside_mm(self) -> float:
        """How far from its track a move may pass the vertices that it leaves out."""
        return min(_ASIDE_PITCHES * self.pitch_mm, _ASIDE_MM)


def on_raster(paths: Iterable[Path], rounding: Rounding, place: Place | None = None) -> Iterator[Path]:
    """Yield the same cuts with every vertex on the raster; rapids go through the nearest places.

    place : how the vertices of a cut are chosen; by default for the least slope errors
    """
    place = place or partial(_place_by_slope, rounding)
    raw = placed = np.full(3, np.nan)
    for path in paths:
        if path.motion is Motion.RAPID or np.isnan(raw[2]):
            points = nearest(path.points_mm, rounding.digits)
            yield Path(motion=path.motion, points_mm=points, feed_mm_per_min=path.feed_mm_per_min)
            raw, placed = path.points_mm[-1], points[-1]
            continue
        for first in range(0, len(path.points_mm), _AT_ONCE):
            line = np.vstack([raw, path.points_mm[first : first + _AT_ONCE]])
            points = place(line, placed) if is_level_way(line) else nearest(line[1:], rounding.digits)
            yield Path(motion=path.motion, points_mm=points, feed_mm_per_min=path.feed_mm_per_min)
            raw, placed = line[-1], points[-1]


def nearest(points_mm: Array, digits: Digits) -> Array:
    """Round each point (n, 3) to the nearest place of the raster."""
    scale = np.array([digits.xy_mm, digits.xy_mm, digits.z_mm])
    return np.floor(points_mm / scale + 0.5) * scale


def is_level_way(line: Array) -> bool:
    """Return whether every move of a line advances in plan: for a vertical move there is no choice."""
    return bool((np.hypot(*np.diff(line[:, :2], axis=0).T) > 0).all())


def _place_by_slope(rounding: Rounding, line: Array, start: Array) -> Array:
    xy_mm, z_mm = rounding.digits.xy_mm, rounding.digits.z_mm
    out = np.empty((len(line), 4))
    weight = 2.0 / rounding.pitch_mm**2
    lowest = -LOWEST_DIGITS * z_mm - 1e-9
    count = choose_vertices(line, np.array(start), xy_mm, z_mm, weight, lowest, rounding.aside_mm, out)
    return out[:count, :3] if count else nearest(line[1:], rounding.digits)


@njit(cache=True, nogil=True)
def _offer(line, i, part, dx, dy, xy_mm, z_mm, run, rise, found, k):  # type: ignore[no-untyped-def]
    """Place k of the choices: `part` of the way along piece i, moved to the raster of X and Y.

    found[k] : X, Y, distance along the piece, height of the path there
    """
    x = math.floor((line[i, 0] + part * dx) / xy_mm + 0.5) * xy_mm
    y = math.floor((line[i, 1] + part * dy) / xy_mm + 0.5) * xy_mm
    along = ((x - line[i, 0]) * dx + (y - line[i, 1]) * dy) / run
    found[k, 0], found[k, 1], found[k, 2], found[k, 3] = x, y, along, line[i, 2] + rise / run * along


@njit(cache=True, nogil=True)
def choose_vertices(line, start, xy_mm, z_mm, weight, lowest, aside_mm, out):  # type: ignore[no-untyped-def]
    """Choose vertices on the raster for line (n, 3), whose first point stands at start; return how many are in out, or
    0.

    weight    : of a height's squared error [1 / mm^2], against that of a slope
    out (n, 4): X, Y, Z and the distance along the line
    choice[v] : X, Y, written Z, distance along the line, height of the path there, integral of its squared slope
    """
    n = line.shape[0]
    run, rise = np.empty(n), np.empty(n)
    way, bent, turn = np.zeros(n), np.zeros(n), np.zeros(n)
    for i in range(n - 1):
        run[i] = math.hypot(line[i + 1, 0] - line[i, 0], line[i + 1, 1] - line[i, 1])
        rise[i] = line[i + 1, 2] - line[i, 2]
        way[i + 1] = way[i] + run[i]
        bent[i + 1] = bent[i] + rise[i] ** 2 / run[i]
    for i in range(1, n - 1):
        ax, ay = line[i, 0] - line[i - 1, 0], line[i, 1] - line[i - 1, 1]
        bx, by = line[i + 1, 0] - line[i, 0], line[i + 1, 1] - line[i, 1]
        turn[i] = abs(math.atan2(ax * by - ay * bx, ax * bx + ay * by))
    choice = np.empty((_CHOICES * n, 6))
    owner_end = np.empty(n + 1, np.int64)
    choice[0, 0], choice[0, 1], choice[0, 2] = start
    choice[0, 3], choice[0, 4], choice[0, 5] = 0.0, line[0, 2], 0.0
    owner_end[0], owner_end[1] = 0, 1
    found = np.empty((_CHOICES, 4))
    count = 1
    for i in range(1, n):
        before_x, before_y = line[i, 0] - line[i - 1, 0], line[i, 1] - line[i - 1, 1]
        # Its own place, one digit down and one up.
        _offer(line, i - 1, 1.0, before_x, before_y, xy_mm, z_mm, run[i - 1], rise[i - 1], found, 0)
        piece, along, height = i - 1, found[0, 2], found[0, 3]
        if along > run[i - 1] and i < n - 1:
            after_x, after_y = line[i + 1, 0] - line[i, 0], line[i + 1, 1] - line[i, 1]
            _offer(line, i, 0.0, after_x, after_y, xy_mm, z_mm, run[i], rise[i], found, 0)
            piece, along, height = i, max(0.0, found[0, 2]), found[0, 3]
        for up in range(2):
            level = math.floor(height / z_mm) + up
            if level * z_mm - height >= lowest:
                slope = rise[piece] / run[piece]
                choice[count, 0], choice[count, 1], choice[count, 2] = found[0, 0], found[0, 1], level * z_mm
                choice[count, 3], choice[count, 4] = way[piece] + along, height
                choice[count, 5] = bent[piece] + slope * slope * along
                count += 1
        # Whole digits that the path crosses, in the nearer half of the piece before and of the piece after.
        for piece in range(i - 1, i + 1 if i < n - 1 else i - 1):
            dz = rise[piece]
            if dz == 0.0:
                continue
            below = (dz > 0.0) == (piece == i - 1)
            level = math.floor(line[i, 2] / z_mm) if below else math.ceil(line[i, 2] / z_mm)
            part = (level * z_mm - line[piece, 2]) / dz
            if not (0.5 <= part <= 1.0 if piece == i - 1 else 0.0 <= part < 0.5):
                continue
            dx, dy = line[piece + 1, 0] - line[piece, 0], line[piece + 1, 1] - line[piece, 1]
            _offer(line, piece, part, dx, dy, xy_mm, z_mm, run[piece], dz, found, 1)
            if not 0.0 <= found[1, 2] <= run[piece] or level * z_mm - found[1, 3] < lowest:
                continue
            slope = dz / run[piece]
            choice[count, 0], choice[count, 1], choice[count, 2] = found[1, 0], found[1, 1], level * z_mm
            choice[count, 3], choice[count, 4] = way[piece] + found[1, 2], found[1, 3]
            choice[count, 5] = bent[piece] + slope * slope * found[1, 2]
            count += 1
        owner_end[i + 1] = count
    cost, came = np.full(count, np.inf), np.full(count, -1, np.int64)
    cost[0] = 0.0
    for i in range(1, n):
        for v in range(owner_end[i], owner_end[i + 1]):
            for j in range(i - 1, max(-1, i - 1 - _LOOK_BACK), -1):
                if way[i] - way[j] > _LONGEST_MM and j < i - 1:
                    break
                for u in range(owner_end[j], owner_end[j + 1]):
                    length = choice[v, 3] - choice[u, 3]
                    if not (length > 0.5 * xy_mm and cost[u] < cost[v]):
                        continue
                    true_rise, made_rise = choice[v, 4] - choice[u, 4], choice[v, 2] - choice[u, 2]
                    slopes = choice[v, 5] - choice[u, 5] + (made_rise**2 - 2.0 * made_rise * true_rise) / length
                    if cost[u] + slopes >= cost[v]:
                        continue
                    # The height's error, piece by piece; the chord may not be too deep over any vertex left out.
                    error, at, heights = choice[u, 2] - choice[u, 4], choice[u, 3], 0.0
                    fits, turned = True, 0.0
                    for k in range(j, i + 1):
                        if choice[u, 3] + xy_mm < way[k] < choice[v, 3] - xy_mm:
                            turned += turn[k]
                            next_error = choice[u, 2] + made_rise * (way[k] - choice[u, 3]) / length - line[k, 2]
                            fits = fits and lowest <= next_error <= z_mm
                            heights += (way[k] - at) * (error**2 + error * next_error + next_error**2) / 3.0
                            error, at = next_error, way[k]
                    next_error = choice[v, 2] - choice[v, 4]
                    heights += (choice[v, 3] - at) * (error**2 + error * next_error + next_error**2) / 3.0
                    total = cost[u] + slopes + weight * heights
                    if fits and turned * length <= 4.0 * aside_mm and total < cost[v]:
                        cost[v], came[v] = total, u
    best = owner_end[n - 1]
    for v in range(owner_end[n - 1], owner_end[n]):
        if cost[v] < cost[best]:
            best = v
    if not cost[best] < np.inf:
        return 0
    kept = 0
    v = best
    while v > 0:
        kept += 1
        v = came[v]
    v = best
    for k in range(kept - 1, -1, -1):
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = choice[v, 0], choice[v, 1], choice[v, 2], choice[v, 3]
        v = came[v]
    return kept
