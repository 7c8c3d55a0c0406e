"""What corrections and polish make of pictures: scores by 4 x 4 tubes, CPU seconds, the largest ball that fits."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

from cam.cutter import largest_fitting_radius_mm
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.metrics import score_caustic
from tests.benchmarks.pictures import PAPER_SETTING, target
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
    ("logo", 3, 0.5, POLISH_STEPS),
)


def figures(pixels: int = 512) -> Iterator[Figure]:
    for name, corrections, radius_mm, steps in CASES:
        goal = target(name, pixels)
        settings = replace(PAPER_SETTING, corrections=corrections, min_radius_mm=radius_mm, polish_steps=steps)
        cpu = time.process_time()
        lens = design_lens(goal, settings).heightfield
        cpu = time.process_time() - cpu
        score = score_caustic(simulate_caustic(lens, settings.bench, pixels=goal.shape).irradiance, goal)
        ball = largest_fitting_radius_mm(lens)
        note = (
            f"CPU {cpu:.1f} s; SSIM {score.ssim:.4f}, misplaced {100 * score.misplaced_light:.2f} %, "
            f"dark leak {100 * score.dark_leak:.2f} %; ball {ball.everywhere_mm:.2f} mm, "
            f"{ball.nearly_mm:.2f} mm on 99.9 %"
        )
        shaped = f"ball {radius_mm:g} mm, {corrections} corrections, {steps} polish steps"
        yield Figure(f"{name} {pixels}, {shaped}", score.psnr_db, "dB", note)
