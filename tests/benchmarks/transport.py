"""Picture to heightfield: time, memory, growth with size, and the scores that the time buys."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

from optics.caustic import simulate_caustic
from optics.design import LensDesign, design_lens
from optics.metrics import score_caustic
from tests.benchmarks.pictures import PAPER_SETTING, target
from tests.benchmarks.timing import Figure, seconds

SIZES = (256, 512, 1024, 2048)
LARGEST_CORRECTED = 1024
POLISH_STEPS = 10
# picture, corrections, polish steps, CPU seconds allowed at each size, two idle cores
CASES: tuple[tuple[str, int, int, dict[int, float]], ...] = (
    ("camera", 0, 0, {256: 0.2, 512: 0.6, 1024: 3.0, 2048: 15.0}),
    ("logo", 0, 0, {256: 0.5, 512: 3.0, 1024: 15.0}),
    ("camera", 2, 0, {256: 1.5, 512: 5.0, 1024: 25.0}),
    ("astronaut", 2, 0, {256: 1.5, 512: 5.0, 1024: 25.0}),
    ("logo", 2, 0, {256: 1.5, 512: 5.0, 1024: 25.0}),
    ("camera", 2, POLISH_STEPS, {256: 6.0, 512: 25.0, 1024: 110.0}),
    ("logo", 2, POLISH_STEPS, {256: 6.0, 512: 25.0, 1024: 110.0}),
)
_PEAK_OF_2048 = """
import resource, sys
from optics.design import design_lens
from tests.benchmarks.pictures import PAPER_SETTING, target
from dataclasses import replace
design_lens(target("camera", 2048), replace(PAPER_SETTING, corrections=int(sys.argv[1]), min_radius_mm=0.5))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def figures() -> Iterator[Figure]:
    for name, corrections, polish_steps, budgets in CASES:
        passes = f"{corrections} corrections" + (f", {polish_steps} polish steps" if polish_steps else "")
        spent: list[tuple[int, float]] = []
        for pixels in SIZES if corrections == 0 else [n for n in SIZES if n <= LARGEST_CORRECTED]:
            cpu, note = _designed(name, pixels, corrections, polish_steps)
            spent.append((pixels, cpu))
            allowed = f"; allowed {budgets[pixels]:g} s" if pixels in budgets else ""
            yield Figure(f"picture to heightfield, {name} {pixels}, {passes}", cpu, "CPU s", note + allowed)
        growth = math.log(spent[-1][1] / spent[0][1]) / math.log(spent[-1][0] / spent[0][0])
        yield Figure(f"growth of that time, {name}, {passes}", growth, "power of the picture's side")
    for corrections in (0, 2):
        command = [sys.executable, "-c", _PEAK_OF_2048, str(corrections)]
        peak = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout) / 1e6
        yield Figure(
            f"memory, camera 2048, {corrections} corrections, with Python and kernels", peak, "GB", "allowed 8"
        )
    goal = target("camera", 512)
    lens = design_lens(goal, PAPER_SETTING).heightfield
    wall, cpu = seconds(lambda: simulate_caustic(lens, PAPER_SETTING.bench, pixels=goal.shape))
    yield Figure("caustic of a 1025 x 1025 lens, 4 x 4 tubes a cell", wall, "s", f"CPU {cpu:.2f} s")


def _designed(name: str, pixels: int, corrections: int, polish_steps: int) -> tuple[float, str]:
    """CPU seconds, and the scores they buy."""
    radius_mm = 0.5 if corrections else 0.0  # with it, the light without closing is looked at too
    goal = target(name, pixels)
    settings = replace(PAPER_SETTING, corrections=corrections, min_radius_mm=radius_mm, polish_steps=polish_steps)
    designs: list[LensDesign] = []
    large = pixels > SIZES[1]
    wall, cpu = seconds(
        lambda: designs.append(design_lens(goal, settings)),
        runs=1 if large or polish_steps else 3,
        warm=pixels == SIZES[0],
    )
    light = simulate_caustic(designs[-1].heightfield, settings.bench, pixels=goal.shape)
    score = score_caustic(light.irradiance, goal)
    return cpu, (
        f"wall {wall:.2f} s; {score.psnr_db:.2f} dB, SSIM {score.ssim:.4f}, misplaced "
        f"{100 * score.misplaced_light:.2f} %, dark leak {100 * score.dark_leak:.2f} %"
    )
