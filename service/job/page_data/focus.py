"""focus.bin: the caustic on screens before, at and behind the throw, for a slider to go through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.heightfield import Array, Heightfield
from optics.irradiance import ViewedFrom, picture_from_irradiance
from service.job.page_data.header import header_line
from service.job.report.figures.base import srgb_levels

FACTORS = (0.5, 0.6, 0.7, 0.78, 0.85, 0.91, 0.96, 1.0, 1.04, 1.09, 1.16, 1.25, 1.35, 1.47, 1.6)
_MOST_PIXELS = 256
_TUBES, _BEAMS = 1, 3
_MOST_VERTICES = 512  # along a side: as many tubes as a picture of 256 pixels can show


def focus_bytes(
    lens: Heightfield,
    bench: Bench,
    *,
    shape: tuple[int, int],
    white: float,
    viewed_from: ViewedFrom,
) -> bytes:
    """Return header, then uint8 (k, ny, nx) sRGB grey as the viewer sees it, row 0 on top; `white` becomes 255.

    shape : (ny, nx) of the job's picture
    """
    scale = min(1.0, _MOST_PIXELS / max(shape))
    ny, nx = (max(1, round(scale * side)) for side in shape)
    coarse = _coarser(lens)
    frames = []
    for factor in FACTORS:
        moved = replace(bench, throw_mm=factor * bench.throw_mm)
        seen = simulate_caustic(coarse, moved, pixels=(ny, nx), tubes_per_cell=_TUBES, beams=_BEAMS)
        picture = picture_from_irradiance(seen.irradiance, viewed_from=viewed_from)
        frames.append(srgb_levels(picture, white=white))
    facts = {"nx": nx, "ny": ny, "factors": list(FACTORS), "throw_mm": bench.throw_mm, "white": white}
    return header_line(facts) + np.stack(frames).tobytes()


def _coarser(lens: Heightfield) -> Heightfield:
    """Return the same surface with fewer vertices, where it has more than can be seen."""
    ny, nx = lens.z_mm.shape
    share = _MOST_VERTICES / max(ny, nx)
    if share >= 1.0:
        return lens
    x_mm, y_mm = (_spread(axis, max(4, round(share * axis.size))) for axis in (lens.x_mm, lens.y_mm))
    return Heightfield(x_mm=x_mm, y_mm=y_mm, z_mm=lens.spline().heights_mm(x_mm[None, :], y_mm[:, None]))


def _spread(axis_mm: Array, count: int) -> Array:
    return np.linspace(axis_mm[0], axis_mm[-1], count)
