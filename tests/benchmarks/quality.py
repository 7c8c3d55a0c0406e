"""What corrections and polish make of pictures, the largest ball that fits, and what is left of polish once milled.

Scores by 4 x 4 tubes. As milled, plainly: rows run along x, much closer than a pixel, so a patch sends its light over
all slopes of its scallops, +-p / 2R, and over those of rows that are off in height by themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import pi, sqrt

import numpy as np

from optics.metrics import score_caustic
from optics.spline import Array
from tests.benchmarks.pictures import PAPER_SETTING, target
from tests.benchmarks.scoring import designed
from tests.benchmarks.timing import Figure

POLISH_STEPS = 10
# picture, corrections, radius of the ball [mm], polish steps
CASES = (
    ("camera", 2, 0.0, 0),
    ("camera", 2, 0.0, POLISH_STEPS),
    ("camera", 2, 2.0, POLISH_STEPS),
    ("astronaut", 2, 0.0, 0),
    ("astronaut", 2, 0.0, POLISH_STEPS),
    ("astronaut", 2, 2.0, POLISH_STEPS),
    ("logo", 3, 0.5, 0),
    ("logo", 3, 0.5, POLISH_STEPS),
    ("logo", 3, 2.0, POLISH_STEPS),
)
FINISH_RADIUS_MM = 0.5
# pitch of the finish pass [mm], of what is left of its scallops [share], height noise from row to row [um]
MILLED = ((0.02, 1.0, 0.0), (0.02, 0.1, 0.0), (0.02, 0.02, 0.0), (0.005, 1.0, 0.0), (0.02, 0.0, 0.02), (0.02, 0.0, 0.1))


def figures(pixels: int = 512) -> Iterator[Figure]:
    for name, corrections, radius_mm, steps in CASES:
        settings = replace(PAPER_SETTING, corrections=corrections, min_radius_mm=radius_mm, polish_steps=steps)
        seen = designed(target(name, pixels), settings)
        shaped = f"ball {radius_mm:g} mm, {corrections} corrections, {steps} polish steps"
        yield Figure(f"{name} {pixels}, {shaped}", seen.score.psnr_db, "dB", seen.sentence)
    for name in ("camera", "astronaut"):
        yield from _left_of_polish(name, pixels)


def _left_of_polish(name: str, pixels: int) -> Iterator[Figure]:
    goal, settings = target(name, pixels), replace(PAPER_SETTING, min_radius_mm=2.0)
    plain, polished = (
        designed(goal, replace(settings, polish_steps=steps)).caustic.irradiance for steps in (0, POLISH_STEPS)
    )
    for pitch_mm, left, noise_um in MILLED:
        before, after = (
            score_caustic(as_milled(light, pitch_mm=pitch_mm, scallops=left, noise_um=noise_um), goal).psnr_db
            for light in (plain, polished)
        )
        surface = f"pitch {pitch_mm:g} mm, {100 * left:g} % of its scallops, rows off by {noise_um:g} um"
        yield Figure(
            f"{name} {pixels}, gain by polish, {surface}", after - before, "dB", f"{before:.2f}, {after:.2f} dB"
        )


def as_milled(irradiance: Array, *, pitch_mm: float, scallops: float, noise_um: float) -> Array:
    """Irradiance (ny, nx) blurred along y by what milled rows do to slopes; mirrored at the frame's edges."""
    bench = PAPER_SETTING.bench
    reach_mm = (bench.refractive_index - 1) * bench.throw_mm  # for a change of slope
    box_mm = reach_mm * scallops * pitch_mm / FINISH_RADIUS_MM
    spread_mm = reach_mm * sqrt(2) * 1e-3 * noise_um / pitch_mm
    rows = irradiance.shape[0]
    waves = np.fft.rfftfreq(2 * rows, bench.screen.height_mm / rows)[:, None]
    kept = np.sinc(waves * box_mm) * np.exp(-2 * (pi * waves * spread_mm) ** 2)
    spectrum = np.fft.rfft(np.concatenate([irradiance, irradiance[::-1]]), axis=0)
    return np.fft.irfft(kept * spectrum, n=2 * rows, axis=0)[:rows]
