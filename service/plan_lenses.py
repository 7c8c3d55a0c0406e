"""Lenses for the planner: one designed, or left by the ball, for each ball of the shop, and lit once.

Lenses are designed on a coarser picture: what they miss of it is taken over, fine detail as the target has it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from cam.pass_time import LensForm
from cam.plan_rest import Filled
from cam.planner import Marks
from optics.ball_fit import ball_fits
from optics.bench import Bench
from optics.caustic import share_by_way_of, simulate_caustic
from optics.closing import closed_to_radius
from optics.corrections import corrected
from optics.heightfield import Array, Heightfield
from optics.settings import LensSettings
from service.plan_light import PictureLight, Valleys
from service.resampling import resized

COARSE = 256  # pixels along the longer side of the picture that lenses are designed for here
_TUBES, _BEAMS = 2, 7

Progress = Callable[[float], None]


def lit_designs(
    target: Array,
    settings: LensSettings,
    radii_mm: Iterable[float],
    *,
    as_given: bool = False,
    aims: bool = True,
    on_progress: Progress | None = None,
) -> PictureLight:
    """A lens designed for each ball, largest first: where nothing is to be filled, smaller balls have the same one.

    as_given : the settings alone shape the lens, and each ball leaves of it what it can
    aims     : each lens is to be made sharper by what milling will blur
    """
    coarse = _coarser(target)
    quick = replace(settings, method="transport", polish_steps=0, corrections=min(1, settings.corrections))

    def lit(radius_mm: float, aim: Array) -> tuple[LensForm, Array, bool]:
        made = corrected(aim, replace(quick, min_radius_mm=radius_mm))
        missed = _light_of(made.best.lens, settings.bench, aim) - aim
        return LensForm.of(made.best.lens), missed, made.closing is not None

    def again(light: PictureLight, marks: Marks, aim: Array) -> None:
        aim = _coarser(aim)
        if as_given:
            made, radii = corrected(aim, quick).best.lens, {marks.radius_mm, marks.smallest_mm}
            _add_as_left(light, made, aim, radii, None)
        else:
            light.add(marks.radius_mm, *lit(marks.radius_mm, aim)[:2])

    light = PictureLight(target, settings.bench, aims=aims, redesign=again)
    if as_given:
        _add_as_left(light, corrected(coarse, quick).best.lens, coarse, radii_mm, on_progress)
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
    on_progress: Progress | None = None,
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
    on_progress: Progress | None,
) -> None:
    form, served = LensForm.of(lens), None
    wanted = sorted(set(radii_mm))
    for number, radius_mm in enumerate(wanted, 1):
        fits = ball_fits(lens, radius_mm)
        if fits and served is not None:
            light.same(radius_mm, served)
            continue
        if fits:
            served = radius_mm
            light.add(radius_mm, form, _light_of(lens, light.bench, target) - target)
        else:
            z = closed_to_radius(lens.z_mm, radius_mm=radius_mm, dx_mm=lens.dx_mm, dy_mm=lens.dy_mm)
            left = replace(lens, z_mm=np.minimum(z, 0.0))
            valleys = _valleys(lens, left, light.bench, target)
            light.add(radius_mm, form, _light_of(left, light.bench, target) - target, valleys=valleys)
        if on_progress is not None:
            on_progress(number / len(wanted))


def _valleys(lens: Heightfield, left: Heightfield, bench: Bench, target: Array) -> Valleys | None:
    """What a ball leaves filled of a lens; None where it is too little for a rest pass."""
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
    coarse = np.maximum(resized(target, shape), 0.0)
    return coarse / coarse.mean()
