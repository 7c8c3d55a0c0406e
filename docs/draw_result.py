"""Draws the light of several finished jobs of one picture on the wall, each with its cost, and the lens of the first.

python docs/draw_result.py out/demo out/demo-paper docs/result.jpg
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from service.job.arrays import load_heightfield
from service.job.report.figures.lens import shade_by_raking_light
from service.wording import duration

SIDE, GAP, CAPTION, FONT = 420, 12, 60, 19
PRESETS = {"recommended": "planned for this mill", "paper": "the paper's three passes", "draft": "draft"}


def main(jobs: list[Path], output: Path) -> None:
    lens = load_heightfield(jobs[0] / "heightfield.npz")
    relief = np.clip(shade_by_raking_light(lens.x_mm, lens.y_mm, lens.z_mm), 0, 1)
    tiles = [
        (Image.open(jobs[0] / "target.png"), "the picture asked for"),
        *map(show_wall, jobs),
        (Image.fromarray(np.rint(255 * relief[::-1]).astype(np.uint8)), "the lens, lit from the side"),
    ]
    strip = Image.new("L", (len(tiles) * (SIDE + GAP) - GAP, SIDE + CAPTION), 255)
    draw = ImageDraw.Draw(strip)
    for number, (tile, caption) in enumerate(tiles):
        left = number * (SIDE + GAP)
        strip.paste(tile.convert("L").resize((SIDE, SIDE), Image.Resampling.LANCZOS), (left, 0))
        draw.multiline_text((left, SIDE + 6), caption, fill=0, font=ImageFont.load_default(FONT))
    strip.save(output, quality=88)


def show_wall(job: Path) -> tuple[Image.Image, str]:
    """Return the light of a job as the viewer will see it, and its cost."""
    report, spec = (json.loads((job / name).read_text()) for name in ("report.json", "spec.json"))
    seen = "as_finished" if report.get("as_finished") else "as_milled"
    hours = f"{duration(sum(row['time_s'] for row in report['passes']))} of milling"
    by_hand = report.get("plan", {}).get("finish", {}).get("minutes") if seen == "as_finished" else None
    done = f"{hours}, {duration(60 * by_hand)} by hand" if by_hand else f"{hours}, not finished"
    caption = f"{PRESETS[spec['preset']]}: {report[seen]['psnr_db']:.1f} dB\n{done}"
    return Image.open(job / f"caustic-{seen.replace('_', '-')}.png"), caption


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:-1]], Path(sys.argv[-1]))
