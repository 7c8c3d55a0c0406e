"""The lens: heights on a vertex grid over the aperture, and the C2 spline between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optics.spline import Array, BicubicSpline, spline_jet

__all__ = ["Array", "BicubicSpline", "Heightfield", "spline_jet"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Heightfield:
    """Refracting surface z = h(x, y) in the work frame: Z0 is the top of the stock, +Z points to the screen.

    x_mm (nx,), y_mm (ny,) : ascending, evenly spaced vertex positions from one rim of the aperture to the other
    z_mm (ny, nx)          : heights, row j at y_mm[j]; never above 0
    rim_mm                 : width around the aperture in which the run-out continues the surface, for a finish that
    extends beyond the rim
    """

    x_mm: Array
    y_mm: Array
    z_mm: Array
    rim_mm: float = 0.0

    def __post_init__(self) -> None:
        for name in ("x_mm", "y_mm", "z_mm"):
            values = np.array(
                getattr(self, name), dtype=np.float64, order="C"
            )  # a copy, so that no one else can write to it
            if not np.isfinite(values).all():
                raise ValueError(f"heightfield {name} holds values that are not finite")
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        if self.z_mm.shape != (self.y_mm.size, self.x_mm.size):
            raise ValueError(f"heightfield is {self.z_mm.shape}, its axes say ({self.y_mm.size}, {self.x_mm.size})")
        for name in ("x_mm", "y_mm"):
            steps = np.diff(getattr(self, name))
            if steps.size < 3 or steps.min() <= 0 or np.ptp(steps) > 1e-6 * steps.mean():
                raise ValueError(f"heightfield {name} must hold at least 4 ascending, evenly spaced positions")

    @classmethod
    def on_aperture(cls, z_mm: Array, *, width_mm: float, height_mm: float) -> Heightfield:
        """Return heights (ny, nx) spread evenly from rim to rim of an aperture whose lower left corner is the
        origin.
        """
        ny, nx = z_mm.shape
        return cls(x_mm=np.linspace(0.0, width_mm, nx), y_mm=np.linspace(0.0, height_mm, ny), z_mm=z_mm)

    @property
    def dx_mm(self) -> float:
        return float(self.x_mm[-1] - self.x_mm[0]) / (self.x_mm.size - 1)

    @property
    def dy_mm(self) -> float:
        return float(self.y_mm[-1] - self.y_mm[0]) / (self.y_mm.size - 1)

    @property
    def width_mm(self) -> float:
        return float(self.x_mm[-1] - self.x_mm[0])

    @property
    def height_mm(self) -> float:
        return float(self.y_mm[-1] - self.y_mm[0])

    @property
    def relief_mm(self) -> float:
        """Highest minus lowest vertex."""
        return float(np.ptp(self.z_mm))

    @cached_property
    def steepest(self) -> float:
        """The greatest slope |grad h|, by differences of the vertices."""
        return float(np.hypot(*np.gradient(self.z_mm, self.dy_mm, self.dx_mm)).max())

    def spline_with_run_out(self, by_mm: float) -> BicubicSpline:
        """Return the spline and the surface around the aperture on which all passes run out: the only definition of
        both.
        """
        return self.spline().extend(by_mm, rim_mm=self.rim_mm)

    def spline(self) -> BicubicSpline:
        """Return the not-a-knot bicubic spline through the vertices."""
        return self._spline

    @cached_property
    def _spline(self) -> BicubicSpline:
        return BicubicSpline.through(
            self.z_mm, x0_mm=float(self.x_mm[0]), y0_mm=float(self.y_mm[0]), dx_mm=self.dx_mm, dy_mm=self.dy_mm
        )
