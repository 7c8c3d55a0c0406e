"""Errors between a heightfield and a program. Every error carries its numbers as attributes."""

from __future__ import annotations

from phrases.phrase import Phrase


class CamError(Exception):
    """Base of all errors of this package."""

    def __init__(self, words: Phrase) -> None:
        super().__init__(words)
        self.words = words


class PassValueError(CamError):
    """A pass or stock setting outside its allowed range."""

    def __init__(self, *, name: str, value: object, allowed: Phrase) -> None:
        self.name, self.value, self.allowed = name, value, allowed
        super().__init__(
            Phrase("{name} = {value} is not allowed: {allowed}", name=name, value=repr(value), allowed=allowed)
        )


class CutterTooLargeError(CamError):
    """A finishing ball that leaves too much of the surface untouched."""

    def __init__(self, *, radius_mm: float, reached_share: float, largest_mm: float, nearly_mm: float) -> None:
        self.radius_mm, self.reached_share = radius_mm, reached_share
        self.largest_mm, self.nearly_mm = largest_mm, nearly_mm
        super().__init__(
            Phrase(
                "a ball of radius {radius_mm:g} mm touches only {percent:.1f} % of the surface; the largest that fits "
                "everywhere has {largest_mm:.3g} mm, on 99.9 % of the area {nearly_mm:.3g} mm",
                radius_mm=radius_mm,
                percent=100 * reached_share,
                largest_mm=largest_mm,
                nearly_mm=nearly_mm,
            )
        )


class StockTooThinError(CamError):
    """The tool would go deeper than the block is thick."""

    def __init__(self, *, lowest_mm: float, thickness_mm: float) -> None:
        self.lowest_mm, self.thickness_mm = lowest_mm, thickness_mm
        super().__init__(
            Phrase(
                "the tool goes down to Z{lowest_mm:.3f} mm, but the stock is {thickness_mm:g} mm thick",
                lowest_mm=lowest_mm,
                thickness_mm=thickness_mm,
            )
        )


class SafeHeightError(CamError):
    """The tool, following the surface, would rise to the height that is meant to be clear of everything."""

    def __init__(self, *, safe_z_mm: float, needed_mm: float) -> None:
        self.safe_z_mm, self.needed_mm = safe_z_mm, needed_mm
        super().__init__(
            Phrase(
                "safe_z = {safe_z_mm:g} mm is too low; it must be at least {needed_mm:.3f} mm",
                safe_z_mm=safe_z_mm,
                needed_mm=needed_mm,
            )
        )


class LineTooLongError(CamError):
    """A block longer than the controller's line buffer."""

    def __init__(self, *, line: str, allowed: int) -> None:
        self.line, self.allowed = line, allowed
        super().__init__(
            Phrase(
                "block of {count} characters (allowed {allowed}): {line}",
                count=len(line),
                allowed=allowed,
                line=repr(line),
            )
        )


class OutlineError(CamError):
    """An outline around which a cutter cannot go in one line without touching it."""

    def __init__(self, *, radius_mm: float, nearest_mm: float) -> None:
        self.radius_mm, self.nearest_mm = radius_mm, nearest_mm
        super().__init__(
            Phrase(
                "the outline has a hollow with a mouth too narrow for a cutter of radius {radius_mm:g} mm, which would "
                "come as near as {nearest_mm:.3f} mm; a thinner cutter, or an outline without it",
                radius_mm=radius_mm,
                nearest_mm=nearest_mm,
            )
        )
