"""Targets and lenses the benchmarks share: pixel values are linear irradiance."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from optics.bench import Bench
from optics.heightfield import Heightfield
from optics.irradiance import target_irradiance
from optics.lens_settings import LensSettings

EXAMPLES = Path(__file__).parents[2] / "examples"
PAPER_SETTING = LensSettings(
    bench=Bench.centre_on(width_mm=100.0, height_mm=100.0, throw_mm=100.0, refractive_index=1.49), skim_mm=0.1
)


@cache
def target(name: str, pixels: int) -> np.ndarray:
    """An example picture as a target of pixels x pixels, area averaged (or interpolated where it is larger)."""
    grey = np.asarray(Image.open(EXAMPLES / f"{name}.png").convert("L"), dtype=np.float32) / 255
    how = Image.Resampling.BOX if pixels <= grey.shape[0] else Image.Resampling.BICUBIC
    sized = np.asarray(Image.fromarray(grey).resize((pixels, pixels), how), dtype=np.float64)
    return target_irradiance(np.clip(sized, 0, None), viewed_from="lens")


@cache
def bumps(spacing_mm: float = 0.1, side_mm: float = 100.0) -> Heightfield:
    """14 broad and 250 fine Gaussian bumps, relief 8 mm: a stand-in for a lens that needs no solver."""
    rng = np.random.default_rng(20140301)
    axis = np.linspace(0.0, side_mm, round(side_mm / spacing_mm) + 1)
    z = np.zeros((axis.size, axis.size))
    for count, width, height in ((14, 14.0, 3.0), (250, 2.5, 0.06)):
        for cx, cy, sign in zip(*rng.uniform(0, side_mm, (2, count)), rng.choice((-1, 1), count), strict=True):
            wx, wy = (np.exp(-(((axis - c) / width) ** 2) / 2) for c in (cx, cy))
            z += sign * height * wy[:, None] * wx[None, :]
    z *= 8.0 / np.ptp(z)
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=side_mm, height_mm=side_mm)
