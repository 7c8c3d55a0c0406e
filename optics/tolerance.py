"""The effect of an inexact set-up on the picture: wall too near or far, tilted light, a source with a size.

Everything is simulated with the lens as it is, against the same target. A shift of the whole picture is reported and
then removed: a person moves the frame on the wall, not the lens. Light from a disc is simulated as light from its
middle, spread on the wall over the disc that the source makes of a point: within some tenths of a dB of many beams, at
the cost of one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter, shift

from optics.bench import Bench
from optics.caustic import Caustic, simulate_caustic
from optics.convolution import convolve_same
from optics.heightfield import Heightfield
from optics.light import SUN_DEG, Beam, disc_points, leave, meet
from optics.metrics import psnr_db
from optics.spline import Array

FOCUS_SHARES = (-0.02, -0.01, -0.005, 0.0, 0.005, 0.01, 0.02)  # of the throw
TILTS_DEG = (0.25, 0.5, 1.0, 2.0)
SOURCES_DEG = (0.1, 0.25, SUN_DEG, 1.0)
FOCUS_LOSS_DB = 3.0
_WIDEST = 0.2  # of the throw: no depth of focus is claimed beyond
_RAYS = 96  # along a side, for the picture's shift
_BLURS = (3.0, 1.5, 0.75, 0.75)  # pixels: from a rough to an exact search of the picture's place
_FINE = 2  # blurred in half pixels: whole pixels, each evenly lit, would add a blur of their own
# Tubes along a side of a cell. Fewer than 4 miss a part of the error, which is the same near focus: it is added from
# the middle's simulation.
_TUBES, _TUBES_COARSE = 2, 1
_BEAMS = 8  # two colours of a changed set-up's light; their error near focus is added from the middle's
_WALL_STEPS = 4
_NEAR, _NEAR_DEG = 0.005, 0.5  # of the throw, and tilt: still near focus, where coarse simulations are within 0.35 dB


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FocusPoint:
    """The wall stands offset_mm further than the lens was made for (negative: nearer)."""

    offset_mm: float
    psnr_db: float
    irradiance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TiltPoint:
    """Light tilted by tilt_deg in x moves the picture by shift_mm (x, y); scores are those without the shift."""

    tilt_deg: float
    shift_mm: tuple[float, float]
    psnr_db: float
    irradiance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlurPoint:
    """A source that appears size_deg wide from the lens, in place of the bench's: each point is a disc of
    diameter_mm.
    """

    size_deg: float
    diameter_mm: float
    diameter_px: float
    psnr_db: float
    irradiance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IndexPoint:
    """The block's index is higher by more_index: the picture with the wall in place, and with it moved by wall_mm,
    farther away counting up. For a lower index the same holds the other way round.
    """

    more_index: float
    psnr_db: float
    wall_mm: float
    psnr_db_moved: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tolerances:
    """focus ascends from near to far, with the design's own throw among it; tilts and sources ascend.

    index          : for the greatest index that the block may have; None if that is not known
    focus_range_mm : offsets of the wall, near (negative) and far, at which FOCUS_LOSS_DB of the picture are lost
    blur_mm, _px   : diameter of the disc that the bench's own light makes of a point; 0 for light without size
    """

    psnr_db: float
    focus: tuple[FocusPoint, ...]
    focus_range_mm: tuple[float, float]
    tilts: tuple[TiltPoint, ...]
    sources: tuple[BlurPoint, ...]
    blur_mm: float
    blur_px: float
    index: IndexPoint | None = None


def without_size(bench: Bench) -> Bench:
    """Return the bench with light only from the middle of its source."""
    return replace(bench, light=replace(bench.light, middle_only=True))


def sharp_light(heightfield: Heightfield, bench: Bench, shape: tuple[int, int]) -> Caustic:
    """Return the light without size in focus, in pixels half as wide as those of a picture of that shape."""
    ny, nx = shape
    return simulate_caustic(heightfield, without_size(bench), pixels=(_FINE * ny, _FINE * nx))


def in_pixels(sharp: Array) -> Array:
    """Return `sharp_light` in pixels of the picture."""
    ny, nx = (side // _FINE for side in sharp.shape)
    return np.asarray(sharp.reshape(ny, _FINE, nx, _FINE).mean(axis=(1, 3)))


def lens_tolerances(
    heightfield: Heightfield,
    bench: Bench,
    target: Array,
    *,
    sharp: Array | None = None,
    index_spread: float | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Tolerances:
    """Return tolerances of a lens for `target` (ny, nx), work frame, mean 1, by 19 simulations.

    sharp        : irradiance of `sharp_light`, if it is known
    index_spread : how far the block's index may be off; None: not known
    """
    report = on_progress or (lambda share: None)
    if sharp is None:
        sharp = sharp_light(heightfield, bench, (target.shape[0], target.shape[1])).irradiance
    view = _View(heightfield, bench, target, sharp, report)
    middle = view.middle
    focus = tuple(middle if share == 0.0 else view.compute_focus_point(share) for share in FOCUS_SHARES)
    near = view.depth_of_focus([p for p in focus if p.offset_mm < 0][::-1], middle)
    far = view.depth_of_focus([p for p in focus if p.offset_mm > 0], middle)
    tilts = tuple(view.compute_tilt_point(tilt) for tilt in TILTS_DEG)
    sources = tuple(view.compute_blur_point(size, sharp) for size in SOURCES_DEG)
    index = None if index_spread is None or bench.mirror else view.compute_index_point(index_spread)
    blur = blur_mm(heightfield, bench, source_rad(heightfield, bench))
    return Tolerances(
        psnr_db=middle.psnr_db,
        focus=focus,
        focus_range_mm=(near, far),
        tilts=tilts,
        sources=sources,
        index=index,
        blur_mm=blur,
        blur_px=blur * target.shape[1] / bench.screen.width_mm,
    )


def source_rad(heightfield: Heightfield, bench: Bench) -> float:
    """Return the angular diameter of the bench's light, in air, as the lens sees it: glass is as long as thickness / n
    of air.
    """
    before = float(heightfield.z_mm.mean()) + bench.thickness_mm
    return bench.light.width_rad(glass_mm=0.0 if bench.mirror else before / bench.refractive_index)


def blur_mm(heightfield: Heightfield, bench: Bench, size_rad: float) -> float:
    """Return the diameter of a point's image on the wall from a source of that angular diameter: size x distance.

    The flat face divides the angles between beams by n, and the surface multiplies them by n, so near the axis the
    index cancels. The distance is measured from the surface's mean height.
    """
    return size_rad * (bench.throw_mm - float(heightfield.z_mm.mean()))


class _View:
    """One lens under changed conditions, in the light of its bench."""

    def __init__(
        self, lens: Heightfield, bench: Bench, target: Array, sharp: Array, report: Callable[[float], None]
    ) -> None:
        self._lens, self._target, self._report = lens, target, report
        self._bench = without_size(bench)
        self._blur_mm = blur_mm(lens, bench, source_rad(lens, bench))
        self._aims = _blur_pictures(target)
        self._done = 0
        light = in_pixels(sharp) if self._blur_mm == 0 else self._spread(sharp, self._blur_mm)
        self.middle = FocusPoint(offset_mm=0.0, psnr_db=psnr_db(light, target), irradiance=light)
        self._missed = _error(light, target) - _error(self._simulate(self._bench, _TUBES), target)

    def _simulate(self, bench: Bench, tubes: int) -> Array:
        fine = 1 if self._blur_mm == 0 else _FINE
        ny, nx = self._target.shape
        light = simulate_caustic(
            self._lens, bench, pixels=(fine * ny, fine * nx), tubes_per_cell=tubes, beams=_BEAMS
        ).irradiance
        self._done += 1
        self._report(self._done / (len(FOCUS_SHARES) + 2 + 2 * len(TILTS_DEG)))
        return light if self._blur_mm == 0 else self._spread(light, self._blur_mm)

    def _evaluate(self, bench: Bench, tubes: int) -> tuple[float, Array]:
        light = self._simulate(bench, tubes)
        error = _error(light, self._target)
        if tubes == _TUBES:
            error = max(error + self._missed, error / 2)
        return self._psnr_db(error), light

    def _spread(self, sharp: Array, diameter_mm: float) -> Array:
        """Return the picture `sharp` from a source with a size, in fine pixels: each point spread over a disc."""
        (ny, nx), screen = self._target.shape, self._bench.screen
        fine_x, fine_y = _FINE * nx / screen.width_mm, _FINE * ny / screen.height_mm
        return in_pixels(convolve_same(sharp, disc_kernel(diameter_mm * fine_x, diameter_mm * fine_y)))

    def compute_focus_point(self, share: float) -> FocusPoint:
        offset = share * self._bench.throw_mm
        moved = replace(self._bench, throw_mm=self._bench.throw_mm + offset)
        psnr, light = self._evaluate(moved, _TUBES if abs(share) <= _NEAR else _TUBES_COARSE)
        return FocusPoint(offset_mm=offset, psnr_db=psnr, irradiance=light)

    def depth_of_focus(self, side: Sequence[FocusPoint], middle: FocusPoint) -> float:
        """Return the offset on one side, from points that move away from focus, where FOCUS_LOSS_DB are lost.

        The mean square error that defocus adds grows as a power of the offset. One more simulation, at the offset that
        the points suggest, refines it.
        """
        least = self._error_of(middle.psnr_db)
        allowed = least * (10 ** (FOCUS_LOSS_DB / 10) - 1)
        added = [(abs(p.offset_mm), self._error_of(p.psnr_db) - least) for p in side]
        sign = math.copysign(1.0, side[0].offset_mm)
        first = self._find_offset(added, allowed)
        psnr, _ = self._evaluate(replace(self._bench, throw_mm=self._bench.throw_mm + sign * first), _TUBES)
        found = self._find_offset([*added, (first, self._error_of(psnr) - least)], allowed)
        return sign * found

    def _error_of(self, psnr: float) -> float:
        return float(self._target.max() ** 2 * 10 ** (-psnr / 10))

    def _psnr_db(self, error: float) -> float:
        return 10 * math.log10(float(self._target.max()) ** 2 / max(error, 1e-300))

    def _find_offset(self, added: list[tuple[float, float]], allowed: float) -> float:
        """Return the offset at which the added error is `allowed`: a power law through the two points next to it."""
        points = sorted((offset, error) for offset, error in added if error > 0)
        widest = _WIDEST * self._bench.throw_mm
        if not points:
            return widest
        if len(points) == 1 or points[0][1] >= allowed:
            offset, error = points[0]
            return min(offset * math.sqrt(allowed / error), widest)
        above = next((k for k, (_, error) in enumerate(points) if error >= allowed), len(points) - 1)
        (a, low), (b, high) = points[max(above - 1, 0)], points[max(above, 1)]
        power = math.log(high / low) / math.log(b / a) if high > low and b > a else 2.0
        return min(a * (allowed / low) ** (1 / max(power, 0.25)), widest)

    def compute_tilt_point(self, tilt_deg: float) -> TiltPoint:
        """Simulate a tilt. The shift is first the mean over rays, then the best one for the picture, because tilted
        light distorts it.
        """
        light, screen, (ny, nx) = self._bench.light, self._bench.screen, self._target.shape
        tilt_x, tilt_y = light.tilt_rad
        tilted = replace(self._bench, light=replace(light, tilt_rad=(tilt_x + math.radians(tilt_deg), tilt_y)))
        by_x, by_y = picture_shift_mm(self._lens, self._bench, tilted)
        _, seen = self._evaluate(_move_bench(tilted, by_x, by_y), _TUBES_COARSE)
        more_x, more_y = _shift_to(self._aims, seen)
        by_x, by_y = by_x + more_x * screen.width_mm / nx, by_y + more_y * screen.height_mm / ny
        psnr, seen = self._evaluate(_move_bench(tilted, by_x, by_y), _TUBES if tilt_deg <= _NEAR_DEG else _TUBES_COARSE)
        return TiltPoint(tilt_deg=tilt_deg, shift_mm=(by_x, by_y), psnr_db=psnr, irradiance=seen)

    def compute_index_point(self, more_index: float) -> IndexPoint:
        off = replace(self._bench, refractive_index=self._bench.refractive_index + more_index)
        wall_mm = wall_for_index_mm(self._lens, self._bench, more_index)
        psnr, moved = (
            self._evaluate(replace(off, throw_mm=off.throw_mm + by_mm), _TUBES)[0] for by_mm in (0.0, wall_mm)
        )
        return IndexPoint(more_index=more_index, psnr_db=psnr, wall_mm=wall_mm, psnr_db_moved=moved)

    def compute_blur_point(self, size_deg: float, sharp: Array) -> BlurPoint:
        diameter = blur_mm(self._lens, self._bench, math.radians(size_deg))
        light = self._spread(sharp, diameter)
        return BlurPoint(
            size_deg=size_deg,
            diameter_mm=diameter,
            diameter_px=diameter * self._target.shape[1] / self._bench.screen.width_mm,
            psnr_db=psnr_db(light, self._target),
            irradiance=light,
        )


def _error(light: Array, target: Array) -> float:
    return float(np.mean((light - target) ** 2))


def _move_bench(bench: Bench, by_x: float, by_y: float) -> Bench:
    screen = bench.screen
    return replace(
        bench, screen=replace(screen, centre_x_mm=screen.centre_x_mm + by_x, centre_y_mm=screen.centre_y_mm + by_y)
    )


def disc_kernel(across: float, along: float, *, points: int = 1024) -> Array:
    """Return the weights of a disc (an ellipse of those diameters in pixels), of sum 1.

    Each point of the disc shifts the picture by a part of a pixel, and so shares it among four.
    """
    x, y = (disc_points(points) * (across / 2, along / 2)).T
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    half_x, half_y = int(np.abs(i).max()) + 1, int(np.abs(j).max()) + 1
    kernel = np.zeros((2 * half_y + 1, 2 * half_x + 1))
    for down in (0, 1):
        for right in (0, 1):
            weight = np.abs(1 - right - (x - i)) * np.abs(1 - down - (y - j))
            np.add.at(kernel, (j + down + half_y, i + right + half_x), weight)
    return kernel / points


def _blur_pictures(target: Array) -> list[Array]:
    return [gaussian_filter(target, sigma) for sigma in _BLURS]


def _shift_to(aims: Sequence[Array], seen: Array) -> tuple[float, float]:
    """Return the shift (x, y) [px] of a picture from the target, whose blurred pictures these are, by Gauss-Newton."""
    found = np.zeros(2)
    for sigma, aim in zip(_BLURS, aims, strict=True):
        given = gaussian_filter(seen, sigma)
        moved = shift(given, (-found[1], -found[0]), order=1, mode="nearest")
        slope_y, slope_x = np.gradient(moved)
        slopes = np.stack([slope_x.ravel(), slope_y.ravel()], axis=1)
        step = np.linalg.pinv(slopes.T @ slopes) @ (slopes.T @ (aim - moved).ravel())
        found += np.clip(step, -1.0, 1.0)
    return float(found[0]), float(found[1])


def picture_shift_mm(heightfield: Heightfield, bench: Bench, changed: Bench) -> tuple[float, float]:
    """Return how far the picture moves as a whole from one bench to the other: the mean over rays through the lens."""
    jets, x, y = _rays_through(heightfield)
    before, after = (_arrivals(jets, x, y, one.beam(), one.throw_mm) for one in (bench, changed))
    moved = np.nanmean(after - before, axis=1)
    return float(moved[0]), float(moved[1])


def wall_for_index_mm(heightfield: Heightfield, bench: Bench, more_index: float) -> float:
    """Return how much farther the wall must stand if the block's index is higher by that much (negative: nearer).

    Computed from rays through the lens: at that distance they arrive as near to their intended points as possible,
    apart from a shift of the whole picture.
    """
    jets, x, y = _rays_through(heightfield)
    meant = _arrivals(jets, x, y, bench.beam(), bench.throw_mm)
    off, wall_mm = replace(bench, refractive_index=bench.refractive_index + more_index).beam(), 0.0
    for _ in range(_WALL_STEPS):
        here, beyond = (_arrivals(jets, x, y, off, bench.throw_mm + wall_mm + step) for step in (0.0, 1.0))
        along, missed = (one - np.nanmean(one, axis=1, keepdims=True) for one in (beyond - here, meant - here))
        steepness = float(np.nansum(along**2))
        wall_mm += float(np.nansum(along * missed)) / steepness if steepness > 0.0 else 0.0
    return wall_mm


def _rays_through(heightfield: Heightfield) -> tuple[Array, Array, Array]:
    """Return the surface's (6, n) jets, and x and y (n,), at points evenly over the lens."""
    along = (np.arange(_RAYS) + 0.5) / _RAYS
    x, y = np.meshgrid(
        heightfield.x_mm[0] + along * heightfield.width_mm, heightfield.y_mm[0] + along * heightfield.height_mm
    )
    return heightfield.spline().jets(x, y).reshape(6, -1), x.ravel(), y.ravel()


@njit(cache=True, nogil=True)
def _arrivals(jets: Array, x: Array, y: Array, beam: Beam, throw: float) -> Array:
    """Return (2, n) the points where rays through surface points meet the plane of the screen [mm]; NaN: reflected."""
    out = np.empty((2, x.size))
    for k in range(x.size):
        dx, dy, dz, _, _, _ = meet(beam, x[k], y[k], jets[0, k])
        tx, ty, tz = leave(dx, dy, dz, jets[1, k], jets[2, k], beam.refractive_index, beam.is_mirror)
        out[0, k] = x[k] + (throw - jets[0, k]) / tz * tx
        out[1, k] = y[k] + (throw - jets[0, k]) / tz * ty
    return out
