"""Set-ups away from the usual one, at full size: outlines, ribbons, mirrors, crossing rays, other screens."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from PIL import Image

from optics.bench import Bench
from optics.irradiance import target_irradiance
from optics.lens_settings import LensSettings
from tests.benchmarks.pictures import EXAMPLES, target
from tests.benchmarks.scoring import designed
from tests.benchmarks.timing import Figure


def _piece(name: str, rows: int, columns: int) -> np.ndarray:
    """The middle of an example picture as rows x columns."""
    with Image.open(EXAMPLES / f"{name}.png") as image:
        wide, high = image.size
        scale = min(wide / columns, high / rows)
        left, top = (wide - columns * scale) / 2, (high - rows * scale) / 2
        box = (left, top, left + columns * scale, top + rows * scale)
        grey = image.convert("F").resize((columns, rows), Image.Resampling.BICUBIC, box=box)
    return target_irradiance(np.clip(np.asarray(grey, dtype=np.float64) / 255, 0, None), viewed_from="lens")


def _bench(width_mm: float = 100.0, height_mm: float = 100.0, throw_mm: float = 100.0, **others: object) -> Bench:
    return Bench.centre_on(
        width_mm=width_mm, height_mm=height_mm, throw_mm=throw_mm, refractive_index=1.49, **others  # type: ignore[arg-type]
    )  # fmt: skip


def _round(diameter_mm: float = 100.0) -> np.ndarray:
    angles = 2 * math.pi * np.arange(256) / 256
    return diameter_mm / 2 * (1 + np.stack([np.cos(angles), np.sin(angles)], axis=1))


def _star(size_mm: float = 100.0, points: int = 5) -> np.ndarray:
    angles = math.pi * np.arange(2 * points) / points + math.pi / 2
    reach = np.where(np.arange(2 * points) % 2 == 0, 1.0, 0.6)[:, None]
    return size_mm / 2 * (1 + reach * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def cases() -> Iterator[tuple[str, np.ndarray, Bench]]:
    """What is tried: words, target, bench."""
    usual = target("camera", 512)
    yield "camera, usual frame", usual, _bench()
    yield (
        "ribbon 16 x 4096",
        _piece("camera", 16, 4096),
        _bench(width_mm=200.0, height_mm=200.0 * 16 / 4096, throw_mm=300.0),
    )
    yield (
        "ribbon 4096 x 16",
        _piece("camera", 4096, 16),
        _bench(height_mm=200.0, width_mm=200.0 * 16 / 4096, throw_mm=300.0),
    )
    yield "3:2, 768 x 512 on 150 x 100 mm", _piece("astronaut", 512, 768), _bench(width_mm=150.0)
    yield "pixels twice as wide, 256 x 512", _piece("camera", 512, 256), _bench()
    yield "round lens, square picture 512", usual, _bench(outline_mm=_round())
    yield "round lens, square picture 1024", target("camera", 1024), _bench(outline_mm=_round())
    yield "star, square picture 512", usual, _bench(outline_mm=_star())
    yield "mirror", usual, _bench(mirror=True)
    yield "mirror, screen 60 mm aside", usual, _bench(mirror=True, shift_mm=(60.0, 0.0), throw_mm=200.0)
    yield "rays cross, throw 300", target("logo", 512), _bench(branch="inverted", throw_mm=300.0, thickness_mm=60.0)
    yield "screen half as wide", usual, _bench(screen_mm=(50.0, 50.0))
    yield "screen three times as wide, throw 300", usual, _bench(screen_mm=(300.0, 300.0), throw_mm=300.0)
    yield "screen 40 mm aside, throw 200", usual, _bench(shift_mm=(40.0, -20.0), throw_mm=200.0)
    yield "index 1.8, throw 60", usual, replace(_bench(throw_mm=60.0), refractive_index=1.8)


def figures() -> Iterator[Figure]:
    for words, goal, bench in cases():
        settings = LensSettings(bench=bench, skim_mm=0.1, corrections=2, min_radius_mm=0.5)
        lens = designed(goal, settings)
        z = lens.design.heightfield.z_mm
        note = (
            f"{lens.sentence}; relief {float(np.ptp(z)):.2f} mm; lost {100 * lens.caustic.outside_share:.2f} %; "
            f"{'converged' if lens.design.converged else lens.design.message}"
        )
        yield Figure(f"frame: {words}", lens.score.psnr_db, "dB", note)
