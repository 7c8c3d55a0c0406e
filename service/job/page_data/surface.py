"""Surfaces for the page. surface.bin: the heights of a lens on a grid coarse enough to be turned about on a screen.

light*.bin: a surface and its light, fine enough for the page itself to compute the light on a wall at any distance. The
slopes make the picture, so differences of heights matter: heights are whole numbers of a step so small that its
rounding moves light by a few thousandths of a cell, and they are stored as differences down and across. These files
and pass-N.path begin with one line of JSON.
"""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from optics.bench import Bench
from optics.block import lower_by_back
from optics.heightfield import Array, Heightfield
from optics.irradiance import ViewedFrom
from optics.tubes.edges import polygon_coverage
from service.job.files import make_header_line

_CELLS = 512  # along the longer side
_SHARP_CELLS = 1024  # for light without size, which does not blur
_COARSER = 4  # cells are a multiple of it along both sides, so that a slow page can use every fourth node only
_ROUNDING = 2e-3  # of a cell: distance by which one step of the heights moves light on the wall
_MOST_LEVELS = 2**30
_FULL = 255
_MOST_SAMPLES = 257
_LEVELS = 65535


def surface_bytes(
    lens: Heightfield, *, thickness_mm: float, margin_mm: float, outline_mm: Sequence[Sequence[float]] | None
) -> bytes:
    """Return header, then uint16 (ny, nx), row 0 at the lowest y: z = z0 + dz u. Both rims are sampled."""
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
    return make_header_line(facts) + levels.astype("<u2").tobytes()


def light_bytes(
    surface: Heightfield, bench: Bench, *, white: float, viewed_from: ViewedFrom, slopes: Array | None = None
) -> bytes:
    """Return, gzipped: header; int32 (ny, nx) differences of heights in steps, row 0 at the lowest y; where the light
    is not the same everywhere, uint8 (ny, nx) share of the strongest at each node.

    white  : irradiance that is shown as white
    slopes : (k, 2) errors of the surface's slope in x and y, each on one k-th of the surface; None: no errors
    """
    longer_mm = max(surface.width_mm, surface.height_mm)
    cells = _CELLS if bench.light.radius > 0 else min(_SHARP_CELLS, max(_CELLS, *surface.z_mm.shape))
    nx, ny = (_nodes(cells * side / longer_mm) for side in (surface.width_mm, surface.height_mm))
    x_mm, y_mm = (np.linspace(axis[0], axis[-1], count) for axis, count in ((surface.x_mm, nx), (surface.y_mm, ny)))
    z_mm = lower_by_back(surface, bench.back).spline().heights_mm(x_mm[None, :], y_mm[:, None])
    dx_mm, dy_mm = surface.width_mm / (nx - 1), surface.height_mm / (ny - 1)
    step_mm = max(_ROUNDING * min(dx_mm, dy_mm) ** 2 / bench.throw_mm, float(np.ptp(z_mm)) / _MOST_LEVELS)
    weights = _weights(bench, nx, ny)
    facts = {
        "nx": nx, "ny": ny, "dx_mm": dx_mm, "dy_mm": dy_mm, "z0_mm": float(z_mm[0, 0]), "dz_mm": step_mm,
        "white": white, "viewed_from": viewed_from, "weighted": weights is not None,
        "slopes": None if slopes is None else np.round(slopes, 7).tolist(),
        **_bench_facts(bench),
    }  # fmt: skip
    levels = np.rint((z_mm - z_mm[0, 0]) / step_mm).astype("<i4")
    steps = np.diff(np.diff(levels, axis=0, prepend=0), axis=1, prepend=0).astype("<i4")
    data = make_header_line(facts) + steps.tobytes() + (b"" if weights is None else weights.tobytes())
    return gzip.compress(data, 6, mtime=0)


def _nodes(cells: float) -> int:
    return _COARSER * max(1, round(cells / _COARSER)) + 1


def _bench_facts(bench: Bench) -> dict[str, Any]:
    light, screen, (shift_x, shift_y) = bench.light, bench.screen, bench.shift_mm
    return {
        "throw_mm": bench.throw_mm, "refractive_index": bench.refractive_index, "thickness_mm": bench.thickness_mm,
        "is_mirror": bench.mirror,
        "screen_mm": [screen.width_mm, screen.height_mm, shift_x, shift_y],
        "light": {
            "distance_mm": light.distance_mm if light.is_point else None,
            "radius": light.radius,
            "slant": np.tan(light.tilt_rad).tolist(),
        },
    }  # fmt: skip


def _weights(bench: Bench, nx: int, ny: int) -> Array | None:
    """Return (ny, nx) uint8: the lens mask times the light on it; None if both are the same everywhere."""
    profile, outline = bench.light.profile, bench.outline_mm
    if profile is None and outline is None:
        return None
    weights = np.ones((ny, nx))
    if outline is not None:
        cells = np.asarray(outline) / (bench.width_mm, bench.height_mm) * (nx - 1, ny - 1)
        weights *= polygon_coverage(cells + 0.5, (ny, nx))
    if profile is not None:
        at = [np.linspace(0.0, side - 1.0, count) for side, count in zip(profile.shape, (ny, nx), strict=True)]
        weights *= map_coordinates(np.asarray(profile, dtype=np.float64), np.meshgrid(*at, indexing="ij"), order=1)
    return np.asarray(np.rint(_FULL * weights / weights.max()), dtype=np.uint8)
