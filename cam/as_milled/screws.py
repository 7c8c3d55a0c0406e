"""Periodic errors of a machine's screws: an axis goes a little too far and too short, once in every turn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cam.moves import Array

_PER_TURN = 16  # pieces of a chord, so that it follows the wave


@dataclass(frozen=True, slots=True, kw_only=True)
class Screws:
    """Triples are X, Y, Z.

    error_mm : amplitude of the error of an axis
    lead_mm  : way of the axis in a turn of its screw
    """

    error_mm: tuple[float, float, float]
    lead_mm: tuple[float, float, float]

    @property
    def longest_mm(self) -> float:
        """How long a chord may be in plan that still follows the waves of X and Y, and of Z on slopes up to 1."""
        leads = [lead for error, lead in zip(self.error_mm, self.lead_mm, strict=True) if error > 0]
        return min(leads, default=math.inf) / _PER_TURN

    def errors_mm(self, tips_mm: Array) -> Array:
        """Return by how much tips (n, 3) are off; where in its turn a screw stands at zero is not known: at its own."""
        return np.asarray(np.array(self.error_mm) * np.sin(2.0 * np.pi * tips_mm / np.array(self.lead_mm)))
