"""Makes six lenses, and from their folders docs/how-good.md with its pictures:  python -m docs.how_good JOBS

A lens whose folder is there already is not made again. `make bench` (section "lenses") makes them too.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import skimage
from PIL import Image

from service.wording import duration, likeness_in_words

TOP = Path(__file__).parents[1]
EXAMPLES, PHOTOGRAPHS = TOP / "examples", Path(skimage.__file__).parent / "data"
SIDE, GAP, QUALITY = 480, 16, 82


@dataclass(frozen=True)
class Lens:
    """why : for the reader, why the wall differs from the picture, and how to bring it closer"""

    name: str
    title: str
    picture: Path
    options: str
    why: str

    def make(self, folder: Path) -> None:
        """Make it as a person does, by the command."""
        command = [str(Path(sys.executable).with_name("causticmill")), "make", str(self.picture), "-o", str(folder)]
        subprocess.run([*command, *self.options.split(), "--force", "--quiet"], check=True)


LENSES = (
    Lens(
        "camera",
        "A photograph, a desktop router",
        EXAMPLES / "camera.png",
        "--machine grbl",
        """Shapes, tones and the tripod are there; the face and the buildings are soft, and the sky has streaks. The
streaks are the remains of the mill's rows: its steps of 4 µm are larger than the errors that a wall
forgives. Sanding takes most of them off, and with them the finest parts of the picture.""",
    ),
    Lens(
        "cup",
        "Large, smooth shapes",
        PHOTOGRAPHS / "coffee.png",
        "--machine grbl",
        """The highest figure of the six: large shapes with soft light on them. Dark parts beside a highlight go
first: the front of the cup and the spoon are lost. If you may choose a picture, choose one with large
shapes and no deep shadows.""",
    ),
    Lens(
        "cat",
        "A small lens on a 3018",
        PHOTOGRAPHS / "chelsea.png",
        "--machine grbl-3018 --set optics.width_mm=60 --set optics.height_mm=60 --set optics.throw_mm=200",
        """Fur and whiskers are finer than what such a mill and felt leave of a lens of this size: they run together
into waves. The wall is far away, which makes the lens flat and the milling short, and turns each error of
its slope into a longer way on the wall.""",
    ),
    Lens(
        "logo",
        "White on black",
        EXAMPLES / "logo.png",
        "--machine grbl",
        """Clear at once, and yet the lowest figure: three quarters of the picture are black, and all light from there
has to go elsewhere, over creases that a ball of this size does not reach into. What stays there is a veil.
Half the radius of the ball, or twice the distance to the wall, halves it.""",
    ),
    Lens(
        "camera-roland",
        "The same photograph on a finer mill",
        EXAMPLES / "camera.png",
        "--machine roland-mdx-40a",
        """Steps of 2 µm in place of 4, and half the error from row to row: less for the sanding to take off, and more
of the picture stays. The face is sharper, the grass is grass again, and the streaks are finer.""",
    ),
    Lens(
        "astronaut",
        "A portrait on a far wall",
        EXAMPLES / "astronaut.png",
        "--machine grbl --set optics.throw_mm=250",
        """The wall is two and a half times as far away as the lens is wide. That makes the lens flat and quick to
mill, and lets each error of its slope travel farther: streaks, soft edges, the buttons gone. The face is
still a face, as it is a large shape in soft light.""",
    ),
)
HEAD = """# How good will it be?
Six lenses, made by one command each. Left the picture wanted, right what the wall will show: the light through the
surface that the written programs leave on that mill, after the finish by hand, simulated. None of it is a photograph;
no lens of ours has been cut yet. The figures are those of `report.json`; `make bench` makes the lenses again and
measures them (section `lenses`).

How to read the figures: **as milled** is the wall before any work by hand, **finished** after it, and **the lens
itself** what a perfect surface would show. The figure is PSNR over the whole picture; the words beside it follow what
an eye sees, which is not the same: a black ground that is not quite dark costs many dB, and no one minds.
"""
FOOT = """

## What makes it better
| you change | what happens |
|---|---|
| the picture: large shapes, soft light, no black ground | the most, and it costs nothing |
| a larger lens with the same wall | detail grows with it; so do the hours |
| a nearer wall | sharper, deeper, slower |
| the finish | most of what a desktop mill loses comes back: compare *as milled* and *finished* |
| a mill of finer steps | [a little](passes.md): the finish covers the steps |
| more hours | less and less: `causticmill plan` draws the curve for your picture |

`causticmill plan PICTURE --machine NAME -o plan.png` predicts all this for your own picture and mill in a minute, and
so does a new job on [the page](page.md).
"""


def main(jobs: Path, page: Path = TOP / "docs" / "how-good.md") -> None:
    parts = [HEAD]
    for lens in LENSES:
        folder = jobs / lens.name
        if not (folder / "report.json").exists():
            lens.make(folder)
        draw(folder, page.with_name("how-good") / f"{lens.name}.webp")
        parts += describe(lens, folder)
    page.write_text("\n".join(parts) + FOOT, encoding="utf-8")


def draw(job: Path, file: Path) -> None:
    """Draw the picture wanted and the wall beside each other."""
    file.parent.mkdir(exist_ok=True)
    both = Image.new("L", (2 * SIDE + GAP, SIDE), 255)
    for left, name in ((0, "target.png"), (SIDE + GAP, "caustic-as-finished.png")):
        both.paste(Image.open(job / name).convert("L").resize((SIDE, SIDE), Image.Resampling.LANCZOS), (left, 0))
    both.save(file, quality=QUALITY, method=6)


def measures(job: Path) -> dict[str, float]:
    """Return hours of milling, minutes by hand, the likeness of three surfaces and the loss by a wall 1 % off [dB]."""
    report: dict[str, Any] = json.loads((job / "report.json").read_text())
    throw_mm = json.loads((job / "spec.json").read_text())["optics"]["throw_mm"]
    focus = [(row["offset_mm"], row["psnr_db"]) for row in report["optics"]["tolerances"]["focus"]]
    off_db = np.interp((-throw_mm / 100, 0.0, throw_mm / 100), *zip(*focus, strict=True))
    return {
        "hours": sum(row["time_s"] for row in report["passes"]) / 3600,
        "minutes": report["plan"]["finish"]["minutes"],
        "milled_db": report["as_milled"]["psnr_db"],
        "finished_db": report["as_finished"]["psnr_db"],
        "lens_db": report["optics"]["psnr_db"],
        "seen_db": report["as_finished"]["seen_db"],
        "wall_off_db": float(off_db[1] - off_db.min()),
    }


def describe(lens: Lens, job: Path) -> Iterator[str]:
    found, spec = measures(job), json.loads((job / "spec.json").read_text())
    optics = spec["optics"]
    yield f"\n## {lens.title}"
    yield f"![Left the picture wanted, right the wall: {lens.title.lower()}](how-good/{lens.name}.webp)\n"
    mill, size = spec["machine"]["profile"], f"{optics['width_mm']:g} x {optics['height_mm']:g}"
    yield (
        f"`{mill}`, lens {size} mm, wall at {optics['throw_mm']:g} mm: "
        f"**{duration(3600 * found['hours'])} of milling, "
        f"{duration(60 * found['minutes'])} of {spec['finish']['process']}**. "
        f"To the eye: {likeness_in_words(found['seen_db'])}."
    )
    yield f"\n{lens.why}\n"
    yield "| as milled | finished | the lens itself |\n|---|---|---|"
    yield "| " + " | ".join(f"{found[key]:.1f} dB" for key in ("milled_db", "finished_db", "lens_db")) + " |"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
