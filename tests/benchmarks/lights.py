"""Lenses designed for the light they get, against the collimated design under that same light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.heightfield import Heightfield
from optics.lens_settings import LensSettings
from optics.light import Light
from optics.metrics import score_caustic
from tests.benchmarks.pictures import PAPER_SETTING, target
from tests.benchmarks.scoring import designed, scores
from tests.benchmarks.timing import Figure


def gaussian(diameter_mm: float, bench: Bench, nodes: int = 65) -> np.ndarray:
    """Strength (nodes, nodes) over the aperture of a beam whose 1/e^2 diameter is that."""
    x = np.linspace(-bench.width_mm / 2, bench.width_mm / 2, nodes)
    y = np.linspace(-bench.height_mm / 2, bench.height_mm / 2, nodes)
    return np.exp(-8 * (x[None, :] ** 2 + y[:, None] ** 2) / diameter_mm**2)


LIGHTS: dict[str, Light] = {
    "sun, 0.53 degrees": Light(kind="sun"),
    "point at 500 mm": Light(kind="point", distance_mm=500.0),
    "disc of 5 mm at 500 mm": Light(kind="point", distance_mm=500.0, size_mm=5.0),
    "point at 150 mm": Light(kind="point", distance_mm=150.0),
    "collimated, Gaussian of 100 mm": Light(profile=gaussian(100.0, PAPER_SETTING.bench)),
}


def figures() -> Iterator[Figure]:
    plain = replace(PAPER_SETTING, corrections=2, min_radius_mm=0.5)
    for pixels, lights in ((256, tuple(LIGHTS)), (512, tuple(LIGHTS)[:3])):
        for name in ("camera", "astronaut"):
            goal = target(name, pixels)
            usual = designed(goal, plain).design.heightfield
            for said in lights:
                yield _figure(
                    f"{name} {pixels}, {said}",
                    goal,
                    replace(plain, bench=replace(plain.bench, light=LIGHTS[said])),
                    usual,
                )


def _figure(what: str, goal: np.ndarray, settings: LensSettings, usual: Heightfield) -> Figure:
    """The gain of the light's own design over the usual lens under that light."""
    seen = simulate_caustic(usual, settings.bench, pixels=goal.shape).irradiance
    before_db, own = score_caustic(seen, goal).psnr_db, designed(goal, settings)
    note = f"{before_db:.2f} to {own.score.psnr_db:.2f} dB ({scores(own.score)}), CPU {own.cpu_s:.1f} s"
    return Figure(f"{what}: gain of a design for it", own.score.psnr_db - before_db, "dB", note)
