"""Black areas: the logo's light in the dark by ball, lens grid and branch, beside the physical estimate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from optics.black import dark_leak_estimate
from tests.benchmarks.pictures import PAPER_SETTING, target
from tests.benchmarks.scoring import designed
from tests.benchmarks.timing import Figure

# ball [mm], vertices per pixel, polish steps
CASES = ((0.0, 2, 0), (0.5, 2, 0), (0.5, 2, 10), (1.0, 2, 0), (2.0, 2, 0), (3.0, 2, 0), (0.5, 4, 0))


def figures(pixels: int = 512) -> Iterator[Figure]:
    goal = target("logo", pixels)
    for radius_mm, per_pixel, steps in CASES:
        settings = replace(
            PAPER_SETTING, corrections=3, min_radius_mm=radius_mm, vertices_per_pixel=per_pixel, polish_steps=steps
        )
        lens = designed(goal, settings)
        estimate = 100 * dark_leak_estimate(goal, settings.bench, radius_mm)
        note = f"estimate {estimate:.2f} % without the grid's share; {lens.score.psnr_db:.2f} dB, {lens.sentence}"
        words = f"logo {pixels}, ball {radius_mm:g} mm, lens grid {per_pixel}x, {steps} polish steps: dark leak"
        yield Figure(words, 100 * lens.score.dark_leak, "%", note)
