"""The planner's light model: predicts what milled lenses show, before a program is written.

Facets of a milled surface are much smaller than a pixel, so each patch spreads its light over all their slopes. The
picture is that of the perfect lens convolved with this spread, darker at its edges, with stripes from the height errors
of rows. A groove of width w under a ball R spreads its light over w (1 + reach / R). Valleys that a small ball cuts
after a big one spread light like the rows of the small one.

The first guess of PSNR needs no picture: the squared errors of a picture's waves add up, and rows keep a part of each
wave, the product of a part for X and a part for Y. The best candidates' lenses are then designed again, sharpened for
their own rows.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import hypot, sqrt
from typing import Literal

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter1d

from cam.passes import PassSpec
from cam.planning.pass_time import LensForm
from cam.planning.planner import Marks
from cam.planning.rest import Filled
from cam.planning.row_slopes import RowSlopes, chord_grain, row_grain
from optics.bench import Bench
from optics.foreseen import sharpen
from optics.heightfield import Array
from optics.irradiance import picture_from_irradiance
from optics.metrics import CausticScore, psnr_db, score_caustic, seen_db, smallest_detail_mm
from optics.threads import thread_count
from service.job.picture.light_png import picture_png
from service.job.picture.resampling import resize
from service.job.planning.waves import Waves, compute_lost_when_sharpened, yx_spreads

WALL_PIXELS = 256
"""Along the longer side of the picture of the wall, at most."""
_SEED, _GRAIN_PIXELS = 20140301, 3.0
_SEEN_PIXELS = 0.25  # blur along the rows; less is not worth sharpening

Redesign = Callable[[Marks, Array], Callable[["PictureLight"], None]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Valleys:
    """Valleys that a ball leaves filled; shares (ny, nx): the part of each pixel's light that comes past them, by the
    lens.
    """

    filled: Filled
    shares_past: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """A lens for one ball: its form, the waves (ny, nx) of its picture before milling and without sharpening, the mean
    square error of that picture, and the valleys that the ball leaves filled.
    """

    form: LensForm
    waves: Array
    perfect_error: float
    valleys: Valleys | None = None


class PictureLight:
    """Pictures and scores of milled lenses; `cam.planning.planner.Light`.

    aims     : a lens can still be made sharper for the blur of its milling
    redesign : designs lenses for those marks and a target; the function that it returns puts them in place of the
               first ones
    goal     : the target's waves, if they are known
    """

    contact_share: float | None = None
    """Share of the lens that the tool of a finish touches; None without a finish."""

    def __init__(
        self,
        target: Array,
        bench: Bench,
        *,
        aims: bool = False,
        redesign: Redesign | None = None,
        goal: Array | None = None,
    ) -> None:
        self.target, self.bench, self.aims, self._redesign = target, bench.clear, aims, redesign
        self.hazy_bench = bench
        self.goal = waves_of(target) if goal is None else goal
        self._peak, self._square = float(target.max()), float(np.square(target).mean())
        self._lost_by_haze = float(np.square(bench.add_haze(target) - target).mean())
        ny, nx = target.shape
        self.pixel_mm = (bench.screen.height_mm / ny, bench.screen.width_mm / nx)
        self._along = Waves.of((ny, nx), self.pixel_mm)
        self.lenses: dict[float, Shown] = {}
        self._halves: dict[tuple[float, float], tuple[Array, Array]] = {}
        self._sums: dict[Shown, tuple[Array, Array]] = {}
        self._reaches_mm: dict[LensForm, float] = {}

    @property
    def forms(self) -> dict[float, LensForm]:
        return {radius: shown.form for radius, shown in self.lenses.items()}

    @property
    def fillings(self) -> dict[float, Filled]:
        """By radius: what balls leave filled in valleys."""
        return {radius: shown.valleys.filled for radius, shown in self.lenses.items() if shown.valleys is not None}

    def add(self, radius_mm: float, form: LensForm, missed: Array, *, valleys: Valleys | None = None) -> None:
        """Add a lens for a ball; missed: its light minus the picture that it aims at, at any size."""
        error = resize(missed, self.target.shape)
        self.lenses[radius_mm] = Shown(
            form=form,
            waves=self.goal + waves_of(error),
            perfect_error=float(np.square(error).mean()),
            valleys=valleys and replace(valleys, shares_past=resize(valleys.shares_past, self.target.shape)),
        )

    def reuse_lens(self, radius_mm: float, as_of_mm: float) -> None:
        """Use the lens of another ball for this one as well."""
        self.lenses[radius_mm] = self.lenses[as_of_mm]

    def retarget(self, target: Array) -> PictureLight:
        """Return the same lenses with the picture at another size, without the valleys that balls leave filled."""
        light = PictureLight(target, self.hazy_bench, aims=self.aims)
        first: dict[Shown, float] = {}
        for radius_mm, shown in self.lenses.items():
            if shown in first:
                light.reuse_lens(radius_mm, first[shown])
                continue
            light.add(radius_mm, shown.form, picture_of_waves(shown.waves - self.goal))
            first[shown] = radius_mm
        return light

    def _widen_slopes(self, marks: Marks) -> RowSlopes:
        """Return the slope errors as they blur the picture: a groove's light starts with the groove's own width."""
        form = self.lenses[marks.radius_mm].form
        reach_mm = self.reach_mm(form) * (-1.0 if self.bench.mirror else 1.0)
        wider = marks.slopes.across.times(form.widen_factor(marks.spec, reach_mm))
        return replace(marks.slopes, across=wider)

    def reach_mm(self, form: LensForm) -> float:
        """Return how far a slope error deflects light on the screen, per unit of slope.

        A slope s deflects light by (n - 1)(s + c s^3) of the distance, to third order; a small change of it has 1 + 2 c
        s^2 times the effect, in the mean over both directions.
        """
        if form not in self._reaches_mm:
            self._reaches_mm[form] = self._reach_of_mm(form)
        return self._reaches_mm[form]

    def _reach_of_mm(self, form: LensForm) -> float:
        drop_mm, n = self.bench.throw_mm - float(form.heights_mm.mean()), self.bench.refractive_index
        cubic = 1.0 if self.bench.mirror else n * (n + 1) / 6 + ((n - 1) ** 2 - 1) / 3
        leaning = 1.0 + 2.0 * cubic * float(np.square(form.slopes).mean())
        return drop_mm * (2.0 if self.bench.mirror else n - 1.0) * leaning

    def blur_mm(self, slopes: RowSlopes) -> float:
        form = next(iter(self.lenses.values())).form
        return self.reach_mm(form) * sqrt(slopes.across.rms**2 + slopes.along.rms**2)

    def psnr_db(self, marks: Marks) -> float:
        """Estimate the PSNR, ignoring that light cannot be negative and the places where dark edges matter more."""
        error = self._error_by_contours(marks) if marks.spec.strategy == "contour" else self._error_by_rows(marks)
        return self.db_of_error(error + self.grain(marks) ** 2 * self._square)

    def aimed_db(self, marks: Marks) -> float:
        return self.psnr_of(self.smooth_picture(marks), self.grain(marks))

    def unsharpened_db(self, marks: Marks) -> float:
        """Return the PSNR of a lens that aims at the picture itself."""
        return self.psnr_of(self._blur_aim(marks, self.lenses[marks.smallest_mm].waves), self.grain(marks))

    def settle(self, several: Iterable[Marks]) -> None:
        """Design the lenses of these balls again, sharpened for those rows; do nothing if none is sharpened."""
        if self._redesign is None:
            return
        wanted = [marks for marks in several if any(self.foreseen_blur_mm(marks))]
        with ThreadPoolExecutor(thread_count()) as pool:
            designs = list(pool.map(self._redesign, wanted, map(self.aim, wanted)))
        for marks, put in zip(wanted, designs, strict=True):
            before = {radius: self.lenses[radius].perfect_error for radius in {marks.radius_mm, marks.smallest_mm}}
            put(self)
            for radius, error in before.items():
                self.lenses[radius] = replace(self.lenses[radius], perfect_error=error)
        self._halves.clear()

    def perfect_db(self, radius_mm: float) -> float:
        """Return the PSNR of the lens for a ball without any mark of the tool."""
        return self.db_of_error(self.lenses[radius_mm].perfect_error)

    def grain(self, marks: Marks) -> float:
        """Return the standard deviation of a pixel's light over its mean, from height errors of rows and slope errors
        of chords.
        """
        own = self._grain_of(marks)
        if marks.rest is None:
            return own
        through = float(picture_of_waves(self._half_waves(marks)[1]).mean())
        return sqrt((1.0 - through) * own**2 + through * self._grain_of(marks.rest) ** 2)

    def across_mm(self, spec: PassSpec) -> float:
        """Return a pixel's side across the rows of a pass."""
        return self.pixel_mm[0 if spec.direction == "x" else 1]

    def _grain_of(self, marks: Marks) -> float:
        spec, slopes = marks.spec, marks.slopes
        across_mm, along_mm = self.across_mm(spec), self.pixel_mm[1 if spec.direction == "x" else 0]
        reach_mm = round(self.reach_mm(self.lenses[spec.radius_mm].form), 1)
        rows = row_grain(spec.radius_mm, spec.pitch_mm, slopes.off_mm, reach_mm, across_mm)
        return hypot(rows, chord_grain(slopes, radius_mm=spec.radius_mm, reach_mm=reach_mm, pixel_mm=along_mm))

    def picture(self, marks: Marks) -> Array:
        """Return the irradiance (ny, nx) on the screen: `clear_picture` through the block's haze."""
        return self.hazy_bench.add_haze(self.clear_picture(marks))

    def clear_picture(self, marks: Marks) -> Array:
        """Return the irradiance (ny, nx) on the screen, work frame, mean 1, with random grain that is longer along the
        rows.
        """
        smooth = np.maximum(self.smooth_picture(marks), 0.0)
        lot = np.random.default_rng(_SEED).standard_normal(smooth.shape)
        lot = gaussian_filter1d(lot, _GRAIN_PIXELS, axis=1 if marks.spec.direction == "x" else 0)
        return np.asarray(smooth * np.maximum(1.0 + self.grain(marks) * lot / lot.std(), 0.0))

    def foreseen_blur_mm(self, marks: Marks) -> tuple[float, float]:
        """Return the standard deviations (x, y) for which the lens may be sharpened; nothing for an existing lens, or
        for contours, which blur each place in its own direction.
        """
        if not self.aims or marks.spec.strategy == "contour":
            return 0.0, 0.0
        form = self.lenses[marks.radius_mm].form
        slopes = self._widen_slopes(marks)
        across, along = (self.reach_mm(form) * spread.rms for spread in (slopes.across, slopes.along))
        along = along if along > _SEEN_PIXELS * min(self.pixel_mm) else 0.0
        return (along, across) if marks.spec.direction == "x" else (across, along)

    def score(self, picture: Array) -> CausticScore:
        return score_caustic(picture, self.target)

    def _error_by_rows(self, marks: Marks) -> float:
        """Return the mean square error of the waves of a lens that is sharpened as far as light allows."""
        kept = self._compute_kept(marks)
        lost = compute_lost_when_sharpened(kept) if self.aims else 1.0 - kept
        if marks.rest is None:
            return float(np.square(lost * self.goal - kept * (self.lenses[marks.radius_mm].waves - self.goal)).mean())
        past, through = self._half_waves(marks)
        came = kept * past + self._compute_kept(marks.rest) * through
        return float(np.square(lost * self.goal - (came - kept * self.goal)).mean())

    def _error_by_contours(self, marks: Marks) -> float:
        """Return the mean square of waves; each place is blurred in its own direction, so squares are averaged."""
        form, along = self.lenses[marks.radius_mm].form, self._along.by_blocks
        kept, squared = along.compute_kept_by_contours(form, self._widen_slopes(marks), self.reach_mm(form))
        goal, sums = self.goal, self._along.block_sums
        if marks.rest is None:
            own_own, own_goal = self._sum_blocks(self.lenses[marks.radius_mm])
            error = (squared * own_own - 2 * kept * own_goal).sum()
        else:
            own, other = self._half_waves(marks)
            left = along.compute_kept(form, self._widen_slopes(marks.rest), marks.rest.spec, self.reach_mm(form))
            error = (squared * sums(own**2) + 2 * kept * (left * sums(own * other) - sums(own * goal))).sum()
            error += (left**2 * sums(other**2) - 2 * left * sums(other * goal)).sum()
        return float(max(error + sums(goal**2).sum(), 0.0)) / self.target.size

    def _sum_blocks(self, shown: Shown) -> tuple[Array, Array]:
        """Return block sums of a lens's squared waves, and of their products with the target's."""
        if shown not in self._sums:
            sums = self._along.block_sums
            self._sums[shown] = sums(shown.waves**2), sums(shown.waves * self.goal)
        return self._sums[shown]

    def _half_waves(self, marks: Marks) -> tuple[Array, Array]:
        """Return the waves past the valleys that the finishing ball leaves filled, and those through them, which a rest
        pass cuts; there the lens is as the smaller ball leaves it.
        """
        key = (marks.radius_mm, marks.smallest_mm)
        if key not in self._halves:
            self._halves[key] = self._split(marks, self.lenses[marks.smallest_mm].waves)
        return self._halves[key]

    def _split(self, marks: Marks, waves: Array) -> tuple[Array, Array]:
        valleys = self.lenses[marks.radius_mm].valleys
        assert valleys is not None, "a rest pass is planned where something is left"
        past = waves_of(valleys.shares_past * picture_of_waves(waves))
        return past, waves - past

    def smooth_picture(self, marks: Marks) -> Array:
        """Return the picture of the lens for that ball, sharpened and then milled, without grain."""
        waves = self.lenses[marks.smallest_mm].waves
        if any(self.foreseen_blur_mm(marks)):
            waves = waves + waves_of(self.aim(marks) - self.target)
        return self._blur_aim(marks, waves)

    def aim(self, marks: Marks) -> Array:
        """Return the target, sharpened by the blur of those rows."""
        blur_x_mm, blur_y_mm = self.foreseen_blur_mm(marks)
        return sharpen(self.target, (blur_y_mm / self.pixel_mm[0], blur_x_mm / self.pixel_mm[1]))

    def _blur_aim(self, marks: Marks, waves: Array) -> Array:
        """Blur the aim; a cosine transform mirrors the picture at the edges, although it is dark beyond them."""
        reach_mm = self.reach_mm(self.lenses[marks.radius_mm].form)
        edges = [
            spread.compute_share_inside((np.arange(count) + 0.5) * pixel_mm, count * pixel_mm, reach_mm)
            for spread, count, pixel_mm in zip(
                yx_spreads(self._widen_slopes(marks), marks.spec), waves.shape, self.pixel_mm, strict=True
            )
        ]
        if marks.rest is None:
            blurred = self._compute_kept(marks) * waves
        else:
            past, through = self._split(marks, waves)
            blurred = self._compute_kept(marks) * past + self._compute_kept(marks.rest) * through
        return np.asarray(picture_of_waves(blurred) * np.outer(*edges))

    def _compute_kept(self, marks: Marks) -> Array:
        """Return the remaining part of each wave (ny, nx)."""
        form = self.lenses[marks.radius_mm].form
        return self._along.compute_kept(form, self._widen_slopes(marks), marks.spec, self.reach_mm(form))

    def psnr_of(self, picture: Array, grain: float) -> float:
        """Return the PSNR of a smooth picture and its grain."""
        error = float(np.square(picture - self.target).mean()) + grain**2 * float(np.square(picture).mean())
        return self.db_of_error(error)

    def db_of_error(self, mean_square: float) -> float:
        """Return the PSNR for a mean square error before haze, which adds its own."""
        return float(10 * np.log10(self._peak**2 / max(mean_square + self._lost_by_haze, 1e-300)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictedPicture:
    """The predicted picture and its target: (ny, nx) irradiance, work frame. The figures belong to this light; the
    smallest detail only considers the tool's marks.
    """

    light: Array
    target: Array
    psnr_db: float
    seen_db: float
    detail_mm: float


def describe_light(light: PictureLight, marks: Marks) -> PredictedPicture:
    """Return the picture that a plan's light predicts for its marks."""
    seen = light.picture(marks)
    return PredictedPicture(
        light=seen,
        target=light.target,
        psnr_db=psnr_db(seen, light.target),
        seen_db=seen_db(seen, light.target),
        detail_mm=smallest_detail_mm(seen, light.target, light.pixel_mm[1]),
    )


def draw_wall(seen: PredictedPicture, viewed_from: Literal["lens", "behind"]) -> str:
    """Return a PNG of the wall as a data URL, as the viewer sees it, exposed like a job's pictures."""
    picture = picture_from_irradiance(seen.light, viewed_from=viewed_from)
    packed = picture_png(picture, white=float(seen.target.max()), side=WALL_PIXELS)
    return f"data:image/png;base64,{b64encode(packed).decode()}"


def waves_of(picture: Array) -> Array:
    return np.asarray(dctn(picture, norm="ortho"))


def picture_of_waves(waves: Array) -> Array:
    return np.asarray(idctn(waves, norm="ortho"))
