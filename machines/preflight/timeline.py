"""When each line of a program is executed: knots of line and time, between which the time is interpolated.

Lines are no measure of time: one may be a row of a minute, a hundred others a second of a curve.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence

KNOTS = 128  # of a program; a record of a run holds them
Timeline = Sequence[Sequence[float]]  # (line, seconds from the start at which it is executed), rising in both


def thin_out(knots: Timeline, most: int = KNOTS) -> tuple[tuple[int, float], ...]:
    """Return at most `most` of the knots, even in lines and in time together, including the last one.

    So no two neighbours are further apart than 2 / most of the whole, in lines or time, unless one line takes longer.
    """
    if len(knots) > most:
        (line0, s0), (line1, s1) = knots[0], knots[-1]
        per_line, per_s = 1.0 / max(1, line1 - line0), 1.0 / max(1e-9, s1 - s0)
        way = [(line - line0) * per_line + (at_s - s0) * per_s for line, at_s in knots]
        last = len(knots) - 1
        knots = [knots[k] for k in sorted({min(last, bisect_left(way, 2.0 * (n + 1) / most)) for n in range(most)})]
    return tuple((int(line), round(float(at_s), 2)) for line, at_s in knots)


def compute_time_at_s(timeline: Timeline, line: int, *, lines: int, time_s: float) -> float:
    """Return when this line is executed. Without knots, every line takes the same time."""
    knots: list[Sequence[float]] = [(0, 0.0), *timeline, (max(lines, 1), time_s)]
    after = min(max(1, bisect_right([knot[0] for knot in knots], line)), len(knots) - 1)
    (line0, s0), (line1, s1) = knots[after - 1], knots[after]
    if line1 <= line0:
        return float(s1)
    share = min(1.0, max(0.0, (line - line0) / (line1 - line0)))
    return float(s0 + share * (s1 - s0))
