"""How finely a dialect, or a mill, can state a position."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Digits:
    """The raster of positions: the last digit of X and Y, and that of Z."""

    xy_mm: float
    z_mm: float

    def coarsen(self, step_mm: float) -> Digits:
        """Return the raster of a mill that moves in such steps: whole steps, where they are coarser than the digits."""
        return Digits(xy_mm=_coarser(self.xy_mm, step_mm), z_mm=_coarser(self.z_mm, step_mm))


def _coarser(digit_mm: float, step_mm: float) -> float:
    """Return a step that the digits can state exactly, no finer than either; the digit where steps are finer."""
    return max(1, round(step_mm / digit_mm)) * digit_mm
