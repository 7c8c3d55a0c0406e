"""The outline of a lens within its aperture, as corners in work-frame mm: seen from above, as it lies on the mill.

Plain Python: the spec is checked where there are no arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise
from math import cos, dist, pi, sin

MOST_CORNERS = 256
_ELLIPSE_CORNERS = 256  # on a lens of 100 mm the chords lie 4 um inside the ellipse
_NEAREST_MM = 1e-3  # of two corners: below that they are one
_LEAST_SHARE = 0.05  # of the aperture that a lens must fill

Corner = Sequence[float]


def ellipse_mm(width_mm: float, height_mm: float) -> list[list[float]]:
    """Return corners of the ellipse that touches all four rims, counter-clockwise."""
    angles = (2 * pi * k / _ELLIPSE_CORNERS for k in range(_ELLIPSE_CORNERS))
    return [[width_mm * (1 + cos(angle)) / 2, height_mm * (1 + sin(angle)) / 2] for angle in angles]


def counter_clockwise(corners: Sequence[Corner]) -> list[list[float]]:
    """Return the same corners, in that order."""
    ordered = [[float(x), float(y)] for x, y in corners]
    return ordered if _signed_area(ordered) > 0 else ordered[::-1]


def outline_fault(corners: Sequence[Corner], *, width_mm: float, height_mm: float) -> str | None:
    """Return what is wrong with a closed outline, in words; None where it is the outline of a lens."""
    sides = list(pairwise([*corners, corners[0]]))
    for number, (x, y) in enumerate(corners):
        if not (0 <= x <= width_mm and 0 <= y <= height_mm):
            return f"corner {number} at X {x:g} Y {y:g} lies beyond the aperture of {width_mm:g} x {height_mm:g} mm"
    for number, (here, there) in enumerate(sides):
        if dist(here, there) < _NEAREST_MM:
            return f"corners {number} and {(number + 1) % len(sides)} are the same point"
    for (j, one), (k, other) in combinations(enumerate(sides), 2):
        if k - j not in (1, len(sides) - 1) and _cross(*one, *other):
            return f"its sides {j} and {k} cross; allowed: corners in order, each side touching only its neighbours"
    share = abs(_signed_area(corners)) / (width_mm * height_mm)
    if share < _LEAST_SHARE:
        return f"it fills {100 * share:.2g} % of the aperture; allowed: at least {100 * _LEAST_SHARE:g} %"
    return None


def _signed_area(corners: Sequence[Corner]) -> float:
    """Return the area, positive where the corners run counter-clockwise."""
    return sum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise([*corners, corners[0]])) / 2


def _cross(a: Corner, b: Corner, c: Corner, d: Corner) -> bool:
    """Return whether the segments a-b and c-d have a point in common."""
    if max(a[0], b[0]) < min(c[0], d[0]) or max(c[0], d[0]) < min(a[0], b[0]):
        return False
    if max(a[1], b[1]) < min(c[1], d[1]) or max(c[1], d[1]) < min(a[1], b[1]):
        return False
    return _side(a, b, c) * _side(a, b, d) <= 0 and _side(c, d, a) * _side(c, d, b) <= 0


def _side(a: Corner, b: Corner, point: Corner) -> float:
    """Return the side, positive where `point` lies to the left of a -> b."""
    return (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])
