"""Finishes of polishing bobs, for tests that need no job."""

from __future__ import annotations

from dataclasses import replace

from optics.bob import ORDER, PRESSURES, Bob
from optics.finish import Finish


def make_finish(bob: Bob, depth_mm: float) -> Finish:
    """Return the finish that the bob makes by taking off that depth."""
    return Finish(
        k0_rad_per_mm=bob.k0_after(depth_mm),
        order=ORDER,
        pad_mm=2 * bob.contact_mm,
        depth_mm=depth_mm,
        off_doses=PRESSURES,
        off_orders=(),
    )


def wear_down(bob: Bob, worn_mm: float) -> Bob:
    """Return the bob with a smaller radius; its path and its touch-off stay."""
    return replace(bob, radius_mm=bob.radius_mm - worn_mm)
