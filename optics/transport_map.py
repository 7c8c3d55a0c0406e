"""The transport map: where on the lens the light of each point of the screen comes from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.spline import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TransportMap:
    """Pixel corners on the screen and the points of the lens that light them.

    screen_mm (ny + 1, nx + 1, 2) : the corners, work-frame x and y
    lens_mm   (ny + 1, nx + 1, 2) : their pre-images on the lens
    """

    screen_mm: Array
    lens_mm: Array

    def __post_init__(self) -> None:
        if self.screen_mm.shape != self.lens_mm.shape or self.screen_mm.shape[-1] != 2:
            raise ValueError(f"map shapes differ: screen {self.screen_mm.shape}, lens {self.lens_mm.shape}")
        for points in (self.screen_mm, self.lens_mm):
            points.setflags(write=False)

    def collect_areas_mm2(self) -> Array:
        """Return (ny, nx) area of the lens that lights each pixel: half the cross product of the quad's diagonals."""
        p = self.lens_mm
        rising = p[1:, 1:] - p[:-1, :-1]
        falling = p[1:, :-1] - p[:-1, 1:]
        return np.asarray(0.5 * (rising[..., 0] * falling[..., 1] - rising[..., 1] * falling[..., 0]))
