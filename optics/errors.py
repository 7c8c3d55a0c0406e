"""Errors of an optical task. Each carries its numbers and states them in one sentence."""

from __future__ import annotations

import math

from phrases.phrase import Phrase


class OpticsError(Exception):
    """Base of all errors of this package."""

    def __init__(self, words: Phrase) -> None:
        super().__init__(words)
        self.words = words


class TargetError(OpticsError):
    """The target irradiance is unusable: not finite, negative, empty, or without any light."""


class TotalReflectionError(OpticsError):
    """The surface would have to be steeper than the critical angle allows: the throw is too short."""

    def __init__(self, *, throw_mm: float, shift_mm: float, shortest_throw_mm: float) -> None:
        self.throw_mm = throw_mm
        self.shift_mm = shift_mm
        self.shortest_throw_mm = shortest_throw_mm
        helps = math.isfinite(shortest_throw_mm)
        if helps:
            words = Phrase(
                "a throw of {throw_mm:g} mm is too short: light must move {shift_mm:.1f} mm sideways and would be "
                "totally reflected; use about {least_mm} mm or more, or a smaller screen",
                throw_mm=throw_mm,
                shift_mm=shift_mm,
                least_mm=math.ceil(shortest_throw_mm),
            )
        else:
            words = Phrase(
                "the light comes in too far from the axis: light must move {shift_mm:.1f} mm sideways and would be "
                "totally reflected; no throw helps: move the light away or tilt it less",
                shift_mm=shift_mm,
            )
        super().__init__(words)


class NoSurfaceError(OpticsError):
    """The solver found no surface that sends the light to the screen, although each single ray is possible."""

    def __init__(self, *, lost_share: float) -> None:
        self.lost_share = lost_share
        super().__init__(
            Phrase(
                "no surface was found that sends this light onto this screen ({percent:.0f} % of the lens has no "
                "height): light or screen are too near or too far to the side; a longer throw, a lamp farther away "
                "or a smaller shift help",
                percent=100 * lost_share,
            )
        )


class UnsupportedBenchError(OpticsError):
    """The method supports only a simpler set-up."""

    def __init__(self, method: Phrase, unknown: list[Phrase]) -> None:
        self.method, self.unknown = method, unknown
        names = unknown[0]
        for name in unknown[1:]:
            names = Phrase("{names} and {name}", names=names, name=name)
        super().__init__(
            Phrase('{method} does not support {names}: use method = "transport"', method=method, names=names)
        )
