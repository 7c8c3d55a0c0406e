"""Moves of the tool tip, of which a pass consists before a post-processor turns it into blocks; and heights of
rapids.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SAFE_Z_MM = 5.0
"""Default height of rapids across the block; jobs use their mill's, from machines/profiles."""

RAPID_CLEARANCE_MM = 1.0
"""Height above the known stock, and never below the top of the block, at which a rapid straight down ends."""

CLEARANCE_MM = 0.1
"""Height above the known stock at which feeding straight down ends."""


class Motion(Enum):
    """RAPID goes as fast as the mill can and must never meet stock; CUT goes at a feed."""

    RAPID = "rapid"
    CUT = "cut"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path:
    """Straight moves of the tool TIP from its present place to each point in turn.

    points_mm            : (n, 3) in the work frame, read-only
    feed_mm_per_min      : of a CUT; None for a RAPID
    """

    motion: Motion
    points_mm: Array
    feed_mm_per_min: float | None = None

    def __post_init__(self) -> None:
        if self.points_mm.ndim != 2 or self.points_mm.shape[1] != 3:
            raise ValueError(f"a path is (n, 3) points, not {self.points_mm.shape}")
        if (self.motion is Motion.CUT) != (self.feed_mm_per_min is not None):
            raise ValueError("a cut needs a feed, a rapid has none")
        self.points_mm.setflags(write=False)


def rapid(*points_mm: ArrayLike) -> Path:
    """Return straight rapids to one point after the other."""
    return Path(motion=Motion.RAPID, points_mm=np.array(points_mm, dtype=np.float64))


def cut(points_mm: ArrayLike, feed_mm_per_min: float) -> Path:
    """Return feed moves along (n, 3) points."""
    return Path(
        motion=Motion.CUT,
        points_mm=np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 3),
        feed_mm_per_min=feed_mm_per_min,
    )
