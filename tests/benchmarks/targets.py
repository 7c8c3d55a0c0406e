"""300 random and adversarial pictures: how each kind ends. None may end in a fold, in NaN, or in a traceback."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from optics.bench import Bench
from optics.black import find_advice
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.errors import TotalReflectionError
from optics.irradiance import target_irradiance
from optics.lens_settings import LensSettings
from optics.metrics import score_caustic
from optics.transport.solver import solve_transport
from tests.benchmarks.hard_pictures import Hard, hard_pictures
from tests.benchmarks.timing import Figure

MOST_TURNED = 0.02  # of the light: what counts as a fold
RADIUS_MM = 0.5
_HARD = 0.06  # misplaced light that should not come without a word


@dataclass(frozen=True)
class Ending:
    """How one picture ended: `fault` is what must never be, `refused` is a throw too short for it."""

    fault: str = ""
    refused: bool = False
    converged: bool = False
    turned: float = 0.0
    misplaced: float = 0.0
    advised: bool = False
    cpu_s: float = 0.0


def ending(hard: Hard, *, side_mm: float = 100.0, throw_mm: float = 100.0, corrections: int = 1) -> Ending:
    """Design the lens and look at it; 100 mm along the picture's longer side."""
    target = target_irradiance(hard.picture, viewed_from="lens")
    ny, nx = target.shape
    scale = side_mm / max(ny, nx)
    bench = Bench.centre_on(width_mm=nx * scale, height_mm=ny * scale, throw_mm=throw_mm, refractive_index=1.49)
    started = time.process_time()
    try:
        path = solve_transport(target, bench, skim_mm=0.1)
        settings = LensSettings(bench=bench, skim_mm=0.1, corrections=corrections, min_radius_mm=RADIUS_MM)
        lens = design_lens(target, settings)
    except TotalReflectionError:
        return Ending(refused=True, cpu_s=time.process_time() - started)
    cpu_s = time.process_time() - started
    light = simulate_caustic(lens.heightfield, bench, pixels=target.shape, tubes_per_cell=2)
    fault = ""
    if not (np.isfinite(lens.heightfield.z_mm).all() and np.isfinite(light.irradiance).all()):
        fault = "NaN"
    elif path.levels[-1].turned > MOST_TURNED:
        fault = "fold"
    return Ending(
        fault=fault,
        converged=lens.converged,
        turned=path.levels[-1].turned,
        misplaced=score_caustic(light.irradiance, target).misplaced_light,
        advised=bool(find_advice(target, bench, RADIUS_MM)),
        cpu_s=cpu_s,
    )


def figures(count: int = 300) -> Iterator[Figure]:
    by_kind: dict[str, list[Ending]] = defaultdict(list)
    for hard in hard_pictures(count):
        by_kind[hard.kind].append(ending(hard))
    for kind, ends in by_kind.items():
        made = [end for end in ends if not end.refused]
        misplaced = [100 * end.misplaced for end in made]
        note = (
            f"of {len(ends)}: {sum(end.converged for end in made)} converged, {len(ends) - len(made)} refused (throw); "
            f"median {np.median(misplaced):.1f} %; turned over at most {100 * max(end.turned for end in made):.2f} %; "
            f"advice for {sum(end.advised for end in made)}; CPU {max(end.cpu_s for end in ends):.1f} s at most"
        )
        yield Figure(f"hard pictures, {kind}: most light misplaced", max(misplaced), "%", note)
    ends = [end for of_kind in by_kind.values() for end in of_kind]
    faults = [end.fault for end in ends if end.fault]
    yield Figure("hard pictures that end in a fold or NaN", len(faults), f"of {len(ends)}", ", ".join(faults))
    silent = sum(end.misplaced > _HARD and not end.advised for end in ends)
    yield Figure(f"more than {100 * _HARD:.0f} % misplaced without a word", silent, f"of {len(ends)}")
