"""The errors of the pure packages, as the service's own: what the person gave, or the job itself."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from cam.errors import (
    CamError,
    CutterTooLargeError,
    OutlineError,
    PassValueError,
    SafeHeightError,
    StockTooThinError,
)
from optics.errors import OpticsError
from service.errors import FailedError, InputError

_INPUT_ERRORS = (OpticsError, CutterTooLargeError, OutlineError, PassValueError, SafeHeightError, StockTooThinError)


@contextmanager
def in_the_services_words() -> Iterator[None]:
    """InputError or FailedError, one line, in place of a package's own error."""
    try:
        yield
    except (OpticsError, CamError, ValueError) as error:  # SolidError is a ValueError
        from service.solid import ReliefTooDeep, SolidError  # what it stands on is slow to import

        if not isinstance(error, (OpticsError, CamError, SolidError)):
            raise
        kind = InputError if isinstance(error, (*_INPUT_ERRORS, ReliefTooDeep)) else FailedError
        raise kind(" ".join(str(error).split())) from error
