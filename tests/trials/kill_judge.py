"""Was every segment cut whole, in order, and nothing else? Arcs, lifts and ways back in make it more than judge.py."""

from __future__ import annotations

from dataclasses import dataclass, field

from machines.simulated.controller import CutSegment
from tests.trials.kill_program import Point

NEAR_MM = 0.005


@dataclass
class Trial:
    """What came out. `faults` is empty if every segment was cut, in order, and nothing else."""

    seed: int
    kills: int
    segments: int
    recut: int = 0
    cut_after_death: int = 0
    journal_loss_s: float = 0.0
    interruptions: list[str] = field(default_factory=list)  # found by the driver itself, not by us
    faults: list[str] = field(default_factory=list)


def _near(a: Point, b: Point) -> bool:
    return all(abs(p - q) <= NEAR_MM for p, q in zip(a, b, strict=True))


def _on_half_circle(point: Point, start: Point, end: Point) -> bool:
    """Chords of the half circles of made_program end on them."""
    if start[1] != end[1] or start[2] != end[2]:
        return False
    middle, radius = (start[0] + end[0]) / 2, (end[0] - start[0]) / 2
    away = ((point[0] - middle) ** 2 + (point[1] - start[1]) ** 2) ** 0.5
    return abs(away - radius) < NEAR_MM and abs(point[2] - start[2]) < NEAR_MM and point[1] > start[1] - NEAR_MM


def compare(trial: Trial, cuts: list[tuple[Point, Point]], done: list[CutSegment], origin: Point) -> None:
    """Every programmed segment whole at least once; within a pass in order without a gap; nothing foreign."""

    def at(point: Point) -> Point:
        return (point[0] - origin[0], point[1] - origin[1], point[2] - origin[2])

    ends = {(round(e[0], 2), round(e[1], 2), round(e[2], 2)): i for i, (_, e) in enumerate(cuts)}

    def index_of(point: Point) -> int | None:
        for dx in (0, 0.01, -0.01):
            for dy in (0, 0.01, -0.01):
                for dz in (0, 0.01, -0.01):
                    i = ends.get((round(point[0] + dx, 2), round(point[1] + dy, 2), round(point[2] + dz, 2)))
                    if i is not None and _near(point, cuts[i][1]):
                        return i
        return None

    seen: set[int] = set()
    last = -1
    begun: tuple[Point, Point] | None = None  # start and end of a cut that a hold has stopped
    for segment in done:
        start, end = at(segment.start), at(segment.end)
        if begun is not None and _near(begun[1], start):
            start = begun[0]
        begun = None if segment.whole else (start, end)
        if not segment.whole:
            continue
        index = index_of(end)
        if index is None:
            if not any(_near(end, cut[0]) or _on_half_circle(end, *cut) for cut in cuts):
                trial.faults.append(f"foreign cut {start} -> {end}")
            continue
        vertical = abs(start[0] - end[0]) < NEAR_MM and abs(start[1] - end[1]) < NEAR_MM
        if vertical and not _near(start, cuts[index][0]) and start[2] > end[2]:
            last = index  # the way back in ends where this segment ended
            continue
        if index in seen:
            trial.recut += 1
        if index > last + 1:
            trial.faults.append(f"segments {last + 1}..{index - 1} passed over before {index}")
        seen.add(index)
        last = index
    missing = sorted(set(range(len(cuts))) - seen)
    if missing:
        trial.faults.append(f"never cut: {missing[:10]}")
