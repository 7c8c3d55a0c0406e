"""Tracks of a finishing pass before its program is written: the rows that the program will have, in memory."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from cam.as_milled.surface import MilledSurface
from cam.as_milled.tracks import Noise, Screws, Tracks
from cam.moves import Array
from cam.passes import Direction
from cam.rows.raster import Rows, continuous_rows, map_in_order, turn_lens
from cam.rows.vertices import SLOPE_ERROR_RAD, VertexRule, finish_rule
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield

DECIMALS = 5  # of z in most dialects
_PLACES = (0.3, 0.7)  # of either side: the middles of samples
_SAMPLE_MM, _SAMPLE_PITCHES = 10.0, 150.0  # side of a sample; no more than a quarter of the lens's


def make_rule(lens: Heightfield, radius_mm: float, slope_error_rad: float) -> VertexRule:
    return finish_rule(slope_error_rad, min(lens.dx_mm, radius_mm / 2), aperture_x_mm=(0.0, lens.width_mm))


def make_tracks(surface: ToolSurface, rows: Rows, rule: VertexRule, direction: Direction, decimals: int) -> Tracks:
    tips = np.concatenate(list(continuous_rows(surface, rows, rule)))
    tips[:, 2] = np.round(tips[:, 2], decimals)
    if direction == "y":
        tips = np.ascontiguousarray(tips[:, [1, 0, 2]])
    joined = np.ones(len(tips), dtype=np.bool_)
    joined[0] = False
    return Tracks(radius_mm=surface.radius_mm, tips_mm=tips, joined=joined)


def find_touched_surface(heightfield: Heightfield, radius_mm: float, direction: Direction) -> ToolSurface:
    """Return the touched surface in the frame of rows of that direction: x and y exchanged for rows along y."""
    return ToolSurface.over(heightfield if direction == "x" else turn_lens(heightfield), radius_mm=radius_mm)


def sample_facets(
    heightfield: Heightfield,
    *,
    radius_mm: float,
    pitch_mm: float,
    direction: Direction = "x",
    step_mm: float = 0.0,
    z_noise_mm: float = 0.0,
    screws: Screws | None = None,
    decimals: int = DECIMALS,
    slope_error_rad: float = SLOPE_ERROR_RAD,
    surface: ToolSurface | None = None,
) -> tuple[Array, ...]:
    """Return (n, 4, 5) facets of four squares of the lens, of 150 rows each at most, which show the effect of such rows
    on its slopes.

    surface : `find_touched_surface` of this ball, if the caller has it already
    """
    lens = heightfield if direction == "x" else turn_lens(heightfield)
    touched = find_touched_surface(heightfield, radius_mm, direction) if surface is None else surface
    rule = make_rule(lens, radius_mm, slope_error_rad)
    error_mm = tip_error_mm(step_mm=step_mm, z_noise_mm=z_noise_mm, decimals=decimals)

    def sample(numbered: tuple[int, Rows]) -> Array:
        number, rows = numbered
        noise = Noise(sigma_mm=z_noise_mm, rows_run=direction, seed=number)
        tracks = make_tracks(touched, rows, rule, direction, decimals)
        tracks = tracks if screws is None else tracks.divide(screws.longest_mm)
        tracks = tracks.run_on_mill(step_mm=step_mm, noise=noise, screws=screws)
        milled = MilledSurface.of_tracks([tracks], heightfield, pitch_mm=pitch_mm, error_mm=error_mm, step_mm=step_mm)
        facets = np.concatenate([milled.part(k) for k in range(milled.parts)])
        return _inner(facets, 3 * milled.reach_mm + pitch_mm)

    return tuple(map_in_order(sample, enumerate(_small_fields(lens, radius_mm, pitch_mm))))


def tip_error_mm(*, step_mm: float, z_noise_mm: float = 0.0, decimals: int = DECIMALS) -> float:
    """Return the standard deviation of the tips' heights: errors of steps and decimals are uniform within +-1/2."""
    return math.hypot(z_noise_mm, step_mm / math.sqrt(12), 10.0**-decimals / math.sqrt(12))


def _small_fields(lens: Heightfield, radius_mm: float, pitch_mm: float) -> Iterator[Rows]:
    """Yield the rows of a pass where they form one of the samples."""
    spline = lens.spline()
    half = min(_SAMPLE_MM, _SAMPLE_PITCHES * pitch_mm, lens.width_mm / 4, lens.height_mm / 4) / 2
    for v in _PLACES:
        for u in _PLACES:
            x, y = lens.x_mm[0] + u * lens.width_mm, lens.y_mm[0] + v * lens.height_mm
            _, zx, zy, *_ = spline.jets(x, y)
            shift = radius_mm / math.sqrt(1 + zx**2 + zy**2)
            tip_x, tip_y = float(x - shift * zx), float(y - shift * zy)
            numbers = np.arange(math.ceil((tip_y - half) / pitch_mm), math.floor((tip_y + half) / pitch_mm) + 1)
            yield Rows(
                y_mm=np.round(numbers * pitch_mm, 4),
                left_mm=round(tip_x - half, 4),
                right_mm=round(tip_x + half, 4),
                turn_mm=math.ceil(pitch_mm / 2 * 1e4) / 1e4,
            )


def _inner(facets: Array, rim_mm: float) -> Array:
    """Return facets without those near the sample's rim, where neighbours are missing; half of a small sample at
    least.
    """
    if not len(facets):
        return facets
    middle = facets[:, :, :2].mean(axis=1)
    low, high = (np.quantile(middle, share, axis=0) for share in (0.002, 0.998))
    rim = np.minimum(rim_mm, (high - low) / 4)
    return facets[((middle > low + rim) & (middle < high - rim)).all(axis=1)]
