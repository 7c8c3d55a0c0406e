"""Predicts what a lens shows after milling and finishing, before a program is written.

A finish levels the marks of rows (height errors, high in frequency) and the finest detail of the surface; the lens
compensates for that. So the picture lacks the waves that the finish removes, and has stripes from the remaining marks:
the change of light is the distance to the wall times the change of curvature. The first guess adds the squares of both
errors, wave by wave. For the chosen plan a coarse lens is designed for the finish, its rows are levelled and its light
is simulated, which corrects both guesses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.fft import idct

from cam.passes import Direction
from cam.planning.planner import Marks
from cam.planning.row_slopes import RowSlopes, row_profile
from optics.bench import Bench
from optics.caustic import share_by_way_of, simulate_caustic
from optics.finish import Finish, Finished, finish_lens
from optics.heightfield import Array, Heightfield
from service.job.picture.resampling import resize
from service.job.planning.predicted_light import PictureLight, Shown, picture_of_waves, waves_of

_EDGES = 1.6  # stray light beside edges over the loss of their waves: 1.5 to 2.2 on `camera` for six finishes
_CLOSING = 0.5  # part of the cost of filling valleys that remains with a finish, which rounds them anyway
_STRIPES = 1.6  # correction for bright places, where stripes are stronger than average
_ALONG = 1.35  # correction for marks that shaped heights leave along the rows: 1.16 to 1.53, five pictures, two mills
_GIVEN_UP = 3e-4  # H^2 of a wave of which a lens for a finish keeps half
_TUBES, _TUBES_PER_PIXEL, _BEAMS = 2, 1.75, 7
_NEARLY_ALL = 0.98  # share of a lens that a tool touches: above it, the loss elsewhere is less than the gain
_WAVE_NUMBERS = 1024  # number of wave numbers for a picture
_ALIKE = 0.01  # step of the logarithm of wave numbers
_ROW_WAVES = np.exp(np.arange(math.log(0.05), math.log(400.0), _ALIKE))
"""Wave numbers [rad/mm] of rows, to periods of 0.016 mm: of k0 = 25 at order 1 a ten-millionth is left of them."""

Design = Callable[[Finish, float, bool], tuple[Heightfield, Array]]
"""A lens for a finish and a ball's radius, coarse or fine, and the target (ny, nx) that it was made for."""


class Spectra:
    """Mean squares by wave number: of a picture's waves, and of the part that lenses for balls lack; and, by
    _ROW_WAVES, of the curvature of rows.

    k_rad_per_mm, wanted : (n,)
    """

    def __init__(self, light: PictureLight) -> None:
        k = _picture_wave_numbers(light.target.shape, light.bench)
        step = float(k[-1, -1]) / _WAVE_NUMBERS
        self._bin = np.ravel((k / step).astype(np.int64))
        self.k_rad_per_mm = np.asarray((np.arange(_WAVE_NUMBERS + 1) + 0.5) * step, dtype=np.float64)
        self._waves = light.goal
        self.wanted = self._sum_squares(light.goal)
        self._lacks: dict[Shown, Array] = {}
        self._across_mm = light.across_mm
        self._bends: dict[tuple[Marks, ...], Array] = {}

    def lack_of(self, shown: Shown) -> Array:
        """Return (n,) the part of each wave that a lens lacks before milling."""
        if shown not in self._lacks:
            self._lacks[shown] = self._sum_squares(shown.waves - self._waves)
        return self._lacks[shown]

    def bends_of(self, several: tuple[Marks, ...]) -> Array:
        """Return (m, n) curvature that rows leave, as a pixel on the screen sees it [1/mm^2]."""
        if several not in self._bends:
            self._bends[several] = np.stack([self._see_rows(marks) for marks in several])
        return self._bends[several]

    def _see_rows(self, marks: Marks) -> Array:
        spec = marks.spec
        seen = np.square(np.sinc(_ROW_WAVES * self._across_mm(spec) / (2.0 * np.pi)))
        return np.asarray(seen * _row_bends(spec.radius_mm, spec.pitch_mm, round(marks.slopes.off_mm, 6)))

    def _sum_squares(self, waves: Array) -> Array:
        squares = np.ravel(waves) ** 2 / waves.size
        return np.asarray(np.bincount(self._bin, squares, minlength=_WAVE_NUMBERS + 1), dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """A finished lens without marks, its target, and its light (ny, nx): bare, and, where the tool does not touch,
    blurred by the rows of the mill.
    """

    done: Finished
    target: Array
    bare: Array
    light: Array


class FinishedLight(PictureLight):
    """The light of milled lenses after a finish, made from the light model of milled lenses. It predicts rows only, no
    rest pass.

    spectra : of the milled light, if several finishes are compared
    """

    def __init__(self, milled: PictureLight, finish: Finish, spectra: Spectra | None = None) -> None:
        super().__init__(milled.target, milled.hazy_bench, goal=milled.goal)
        self.lenses, self.finish = dict(milled.lenses), finish  # a copy: the other light settles its lenses again
        self._spectra = spectra or Spectra(milled)
        self._lens_scale, self._lost_contact = 1.0, 0.0
        self._stripe_scale: dict[Direction, float] = {"x": 1.0, "y": 1.0}
        self._errors: dict[float, float] = {}  # of the guess, by radius
        self._shone: dict[tuple[Marks, bool], Seen] = {}
        self._lit: dict[float, Array] = {}  # (ny, nx) through a lens as fine as the picture, unmarked, by radius

    @cached_property
    def _kept_waves(self) -> Array:
        """Return (ny, nx) the part of each wave of the picture that a lens made for the finish keeps."""
        return _weigh_kept(self.finish, _picture_wave_numbers(self.target.shape, self.bench))

    def psnr_db(self, marks: Marks) -> float:
        return self.psnrs_db([marks])[0]

    def psnrs_db(self, several: Sequence[Marks]) -> list[float]:
        """Return `psnr_db` of several plans at once, in their order."""
        errors = np.array([self._lens_error(one.radius_mm) for one in several])
        errors += np.square(self._grains(several)) * self._square
        return [self.db_of_error(error) for error in errors.tolist()]

    aimed_db = unsharpened_db = psnr_db

    def foreseen_blur_mm(self, marks: Marks) -> tuple[float, float]:
        """Return no blur, because the finish removes its cause."""
        return 0.0, 0.0

    def blur_mm(self, slopes: RowSlopes) -> float:
        """Return the standard deviation of the Gaussian that halves the same wave as the finish."""
        return blur_of(self.finish)

    def perfect_db(self, radius_mm: float) -> float:
        """Return the PSNR without any mark of the tool."""
        return self.db_of_error(self._lens_error(radius_mm))

    def grain(self, marks: Marks) -> float:
        """Return the standard deviation of the light over its mean, from the remaining height errors of rows."""
        return float(self._grains([marks])[0])

    def _grains(self, several: Sequence[Marks]) -> Array:
        """Return `grain` (n,) of several plans: the distance to the wall times the remaining curvature of rows."""
        squares = self._spectra.bends_of(tuple(several))
        reaches_mm = np.array([self.reach_mm(self.lenses[one.radius_mm].form) for one in several])
        stripes = np.array([_STRIPES * self._stripe_scale[one.spec.direction] for one in several])
        return np.asarray(reaches_mm * np.sqrt(stripes * (squares @ np.square(self.finish.compute_kept(_ROW_WAVES)))))

    def is_lit(self, marks: Marks) -> bool:
        """Return whether the light of a lens for that ball has been simulated."""
        return marks.radius_mm in self._lit

    def smooth_picture(self, marks: Marks) -> Array:
        """Return the light without stripes: of a simulated lens, or from the waves alone."""
        if (seen := self._lit.get(marks.radius_mm)) is not None:
            return seen
        return np.maximum(picture_of_waves(self._kept_waves * self.goal), 0.0)

    def clear_picture(self, marks: Marks) -> Array:
        """Return irradiance (ny, nx) on the screen, work frame: the smooth picture with random stripes along rows."""
        smooth, along_x = self.smooth_picture(marks), marks.spec.direction == "x"
        lot = self._draw_stripes(marks, smooth.shape[0 if along_x else 1])
        stripes = lot[:, None] if along_x else lot[None, :]
        return np.asarray(smooth * np.maximum(1.0 + self.grain(marks) * stripes, 0.0))

    def _draw_stripes(self, marks: Marks, count: int) -> Array:
        """Return random stripes (count,) of standard deviation 1, as wide as those that the finish leaves."""
        side_mm = self.bench.height_mm if marks.spec.direction == "x" else self.bench.width_mm
        k = math.pi * np.arange(1, count) / side_mm
        squares = self._spectra.bends_of((marks,))[0] * np.square(self.finish.compute_kept(_ROW_WAVES)) / _ROW_WAVES
        waves = np.sqrt(np.interp(k, _ROW_WAVES, squares)) * np.random.default_rng(count).standard_normal(count - 1)
        lot = idct(np.concatenate([[0.0], waves]), norm="ortho")
        return np.asarray(lot / max(float(lot.std()), 1e-300))

    def look_at(self, marks: Marks, design: Design) -> None:
        """Simulate a coarse lens designed for the finish and keep its light for those marks; add the waves that a
        coarse lens lacks, as far as the finish keeps them.
        """
        seen = self._shine(marks, design, fine=False)
        ny, nx = seen.target.shape
        waves = self._kept_waves * self.goal
        waves[:ny, :nx] = waves_of(seen.light)[:ny, :nx]
        self._lit[marks.radius_mm] = np.maximum(picture_of_waves(waves), 0.0)

    def calibrate(self, marks: Marks, design: Design, *, fine: bool = False) -> None:
        """Correct both guesses by a lens that is designed, milled in rows, finished and lit; keep the light of a fine
        one.
        """
        seen = self._shine(marks, design, fine=fine)
        if fine:
            self._lit[marks.radius_mm] = seen.light
        target, self.contact_share = seen.target, seen.done.contact_share
        light = seen.light if target.shape == seen.light.shape else np.maximum(resize(seen.light, target.shape), 0.0)
        off_free = float(np.square(light - target).mean())
        finer = self.goal**2
        ny, nx = target.shape
        finer[:ny, :nx] = 0.0  # waves too fine for the coarse lens
        off_fine = float((finer * np.square(1.0 - self._kept_waves)).mean())
        off, guess = off_free + off_fine, self._guess_error(marks.radius_mm)
        # What a tool does not reach costs as much after less work: k0 2.05 to 2.9, 23.6 to 24.0 dB on two pictures.
        adds = self.contact_share < _NEARLY_ALL and off > guess
        self._lens_scale, self._lost_contact = (1.0, off - guess) if adds else (off / guess, 0.0)
        for direction in self._stripe_scale:
            self._calibrate_stripes(replace(marks, spec=replace(marks.spec, direction=direction)), seen)

    def _shine(self, marks: Marks, design: Design, *, fine: bool) -> Seen:
        """Return the simulated light for those marks; each lens is designed once."""
        if (marks, fine) not in self._shone:
            self._shone[marks, fine] = self._shine_anew(marks, design, fine=fine)
        return self._shone[marks, fine]

    def _shine_anew(self, marks: Marks, design: Design, *, fine: bool) -> Seen:
        lens, target = design(self.finish, marks.radius_mm, fine)
        done = finish_lens(lens, self.finish)
        bare = self._light_of(done.lens, self.target.shape)  # half of the stripes are finer than a coarse pixel
        return Seen(done=done, target=target, bare=bare, light=self._blur_past_tool(bare, done, marks))

    def _blur_past_tool(self, light: Array, done: Finished, marks: Marks) -> Array:
        """Return light (ny, nx) in which the part from places that the tool does not touch is blurred by rows, as
        milled.
        """
        if done.touched.all():
            return light
        hangs = 1.0 - done.touched[:-1, :-1].astype(np.float64)
        share = share_by_way_of(hangs, done.lens, self.bench, pixels=light.shape, tubes_per_cell=1, beams=_BEAMS)
        past = share * light
        return np.asarray(light - past + np.maximum(picture_of_waves(self._compute_kept(marks) * waves_of(past)), 0.0))

    def _calibrate_stripes(self, marks: Marks, seen: Seen) -> None:
        if (guessed := self.grain(marks) ** 2 * self._square) > 0:
            marked = self._light_of(add_rows(seen.done.lens, marks, self.finish), seen.bare.shape)
            self._stripe_scale[marks.spec.direction] *= _ALONG * float(np.square(marked - seen.bare).mean()) / guessed

    def trust(self, calibrated: FinishedLight) -> None:
        """Apply the corrections of another finish."""
        self._lens_scale, self._stripe_scale = calibrated._lens_scale, dict(calibrated._stripe_scale)
        self._lost_contact, self.contact_share = calibrated._lost_contact, calibrated.contact_share

    def _light_of(self, lens: Heightfield, shape: tuple[int, ...]) -> Array:
        pixels = (shape[0], shape[1])
        tubes = max(_TUBES, math.ceil(_TUBES_PER_PIXEL * pixels[1] / (lens.x_mm.size - 1)))
        return simulate_caustic(lens, self.bench, pixels=pixels, tubes_per_cell=tubes, beams=_BEAMS).irradiance

    def _lens_error(self, radius_mm: float) -> float:
        """Return the mean square error of the picture of the lens for a ball."""
        return self._lens_scale * self._guess_error(radius_mm) + self._lost_contact

    def _guess_error(self, radius_mm: float) -> float:
        """Return the mean square error estimated from the finish's waves alone, before a lens is simulated."""
        if radius_mm not in self._errors:
            kept = _weigh_kept(self.finish, self._spectra.k_rad_per_mm)
            lost = np.square(1.0 - kept) @ self._spectra.wanted
            closed = np.square(kept) @ self._spectra.lack_of(self.lenses[radius_mm])
            self._errors[radius_mm] = float(_EDGES * lost + _CLOSING * closed)
        return self._errors[radius_mm]


def _picture_wave_numbers(shape: tuple[int, ...], bench: Bench) -> Array:
    """Return wave numbers (ny, nx) [rad/mm on the lens] of a picture's cosine waves."""
    sides = (bench.height_mm, bench.width_mm)
    down, across = (math.pi * np.arange(n) / side for n, side in zip(shape, sides, strict=True))
    return np.asarray(np.hypot(down[:, None], across[None, :]), dtype=np.float64)


def _weigh_kept(finish: Finish, k_rad_per_mm: Array) -> Array:
    square = np.square(finish.compute_kept(k_rad_per_mm))
    return np.asarray(square / (square + _GIVEN_UP))


def blur_of(finish: Finish) -> float:
    """Return the standard deviation [mm on the lens] of the Gaussian that halves the same wave."""
    return math.sqrt(2.0 * math.log(2.0)) / _half_kept(finish)


def _half_kept(finish: Finish) -> float:
    """Return the wave number [rad/mm] of which a lens made for the finish keeps half: H^2 is _GIVEN_UP there."""
    return finish.k0_rad_per_mm * float(-0.5 * math.log(_GIVEN_UP)) ** (1.0 / finish.order)


def add_rows(finished: Heightfield, marks: Marks, finish: Finish) -> Heightfield:
    """Return the surface plus the rest of the rows' height errors after the finish, constant along each row."""
    spec = marks.spec
    along_x = spec.direction == "x"
    places = finished.y_mm if along_x else finished.x_mm
    length_mm = float(10 * math.ceil((places[-1] - places[0]) / 10 + 2))
    heights, spacing_mm = row_profile(spec.radius_mm, spec.pitch_mm, round(marks.slopes.off_mm, 6), length_mm=length_mm)
    left = np.fft.irfft(np.fft.rfft(heights) * finish.compute_kept(_wave_numbers(heights, spacing_mm)), heights.size)
    off = np.interp(places, places[0] + spacing_mm * np.arange(left.size), left)
    z = finished.z_mm + (off[:, None] if along_x else off[None, :])
    return Heightfield(x_mm=finished.x_mm, y_mm=finished.y_mm, z_mm=z - max(0.0, float(z.max())))


def _wave_numbers(heights: Array, spacing_mm: float) -> Array:
    """Return wave numbers [rad/mm] of the real transform of heights."""
    return 2.0 * np.pi * np.asarray(np.fft.rfftfreq(heights.size, spacing_mm), dtype=np.float64)


@lru_cache(maxsize=512)
def _row_bends(radius_mm: float, pitch_mm: float, off_mm: float) -> Array:
    """Return mean squares [1/mm^2] of the curvature of rows by _ROW_WAVES."""
    heights, spacing_mm = row_profile(radius_mm, pitch_mm, off_mm)
    k = _wave_numbers(heights, spacing_mm)
    some = slice(1, int(np.searchsorted(k, _ROW_WAVES[-1])))
    k, squares = k[some], 2.0 * np.square((np.abs(np.fft.rfft(heights)) / heights.size)[some] * k[some] ** 2)
    nearest = np.rint((np.log(k) - np.log(_ROW_WAVES[0])) / _ALIKE).astype(np.int64)
    return np.asarray(np.bincount(nearest, squares, minlength=_ROW_WAVES.size), dtype=np.float64)
