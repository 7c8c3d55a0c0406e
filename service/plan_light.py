"""What lenses show as milled, as far as it can be known before a program is written: the planner's eyes.

Each lens is designed, or closed, for its ball and lit once. Facets of a milled surface are much smaller than a pixel:
each patch sends its light over all their slopes, and the picture is that of the perfect lens convolved with where they
send it, darker at its edges, with the stripes of rows that are off in height. Lenses are designed on a coarser picture:
what they miss of it is taken over, fine detail as the target has it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from math import hypot, sqrt

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter1d

from cam.pass_time import LensForm
from cam.passes import PassSpec
from cam.row_slopes import RowSlopes, chord_grain, row_grain
from optics.ball_fit import ball_fits
from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.closing import closed_to_radius
from optics.design import design_lens
from optics.foreseen import sharpened
from optics.heightfield import Array, Heightfield
from optics.metrics import CausticScore, score_caustic
from optics.settings import LensSettings
from service.resampling import Span, resampling_weights

COARSE = 256  # pixels along the longer side of the picture that lenses are designed for here
_DIRECTIONS = 16
_TUBES, _BEAMS = 2, 7
_SEED, _GRAIN_PIXELS = 20140301, 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """A lens for one ball: its form, and the waves (ny, nx) of the picture that it would show unmilled."""

    form: LensForm
    waves: Array


class PictureLight:
    """Pictures and scores of milled lenses; `cam.planner.Light`.

    aims : a lens can still be made sharper for the blur of its milling
    """

    def __init__(self, target: Array, bench: Bench, *, aims: bool = False) -> None:
        self.target, self.bench, self.aims = target, bench, aims
        self._waves = dctn(target, norm="ortho")
        self._peak = float(target.max())
        ny, nx = target.shape
        self.pixel_mm = (bench.screen.height_mm / ny, bench.screen.width_mm / nx)
        self._along_y, self._along_x = (
            np.arange(count) / (2 * count * size) for count, size in zip((ny, nx), self.pixel_mm, strict=True)
        )
        self.lenses: dict[float, Shown] = {}

    @property
    def forms(self) -> dict[float, LensForm]:
        return {radius: shown.form for radius, shown in self.lenses.items()}

    def add(self, radius_mm: float, form: LensForm, missed: Array) -> None:
        """A lens for a ball; missed: its light less the target, at any size."""
        error = _resized(missed, self.target.shape)
        self.lenses[radius_mm] = Shown(form=form, waves=self._waves + dctn(error, norm="ortho"))

    def same(self, radius_mm: float, as_of_mm: float) -> None:
        """The lens for another ball serves this one as well."""
        self.lenses[radius_mm] = self.lenses[as_of_mm]

    def reach_mm(self, form: LensForm) -> float:
        """How far aside a slope error sends light on the screen, per unit of slope."""
        drop_mm = self.bench.throw_mm - float(form.heights_mm.mean())
        return drop_mm * (2.0 if self.bench.mirror else self.bench.refractive_index - 1.0)

    def blur_mm(self, slopes: RowSlopes) -> float:
        form = next(iter(self.lenses.values())).form
        return self.reach_mm(form) * sqrt(slopes.across.rms**2 + slopes.along.rms**2)

    def psnr_db(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> float:
        shown = self.lenses[radius_mm]
        return self._psnr_db(self._milled(shown, shown.waves, slopes, spec), self.grain(radius_mm, slopes, spec))

    def aimed_db(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> float:
        return self._psnr_db(self._aimed(radius_mm, slopes, spec), self.grain(radius_mm, slopes, spec))

    def perfect_db(self, radius_mm: float) -> float:
        """What the lens for a ball would show without any mark of the tool."""
        return self._psnr_db(idctn(self.lenses[radius_mm].waves, norm="ortho"), 0.0)

    def grain(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> float:
        """Standard deviation of the light of a pixel over its mean: rows off in height, chords off in slope."""
        pixel_y_mm, pixel_x_mm = self.pixel_mm
        across_mm, along_mm = (pixel_y_mm, pixel_x_mm) if spec.direction == "x" else (pixel_x_mm, pixel_y_mm)
        reach_mm = round(self.reach_mm(self.lenses[radius_mm].form), 1)
        rows = row_grain(radius_mm, spec.pitch_mm, slopes.off_mm, reach_mm, across_mm)
        return hypot(rows, chord_grain(slopes, radius_mm=radius_mm, reach_mm=reach_mm, pixel_mm=along_mm))

    def picture(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> Array:
        """Irradiance (ny, nx) on the screen, work frame, mean 1; its grain drawn by lot, longer along the rows."""
        smooth = np.maximum(self._aimed(radius_mm, slopes, spec), 0.0)
        lot = np.random.default_rng(_SEED).standard_normal(smooth.shape)
        lot = gaussian_filter1d(lot, _GRAIN_PIXELS, axis=1 if spec.direction == "x" else 0)
        return np.asarray(smooth * np.maximum(1.0 + self.grain(radius_mm, slopes, spec) * lot / lot.std(), 0.0))

    def foreseen_blur_mm(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> tuple[float, float]:
        """(x, y) standard deviations that the lens may be made sharper for; nothing for a lens that exists."""
        if not self.aims:
            return 0.0, 0.0
        form = self.lenses[radius_mm].form
        across, along = (self.reach_mm(form) * spread.rms for spread in (slopes.across, slopes.along))
        if spec.strategy == "contour":
            share_x = float((np.cos(form.turns_rad) ** 2).mean())
            return sqrt(share_x) * across, sqrt(1 - share_x) * across
        return (along, across) if spec.direction == "x" else (across, along)

    def _aimed(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> Array:
        """The picture of the lens for that ball, made sharper and then milled, without grain."""
        shown = self.lenses[radius_mm]
        blur_x_mm, blur_y_mm = self.foreseen_blur_mm(radius_mm, slopes, spec)
        waves = shown.waves
        if self.aims:
            aim = sharpened(self.target, (blur_y_mm / self.pixel_mm[0], blur_x_mm / self.pixel_mm[1]))
            waves = waves + dctn(aim - self.target, norm="ortho")
        return self._milled(shown, waves, slopes, spec)

    def _milled(self, shown: Shown, waves: Array, slopes: RowSlopes, spec: PassSpec) -> Array:
        """Blurred; a cosine transform mirrors what lies beyond the edges, where in truth it is dark."""
        reach_mm, contour = self.reach_mm(shown.form), spec.strategy == "contour"
        over_y, over_x = (slopes.along, slopes.across) if spec.direction == "y" else (slopes.across, slopes.along)
        over_x = slopes.across if contour else over_x
        edges = [
            spread.kept_inside((np.arange(count) + 0.5) * pixel_mm, count * pixel_mm, reach_mm)
            for spread, count, pixel_mm in zip((over_y, over_x), waves.shape, self.pixel_mm, strict=True)
        ]
        blurred = idctn(self._kept(shown.form, slopes, spec) * waves, norm="ortho")
        return np.asarray(blurred * edges[0][:, None] * edges[1][None, :])

    def score(self, picture: Array) -> CausticScore:
        return score_caustic(picture, self.target)

    def _psnr_db(self, picture: Array, grain: float) -> float:
        error = float(np.square(picture - self.target).mean()) + grain**2 * float(np.square(picture).mean())
        return float(10 * np.log10(self._peak**2 / max(error, 1e-300)))

    def _kept(self, form: LensForm, slopes: RowSlopes, spec: PassSpec) -> Array:
        """What is left of each wave (ny, nx)."""
        reach = self.reach_mm(form)
        if spec.strategy == "contour":
            return self._kept_by_contours(form, slopes, reach)
        over_y, over_x = (slopes.across, slopes.along) if spec.direction == "x" else (slopes.along, slopes.across)
        return over_y.transfer(self._along_y, reach)[:, None] * over_x.transfer(self._along_x, reach)[None, :]

    def _kept_by_contours(self, form: LensForm, slopes: RowSlopes, reach: float) -> Array:
        """Rows run along the contour lines, so across them is the gradient's direction, which all places share out."""
        edges = np.linspace(0.0, np.pi, _DIRECTIONS + 1)
        share = np.histogram(np.mod(form.turns_rad, np.pi), edges)[0] / form.turns_rad.size
        most = float(np.hypot(self._along_x[-1], self._along_y[-1]))
        waves = np.linspace(0.0, most, 512)
        across = slopes.across.transfer(waves, reach)
        kept = np.zeros((self._along_y.size, self._along_x.size))
        for turn, part in zip((edges[:-1] + edges[1:]) / 2, share, strict=True):
            for way in (1.0, -1.0):  # a cosine transform knows no sign of a wave
                along = self._along_x[None, :] * np.cos(turn) + way * self._along_y[:, None] * np.sin(turn)
                kept += part / 2 * np.interp(np.abs(along), waves, across)
        return kept


def lit_designs(
    target: Array,
    settings: LensSettings,
    radii_mm: Iterable[float],
    *,
    as_given: bool = False,
    aims: bool = True,
    on_progress: Callable[[float], None] | None = None,
) -> PictureLight:
    """A lens designed for each ball, largest first: where nothing is to be filled, smaller balls have the same one.

    as_given : the settings alone shape the lens, and each ball leaves of it what it can
    aims     : each lens is to be made sharper by what milling will blur
    """
    coarse = _coarser(target)
    quick = replace(settings, method="transport", polish_steps=0, corrections=min(1, settings.corrections))
    light = PictureLight(target, settings.bench, aims=aims)
    if as_given:
        _add_as_left(light, design_lens(coarse, quick).heightfield, coarse, radii_mm, on_progress)
        return light
    wanted = sorted(set(radii_mm), reverse=True)
    served: float | None = None
    for number, radius_mm in enumerate(wanted, 1):
        if served is not None:
            light.same(radius_mm, served)
            continue
        design = design_lens(coarse, replace(quick, min_radius_mm=radius_mm))
        lens = design.heightfield
        light.add(radius_mm, LensForm.of(lens), _light_of(lens, settings.bench, coarse) - coarse)
        if design.closing is None:
            served = radius_mm
        if on_progress is not None:
            on_progress(number / len(wanted))
    return light


def lit_lens(
    lens: Heightfield,
    target: Array,
    bench: Bench,
    radii_mm: Iterable[float],
    *,
    on_progress: Callable[[float], None] | None = None,
) -> PictureLight:
    """An existing lens as each ball leaves it: valleys that are tighter stay filled."""
    light = PictureLight(target, bench)
    _add_as_left(light, lens, target, radii_mm, on_progress)
    return light


def _add_as_left(
    light: PictureLight,
    lens: Heightfield,
    target: Array,
    radii_mm: Iterable[float],
    on_progress: Callable[[float], None] | None,
) -> None:
    form, served = LensForm.of(lens), None
    wanted = sorted(set(radii_mm))
    for number, radius_mm in enumerate(wanted, 1):
        fits = ball_fits(lens, radius_mm)
        if fits and served is not None:
            light.same(radius_mm, served)
            continue
        left = lens
        if fits:
            served = radius_mm
        else:
            z = closed_to_radius(lens.z_mm, radius_mm=radius_mm, dx_mm=lens.dx_mm, dy_mm=lens.dy_mm)
            left = replace(lens, z_mm=np.minimum(z, 0.0))
        light.add(radius_mm, form, _light_of(left, light.bench, target) - target)
        if on_progress is not None:
            on_progress(number / len(wanted))


def _light_of(lens: Heightfield, bench: Bench, target: Array) -> Array:
    return simulate_caustic(lens, bench, pixels=target.shape, tubes_per_cell=_TUBES, beams=_BEAMS).irradiance


def _coarser(target: Array) -> Array:
    scale = min(1.0, COARSE / max(target.shape))
    shape = (max(4, round(scale * target.shape[0])), max(4, round(scale * target.shape[1])))
    coarse = np.maximum(_resized(target, shape), 0.0)
    return coarse / coarse.mean()


def _resized(picture: Array, shape: tuple[int, ...]) -> Array:
    """Area averages, or cubic where it must be enlarged."""
    if picture.shape == tuple(shape):
        return picture
    down, across = (
        resampling_weights(size, Span(0.0, float(size)), count)
        for size, count in zip(picture.shape, shape, strict=True)
    )
    return np.asarray((across @ (down @ picture).T).T)
