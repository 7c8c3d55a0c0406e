"""Figures of docs/light.md: `camera`, 512 pixels, 100 mm wide, wall at 100 mm.

Of the lens itself, designed as by default; and of the lens that docs/how-good.md makes for the finish by hand, in the
light after that finish. Pixel values are read as a job reads them.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from docs.how_good import LENSES
from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.finish import surface_in_light
from optics.heightfield import Heightfield
from optics.light import Light
from optics.metrics import psnr_db
from optics.spectrum import Spectrum
from service.job.arrays import load_heightfield, load_target
from service.job.files import HEIGHTFIELD, MAP
from service.job.spec.lens_task import bench_of, finish_of, lens_settings
from service.job.spec.loading import load_stored_spec, resolve_spec
from tests.benchmarks.timing import Figure

LIGHTS = {
    "one wavelength": Spectrum(),
    "a green LED": Spectrum(kind="led", centre_nm=530.0, width_nm=35.0),
    "white": Spectrum(kind="white"),
}
BLOCKS = {
    "clear and flat": "stock.haze_percent=0",
    "haze 1 %": "stock.haze_percent=1",
    "haze 5 %": "stock.haze_percent=5",
    "haze 20 %": "stock.haze_percent=20",
    "back of 5 um": "stock={haze_percent=0, back_flatness_mm=0.005, back_period_mm=40}",
    "back of 10 um": "stock={haze_percent=0, back_flatness_mm=0.01, back_period_mm=40}",
    "back of 20 um": "stock={haze_percent=0, back_flatness_mm=0.02, back_period_mm=40}",
}
INDEX_ERROR = 0.0026


def figures(job: Path | None = None) -> Iterator[Figure]:
    """job : the folder of `camera` of docs/how-good.md; None: made first"""
    with tempfile.TemporaryDirectory() as folder:
        if job is None:
            job = Path(folder)
            next(one for one in LENSES if one.name == "camera").make(job)
        goal, spec = load_target(job / MAP), load_stored_spec(job)
        shaped = load_heightfield(job / HEIGHTFIELD)
    finished = surface_in_light(shaped, finish_of(spec))
    lenses = {}
    clear = "stock.haze_percent=0"
    in_light = {name: replace(_bench(clear), light=Light(spectrum=spectrum)) for name, spectrum in LIGHTS.items()}
    for name, bench in in_light.items():  # of one mean index: the wall stands where each is sharp
        settings = replace(lens_settings(resolve_spec(), branch="direct"), bench=bench)
        lenses[name] = design_lens(goal, settings).heightfield
        for other, seen in in_light.items():
            yield _figure(f"lens for {name} in {other}", lenses[name], seen, goal)
    usual = {
        "lens itself": (lenses["white"], _bench),
        "finished": (finished, lambda *given: _of(bench_of(spec), _bench(*given))),
    }
    for block, given in BLOCKS.items():
        for what, (lens, bench_for) in usual.items():
            yield _figure(f"{block}, {what}", lens, bench_for(given), goal)
    for what, (lens, bench_for) in usual.items():
        bench = bench_for(clear)
        off = replace(bench, refractive_index=bench.refractive_index + INDEX_ERROR)
        yield _figure(f"index {INDEX_ERROR} more, {what}", lens, off, goal)
        yield _figure(f"wall 1 % farther, {what}", lens, replace(bench, throw_mm=1.01 * bench.throw_mm), goal)


def _bench(*overrides: str) -> Bench:
    return bench_of(resolve_spec(overrides=overrides))


def _of(own: Bench, block: Bench) -> Bench:
    """The bench of a job with another block."""
    return replace(own, haze=block.haze, back=block.back)


def _figure(name: str, lens: Heightfield, bench: Bench, goal: np.ndarray) -> Figure:
    return Figure(f"docs, {name}", psnr_db(simulate_caustic(lens, bench, pixels=goal.shape).irradiance, goal), "dB")


if __name__ == "__main__":
    for one in figures(Path(sys.argv[1])):
        print(one.name, one.value, one.unit)
