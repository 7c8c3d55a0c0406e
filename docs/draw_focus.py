"""Draws a finished lens's light on a wall that moves into focus: an animation and its last picture, for the page.

causticmill make examples/astronaut.png -o out/focus --set optics.throw_mm=250
python docs/draw_focus.py out/focus service/page/jobs
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from optics.caustic import simulate_caustic
from optics.finish import surface_in_light
from optics.irradiance import flip_between_picture_and_work_frame
from service.job.arrays import load_heightfield
from service.job.picture.linear_light import linear_to_srgb
from service.job.spec.lens_task import bench_of, finish_of
from service.job.spec.loading import load_stored_spec

SIDE, FRAMES, QUALITY = 416, 26, 36
NEAREST = 0.25  # of the throw: where the wall stands first
WHITE = 3.0  # irradiance that is drawn white, where 1 is the mean
FIRST_MS, MS, LAST_MS = 700, 130, 3_600_000  # AVIF begins again at its end


def main(job: Path, folder: Path) -> None:
    spec = load_stored_spec(job)
    lens, bench = surface_in_light(load_heightfield(job / "heightfield.npz"), finish_of(spec)), bench_of(spec)
    frames = []
    for step in np.linspace(0.0, 1.0, FRAMES):
        share = 1.0 - (1.0 - NEAREST) * (1.0 - step) ** 2
        wall = replace(bench, throw_mm=share * bench.throw_mm)
        light = simulate_caustic(lens, wall, pixels=(SIDE, SIDE), tubes_per_cell=2).irradiance
        shown = flip_between_picture_and_work_frame(light, spec.optics.viewed_from)
        seen = linear_to_srgb(np.clip(shown / WHITE, 0.0, 1.0))
        frames.append(Image.fromarray(np.rint(255 * seen).astype(np.uint8)))
    times = [FIRST_MS, *[MS] * (FRAMES - 2), LAST_MS]
    frames[0].save(
        folder / "focus.avif", save_all=True, append_images=frames[1:], duration=times, quality=QUALITY, speed=2
    )
    frames[-1].save(folder / "focus-still.avif", quality=QUALITY - 6, speed=2)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
