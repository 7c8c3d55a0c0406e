"""Converts the job spec into the types of the optics package: the bench, its light, the settings of the lens."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cam.materials import MATERIALS
from optics.bench import Bench, Branch
from optics.black import choose_branch
from optics.block import Back
from optics.finish import PAD_MM, Finish
from optics.heightfield import Array
from optics.irradiance import flip_between_picture_and_work_frame
from optics.lens_settings import LensSettings
from optics.light import Light
from phrases.phrase import Phrase
from service.errors import PictureError
from service.job.files import table
from service.job.spec.finish import FinishSpec
from service.job.spec.light import LIGHT_WORDS, kind_of, name_spectrum, spectrum_of
from service.job.spec.model import JobSpec
from service.job.spec.optics import OpticsSpec

POLISH_STEPS = 20
_ONE_TONE = 1e-4  # relative spread of a target that is one tone: far below one step of 8 bits
_GAUSSIAN_NODES = 129  # from rim to rim: bilinear between them is within 2e-4 of a beam as wide as half the lens


def bench_of(spec: JobSpec) -> Bench:
    """Return the set-up. If light crosses the block straight, its thickness does not matter and is left out; for a
    mirror the block does not matter at all.
    """
    optics, is_lens = spec.optics, spec.optics.surface == "lens"
    corners = optics.outline_mm
    block = {"thickness_mm": spec.stock.thickness_mm} if optics.light_crosses_block else {}
    return Bench.centre_on(
        width_mm=optics.width_mm,
        height_mm=optics.height_mm,
        throw_mm=optics.throw_mm,
        refractive_index=optics.refractive_index,
        dispersion=MATERIALS[spec.stock.material].dispersion or 0.0,
        screen_mm=optics.screen_size_mm,
        shift_mm=(optics.screen_shift_x_mm, optics.screen_shift_y_mm),
        mirror=not is_lens,
        haze=haze_of(spec) if is_lens else 0.0,
        back=back_of(spec) if is_lens else None,
        light=light_of(optics),
        outline_mm=None if corners is None else np.array(corners),
        **block,
    )


def haze_of(spec: JobSpec) -> float:
    """Return the share of the light that the block scatters."""
    stated, usual = spec.stock.haze_percent, MATERIALS[spec.stock.material].haze
    return (usual or 0.0) if stated is None else stated / 100


def back_of(spec: JobSpec) -> Back | None:
    """Return the face by which light enters; None if it is flat, or not known."""
    flatness_mm, period_mm = spec.stock.back_flatness_mm, spec.stock.back_period_mm
    return Back(flatness_mm=flatness_mm, period_mm=period_mm) if flatness_mm else None


def light_of(optics: OpticsSpec) -> Light:
    """Return the source, its profile turned into the work frame."""
    given = optics.light
    return Light(kind=given.kind, profile=_profile(optics), spectrum=spectrum_of(given), **given.figures)


def facts_of_light(spec: JobSpec) -> dict[str, Any]:
    """Return the light of the scores as plain data, and its colours in words; dispersion: the effective n_F - n_C,
    None: unknown.
    """
    light = spec.optics.light.model_dump(mode="json", exclude={"profile"}, exclude_none=True)
    dispersion = MATERIALS[spec.stock.material].dispersion
    dispersion = 0.0 if spec.optics.surface == "mirror" else dispersion
    return {**light, "dispersion": dispersion, "words": name_spectrum(light.get("spectrum"))}


def branch_of(spec: JobSpec, target: Array) -> Branch:
    """Return whether rays cross: as the person has chosen, or as picture and block thickness suggest."""
    if spec.optics.method == "paper":
        return "direct"
    if spec.optics.branch == "auto":
        in_block = replace(bench_of(spec), thickness_mm=spec.stock.thickness_mm)
        return choose_branch(target, in_block, spec.lens_radius_mm)
    return spec.optics.branch


def with_branch(spec: JobSpec, target: Array) -> JobSpec:
    """Return the spec with the branch that its picture suggests; target (ny, nx): at the job's resolution."""
    return spec.model_copy(update={"optics": spec.optics.model_copy(update={"branch": branch_of(spec, target)})})


def lens_settings(spec: JobSpec, *, branch: Branch) -> LensSettings:
    """Return the optical task of a job."""
    optics = spec.optics
    return LensSettings(
        bench=replace(bench_of(spec), branch=branch),
        skim_mm=spec.stock.skim_mm,
        method=optics.method,
        corrections=optics.corrections,
        min_radius_mm=spec.lens_radius_mm,
        vertices_per_pixel=optics.vertices_per_pixel,
        polish_steps=POLISH_STEPS if optics.polish else 0,
        finish=finish_of(spec),
        creases=optics.creases,
    )


def finish_of(spec: JobSpec) -> Finish | None:
    """Return the finish after milling; None if nothing is levelled, or if it is still to be planned."""
    return build_finish(spec.finish)


def build_finish(given: FinishSpec) -> Finish | None:
    """Return a finish as the optics package's type; None if nothing is levelled, or if that is not known."""
    if given.k0_rad_per_mm is None or given.order is None:
        return None
    return Finish(
        k0_rad_per_mm=given.k0_rad_per_mm,
        order=given.order,
        pad_mm=PAD_MM if given.pad_mm is None else given.pad_mm,
        depth_mm=given.contact_depth_mm,
    )


def _profile(optics: OpticsSpec) -> Array | None:
    """Return the strength on the face, row 0 at the lowest y, mean 1; None if it is even."""
    light = optics.light
    if light.profile is not None:
        seen = np.array(light.profile, dtype=np.float64)
        rows = flip_between_picture_and_work_frame(seen, optics.viewed_from)
    elif light.gaussian_mm is not None:
        x, y = (np.linspace(-side / 2, side / 2, _GAUSSIAN_NODES) for side in (optics.width_mm, optics.height_mm))
        rows = np.exp(-8.0 * (x[None, :] ** 2 + y[:, None] ** 2) / light.gaussian_mm**2)
    else:
        return None
    return np.asarray(rows / rows.mean())


def explain_blocked_light(spec: JobSpec) -> Phrase | None:
    """Explain if the screen blocks the light of a mirror, which is lit past its screen."""
    optics, light = spec.optics, spec.optics.light
    if optics.surface == "lens" or (light.distance_mm or math.inf) <= optics.throw_mm:
        return None
    narrowed = 1.0 - optics.throw_mm / light.distance_mm if light.distance_mm else 1.0
    screen = optics.screen_size_mm
    need_x = (narrowed * optics.width_mm + screen[0]) / 2
    need_y = (narrowed * optics.height_mm + screen[1]) / 2
    if abs(optics.screen_shift_x_mm) >= need_x or abs(optics.screen_shift_y_mm) >= need_y:
        return None
    return Phrase(
        "the screen stands in the light of the mirror and would shade it; optics.screen_shift_x_mm = {x_mm:.0f} or "
        "optics.screen_shift_y_mm = {y_mm:.0f} lets the light pass",
        x_mm=need_x,
        y_mm=need_y,
    )


def warn_of_reflection(share: float) -> Phrase:
    """Warn of the share of light that is totally reflected inside the lens."""
    return Phrase(
        "{percent:.2g} % of the light is totally reflected inside the lens; a wall farther away helps",
        percent=100 * share,
    )


def require_contrast(spec: JobSpec, target: Array) -> None:
    """Raise PictureError for a target (ny, nx) of one tone if the light is even without a lens.

    An even screen of another size or place, or one lit by a lamp, is a valid task for a lens.
    """
    optics, light = spec.optics, spec.optics.light
    straight = light.distance_mm is None and light.even and optics.outline_mm is None
    unshifted = optics.screen_shift_x_mm == 0 == optics.screen_shift_y_mm
    same_size = optics.screen_size_mm == (optics.width_mm, optics.height_mm)
    if straight and unshifted and same_size and np.ptp(target) <= _ONE_TONE * target.max():
        raise PictureError(
            Phrase(
                "the picture is one tone all over, and without contrast the lens is a plain window; allowed: a picture "
                "with contrast, or one tone on a screen of another size"
            )
        )


def source_spread_mm(spec: Mapping[str, Any], throw_mm: float) -> float | None:
    """Return the diameter of the source's disc on the wall, for a thin lens; None for a source without size."""
    light = table(table(spec.get("optics")).get("light"))
    kind = kind_of(light)
    figures: dict[str, Any] = {
        name: float(light[name]) for name in LIGHT_WORDS[kind].figures if light.get(name) is not None
    }
    return Light(kind=kind, **figures).spread_mm(throw_mm) or None
