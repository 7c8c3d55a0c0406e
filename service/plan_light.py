"""What lenses show as milled, as far as it can be known before a program is written: the planner's eyes.

Each lens is designed, or closed, for its ball and lit once. Facets of a milled surface are much smaller than a pixel:
each patch sends its light over all their slopes, and the picture is that of the perfect lens convolved with where they
send it, darker at its edges, with the stripes of rows that are off in height. Lenses are designed on a coarser picture:
what they miss of it is taken over, fine detail as the target has it.

A first guess of PSNR takes no picture at all: the errors of a picture's waves add up as squares, and rows keep of each
wave a part for X times a part for Y. Lenses of the best are then designed once more, sharpened for their own rows.
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
_SEEN_PIXELS = 0.25  # of blur along the rows; less is not worth sharpening for
_BLOCK = 4  # waves along a side that share what contours keep of them
_SHARPENING = 4.0  # of Landweber's steps, that light without negative places allows on average


Redesign = Callable[[float, Array], tuple[LensForm, Array]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """A lens for one ball: its form, the waves (ny, nx) of the picture that it would show unmilled, were it not
    sharpened, and the PSNR of that picture."""

    form: LensForm
    waves: Array
    perfect_db: float


class PictureLight:
    """Pictures and scores of milled lenses; `cam.planner.Light`.

    aims     : a lens can still be made sharper for the blur of its milling
    redesign : form and missed light of a lens for a ball (mm) that aims at a picture of the target's size
    """

    def __init__(self, target: Array, bench: Bench, *, aims: bool = False, redesign: Redesign | None = None) -> None:
        self.target, self.bench, self.aims, self._redesign = target, bench, aims, redesign
        self._waves = dctn(target, norm="ortho")
        self._peak, self._square = float(target.max()), float(np.square(target).mean())
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
        """A lens for a ball; missed: its light less the picture that it aims at, at any size."""
        error = _resized(missed, self.target.shape)
        shown = Shown(
            form=form,
            waves=self._waves + dctn(error, norm="ortho"),
            perfect_db=self._psnr_db(self.target + error, 0.0),
        )
        self.lenses[radius_mm] = shown

    def same(self, radius_mm: float, as_of_mm: float) -> None:
        """The lens for another ball serves this one as well."""
        self.lenses[radius_mm] = self.lenses[as_of_mm]

    def reach_mm(self, form: LensForm) -> float:
        """How far aside a slope error sends light on the screen, per unit of slope.

        A slope s sends light aside by (n - 1)(s + c s^3) of the way, to third order; its change by 1 + 2 c s^2 times as
        much, the mean of along it and across it.
        """
        drop_mm, n = self.bench.throw_mm - float(form.heights_mm.mean()), self.bench.refractive_index
        cubic = 1.0 if self.bench.mirror else n * (n + 1) / 6 + ((n - 1) ** 2 - 1) / 3
        leaning = 1.0 + 2.0 * cubic * float(np.square(form.slopes).mean())
        return drop_mm * (2.0 if self.bench.mirror else n - 1.0) * leaning

    def blur_mm(self, slopes: RowSlopes) -> float:
        form = next(iter(self.lenses.values())).form
        return self.reach_mm(form) * sqrt(slopes.across.rms**2 + slopes.along.rms**2)

    def psnr_db(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> float:
        """At a guess: as if darkness had no floor, and the picture no place where its edges' darkness matters more."""
        shown, form = self.lenses[radius_mm], self.lenses[radius_mm].form
        grain = self.grain(radius_mm, slopes, spec)
        if spec.strategy == "contour":
            error = self._error_by_contours(shown, slopes)
        else:
            over_y, over_x = (slopes.across, slopes.along) if spec.direction == "x" else (slopes.along, slopes.across)
            kept_y, kept_x = (
                spread.transfer(waves, self.reach_mm(form))
                for spread, waves in ((over_y, self._along_y), (over_x, self._along_x))
            )
            error = self._error_by_rows(shown, kept_y, kept_x)
        return float(10 * np.log10(self._peak**2 / max(error + grain**2 * self._square, 1e-300)))

    def aimed_db(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> float:
        return self._psnr_db(self._aimed(radius_mm, slopes, spec), self.grain(radius_mm, slopes, spec))

    def unsharpened_db(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> float:
        """The same of a lens that aims at the picture itself."""
        shown = self.lenses[radius_mm]
        return self._psnr_db(self._milled(shown, shown.waves, slopes, spec), self.grain(radius_mm, slopes, spec))

    def settle(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> None:
        """Design the lens of a ball once more, sharpened for those rows; nothing where none is sharpened."""
        blur_x_mm, blur_y_mm = self.foreseen_blur_mm(radius_mm, slopes, spec)
        if self._redesign is None or not (blur_x_mm or blur_y_mm):
            return
        aim = sharpened(self.target, (blur_y_mm / self.pixel_mm[0], blur_x_mm / self.pixel_mm[1]))
        before_db = self.lenses[radius_mm].perfect_db
        self.add(radius_mm, *self._redesign(radius_mm, aim))
        self.lenses[radius_mm] = replace(self.lenses[radius_mm], perfect_db=before_db)

    def _error_by_rows(self, shown: Shown, kept_y: Array, kept_x: Array) -> float:
        """Mean square of what the waves lack, of a lens that is sharpened as far as light allows."""
        left = np.outer(kept_y, kept_x)
        lost = 1.0 - left
        if self.aims:
            lost *= np.clip(1.0 - left * left, 0.0, 1.0) ** _SHARPENING
        return float(np.square(lost * self._waves - left * (shown.waves - self._waves)).mean())

    def _error_by_contours(self, shown: Shown, slopes: RowSlopes) -> float:
        """Each place is blurred in a direction of its own: squares of what is left are averaged, not what is left."""
        ny, nx = (count // _BLOCK * _BLOCK for count in self.target.shape)
        along_y, along_x = self._along_y[:ny:_BLOCK], self._along_x[:nx:_BLOCK]
        kept, squared = _kept_by_contours(shown.form, slopes, self.reach_mm(shown.form), along_y, along_x)

        def blocks(values: Array) -> Array:
            return np.asarray(values[:ny, :nx].reshape(ny // _BLOCK, _BLOCK, nx // _BLOCK, _BLOCK).sum(axis=(1, 3)))

        own, cross, goal = shown.waves**2, shown.waves * self._waves, self._waves**2
        error = (squared * blocks(own) - 2 * kept * blocks(cross)).sum() + goal.sum()
        return float(max(error, 0.0)) / self.target.size

    def perfect_db(self, radius_mm: float) -> float:
        """What the lens for a ball would show without any mark of the tool."""
        return self.lenses[radius_mm].perfect_db

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
        """(x, y) standard deviations that the lens may be made sharper for; nothing for a lens that exists,
        nor where contours blur each place in a direction of its own.
        """
        if not self.aims or spec.strategy == "contour":
            return 0.0, 0.0
        form = self.lenses[radius_mm].form
        across, along = (self.reach_mm(form) * spread.rms for spread in (slopes.across, slopes.along))
        along = along if along > _SEEN_PIXELS * min(self.pixel_mm) else 0.0
        return (along, across) if spec.direction == "x" else (across, along)

    def _aimed(self, radius_mm: float, slopes: RowSlopes, spec: PassSpec) -> Array:
        """The picture of the lens for that ball, made sharper and then milled, without grain."""
        shown = self.lenses[radius_mm]
        blur_x_mm, blur_y_mm = self.foreseen_blur_mm(radius_mm, slopes, spec)
        waves = shown.waves
        if blur_x_mm or blur_y_mm:
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
            return _kept_by_contours(form, slopes, reach, self._along_y, self._along_x)[0]
        over_y, over_x = (slopes.across, slopes.along) if spec.direction == "x" else (slopes.along, slopes.across)
        return over_y.transfer(self._along_y, reach)[:, None] * over_x.transfer(self._along_x, reach)[None, :]


def _kept_by_contours(
    form: LensForm, slopes: RowSlopes, reach: float, along_y: Array, along_x: Array
) -> tuple[Array, Array]:
    """What is left of each wave (ny, nx), and of its square: rows run along the contour lines, so across them is the
    gradient's direction, which all places share out.
    """
    edges = np.linspace(0.0, np.pi, _DIRECTIONS + 1)
    share = np.histogram(np.mod(form.turns_rad, np.pi), edges)[0] / form.turns_rad.size
    waves = np.linspace(0.0, float(np.hypot(along_x[-1], along_y[-1])), 512)
    across = slopes.across.transfer(waves, reach)
    kept, squared = np.zeros((2, along_y.size, along_x.size))
    for turn, part in zip((edges[:-1] + edges[1:]) / 2, share, strict=True):
        for way in (1.0, -1.0):  # a cosine transform knows no sign of a wave
            along = along_x[None, :] * np.cos(turn) + way * along_y[:, None] * np.sin(turn)
            left = np.interp(np.abs(along), waves, across)
            kept += part / 2 * left
            squared += part / 2 * left**2
    return kept, squared


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

    def lit(radius_mm: float, aim: Array) -> tuple[LensForm, Array, bool]:
        design = design_lens(aim, replace(quick, min_radius_mm=radius_mm))
        missed = _light_of(design.heightfield, settings.bench, aim) - aim
        return LensForm.of(design.heightfield), missed, design.closing is not None

    light = PictureLight(
        target, settings.bench, aims=aims, redesign=None if as_given else lambda r, aim: lit(r, _coarser(aim))[:2]
    )
    if as_given:
        _add_as_left(light, design_lens(coarse, quick).heightfield, coarse, radii_mm, on_progress)
        return light
    wanted = sorted(set(radii_mm), reverse=True)
    served: float | None = None
    for number, radius_mm in enumerate(wanted, 1):
        if served is not None:
            light.same(radius_mm, served)
            continue
        form, missed, filled = lit(radius_mm, coarse)
        light.add(radius_mm, form, missed)
        if not filled:
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
