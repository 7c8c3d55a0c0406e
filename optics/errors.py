"""What can be wrong with an optical task. Each error carries its numbers and says them in one sentence."""

from __future__ import annotations


class OpticsError(Exception):
    """Base of all errors of this package."""


class TargetError(OpticsError):
    """The target irradiance cannot be aimed at: not finite, negative, empty, or without any light."""


class TotalReflectionError(OpticsError):
    """The surface would have to be steeper than the critical angle allows: the throw is too short."""

    def __init__(self, *, throw_mm: float, shift_mm: float, shortest_throw_mm: float) -> None:
        self.throw_mm = throw_mm
        self.shift_mm = shift_mm
        self.shortest_throw_mm = shortest_throw_mm
        super().__init__(
            f"throw_mm = {throw_mm:g} is too short: light must move {shift_mm:.1f} mm sideways and would be totally "
            f"reflected; use a throw of about {shortest_throw_mm:.0f} mm or more, or a smaller screen"
        )
