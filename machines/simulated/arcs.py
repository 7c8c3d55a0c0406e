"""Arcs: the centre from I, J, K or R, and the chords the firmware cuts instead ($12)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin, sqrt

from machines.simulated.words import GcodeError

Triple = tuple[float, float, float]
PLANES = {"G17": (0, 1, 2), "G18": (2, 0, 1), "G19": (1, 2, 0)}
_SAME_ANGLE = 5e-7  # rad: a turn smaller than this is taken as a whole circle


@dataclass(frozen=True, slots=True)
class SimulatedArc:
    """From start to end about `centre` in `plane`, both in machine mm."""

    start: Triple
    end: Triple
    centre: tuple[float, float]
    radius_mm: float
    plane: tuple[int, int, int]
    clockwise: bool


def arc_from_radius(
    start: Triple, end: Triple, radius: float, plane: tuple[int, int, int], clockwise: bool
) -> SimulatedArc:
    """Return the arc of the R form: the shorter of the two, the longer one for a negative radius."""
    a, b, _ = plane
    dx, dy = end[a] - start[a], end[b] - start[b]
    chord = hypot(dx, dy)
    if start == end or chord == 0.0:
        raise GcodeError(33)
    square = 4 * radius * radius - chord * chord
    if square < 0:
        raise GcodeError(34)
    side = sqrt(square) / chord  # twice the height over the chord, over the chord
    if clockwise == (radius > 0):
        side = -side
    centre = (start[a] + 0.5 * (dx - dy * side), start[b] + 0.5 * (dy + dx * side))
    return SimulatedArc(start, end, centre, abs(radius), plane, clockwise)


def arc_from_offsets(
    start: Triple, end: Triple, offsets: tuple[float, float], plane: tuple[int, int, int], clockwise: bool
) -> SimulatedArc:
    """Return the arc of the I, J, K form; the two radii may differ by 0.005 mm, or by 0.1 % if that is less than 0.5
    mm.
    """
    a, b, _ = plane
    centre = (start[a] + offsets[0], start[b] + offsets[1])
    radius = hypot(*offsets)
    difference = abs(hypot(end[a] - centre[0], end[b] - centre[1]) - radius)
    if difference > 0.005 and (difference > 0.5 or difference > 0.001 * radius):
        raise GcodeError(33)
    return SimulatedArc(start, end, centre, radius, plane, clockwise)


def chords(arc: SimulatedArc, tolerance_mm: float) -> Iterator[Triple]:
    """End points of the chords, at most `tolerance_mm` from the arc; the last is the arc's end."""
    a, b, c = arc.plane
    first = atan2(arc.start[b] - arc.centre[1], arc.start[a] - arc.centre[0])
    last = atan2(arc.end[b] - arc.centre[1], arc.end[a] - arc.centre[0])
    turn = last - first
    if arc.clockwise:
        if turn >= -_SAME_ANGLE:
            turn -= 2 * pi
    elif turn <= _SAME_ANGLE:
        turn += 2 * pi
    inner = tolerance_mm * (2 * arc.radius_mm - tolerance_mm)
    count = int(abs(0.5 * turn * arc.radius_mm) / sqrt(inner)) if inner > 0 else 0
    for k in range(1, count):
        angle = first + turn * k / count
        point = [0.0, 0.0, 0.0]
        point[a] = arc.centre[0] + arc.radius_mm * cos(angle)
        point[b] = arc.centre[1] + arc.radius_mm * sin(angle)
        point[c] = arc.start[c] + (arc.end[c] - arc.start[c]) * k / count
        yield (point[0], point[1], point[2])
    yield arc.end
