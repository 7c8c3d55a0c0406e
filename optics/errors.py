"""What can be wrong with an optical task. Each error carries its numbers and says them in one sentence."""

from __future__ import annotations

import math


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
        helps = math.isfinite(shortest_throw_mm)
        cause = f"a throw of {throw_mm:g} mm is too short" if helps else "the light comes in too far from the axis"
        remedy = (
            f"use about {math.ceil(shortest_throw_mm)} mm or more, or a smaller screen"
            if helps
            else "no throw helps: move the light away or tilt it less"
        )
        super().__init__(
            f"{cause}: light must move {shift_mm:.1f} mm sideways and would be totally reflected; {remedy}"
        )


class NoSurfaceError(OpticsError):
    """The solver came to no surface that sends the light to the screen, though no single ray says why."""

    def __init__(self, *, lost_share: float) -> None:
        self.lost_share = lost_share
        super().__init__(
            f"no surface was found that sends this light onto this screen ({100 * lost_share:.0f} % of the lens has no "
            f"height): light or screen are too near or too far aside; a longer throw, a lamp further away or a smaller "
            f"shift help"
        )


class UnsupportedBenchError(OpticsError):
    """The method was made for a simpler set-up."""

    def __init__(self, method: str, unknown: list[str]) -> None:
        self.method, self.unknown = method, unknown
        super().__init__(f'{method} does not know {" and ".join(unknown)}: use method = "transport"')
