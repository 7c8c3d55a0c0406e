"""Which levels of f are tracks at which density: lines in the plane of class and level, born in gaps, never crossing.

At a whole class j the tracks are the levels m S_j, S_j = S_0 / RATIO^j, m any whole number. From class to class every
line glides to the nearest level of the denser one; levels that none takes are born at the begin of the glide, in
between. Neighbours are thus nowhere farther apart than S_j, the spacing that the class stands for, and of a family born
together the next is more than ten pitches away: room for a turn.
"""

from __future__ import annotations

from math import ceil, floor
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from cam.contour.field import RATIO


class Levels(NamedTuple):
    """What the kernels need.

    spacing (nc,)     : S_j
    first (nc,)       : m of the first level of class j
    offset (nc + 1,)  : where class j begins in line_of
    line_of (n,)      : which line is at a level of a class
    birth (nl,)       : class at which a line is first whole; it exists from one class before
    level (nl, nc)    : of each line at each class; before its birth, that of its birth
    """

    spacing: Any
    first: Any
    offset: Any
    line_of: Any
    birth: Any
    level: Any


def level_tree(lowest: float, highest: float, level_mm: float, classes: int) -> Levels:
    """Build lines over levels from lowest to highest and classes 0..classes - 1."""
    spacing = level_mm / RATIO ** np.arange(classes)
    first = np.array([floor(lowest / s) - 2 for s in spacing])
    counts = np.array([ceil(highest / s) + 3 for s in spacing]) - first
    offset = np.concatenate([[0], np.cumsum(counts)])
    line_of = np.empty(offset[-1], np.int64)
    line_of[: counts[0]] = np.arange(counts[0])
    births = [np.zeros(counts[0], np.int64)]
    total = int(counts[0])
    for j in range(1, classes):
        here = np.full(counts[j], -1)
        before = line_of[offset[j - 1] : offset[j]]
        m = np.rint((first[j - 1] + np.arange(before.size)) * RATIO).astype(np.int64) - first[j]
        kept = (m >= 0) & (m < counts[j])
        here[m[kept]] = before[kept]
        fresh = np.flatnonzero(here < 0)
        here[fresh] = total + np.arange(fresh.size)
        births.append(np.full(fresh.size, j))
        total += fresh.size
        line_of[offset[j] : offset[j + 1]] = here
    birth = np.concatenate(births)
    level = np.full((total, classes), np.nan)
    for j in range(classes):
        level[line_of[offset[j] : offset[j + 1]], j] = (first[j] + np.arange(counts[j])) * spacing[j]
    for j in range(classes - 2, -1, -1):  # before birth; and lines that left the range keep out of it
        level[:, j] = np.where(np.isnan(level[:, j]), level[:, j + 1], level[:, j])
    for j in range(1, classes):
        level[:, j] = np.where(np.isnan(level[:, j]), level[:, j - 1], level[:, j])
    return Levels(spacing=spacing, first=first, offset=offset, line_of=line_of, birth=birth, level=level)


@njit(cache=True, nogil=True, inline="always")
def level_at(levels, line, density):  # type: ignore[no-untyped-def]
    """Return the level of a line at a class that need not be whole."""
    last = levels.spacing.size - 1
    j = min(int(density), last - 1)
    t = density - j
    return levels.level[line, j] * (1.0 - t) + levels.level[line, j + 1] * t
