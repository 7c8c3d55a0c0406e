"""Shapes of end mills as numbers: a flat disc with a rounded corner, between a flat end mill and a ball.

Outside its flat part, the underside of such a cutter rises as a quarter circle of the corner's radius.
A shape determines where stock is removed. A flat cutter only roughs the block (`cam.surface.tool_surface`); balls make
the lens (`cam.surface.contact`).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class CutterShape:
    """The shape of an end mill of any radius.

    name         : as jobs name it; people read "... end mill"
    corner_share : of the radius that is the corner's: 0 for a flat end mill, 1 for a ball
    pitch_share  : default distance of rows, in radii
    """

    name: str
    corner_share: float
    pitch_share: float

    def corner_mm(self, radius_mm: float) -> float:
        """Return the radius of the corner."""
        return self.corner_share * radius_mm

    def flat_mm(self, radius_mm: float) -> float:
        """Return the radius of the flat part."""
        return radius_mm - self.corner_mm(radius_mm)

    def widest_pitch_mm(self, radius_mm: float) -> float:
        """Return the largest distance at which rows overlap: for a ball, half its width."""
        return 2 * self.flat_mm(radius_mm) + self.corner_mm(radius_mm)

    def cusp_mm(self, radius_mm: float, pitch_mm: float) -> float:
        """Return the height of the ridge that stays between two rows on a plane."""
        corner_mm, gap_mm = self.corner_mm(radius_mm), pitch_mm - 2 * self.flat_mm(radius_mm)
        return 0.0 if gap_mm <= 0 else corner_mm - (corner_mm**2 - gap_mm**2 / 4) ** 0.5


BALL = CutterShape(name="ball", corner_share=1.0, pitch_share=1 / 6)  # cusps of R / 288
FLAT_STEP = 1.2
"""Of the radius, 60 % of the diameter: rows of a flat cutter stand no farther apart."""


def end_mill(corner_share: float) -> CutterShape:
    """Return a flat end mill (0), or one with a rounded corner."""
    return CutterShape(name="bull-nose" if corner_share else "flat", corner_share=corner_share, pitch_share=FLAT_STEP)


def cutter_shape(radius_mm: float, corner_radius_mm: float | None) -> CutterShape:
    """Return the shape of an end mill by the radius of its corner, None of a ball."""
    if corner_radius_mm is None or corner_radius_mm == radius_mm:
        return BALL
    return end_mill(corner_radius_mm / radius_mm)


CUTTERS: dict[str, CutterShape] = {shape.name: shape for shape in (end_mill(0.0), BALL)}
"""Every shape that a job can name."""
