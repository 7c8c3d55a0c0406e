"""Lenses for the planner: for each ball of the shop, the lens designed for it or the given lens as that ball leaves it,
and their light.

Lenses are designed on a coarser picture; their error is applied to the full picture, which keeps the target's fine
detail.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from threading import Lock
from typing import Any

import numpy as np

from cam.planning.pass_time import LensForm
from cam.planning.planner import Marks
from cam.planning.rest import Filled
from optics.ball_fit import ball_fits
from optics.bench import Bench
from optics.caustic import share_by_way_of, simulate_caustic
from optics.closing import close_to_radius
from optics.corrections import Corrected, correct_lens
from optics.finish import Finish
from optics.heightfield import Array, Heightfield
from optics.lens_settings import LensSettings
from optics.polish import Polished, digest_task, polish_lens
from optics.threads import thread_count
from optics.transport.solver import OpticalPath, solve_transport
from service.job.picture.resampling import resize
from service.job.planning.predicted_light import PictureLight, Valleys

COARSE = 256  # pixels along the longer side of the picture for the lenses made here
_SMALL = 128 * 128  # pixels
_TUBES, _BEAMS = 2, 7
_COARSE_STEPS = 8  # steps of descent for a finish; a lens as fine as the picture takes as many as the job

_solving = Lock()

Progress = Callable[[float], None]


def predict_designs(
    target: Array,
    settings: LensSettings,
    radii_mm: Iterable[float],
    *,
    as_given: bool = False,
    aims: bool = True,
    on_progress: Progress | None = None,
) -> PictureLight:
    """Design a lens for each ball, largest first; if nothing has to be filled, smaller balls share the lens.

    as_given : only the settings shape the lens, and each ball cuts it as well as it can
    aims     : each lens is to be sharpened by the blur of its milling
    """
    coarse = _coarser(target)
    quick = simplify(settings)
    first = partial(_solve_first, coarse, settings)

    def solve_near_first(aim: Array) -> OpticalPath | None:
        path = solve_transport(aim, settings.bench, skim_mm=settings.skim_mm, start=first())
        return path if path.converged else None

    def shape_for(radius_mm: float, aim: Array, start: Callable[[], OpticalPath | None]) -> _Shaped:
        made = compute_passes(aim, replace(quick, min_radius_mm=radius_mm), start)
        seen = made.best.caustic.irradiance
        if settings.bench.back is not None:
            seen = _light_of(made.best.lens, settings.bench.clear, aim)
        return _Shaped(form=form_of(made.best.lens), missed=seen - aim, fits=not made.is_shaped)

    def redesign(marks: Marks, aim: Array) -> Callable[[PictureLight], None]:
        aim = _coarser(aim)
        if as_given:
            lens = compute_passes(aim, quick, lambda: solve_near_first(aim)).best.lens
            return lambda light: _add_as_left(light, lens, aim, {marks.radius_mm, marks.smallest_mm}, None)
        shaped = shape_for(marks.radius_mm, aim, lambda: solve_near_first(aim))
        return lambda light: light.add(marks.radius_mm, shaped.form, shaped.missed)

    light = PictureLight(target, settings.bench, aims=aims, redesign=redesign)
    if as_given:
        _add_as_left(light, compute_passes(coarse, quick, first).best.lens, coarse, radii_mm, on_progress)
        return light
    wanted = sorted(set(radii_mm), reverse=True)
    with ThreadPoolExecutor(thread_count()) as pool:
        coming = [pool.submit(shape_for, radius_mm, coarse, first) for radius_mm in wanted]
        for number, radius_mm in enumerate(wanted):
            shaped = coming[number].result()
            light.add(radius_mm, shaped.form, shaped.missed)
            if on_progress is not None:
                on_progress((number + 1) / len(wanted))
            if shaped.fits:
                pool.shutdown(wait=False, cancel_futures=True)
                for smaller_mm in wanted[number + 1 :]:
                    light.reuse_lens(smaller_mm, radius_mm)
                break
    return light


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Shaped:
    """A lens for a ball; missed: its light minus its target. fits: nothing had to be filled for the ball."""

    form: LensForm
    missed: Array
    fits: bool


def simplify(settings: LensSettings) -> LensSettings:
    """Return settings for a quick lens: transport method, at most one correction, no polish, no finish."""
    return replace(settings, method="transport", polish_steps=0, corrections=min(1, settings.corrections), finish=None)


class FinishDesigns:
    """Designs lenses for finishes by a few steps of descent: coarse ones for a single finish, or one as fine as the
    target for all outcomes of a finish, as the job would. polished: the last of these
    """

    def __init__(self, target: Array, settings: LensSettings) -> None:
        self._target, self._settings = target, settings
        self.polished: Polished | None = None

    def __call__(self, finish: Finish, radius_mm: float, fine: bool) -> tuple[Heightfield, Array]:
        settings, aim = (self._settings, self._target) if fine else (simplify(self._settings), _coarser(self._target))
        settings = replace(settings, method="transport", finish=finish, min_radius_mm=radius_mm)
        start, bench = compute_passes(aim, settings).best.lens, settings.bench
        steps = settings.descent_steps if fine else _COARSE_STEPS
        ball_mm = settings.closing_radius_mm
        lens, record = polish_lens(start, aim, bench, steps=steps, ball_mm=ball_mm, finish=finish, as_planned=not fine)
        if fine:
            task = digest_task(start, aim, bench, steps=steps, ball_mm=ball_mm, finish=finish)
            self.polished = Polished(z_mm=lens.z_mm, record=record, task=task)
        return lens, aim


def design_whole(light: PictureLight, marks: Marks, settings: LensSettings, *, as_given: bool) -> Heightfield:
    """Return the lens as fine as the target, for those rows and no finish."""
    whole = replace(simplify(settings), corrections=settings.corrections)
    if not as_given:
        whole = replace(whole, min_radius_mm=marks.smallest_mm)
    return compute_passes(light.aim(marks), whole).best.lens


def compute_passes(
    target: Array, settings: LensSettings, first: Callable[[], OpticalPath | None] | None = None
) -> Corrected:
    """Return the passes for a target (ny, nx). Small lenses are cached, because people try one value after another.

    first : the target's own solution, or a similar one, to start from
    """
    if target.size > _SMALL:
        return correct_lens(target, settings, first=first and first())
    first = first or partial(_solve_first, target, settings)
    return _compute_once(_Wanted.of(target, settings, make=lambda: correct_lens(target, settings, first=first())))


def _solve_first(target: Array, settings: LensSettings) -> OpticalPath:
    """Solve for the picture itself: the lenses for all balls and finishes start from this solution."""
    bench, skim_mm = settings.bench, settings.skim_mm
    wanted = _Wanted.of(target, bench, skim_mm, make=lambda: solve_transport(target, bench, skim_mm=skim_mm))
    with _solving:  # several threads may ask for the same at once
        return _solve_once(wanted)


def form_of(lens: Heightfield) -> LensForm:
    """Return the form of a lens; small lenses are cached together with all computed times of their passes."""
    return _form_once(lens) if lens.z_mm.size <= 2 * _SMALL else LensForm.of(lens)


_form_once = lru_cache(maxsize=32)(LensForm.of)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Wanted:
    """A cache of results, by the hash of their inputs."""

    key: bytes
    make: Callable[[], Any] = field(compare=False)

    @classmethod
    def of(cls, *values: object, make: Callable[[], Any]) -> _Wanted:
        return cls(key=hashlib.blake2b(pickle.dumps(values)).digest(), make=make)


@lru_cache(maxsize=32)
def _compute_once(wanted: _Wanted) -> Corrected:
    return wanted.make()


@lru_cache(maxsize=4)
def _solve_once(wanted: _Wanted) -> OpticalPath:
    return wanted.make()


def predict_lens(
    lens: Heightfield,
    target: Array,
    bench: Bench,
    radii_mm: Iterable[float],
    *,
    on_progress: Progress | None = None,
) -> PictureLight:
    """Return an existing lens as each ball leaves it: valleys that are tighter stay filled."""
    light = PictureLight(target, bench)
    _add_as_left(light, lens, target, radii_mm, on_progress)
    return light


def _add_as_left(
    light: PictureLight,
    lens: Heightfield,
    target: Array,
    radii_mm: Iterable[float],
    on_progress: Progress | None,
) -> None:
    form, served = LensForm.of(lens), None
    wanted = sorted(set(radii_mm))
    for number, radius_mm in enumerate(wanted, 1):
        fits = ball_fits(lens, radius_mm)
        if fits and served is not None:
            light.reuse_lens(radius_mm, served)
            continue
        if fits:
            served = radius_mm
            light.add(radius_mm, form, _light_of(lens, light.bench, target) - target)
        else:
            z = close_to_radius(lens.z_mm, radius_mm=radius_mm, dx_mm=lens.dx_mm, dy_mm=lens.dy_mm)
            left = replace(lens, z_mm=np.minimum(z, 0.0))
            valleys = _valleys(lens, left, light.bench, target)
            light.add(radius_mm, form, _light_of(left, light.bench, target) - target, valleys=valleys)
        if on_progress is not None:
            on_progress(number / len(wanted))


def _valleys(lens: Heightfield, left: Heightfield, bench: Bench, target: Array) -> Valleys | None:
    """Return the valleys that a ball leaves filled; None if they are too small for a rest pass."""
    filled = Filled(lens=lens, over_mm=left.z_mm - lens.z_mm)
    if filled.share == 0:
        return None
    past = np.where(filled.cells, 0.0, 1.0)
    shares_past = share_by_way_of(past, lens, bench, pixels=target.shape, tubes_per_cell=_TUBES, beams=_BEAMS)
    return Valleys(filled=filled, shares_past=shares_past)


def _light_of(lens: Heightfield, bench: Bench, target: Array) -> Array:
    return simulate_caustic(lens, bench, pixels=target.shape, tubes_per_cell=_TUBES, beams=_BEAMS).irradiance


def _coarser(target: Array) -> Array:
    scale = min(1.0, COARSE / max(target.shape))
    shape = (max(4, round(scale * target.shape[0])), max(4, round(scale * target.shape[1])))
    coarse = np.maximum(resize(target, shape), 0.0)
    return coarse / coarse.mean()
