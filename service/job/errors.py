"""The errors of the pure packages, as the service's own: what the person gave, or the job itself."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil, isfinite

from cam.errors import CamError, CutterTooLargeError, OutlineError, PassValueError, SafeHeightError, StockTooThinError
from optics.errors import OpticsError, TotalReflectionError
from service.errors import FailedError, InputError, SpecError

_INPUT_ERRORS = (OpticsError, CutterTooLargeError, OutlineError, PassValueError, SafeHeightError, StockTooThinError)

_THROW, _THICKNESS = "optics.throw_mm", "stock.thickness_mm"


class SolidError(ValueError):
    """The lens does not make a solid block."""


class ReliefTooDeep(SolidError):
    """The lens would pierce the back of the block, or leave a floor thinner than wanted."""

    def __init__(self, *, deepest_mm: float, relief_mm: float, thickness_mm: float, min_floor_mm: float) -> None:
        self.needed_mm = deepest_mm + min_floor_mm
        floor_mm = thickness_mm - deepest_mm
        left = (
            f"leaves a floor of {floor_mm:.2f} mm" if floor_mm > 0 else f"is pierced by {-floor_mm:.2f} mm at the back"
        )
        super().__init__(
            f"relief of {relief_mm:.2f} mm does not fit: its deepest point lies {deepest_mm:.2f} mm below the stock "
            f"top, a stock.thickness_mm of {thickness_mm:g} {left}; a floor of at least {min_floor_mm:g} mm is wanted, "
            f"so a thickness of {self.needed_mm:.2f} mm or more, or a longer optics.throw_mm, which makes it flatter"
        )


@contextmanager
def translate_errors() -> Iterator[None]:
    """Raise InputError or FailedError, one line, in place of a package's own error."""
    try:
        yield
    except (OpticsError, CamError, ValueError) as error:  # SolidError is a ValueError
        if not isinstance(error, (OpticsError, CamError, SolidError)):
            raise
        words = " ".join(str(error).split())
        if isinstance(error, TotalReflectionError) and isfinite(error.shortest_throw_mm):
            raise SpecError([(_THROW, words)], {_THROW: ceil(error.shortest_throw_mm)}) from error
        if isinstance(error, ReliefTooDeep):
            raise SpecError([(_THICKNESS, words)], {_THICKNESS: ceil(error.needed_mm)}) from error
        kind = InputError if isinstance(error, _INPUT_ERRORS) else FailedError
        raise kind(words) from error
