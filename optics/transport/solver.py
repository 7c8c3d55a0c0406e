"""The transport map with exact near-field refraction: one fixed-point iteration on the optical path.

Solves det Dp(q) = g(q) for the optical path c(q) (optical_path.py): each pixel gets its share g = target / mean.
    step      c += scale * (what grid_levels.py makes of the residual)
    piston    c += (n - 1) (-skim - top): the highest point stays skim_mm under Z0
    Anderson  depth 16, least squares on r and the piston together (with r alone, the piston never settles if screen and
    aperture differ); beyond twice the best residual: back to the best with half the step levels    32, 64 .. N pixels,
    cubic prolongation of c
No Jacobian, no line search, no floor under the target (a softer target only if the map folds): black pixels converge
like others. If no iterate sends all light to the screen, a far screen shows whether total reflection is the reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from optics.bench import Bench
from optics.errors import NoSurfaceError, TotalReflectionError
from optics.light import Light, meet
from optics.spline import Array
from optics.transport.anderson import Anderson
from optics.transport.grid_levels import Misses, TransportLevel, average_boxes, level_shapes, prolong
from optics.transport.optical_path import Preimages, flat_path_mm, heights_mm
from optics.transport_map import TransportMap, screen_positions

TOLERANCE = 1e-3  # rms of det - g over the rms of g, at which a level is done
_ANDERSON_DEPTH = 16  # necessary for black logos; 8 and 24 are not quicker
_PISTON_WEIGHT = 3.0  # of the highest point's distance from the skim, in throws, beside the rms of det - g
_TURNED = 7.0  # in tolerances: light that may fall on turned pixels; black ones turn by rounding, others rarely
_FOLDED = 0.02  # share of light on turned pixels above which a lens must not be made
_SOFTER = ((0.0, 0.0), (0.01, 1.0), (0.03, 3.0), (0.1, 10.0), (1.0, 0.0))  # (floor, blur), tried in turn
_MOST_ITERATIONS, _MOST_COARSE = 300, 100  # of the finest level, of each of the others
_STALE = 60  # iterations without 2 % of progress: stopped
_BLOW_UP = 2.0  # a residual this many times the best: restart
_SAFE = 0.6  # of the tangent of the largest deflection: relief and the pixels' own slopes need the rest
_FARTHEST = 1e6  # largest throw tried, in screens


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelRecord:
    """The record of one grid level: pixels across, iterations, and the errors of the best iterate.

    rms    : of det - g, over the rms of g
    turned : share of the light on pixels whose pre-image has turned over (a fold)
    """

    pixels: int
    iterations: int
    rms: float
    turned: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpticalPath:
    """The solution on the screen's pixels, the basis of warm starts and of lens heights."""

    bench: Bench
    path_mm: Array  # (ny, nx)
    levels: tuple[LevelRecord, ...]
    converged: bool
    floor: float = 0.0  # share of even light added to the aim, and its blur, without which the lens would have folded
    blur_pixels: float = 0.0

    def transport_map(self) -> TransportMap:
        """Return pixel corners and the lens points that light them."""
        ny, nx = self.path_mm.shape
        px, py = Preimages(self.bench, self.path_mm.shape).corners(self.path_mm)
        s = self.bench.screen
        qx, qy = np.meshgrid(
            s.left_mm + np.arange(nx + 1) * s.width_mm / nx, s.bottom_mm + np.arange(ny + 1) * s.height_mm / ny
        )
        return TransportMap(screen_mm=np.stack([qx, qy], axis=-1), lens_mm=np.stack([px, py], axis=-1))

    def heights_mm(self, x_mm: Array, y_mm: Array) -> Array:
        """Return (ny, nx) of the surface over x (nx,), y (ny,): the map inverted, then heights in closed form."""
        corners = self.transport_map().lens_mm
        u, v = screen_positions(corners[..., 0], corners[..., 1], x_mm, y_mm)
        return heights_mm(self.path_mm, u, v, x_mm, y_mm, self.bench)


def solve_transport(
    target: Array,
    bench: Bench,
    *,
    skim_mm: float,
    start: OpticalPath | None = None,
    tolerance: float = TOLERANCE,
    on_progress: Callable[[float], None] | None = None,
) -> OpticalPath:
    """Return the optical path whose refraction gives each pixel its share of the light.

    target      : (ny, nx) irradiance in the work frame, mean 1 (any mean is scaled)
    skim_mm     : depth of the lens's highest point under Z0
    start       : an earlier solution on the same grid, for a warm start without the coarse levels
    tolerance   : rms of det - g over that of g, with folds and the skim's share, at which a level is done
    returns converged = False, with its history, where the finest level stopped early; for a picture that folds, the
    first of its softer versions that does not (for a warm start that folds, the start) raises TotalReflectionError if
    the throw is too short for the way the light must go, NoSurfaceError if no iterate sent all light to the screen for
    another reason
    """
    g = target / target.mean()
    report = on_progress or (lambda share: None)
    if start is not None:
        path = _solve_levels(g, bench, skim_mm, start, tolerance, report)
        return path if path.levels[-1].turned <= _FOLDED else replace(start, levels=path.levels, converged=False)
    for floor, blur_pixels in _SOFTER:
        aim = (1.0 - floor) * (gaussian_filter(g, blur_pixels, mode="reflect") if blur_pixels > 0 else g) + floor
        path = _solve_levels(aim, bench, skim_mm, None, tolerance, report)
        if path.levels[-1].turned <= _FOLDED:
            break
    if not math.isfinite(path.levels[-1].rms):
        raise NoSurfaceError(lost_share=1.0)
    return replace(path, floor=floor, blur_pixels=blur_pixels, converged=path.converged and floor == 0.0)


def _solve_levels(
    g: Array,
    bench: Bench,
    skim_mm: float,
    start: OpticalPath | None,
    tolerance: float,
    report: Callable[[float], None],
) -> OpticalPath:
    """Solve from coarse to fine, or on the finest grid alone from a start."""
    records: list[LevelRecord] = []
    shapes = level_shapes(g.shape) if start is None else [g.shape]
    c = flat_path_mm(bench, shapes[0], skim_mm=skim_mm) if start is None else start.path_mm
    reflected = False
    for number, shape in enumerate(shapes, start=1):
        if c.shape != shape:
            c = prolong(c, shape, bench)
        most = _MOST_ITERATIONS if number == len(shapes) else _MOST_COARSE
        c, record, met_reflection = _solve_level(average_boxes(g, shape), c, bench, skim_mm, tolerance, most)
        records.append(record)
        reflected |= met_reflection
        report(4.0 ** (number - len(shapes)))
    converged = max(records[-1].rms, records[-1].turned / _TURNED) <= tolerance
    if reflected and not converged:
        _refuse_too_short_throw(g, bench)
    return OpticalPath(bench=bench, path_mm=c, levels=tuple(records), converged=converged)


def _solve_level(
    g: Array, c: Array, bench: Bench, skim_mm: float, tolerance: float, most: int
) -> tuple[Array, LevelRecord, bool]:
    """Iterate one level; the last value says whether an iterate sent light beyond the critical angle."""
    level, step = TransportLevel(g, bench), 1.0
    memory = Anderson(g.size, _ANDERSON_DEPTH, level.step_type)
    scale = math.sqrt(float(np.mean(g * g)))
    reflected = False
    best, best_rms, best_turned, best_merit = c, math.inf, math.inf, math.inf
    stale, iteration = 0, 0
    for iteration in range(most + 1):
        misses = level.evaluate(c)
        piston = _piston(misses, bench, skim_mm)
        merit = math.hypot(misses.rms / scale, piston / scale, misses.turned / _TURNED)
        if not math.isfinite(merit):
            reflected, merit = True, math.inf
            if best_merit == math.inf:
                break
        stale = 0 if merit < 0.98 * best_merit else stale + 1
        if merit < best_merit:
            best, best_rms, best_turned, best_merit = c, misses.rms / scale, misses.turned, merit
        if merit <= tolerance or iteration == most or stale > _STALE:
            break
        if merit > _BLOW_UP * best_merit:
            step *= 0.5
            memory.forget()
            c = best
            misses = level.evaluate(c)
            piston = _piston(misses, bench, skim_mm)
        moved = c + step * level.step() - level.preimages.path_per_height * (misses.top_mm + skim_mm)
        c = memory.find_next(moved, misses.residual, piston * math.sqrt(g.size))
    record = LevelRecord(pixels=g.shape[1], iterations=iteration, rms=best_rms, turned=best_turned)
    return best, record, reflected


def _piston(misses: Misses, bench: Bench, skim_mm: float) -> float:
    return _PISTON_WEIGHT * (misses.top_mm + skim_mm) / bench.throw_mm


def _refuse_too_short_throw(g: Array, bench: Bench) -> None:
    """Raise TotalReflectionError if the sideways distance of the light stopped the solution.

    That distance hardly depends on the throw, so a coarse solution for a far screen shows it.
    """
    coarse = average_boxes(g, level_shapes(g.shape)[0])
    moved = solve_transport(coarse, move_far_away(bench), skim_mm=0.0, tolerance=1e-2).transport_map()
    refuse_wide_turns(moved.lens_mm, moved.screen_mm, bench)


def move_far_away(bench: Bench) -> Bench:
    """Return the same frames under even light, so far apart that nothing is reflected; the map is almost the same."""
    s = bench.screen
    throw_mm = 20 * max(bench.width_mm, bench.height_mm, s.width_mm, s.height_mm, *map(abs, bench.shift_mm))
    return replace(bench, throw_mm=max(throw_mm, 20 * bench.throw_mm), light=Light(), mirror=False, outline_mm=None)


def refuse_wide_turns(lens_mm: Array, screen_mm: Array, bench: Bench) -> None:
    """Raise TotalReflectionError if light on its way from lens_mm to screen_mm (..., 2) turns too far for the index.

    Light leaves where n d . s > 1, so it turns by at most the angle whose tangent is sqrt(n^2 - 1). Mirrors may turn
    it as far as they like.
    """
    if bench.mirror:
        return
    p, q = lens_mm.reshape(-1, 2), screen_mm.reshape(-1, 2)
    beam = bench.beam()
    before = np.array([meet(beam, x, y, 0.0)[:3] for x, y in p])
    most = math.atan(_SAFE * math.sqrt(bench.refractive_index**2 - 1))

    def turn(throw_mm: float) -> float:
        way = np.concatenate([q - p, np.full((len(p), 1), throw_mm)], axis=1)
        cosine = (way * before).sum(axis=1) / np.linalg.norm(way, axis=1)
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)).max())

    if turn(bench.throw_mm) <= most:
        return
    low, high = bench.throw_mm, _FARTHEST * max(bench.screen.width_mm, bench.screen.height_mm)
    enough = turn(high) <= most
    for _ in range(60 if enough else 0):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if turn(middle) <= most else (middle, high)
    raise TotalReflectionError(
        throw_mm=bench.throw_mm,
        shift_mm=float(np.linalg.norm(q - p, axis=1).max()),
        shortest_throw_mm=high if enough else math.inf,
    )
