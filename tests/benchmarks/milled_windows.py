"""The milled surface against brute force: stock taken off cell by cell in windows of a lens, and its slopes.

A slope between two cells is wrong where a crest runs between them: it is anything from the slope of one groove to that
of the next. So a share of cell / pitch of them is a third of what it should be in the mean square, and twice that share
is missing from it: 10 % where a pitch is 20 cells, 5 % of the rms. Therefore the cells are cut three times, shifted by
10 nm along x and along y: then one slope in 2000 is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cam.as_milled.rows import tip_error_mm
from cam.as_milled.surface import MilledSurface
from cam.as_milled.tracks import Noise, Tracks
from cam.checking.removal import RemovalGrid
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield
from tests.benchmarks.timing import Figure
from tests.cam.facet_points import rms, spread_over
from tests.cam.programs import row_tracks

CELL_MM, SHIFT_MM = 0.001, 1e-5
_PIECE_MM = 8.0  # of the lens, side
_NEXT_MM = 0.1  # no tip is farther from the one before it


class Case(NamedTuple):
    """[mm]; chord: no move longer."""

    radius: float
    pitch: float
    step: float
    noise: float
    chord: float
    window: float

    def __str__(self) -> str:
        words = f"R {self.radius:g}, pitch {self.pitch:g}, step {1e3 * self.step:g} um, noise {1e3 * self.noise:g} um"
        return words if self.chord > self.window else f"{words}, moves of {1e3 * self.chord:g} um"


LONG = 1e3
CASES = (
    Case(0.5, 0.02, 0.0, 0.0, LONG, 0.4),
    Case(0.5, 0.005, 0.0, 0.0, LONG, 0.2),
    Case(0.5, 0.02, 0.0, 0.0005, LONG, 0.6),
    Case(0.5, 0.02, 0.002, 0.0005, LONG, 0.6),
    Case(0.5, 0.02, 0.004, 0.001, LONG, 0.6),
    Case(3.0, 0.1, 0.002, 0.0005, LONG, 1.0),
    Case(3.0, 0.1, 0.002, 0.0005, 0.004, 0.6),
    Case(0.5, 0.02, 0.002, 0.0005, 0.008, 0.4),
)


def figures(lens: Heightfield) -> Iterator[Figure]:
    piece = _piece_of(lens)
    for case in CASES:
        tracks = _tracks(piece, case)
        mine, area = _of_facets(tracks, piece, case)
        exact, by_cells = _by_cells(tracks, piece, case)
        note = f"{1e3 * exact[2]:.2f} mrad; along {mine[0] / exact[0]:.3f}, across {mine[1] / exact[1]:.3f}; "
        note += f"facets cover {area:.4f}; slopes between cells of 1 um: {by_cells / exact[2]:.3f}; asked: within 5 %"
        yield Figure(f"slope rms over brute force, {case}", mine[2] / exact[2], "", note)


def _piece_of(lens: Heightfield) -> Heightfield:
    """A square from the middle of the lens."""
    side = round(_PIECE_MM / lens.dx_mm)
    row, column = ((size - side) // 2 for size in lens.z_mm.shape)
    z = lens.z_mm[row : row + side + 1, column : column + side + 1]
    return Heightfield.on_aperture(z, width_mm=side * lens.dx_mm, height_mm=side * lens.dy_mm)


def _tracks(lens: Heightfield, case: Case) -> Tracks:
    """What of the rows comes near the window in the middle."""
    rows = row_tracks(lens, radius_mm=case.radius, pitch_mm=case.pitch).divide(case.chord)
    whole = rows.run_on_mill(step_mm=case.step, noise=Noise(sigma_mm=case.noise)).divide(_NEXT_MM)
    away = np.abs(whole.tips_mm[:, :2] - _middle(lens)).max(axis=1)
    near = away < case.window / 2 + 0.3 * case.radius + 0.3
    joined = whole.joined & near & np.roll(near, 1)
    return Tracks(radius_mm=case.radius, tips_mm=whole.tips_mm[near], joined=joined[near])


def _middle(lens: Heightfield) -> np.ndarray:
    return np.array([lens.width_mm, lens.height_mm]) / 2


def _of_facets(tracks: Tracks, lens: Heightfield, case: Case) -> tuple[tuple[float, float, float], float]:
    """rms (along, across, both) of the slopes added to the lens's, and the facets' area over that of the window."""
    error = tip_error_mm(step_mm=case.step, z_noise_mm=case.noise)
    surface = MilledSurface.of_tracks([tracks], lens, pitch_mm=case.pitch, error_mm=error)
    facets = np.concatenate([surface.part(k) for k in range(surface.parts)])
    half = np.full(2, case.window / 2)
    points, weights = spread_over(facets, _middle(lens) - half, _middle(lens) + half, parts=30)
    slopes = lens.spline().jets(points[:, 0], points[:, 1])[1:3]
    along, across = (rms(points[:, 3 + axis] - slopes[axis], weights) for axis in (0, 1))
    return (along, across, float(np.hypot(along, across))), float(weights.sum()) / case.window**2


def _by_cells(tracks: Tracks, lens: Heightfield, case: Case) -> tuple[tuple[float, float, float], float]:
    """The same of brute force, and the rms of both that the differences of its cells have."""
    half = case.window / 2
    corner = _middle(lens) - half
    here, right, above = (
        _left_of(tracks, corner + np.array(shift), case.window) for shift in ((0, 0), (SHIFT_MM, 0), (0, SHIFT_MM))
    )
    centres = corner[:, None] + (np.arange(len(here)) + 0.5) * CELL_MM
    x, y = np.meshgrid(*centres)
    _, lens_x, lens_y = (part.reshape(x.shape) for part in lens.spline().jets(x.ravel(), y.ravel())[:3])
    along, across = rms((right - here) / SHIFT_MM - lens_x), rms((above - here) / SHIFT_MM - lens_y)
    between = np.diff(here, axis=1)[:-1] / CELL_MM, np.diff(here, axis=0)[:, :-1] / CELL_MM
    cells = np.hypot(rms(between[0] - lens_x[:-1, :-1]), rms(between[1] - lens_y[:-1, :-1]))
    return (along, across, float(np.hypot(along, across))), float(cells)


def _left_of(tracks: Tracks, corner: np.ndarray, side: float) -> np.ndarray:
    """(n, n) heights of the stock left at the centres of cells from that corner on."""
    n = round(side / CELL_MM)
    block = StockGrid(x0_mm=corner[0], y0_mm=corner[1], cell_mm=CELL_MM, top_mm=np.full((n, n), 1.0))
    grid = RemovalGrid(block, radius_mm=tracks.radius_mm)
    for first, last in _runs(tracks.joined):
        grid.cut(_batch(tracks.tips_mm[first - 1 : last]))
    return grid.top_mm


def _batch(tips: np.ndarray) -> MoveBatch:
    count = len(tips) - 1
    return MoveBatch(
        points_mm=np.ascontiguousarray(tips),
        is_rapid=np.zeros(count, dtype=np.bool_),
        feed_mm_per_min=np.ones(count),
        line=np.arange(1, count + 1),
        spindle_rpm=np.full(count, 1e4),
        pause_s=np.full(count, -1.0),
        lines_read=count,
        bytes_read=count,
        ended=False,
    )


def _runs(wanted: np.ndarray) -> Iterator[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wanted, [False]]).astype(int)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
