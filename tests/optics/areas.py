"""Areas of the quads of a map."""

from __future__ import annotations

import numpy as np

from optics.spline import Array


def areas_mm2(corners_mm: Array) -> Array:
    """Return (ny, nx) from corners (ny + 1, nx + 1, 2): half the cross product of the quad's diagonals."""
    rising = corners_mm[1:, 1:] - corners_mm[:-1, :-1]
    falling = corners_mm[1:, :-1] - corners_mm[:-1, 1:]
    return np.asarray(0.5 * (rising[..., 0] * falling[..., 1] - rising[..., 1] * falling[..., 0]))
