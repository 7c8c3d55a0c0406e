"""surface.bin: the heights of a lens on a grid coarse enough to be turned about on a screen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optics.heightfield import Heightfield
from service.job.page_data.header import header_line

_MOST_SAMPLES = 257
_LEVELS = 65535


def surface_bytes(
    lens: Heightfield, *, thickness_mm: float, margin_mm: float, outline_mm: Sequence[Sequence[float]] | None
) -> bytes:
    """Return header, then uint16 (ny, nx), row 0 at the lowest y: z = z0 + dz u. Both rims of the aperture are
    sampled.
    """
    longer_mm = max(lens.width_mm, lens.height_mm)
    nx, ny = (max(2, round((_MOST_SAMPLES - 1) * side / longer_mm) + 1) for side in (lens.width_mm, lens.height_mm))
    x_mm = np.linspace(lens.x_mm[0], lens.x_mm[-1], nx)
    y_mm = np.linspace(lens.y_mm[0], lens.y_mm[-1], ny)
    z_mm = lens.spline().heights_mm(x_mm[None, :], y_mm[:, None])
    lowest_mm, step_mm = float(z_mm.min()), float(np.ptp(z_mm)) / _LEVELS
    facts = {
        "nx": nx, "ny": ny,
        "x0_mm": float(x_mm[0]), "y0_mm": float(y_mm[0]),
        "dx_mm": lens.width_mm / (nx - 1), "dy_mm": lens.height_mm / (ny - 1),
        "z0_mm": lowest_mm, "dz_mm": step_mm,
        "thickness_mm": thickness_mm, "margin_mm": margin_mm,
        "outline_mm": None if outline_mm is None else [list(corner) for corner in outline_mm],
    }  # fmt: skip
    levels = np.rint((z_mm - lowest_mm) / step_mm) if step_mm > 0 else np.zeros_like(z_mm)
    return header_line(facts) + levels.astype("<u2").tobytes()
