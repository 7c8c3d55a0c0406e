"""Holds the path that was really cut against the program: what was skipped, cut twice, or never asked for."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from machines.simulated import CutSegment

Triple = tuple[float, float, float]
TOLERANCE_MM = 2e-3  # a step of the axes and the rounding of reported positions used for re-entry


@dataclass(slots=True)
class Verdict:
    """`skipped` and `recut` count program segments; `foreign` lists cuts the program does not contain."""

    segments: int
    skipped: list[int] = field(default_factory=list)
    foreign: list[CutSegment] = field(default_factory=list)
    recut: int = 0
    longest_recut: int = 0
    out_of_order: int = 0

    @property
    def clean(self) -> bool:
        return not self.skipped and not self.foreign and not self.out_of_order


def judge(path: Sequence[Triple], cuts: Iterable[CutSegment], *, back: int = 60) -> Verdict:
    """`path` are the ends of the program's feed moves, in order, the first being where cutting starts.

    back : how many segments a recovery may step back and still be recognised (more is reported as foreign)
    """
    verdict = Verdict(len(path) - 1)
    covered = [0.0] * (len(path) - 1)
    times = [0.0] * (len(path) - 1)
    at = 0
    reached = 0
    for cut in cuts:
        if cut.kind == "slip" or cut.rapid or math.dist(cut.start, cut.end) < 1e-9:
            continue
        found = _where(path, cut, at, back)
        if found is None:
            if not _plunges_to_path(path, cut, at, back):
                verdict.foreign.append(cut)
            continue
        number, begin, end = found
        if number > reached + 1 and covered[number - 1] < 1 - 1e-6:
            verdict.out_of_order += 1
        times[number] += end - begin
        if begin <= covered[number] + 0.05:  # a stop and a start inside one segment join
            covered[number] = max(covered[number], end)
        verdict.longest_recut = max(verdict.longest_recut, reached - number)
        at, reached = number, max(reached, number)
    lengths = [math.dist(a, b) for a, b in itertools.pairwise(path)]
    verdict.skipped = [k for k, share in enumerate(covered) if (1 - share) * lengths[k] > TOLERANCE_MM]
    verdict.recut = sum(1 for k, share in enumerate(times) if (share - 1) * lengths[k] > TOLERANCE_MM)
    return verdict


def _where(path: Sequence[Triple], cut: CutSegment, at: int, back: int) -> tuple[int, float, float] | None:
    """The segment on which this cut lies, going its way, and from which share of it to which."""
    ahead = range(at, min(at + 40, len(path) - 1))
    behind = range(at - 1, max(-1, at - back), -1)
    for number in (*ahead, *behind):
        a, b = path[number], path[number + 1]
        begin, end = _share(a, b, cut.start), _share(a, b, cut.end)
        if begin is not None and end is not None and end > begin:
            return number, begin, end
    return None


def _share(a: Triple, b: Triple, point: Triple) -> float | None:
    """How far along a-b the point lies; None if it does not lie on it."""
    length2 = sum((q - p) ** 2 for p, q in zip(a, b, strict=True))
    if length2 == 0.0:
        return None
    share = sum((q - p) * (r - p) for p, q, r in zip(a, b, point, strict=True)) / length2
    clamped = min(max(share, 0.0), 1.0)
    nearest = tuple(p + clamped * (q - p) for p, q in zip(a, b, strict=True))
    return clamped if math.dist(nearest, point) < TOLERANCE_MM else None


def _plunges_to_path(path: Sequence[Triple], cut: CutSegment, at: int, back: int) -> bool:
    """A way in: straight down onto a point of the path, from above it."""
    x, y, z = cut.end
    if math.hypot(x - cut.start[0], y - cut.start[1]) > TOLERANCE_MM or cut.start[2] < z:
        return False
    near = path[max(0, at - back) : at + 40]
    return any(math.hypot(p[0] - x, p[1] - y) < TOLERANCE_MM and z > p[2] - TOLERANCE_MM for p in near)
