"""A linear-light picture as the target irradiance on the screen, and back."""

from __future__ import annotations

from typing import Literal

import numpy as np

from optics.errors import TargetError
from optics.spline import Array
from phrases.phrase import Phrase

ViewedFrom = Literal["lens", "behind"]


def flip_between_picture_and_work_frame(pixels: Array, viewed_from: ViewedFrom) -> Array:
    """Return rows and columns of a picture (row 0 on top) in the order of the work frame (row 0 lowest), or back.

    The one place that flips. Light travels +Z. A person behind a translucent screen looks down -Z and sees +X to the
    right: only the rows turn round. A person on the lens's side, who looks along +Z at a wall with +Y up, has +X to
    the left: the columns turn round too.
    """
    flipped = pixels[::-1, ::-1] if viewed_from == "lens" else pixels[::-1, :]
    return np.ascontiguousarray(flipped)


def target_irradiance(linear: Array, *, viewed_from: ViewedFrom) -> Array:
    """Return target irradiance (ny, nx) in the work frame, mean 1, from a linear-light picture (ny, nx), row 0 on top.

    Each value is the *average* over its pixel, not a sample at its centre: the mapping gives each pixel exactly that
    share of the light. Black pixels stay black.
    """
    picture = np.asarray(linear, dtype=np.float64)
    if picture.ndim != 2 or min(picture.shape) < 2:
        raise TargetError(
            Phrase("a target is a grid of at least 2 x 2 pixels, not {size}", size="x".join(map(str, picture.shape)))
        )
    if not np.isfinite(picture).all() or picture.min() < 0:
        raise TargetError(Phrase("a target's pixels must be finite and not negative"))
    mean = picture.mean()
    if not mean > 0:
        raise TargetError(Phrase("the picture is black everywhere: there is no light to aim"))
    return flip_between_picture_and_work_frame(picture / mean, viewed_from)


def picture_from_irradiance(irradiance: Array, *, viewed_from: ViewedFrom) -> Array:
    """Return an irradiance in the work frame as the viewer sees it, row 0 on top."""
    return flip_between_picture_and_work_frame(irradiance, viewed_from)
