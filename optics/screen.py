"""The plane rectangle on which the picture appears."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Screen:
    """A rectangle parallel to the stock's top, in work-frame x and y."""

    width_mm: float
    height_mm: float
    centre_x_mm: float
    centre_y_mm: float

    @property
    def left_mm(self) -> float:
        return self.centre_x_mm - self.width_mm / 2

    @property
    def bottom_mm(self) -> float:
        return self.centre_y_mm - self.height_mm / 2
