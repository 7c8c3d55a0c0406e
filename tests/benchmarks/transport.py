"""Picture to heightfield: time, growth with size, and the scores that the time buys."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from optics.caustic import simulate_caustic
from optics.design import LensDesign, design_lens
from optics.metrics import score_caustic
from tests.benchmarks.pictures import PAPER_SETTING, target
from tests.benchmarks.timing import Figure, seconds

SIZES = (128, 256, 512, 1024)
CASES = (("camera", 0), ("camera", 2), ("astronaut", 2), ("logo", 2))


def figures() -> Iterator[Figure]:
    for name, corrections in CASES:
        settings = replace(PAPER_SETTING, corrections=corrections, min_radius_mm=0.5)
        walls: list[float] = []
        for pixels in SIZES:
            goal = target(name, pixels)
            designs: list[LensDesign] = []
            wall, cpu = seconds(
                lambda goal=goal, settings=settings, designs=designs: designs.append(design_lens(goal, settings)),
                runs=2,
                warm=pixels == SIZES[0],
            )
            walls.append(wall)
            lens = designs[-1].heightfield
            light = simulate_caustic(lens, settings.bench, pixels=goal.shape)
            score = score_caustic(light.irradiance, goal)
            note = (
                f"CPU {cpu:.2f} s; {score.psnr_db:.2f} dB, SSIM {score.ssim:.4f}, "
                f"misplaced {100 * score.misplaced_light:.2f} %, dark leak {100 * score.dark_leak:.2f} %"
            )
            yield Figure(f"picture to heightfield, {name} {pixels}, {corrections} corrections", wall, "s", note)
        growth = math.log(walls[-1] / walls[0]) / math.log(SIZES[-1] / SIZES[0])
        yield Figure(f"growth of that time, {name}, {corrections} corrections", growth, "power of the picture's side")
    goal = target("camera", 512)
    lens = design_lens(goal, PAPER_SETTING).heightfield
    wall, cpu = seconds(lambda: simulate_caustic(lens, PAPER_SETTING.bench, pixels=goal.shape))
    yield Figure("caustic of a 1025 x 1025 lens, 4 x 4 tubes a cell", wall, "s", f"CPU {cpu:.2f} s")
