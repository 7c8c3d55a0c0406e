"""A polishing bob on a mill's spindle: its contact with the lens, what it takes off, and the time that it needs.

Theory of operation. A ball of felt or foam (radius R, contact modulus E) is pressed d deep into the surface. Hertz:
the contact has the radius a = sqrt(d / b) and the pressure p = p0 sqrt(1 - r^2 / a^2), p0 = (2 / pi) E sqrt(d b), with
the curvature b of ball and surface together. The surface is rigid beside the bob. A spindle without tilt moves each
point of the bob by omega times its distance from the axis: fast on slopes, slow on flats. Preston's law: c p v comes
off along the normal in each second. The mill sets d, not a force, so the pressure follows from the bob's modulus.

A ripple of wave number k is pressed harder on its crests. While the bob takes off the mean depth D, it falls to
exp(-f(k a) D / d), whatever E and R are. The exact contact of a ball on ripples (`tests/optics/test_bob`) gives f =
1.68, 2.21, 3.70, 6.67, 10.3 for k a = 0.6, 1.25, 2.5, 5, 8: that of a half space under the mean pressure, 3 pi k a / 8,
and 0.75 more from the rim of the contact. 1.697 (k a)^0.85 is within 3 % from 2.5 to 8 and 7 % too low at 1.25, so the
finish has the order 0.85. Waves that are longer than the contact are form: the path follows them at the same d. What
comes off unevenly at short waves is levelled by the work that comes after it.

Plain Python, for callers without arrays; `optics.bob_wear` computes what comes off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

HEAT_LIMIT_MM_PER_S = 6100.0
"""Surface speed of soft wheels on acrylic, 1200 ft/min: the lowest that U.S. Plastic Corp. recommends (knowledge base,
article 582; up to 4000 for cooled wheels of muslin). A felt that turns faster may burn it where it goes slowly."""

PRESSURES = (0.8, 1.2)
"""Pressure over the planned one that a lens for a bob has to bear: how far the modulus of felt may be off."""

ORDER = 0.85
_MEAN_RADIUS = 3 * math.pi / 16  # of a contact, weighted by its pressure
_FALL = 1.697  # of a ripple of k a = 1, in depths over the compression


@dataclass(frozen=True, slots=True, kw_only=True)
class Bob:
    """A ball of felt or foam.

    modulus_mpa    : E / (1 - nu^2) of the bob
    wear_per_mpa   : Preston's c: mm taken off for each MPa and mm of sliding
    compression_mm : how deep the path presses it into the surface, along the normal
    """

    radius_mm: float
    modulus_mpa: float
    wear_per_mpa: float
    compression_mm: float
    spindle_rpm: float

    @property
    def contact_mm(self) -> float:
        """Radius of the contact on a flat."""
        return math.sqrt(self.radius_mm * self.compression_mm)

    @property
    def mean_pressure_mpa(self) -> float:
        return 4 / (3 * math.pi) * self.modulus_mpa * math.sqrt(self.compression_mm / self.radius_mm)

    @property
    def force_n(self) -> float:
        """Force on a flat, along the normal."""
        return self.mean_pressure_mpa * math.pi * self.contact_mm**2

    @property
    def turn_rad_per_s(self) -> float:
        return self.spindle_rpm * math.pi / 30

    def fastest_mm_per_s(self, slope: float) -> float:
        """Return the greatest surface speed in the contact on a lens of that slope, |grad h|."""
        return self.turn_rad_per_s * (self.radius_mm * slope / math.hypot(1.0, slope) + self.contact_mm)

    def rate_mm3_per_s(self, slope: float) -> float:
        """Return the volume that comes off a plane of that slope, within 7 %: a first guess."""
        aside = (self.radius_mm - self.compression_mm) * slope / math.hypot(1.0, slope)
        mean = math.hypot(aside, _MEAN_RADIUS * self.contact_mm)
        return self.wear_per_mpa * self.force_n * self.turn_rad_per_s * mean

    def k0_after(self, depth_mm: float) -> float:
        """Return k0 [rad/mm] of the finish that this bob makes by taking off that depth."""
        return (self.compression_mm / (_FALL * depth_mm)) ** (1 / ORDER) / self.contact_mm
