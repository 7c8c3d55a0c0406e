"""StockGrid: the remaining stock, as heights at the centres of square cells."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor
from typing import Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class BlockSize(Protocol):
    """The size of the stock for a grid; `cam.passes.Stock` is one."""

    @property
    def width_mm(self) -> float: ...
    @property
    def height_mm(self) -> float: ...
    @property
    def margin_mm(self) -> float: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StockGrid:
    """Heights of the remaining stock at cell CENTRES, in the work frame.

    x0_mm, y0_mm : lower left CORNER of the grid, so cell (j, i) is centred on
                   (x0 + (i + 1/2) cell, y0 + (j + 1/2) cell)
    cell_mm      : side of a cell
    top_mm       : (ny, nx) float64, read-only; row 0 has the lowest y; 0 is the uncut top
    """

    x0_mm: float
    y0_mm: float
    cell_mm: float
    top_mm: Array

    def __post_init__(self) -> None:
        top_mm = np.array(self.top_mm, dtype=np.float64, order="C")
        if top_mm.ndim != 2 or top_mm.size == 0:
            raise ValueError(f"stock heights are (ny, nx), not {top_mm.shape}")
        if not self.cell_mm > 0:
            raise ValueError(f"a stock cell is {self.cell_mm:g} mm; it must be above 0")
        top_mm.flags.writeable = False
        object.__setattr__(self, "top_mm", top_mm)
        for name in ("x0_mm", "y0_mm", "cell_mm"):  # kernels are compiled for one kind of number
            object.__setattr__(self, name, float(getattr(self, name)))

    @classmethod
    def block(cls, stock: BlockSize, cell_mm: float | None = None) -> StockGrid:
        """Return the uncut block, aperture and margin, all at Z0.

        cell_mm : by default 1/1100 of the longer side, between 0.05 and 0.2 mm: 0.1 mm for a lens of 100 mm
        Whole cells: where cell_mm does not divide the block, the grid grows evenly on both
        sides by less than one cell, so every point of the block lies in a cell.
        """
        width_mm = stock.width_mm + 2 * stock.margin_mm
        height_mm = stock.height_mm + 2 * stock.margin_mm
        if cell_mm is None:
            cell_mm = min(max(max(width_mm, height_mm) / 1100, 0.05), 0.2)
        nx, ny = (max(1, ceil(size / cell_mm - 1e-9)) for size in (width_mm, height_mm))
        return cls(
            x0_mm=-stock.margin_mm - (nx * cell_mm - width_mm) / 2,
            y0_mm=-stock.margin_mm - (ny * cell_mm - height_mm) / 2,
            cell_mm=cell_mm,
            top_mm=np.zeros((ny, nx)),
        )

    @property
    def x_mm(self) -> Array:
        """(nx,) x of the cell centres."""
        return self.x0_mm + self.cell_mm * (np.arange(self.top_mm.shape[1], dtype=np.float64) + 0.5)

    @property
    def y_mm(self) -> Array:
        """(ny,) y of the cell centres."""
        return self.y0_mm + self.cell_mm * (np.arange(self.top_mm.shape[0], dtype=np.float64) + 0.5)

    def highest_mm(self, x_lo_mm: float, x_hi_mm: float, y_lo_mm: float, y_hi_mm: float) -> float | None:
        """Return the highest stock in the cells that a rectangle touches; None when it misses the block."""
        ny, nx = self.top_mm.shape
        i0 = max(0, floor((x_lo_mm - self.x0_mm) / self.cell_mm))
        i1 = min(nx, floor((x_hi_mm - self.x0_mm) / self.cell_mm) + 1)
        j0 = max(0, floor((y_lo_mm - self.y0_mm) / self.cell_mm))
        j1 = min(ny, floor((y_hi_mm - self.y0_mm) / self.cell_mm) + 1)
        if i0 >= i1 or j0 >= j1:
            return None
        return float(self.top_mm[j0:j1, i0:i1].max())
