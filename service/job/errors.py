"""Translates the errors of the pure packages into the service's own: faults of the input, or of the job itself."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil, isfinite
from pathlib import Path

from cam.errors import CamError, CutterTooLargeError, OutlineError, PassValueError, SafeHeightError, StockTooThinError
from optics.errors import OpticsError, TotalReflectionError
from phrases.phrase import Phrase
from service.errors import FailedError, InputError, ServiceError, SpecError

_INPUT_ERRORS = (OpticsError, CutterTooLargeError, OutlineError, PassValueError, SafeHeightError, StockTooThinError)

_THROW, _THICKNESS = "optics.throw_mm", "stock.thickness_mm"


class SolidError(ValueError):
    """The lens does not make a solid block."""

    def __init__(self, words: Phrase) -> None:
        super().__init__(words)
        self.words = words


class ReliefTooDeep(SolidError):
    """The lens would pierce the back of the block, or leave a floor thinner than wanted."""

    def __init__(self, *, deepest_mm: float, relief_mm: float, thickness_mm: float, min_floor_mm: float) -> None:
        self.needed_mm = deepest_mm + min_floor_mm
        floor_mm = thickness_mm - deepest_mm
        super().__init__(
            Phrase(
                "relief of {relief_mm:.2f} mm does not fit: its deepest point lies {deepest_mm:.2f} mm below the "
                "stock top, a stock.thickness_mm of {thickness_mm:g} {left}; it needs a floor of at least "
                "{floor_mm:g} mm: a thickness of {needed_mm:.2f} mm or more, or a longer optics.throw_mm, which "
                "makes it flatter",
                relief_mm=relief_mm,
                deepest_mm=deepest_mm,
                thickness_mm=thickness_mm,
                left=Phrase("leaves a floor of {floor_mm:.2f} mm", floor_mm=floor_mm)
                if floor_mm > 0
                else Phrase("is pierced by {over_mm:.2f} mm at the back", over_mm=-floor_mm),
                floor_mm=min_floor_mm,
                needed_mm=self.needed_mm,
            )
        )


class LensKeptError(ServiceError):
    """A stage refused programs, and the folder contains the lens without them. reason: for the lens's own report."""

    def __init__(self, error: ServiceError, stage: str, folder: Path) -> None:
        number = stage.removeprefix("pass-")
        is_pass = number.isdecimal()
        what, key = (f"pass {number}", f"passes.{int(number) - 1}.KEY") if is_pass else ("this set-up", "KEY")
        self.exit_code = error.exit_code
        self.reason = Phrase("the folder holds no programs: {cause}", cause=error.lines[0])
        words = (
            f"{what} is refused, so {folder} holds the lens without programs; with another value, "
            f"`causticmill cam {folder} --set {key}=VALUE` writes them"
        )
        super().__init__(*error.lines, words)


@contextmanager
def translate_errors() -> Iterator[None]:
    """Raise InputError or FailedError, one line, in place of a package's own error."""
    try:
        yield
    except (OpticsError, CamError, SolidError) as error:
        words = error.words
        if isinstance(error, TotalReflectionError) and isfinite(error.shortest_throw_mm):
            raise SpecError([(_THROW, words)], {_THROW: ceil(error.shortest_throw_mm)}) from error
        if isinstance(error, ReliefTooDeep):
            raise SpecError([(_THICKNESS, words)], {_THICKNESS: ceil(error.needed_mm)}) from error
        kind = InputError if isinstance(error, _INPUT_ERRORS) else FailedError
        raise kind(words) from error
