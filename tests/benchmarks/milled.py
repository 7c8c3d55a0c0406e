"""The picture as milled: time and memory of the whole part, slopes against brute force, the quick form's error."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator

import numpy as np

from cam.as_milled.noise import Noise
from cam.as_milled.rows import row_tracks, sample_facets, tip_error_mm
from cam.as_milled.surface import CHORDS_PER_PART, MilledSurface
from cam.as_milled.tracks import Tracks
from cam.checking.removal import RemovalGrid
from cam.reading.gcode import MoveBatch
from cam.stock_grid import StockGrid
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.heightfield import Heightfield
from optics.metrics import score_caustic
from optics.milled import simulate_milled
from optics.milled_blur import deviations, predicted_light
from tests.benchmarks.pictures import PAPER_SETTING, target
from tests.benchmarks.timing import Figure

# radius, pitch, step, noise [mm]
CASES = ((0.5, 0.02, 0.0, 0.0), (0.5, 0.02, 0.0, 0.0005), (3.0, 0.1, 0.002, 0.0005))
_WINDOW_MM, _CELL_MM = 0.4, 0.001


def figures(pixels: int = 512) -> Iterator[Figure]:
    goal, bench = target("camera", pixels), PAPER_SETTING.bench
    lens = design_lens(goal, PAPER_SETTING).heightfield
    designed = simulate_caustic(lens, bench, pixels=goal.shape).irradiance
    for radius, pitch, step, noise in CASES:
        name = f"R {radius:g}, pitch {pitch:g}, step {1000 * step:g} um, noise {1000 * noise:g} um"
        plain = row_tracks(lens, radius_mm=radius, pitch_mm=pitch)
        started, cpu = time.perf_counter(), time.process_time()
        tracks = plain.made_by(step_mm=step, noise=Noise(sigma_mm=noise))
        surface = _surface(tracks, lens, pitch, step, noise)
        light = simulate_milled(surface.part, surface.parts, lens, bench, pixels=goal.shape).irradiance
        wall, cpu = time.perf_counter() - started, time.process_time() - cpu
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        score = score_caustic(light, goal)
        found = deviations([surface.part(k) for k in range(0, surface.parts, 25)], lens, bench, goal.shape)
        note = f"{surface.chords.joined.size / 1e6:.1f} M chords, {cpu:.0f} s CPU, peak {peak_mb:.0f} MB so far"
        yield Figure(f"as milled, whole part, {name}", wall, "s", note)
        words = f"SSIM {score.ssim:.3f}, slopes {found.slope_mrad:.1f} mrad, blur {found.blur_px:.2f} px"
        yield Figure(f"camera {pixels} as milled, {name}", score.psnr_db, "dB", words)
        started = time.perf_counter()
        samples = sample_facets(lens, radius_mm=radius, pitch_mm=pitch, step_mm=step, z_noise_mm=noise)
        quick = score_caustic(predicted_light(designed, samples, lens, bench), goal)
        wall = time.perf_counter() - started
        yield Figure(f"quick form less full, {name}", quick.psnr_db - score.psnr_db, "dB", f"{wall:.1f} s")
        mine, brute = _against_brute_force(tracks, surface, lens)
        yield Figure(f"slope rms over brute force, {name}", mine / brute, "", f"{1e3 * brute:.2f} mrad, 1 um cells")


def _surface(tracks: Tracks, lens: Heightfield, pitch: float, step: float, noise: float) -> MilledSurface:
    error, roughness = tip_error_mm(step_mm=step, z_noise_mm=noise), tip_error_mm(step_mm=step)
    return MilledSurface.of_tracks([tracks], lens, pitch_mm=pitch, error_mm=error, roughness_mm=roughness)


def _against_brute_force(tracks: Tracks, surface: MilledSurface, lens: Heightfield) -> tuple[float, float]:
    """rms of slopes added to the lens's, in a window in the middle: of facets, and of stock removed cell by cell.

    The cells' own differences miss the creases by about cell / pitch: the brute force comes out that much too smooth.
    """
    low = np.array([lens.width_mm, lens.height_mm]) / 2
    n = round(_WINDOW_MM / _CELL_MM)
    grid = RemovalGrid(
        StockGrid(x0_mm=low[0], y0_mm=low[1], cell_mm=_CELL_MM, top_mm=np.full((n, n), 1.0)),
        radius_mm=tracks.radius_mm,
    )
    tips = tracks.tips_mm
    near = (np.abs(tips[:, :2] - low - _WINDOW_MM / 2) < _WINDOW_MM + tracks.radius_mm).all(axis=1)
    for first, last in _runs(near & tracks.joined):
        count = last - first
        grid.cut(
            MoveBatch(
                points_mm=np.ascontiguousarray(tips[first - 1 : last]),
                is_rapid=np.zeros(count, dtype=np.bool_),
                feed_mm_per_min=np.ones(count),
                line=np.arange(1, count + 1),
                spindle_on=np.ones(count, dtype=np.bool_),
                pause_s=np.full(count, -1.0),
                lines_read=count,
                bytes_read=count,
                ended=False,
            )
        )
    x = low[0] + (np.arange(n) + 0.5) * _CELL_MM
    y = low[1] + (np.arange(n) + 0.5) * _CELL_MM
    over = grid.top_mm - lens.spline().heights_mm(x[None, :], y[:, None])
    slopes = np.diff(over, axis=0)[:, :-1] / _CELL_MM, np.diff(over, axis=1)[:-1] / _CELL_MM
    brute = float(np.sqrt(np.mean(slopes[0] ** 2 + slopes[1] ** 2)))
    around = (np.abs(surface.chords.tips[:, :2] - low - _WINDOW_MM / 2) < _WINDOW_MM + tracks.radius_mm).all(axis=1)
    facets = [surface.part(k) for k in np.unique(np.flatnonzero(around) // CHORDS_PER_PART).tolist()]
    middles = [part[:, :, :2].mean(axis=1) for part in facets]
    inside = [((middle > low) & (middle < low + _WINDOW_MM)).all(axis=1) for middle in middles]
    chosen = [part[kept] for part, kept in zip(facets, inside, strict=True)]
    return 1e-3 * deviations(chosen, lens, PAPER_SETTING.bench, (512, 512)).slope_mrad, brute


def _runs(wanted: np.ndarray) -> Iterator[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wanted, [False]]).astype(int)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
