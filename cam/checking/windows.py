"""Windows: small squares of the part watched at a fine cell, where a mistake would be largest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

from cam.passes import PassSpec
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Array, Heightfield

_SIZE_MM, _FINEST_MM, _COARSEST_MM = 1.0, 0.0025, 0.01
_FLAT_MM = 0.05  # after a flat cutter: its stairs are tenths of a millimetre


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """One watched square: why it is here, and the fine stock before the pass."""

    name: str
    stock: StockGrid


def place_windows(heightfield: Heightfield, spec: PassSpec, before: StockGrid) -> tuple[Window, ...]:
    """Return corners, one edge, the centre, and where the lens is most concave, most convex and steepest.

    The stock before the pass is known at the whole part's cells only; a window starts from the highest of the
    nearest cells, so what it shows afterwards is the work of this pass or too high, never too low.
    """
    width, height = heightfield.width_mm, heightfield.height_mm
    size = min(max(_SIZE_MM, 4 * spec.pitch_mm), width / 3, height / 3)
    cell_mm = min(max(spec.pitch_mm / 5, _FINEST_MM), _COARSEST_MM) if spec.is_ball else _FLAT_MM
    n = max(8, round(size / cell_mm))
    highest = maximum_filter(before.top_mm, size=3)
    windows = []
    for name, x_mm, y_mm in _places(heightfield):
        x0 = float(np.clip(x_mm - size / 2, 0, width - size))
        y0 = float(np.clip(y_mm - size / 2, 0, height - size))
        centres = (np.arange(n) + 0.5) * size / n
        columns = np.clip(((x0 + centres - before.x0_mm) / before.cell_mm).astype(int), 0, highest.shape[1] - 1)
        rows = np.clip(((y0 + centres - before.y0_mm) / before.cell_mm).astype(int), 0, highest.shape[0] - 1)
        stock = StockGrid(x0_mm=x0, y0_mm=y0, cell_mm=size / n, top_mm=highest[np.ix_(rows, columns)])
        windows.append(Window(name=name, stock=stock))
    return tuple(windows)


def _places(heightfield: Heightfield) -> list[tuple[str, float, float]]:
    width, height = heightfield.width_mm, heightfield.height_mm
    mean, spread, slope2 = _shape(heightfield)
    inner = (slice(2, -2), slice(2, -2)) if min(heightfield.z_mm.shape) > 8 else (slice(None), slice(None))

    def at_most(values: Array) -> tuple[float, float]:
        offset = inner[0].start or 0
        j, i = divmod(int(values[inner].argmax()), values[inner].shape[1])
        return float(heightfield.x_mm[i + offset]), float(heightfield.y_mm[j + offset])

    return [
        ("lower left corner", 0.0, 0.0),
        ("lower right corner", width, 0.0),
        ("upper left corner", 0.0, height),
        ("upper right corner", width, height),
        ("right edge", width, height / 2),
        ("centre", width / 2, height / 2),
        ("most concave", *at_most(mean + spread)),
        ("most convex", *at_most(spread - mean)),
        ("steepest", *at_most(slope2)),
    ]


def _shape(heightfield: Heightfield) -> tuple[Array, Array, Array]:
    """Return (ny, nx) each: mean of the second derivatives, half the spread of their eigenvalues, slope squared."""
    zy, zx = np.gradient(heightfield.z_mm, heightfield.dy_mm, heightfield.dx_mm)
    zxy, zxx = np.gradient(zx, heightfield.dy_mm, heightfield.dx_mm)
    zyy = np.gradient(zy, heightfield.dy_mm, axis=0)
    return np.asarray((zxx + zyy) / 2), np.asarray(np.hypot((zxx - zyy) / 2, zxy)), np.asarray(zx**2 + zy**2)
