"""What a polishing bob is to do: the settings of its path and of the check; `cam.polish.path` says why these loops."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cam.errors import PassValueError
from phrases.phrase import Phrase

_LOOP, _ADVANCE, _NODES = 0.63, 0.2018, 0.32  # radius of a loop, its advance, spacing of the lattice: contact radii
_ROW = 2 * math.pi / 5.5201  # distance of rows over the radius of a loop
_BRAKE_SHARE = 0.5  # of the axes' acceleration, that a loop takes
_BEYOND = 1.5  # contact radii beyond the rim that the bob's contact point goes


@dataclass(frozen=True, slots=True, kw_only=True)
class PolishCut:
    """A bob's work: a soft ball pressed into the lens by a constant depth along the normal.

    contact_mm          : radius of its contact on a flat
    most_mm_per_s       : surface speed that heat allows
    acceleration_mm_per_s2, max_rate_mm_per_min : of the axes X, Y, Z, which feeds keep to
    """

    radius_mm: float
    compression_mm: float
    contact_mm: float
    plunge_mm_per_min: float
    spindle_rpm: float
    most_mm_per_s: float
    acceleration_mm_per_s2: tuple[float, float, float]
    max_rate_mm_per_min: tuple[float, float, float]

    def __post_init__(self) -> None:
        for name in ("radius_mm", "compression_mm", "contact_mm", "plunge_mm_per_min", "spindle_rpm"):
            if not 0 < (value := getattr(self, name)) < math.inf:
                raise PassValueError(name=name, value=value, allowed=Phrase("above {least:g}", least=0))
        if self.compression_mm > self.radius_mm / 4:
            allowed = Phrase("at most a quarter of the bob's radius, {most_mm:g} mm", most_mm=self.radius_mm / 4)
            raise PassValueError(name="compression_mm", value=self.compression_mm, allowed=allowed)

    @property
    def loop_mm(self) -> float:
        """Radius of the loops."""
        return _LOOP * self.contact_mm

    @property
    def advance_mm(self) -> float:
        return _ADVANCE * self.contact_mm

    @property
    def row_mm(self) -> float:
        return _ROW * self.loop_mm

    @property
    def node_mm(self) -> float:
        """Spacing of the lattice on which dwell is planned."""
        return _NODES * self.contact_mm

    @property
    def most_feed_mm_per_min(self) -> float:
        """The feed at which loops take half of what the axes can accelerate."""
        by_loops = 60 * math.sqrt(_BRAKE_SHARE * min(self.acceleration_mm_per_s2[:2]) * self.loop_mm)
        return min(by_loops, *self.max_rate_mm_per_min)

    @property
    def least_dwell_s(self) -> float:
        """Least time that one round spends around a node, at the greatest feed."""
        length_mm = self.node_mm**2 * 2 * math.pi * self.loop_mm / (self.advance_mm * self.row_mm)
        return 60 * length_mm / self.most_feed_mm_per_min

    @property
    def most_reach_mm(self) -> float:
        """How far outside the aperture its axis may have to go."""
        return self.radius_mm + self.beyond_mm

    @property
    def beyond_mm(self) -> float:
        """How far beyond the rim its contact point goes."""
        return _BEYOND * self.contact_mm
