"""Draws docs/result.jpg, the README's picture, from a finished job:  python docs/draw_result.py out/demo"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from service.job.arrays import load_heightfield
from service.job.report.figures.lens import shade_by_raking_light

SIDE = 420
GAP = 12


def main(job: Path) -> None:
    lens = load_heightfield(job / "heightfield.npz")
    relief = np.clip(shade_by_raking_light(lens.x_mm, lens.y_mm, lens.z_mm), 0, 1)
    tiles = [
        Image.open(job / "target.png").convert("L"),
        Image.open(job / "caustic.png").convert("L"),
        Image.fromarray(np.rint(255 * relief[::-1]).astype(np.uint8)),
    ]
    strip = Image.new("L", (3 * SIDE + 2 * GAP, SIDE), 255)
    for number, tile in enumerate(tiles):
        strip.paste(tile.resize((SIDE, SIDE), Image.Resampling.LANCZOS), (number * (SIDE + GAP), 0))
    strip.save(Path(__file__).with_name("result.jpg"), quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
