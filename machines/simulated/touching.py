"""What closes the probe's circuit: a plane under the tool, or a plate on the front left corner of a block."""

from __future__ import annotations

from math import hypot, inf

from machines.simulated.traits import Traits, Triple

_NOISE_MM = 1e-10
_STEPS = 60  # halves the way until it is below what a double tells


def _compute_overlap_mm(traits: Traits, at_mm: Triple) -> float:
    """Return how deep the tool is in what it touches, in physical coordinates; below 0: it does not touch."""
    x, y, z = at_mm
    surface_mm, corner = traits.probe_surface_mm, traits.corner_plate
    if surface_mm is None:
        return -inf
    if corner is None:
        return surface_mm - z
    outside_mm = hypot(max(corner.left_mm - x, 0.0), max(corner.front_mm - y, 0.0))
    return min(surface_mm - z, corner.tool_radius_mm - outside_mm)


def is_touching(traits: Traits, at_mm: Triple) -> bool:
    return _compute_overlap_mm(traits, at_mm) > _NOISE_MM


def find_contact(traits: Traits, start_mm: Triple, end_mm: Triple, *, shift_mm: Triple) -> Triple | None:
    """Return where on a straight way contact begins or ends, None where it does neither.

    shift_mm : from the coordinates of the way, and of the answer, to physical ones
    """

    def place(share: float) -> Triple:
        x, y, z = (a + share * (b - a) for a, b in zip(start_mm, end_mm, strict=True))
        return x, y, z

    def touches(share: float) -> bool:
        x, y, z = (a + b for a, b in zip(place(share), shift_mm, strict=True))
        return is_touching(traits, (x, y, z))

    if touches(0.0) is (at_end := touches(1.0)):
        return None
    low, high = 0.0, 1.0
    for _ in range(_STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if touches(middle) is at_end else (middle, high)
    return place(high)
