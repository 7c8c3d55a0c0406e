"""Photographs of the witness marks' light: rows with errors, a finish, a lamp with a size, a hand-held camera."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np
from scipy.ndimage import gaussian_filter1d

from optics import contact
from optics.contact import Wear, wear_surface
from optics.finish import Finish
from optics.spline import Array
from optics.witness import Strip
from optics.witness_light import CELL_MM, WALL_MM, strip_heights_mm
from tests.optics.photographs import camera, photographed

_PER_MM = 50
_WIDE_MM, _AROUND_MM = 5.0, 4.0


def work_strip(heights_mm: Array, finish: Finish, depth_mm: float, dose: float) -> Array:
    """Heights after that share of a finish by a pad that takes depth_mm off at the planned dose: unilateral contact."""
    reached = replace(finish, k0_rad_per_mm=finish.k0_rad_per_mm * dose ** (-1 / finish.order))
    same = np.tile(heights_mm, (3, 1))
    multipliers = reached.multipliers(same.shape, (CELL_MM, CELL_MM))
    return np.asarray((same - wear_in_steps(same, multipliers, depth_mm * dose, steps=4).removal_mm)[1])


def wear_in_steps(heights_mm: Array, multipliers: Array, depth_mm: float, *, steps: int) -> Wear:
    with mock.patch.object(contact, "STEPS", steps):
        return wear_surface(heights_mm, multipliers, depth_mm)


def rough_heights_mm(strip: Strip, noise_mm: float, *, seed: int) -> tuple[Array, Array]:
    """As `strip_heights_mm`, of rows whose tips are off by noise."""
    places, tips = strip.rows()
    tips = tips + noise_mm * np.random.default_rng(seed).standard_normal(tips.size)
    with mock.patch.object(Strip, "rows", return_value=(places, tips)):
        return strip_heights_mm(strip)


def light_on_paper(
    strip: Strip, finish: Finish, depth_mm: float, dose: float, *, noise_mm: float, lamp_mm: float,
    lever: float = 1.0, seed: int = 0, covered_mm: tuple[float, float] = (0.0, 0.0),
) -> Array:  # fmt: skip
    """Light (n,) along the strip and 4 mm around it, 50 to a mm; rays counted where they arrive, no linear optics.

    covered_mm : of either end of the strip, by tape
    lever      : of the paper, over its nominal one
    lamp_mm    : standard deviation of the blur there
    """
    u, milled = rough_heights_mm(strip, noise_mm, seed=seed)
    heights = work_strip(milled, finish, depth_mm, dose)
    fine = np.linspace(covered_mm[0], strip.length_mm - covered_mm[1], 60 * round(_PER_MM * strip.length_mm))
    slope = np.interp(fine, u, np.gradient(heights, u[1] - u[0]))
    arrive = fine + 0.49 * WALL_MM * lever * slope
    seen_mm = strip.length_mm - sum(covered_mm)
    ends = covered_mm[0] - _AROUND_MM, strip.length_mm - covered_mm[1] + _AROUND_MM
    light, _ = np.histogram(arrive, bins=round((seen_mm + 2 * _AROUND_MM) * _PER_MM), range=ends)
    return np.asarray(gaussian_filter1d(light / 60.0, lamp_mm * _PER_MM))


def photograph_strip(light: Array, *, seed: int) -> Array:
    """A photograph (h, w) of that light, linear as an 8 bit file keeps it: askew, exposed at random, with noise."""
    rng = np.random.default_rng(1000 + seed)
    across = np.zeros(round((_WIDE_MM + 2 * _AROUND_MM) * _PER_MM))
    rim = round(_AROUND_MM * _PER_MM)
    across[rim:-rim] = 1.0
    picture = gaussian_filter1d(across, 0.05 * _PER_MM)[:, None] * light
    place = camera(
        aside_deg=rng.uniform(-20, 20),
        above_deg=rng.uniform(-15, 15),
        roll_deg=rng.uniform(-15, 15),
        quarter_turns=int(rng.integers(0, 4)),
        aspect=picture.shape[1] / picture.shape[0],
        shape=(1500, 1500),
        filling=rng.uniform(0.6, 0.8),
    )
    return photographed(
        picture,
        place,
        shape=(1500, 1500),
        stops=rng.uniform(-2.0, -0.2),
        blur_px=rng.uniform(0.7, 2.5),
        noise=0.02,
        background=rng.uniform(0.003, 0.02),
        shading=rng.uniform(0.0, 0.2),
        seed=seed,
    ).photo
