"""One function per figure of the paper: draws ours, and says the claim and what we measure."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from optics.metrics import score_caustic
from tests.paper import figures
from tests.paper.cases import (
    WAYS,
    Result,
    by_the_paper,
    by_transport,
    edge_waviness_pixels,
    seen,
    target,
)

MAIN = "camera"  # stands for the paper's portrait
OTHERS = ("vector", "astronaut", "characters", "logo")
STUCK = ("vector", "logo")
EDGE_PIXELS = 128


class Sizes(NamedTuple):
    """Pixels a side: of the main picture (Figs 5 to 8) and of the others (Figs 9 and 12)."""

    main: int
    others: int


def all_sections(sizes: Sizes, folder: Path) -> Iterator[str]:
    for section in (figure_5, figure_6, figure_7, figure_8, figure_9, figure_12):
        yield section(sizes, folder)
    yield WHAT_IS_MISSING


def scores(result: Result) -> str:
    s = result.score
    return (
        f"{s.psnr_db:.1f} dB | {s.ssim:.3f} | {100 * s.misplaced_light:.1f} % | {100 * result.contrast:.0f} % | "
        f"{result.heightfield.relief_mm:.1f} mm | {result.cpu_s:.0f} s"
    )


TABLE = "| PSNR | SSIM | misplaced | contrast | relief | CPU |\n|---|---|---|---|---|---|---|"


def figure_5(sizes: Sizes, folder: Path) -> str:
    n, wanted = sizes.main, target(MAIN, sizes.main)
    plain, clean, ours = by_the_paper(MAIN, n, "none"), by_the_paper(MAIN, n, "clean"), by_transport(MAIN, n)
    named = (("paper, no remeshing", plain), ("paper, clean remeshing", clean), ("our own method", ours))
    peak = wanted.max()
    figures.panels(
        folder / "figure-5.jpg",
        [[("input", figures.picture(wanted, peak)), *((name, figures.picture(r.light, peak)) for name, r in named)]],
        side=3.2,
    )
    rows = "\n".join(f"| {name} | {scores(result)} |" for name, result in named)
    left, misfit = clean.flow.steps[-1].rms_percent, 1e3 * clean.surface.surface.misfit_rms
    return f"""## Figure 5: simulated caustic

*Claim*: detail of a 512 x 512 photograph is nicely reproduced. *Ours*, `{MAIN}` at {n} x {n}:

![Figure 5](paper/figure-5.jpg)

| |{TABLE[1:]}
{rows}

Clean remeshing brings D of the *map* to {left:.1f} % rms. What the picture still lacks is lost by the surface: the map
has curl, so no surface follows it everywhere (slopes are {misfit:.1f} mrad rms off) and the picture is a little out of
place. Our own method has the optical path as its unknown and no such rest.
"""


def figure_6(sizes: Sizes, folder: Path) -> str:
    flow = by_the_paper(MAIN, sizes.main, "none").flow
    kept = [snapshot for snapshot in flow.snapshots if snapshot.step in (1, 3, 5, 7, 25)]
    figures.panels(
        folder / "figure-6.jpg",
        [
            [(f"after {s.step} steps", figures.lines(s.lens_mm)) for s in kept],
            [
                (f"D, rms {100 * np.sqrt(np.mean(s.difference**2)):.1f} %", figures.difference(s.difference))
                for s in kept
            ],
        ],
    )
    at_once = {way: by_the_paper(MAIN, sizes.main, way).flow for way in ("none", "clean")}
    start = 100 * float(np.std(target(MAIN, sizes.main)))
    lines = [
        f"| {step} | "
        + " | ".join(
            f"{flow_step.rms_percent:.1f} % | {flow_step.max_percent:.0f} % | {flow_step.dt:.1e}"
            if flow_step
            else "- | - | -"
            for flow_step in (next((s for s in f.steps if s.step == step), None) for f in at_once.values())
        )
        + " |"
        for step in (1, 3, 5, 7, 25)
    ]
    table = "\n".join(lines)
    seventh, last = (at_once["none"].steps[k].rms_percent for k in (6, min(24, len(at_once["none"].steps) - 1)))
    return f"""## Figure 6: the relationship after 1, 3, 5, 7 and 25 steps

*Claim*: it almost converges after seven steps. *Ours*, without remeshing as in the paper: D starts at {start:.1f} % rms
of the mean; seven steps take {100 * (start - seventh) / (start - last):.0f} % of what 25 steps take off. Lines of
constant u, v on the lens above, D below (red: too much light, +-100 % of the mean).

![Figure 6](paper/figure-6.jpg)

| step | D rms, no remeshing | largest | dt | D rms, clean remeshing | largest | dt |
|---|---|---|---|---|---|---|
{table}

What ends it here is the rule that no triangle may flip: our picture has a black coat before a bright sky.
{at_once["none"].message} With clean remeshing (its first steps are on a coarser grid): {at_once["clean"].message}
"""


def figure_7(sizes: Sizes, folder: Path) -> str:
    ways = {way: by_the_paper(MAIN, sizes.main, way) for way in ("none", "clean")}
    ours = by_transport(MAIN, sizes.main)
    cells = [(f"paper, {way}: relief {r.heightfield.relief_mm:.1f} mm", r) for way, r in ways.items()]
    cells.append((f"our own: relief {ours.heightfield.relief_mm:.1f} mm", ours))
    figures.panels(folder / "figure-7.jpg", [[(title, figures.relief(r.heightfield)) for title, r in cells]], side=3.6)
    changes = ways["none"].surface.surface.changes_mm
    sweeps = ", ".join(f"{change:.1e}" for change in changes)
    return f"""## Figure 7: the surface

*Claim*: three iterations of section 3.2 converge; the relief of their portrait is 14.4 mm. *Ours*: relief
{ways["none"].heightfield.relief_mm:.1f} mm (another picture, with a dark figure before a bright sky), more once the
contrast is all there. The largest change of a height per iteration, in mm: {sweeps}. After three it is
{1e3 * changes[min(2, len(changes) - 1)]:.1f} µm.

![Figure 7](paper/figure-7.jpg)
"""


def figure_8(sizes: Sizes, folder: Path) -> str:
    factors = (0.5, 1.0, 1.5, 2.0)
    wanted = target(MAIN, sizes.main)
    named = {"paper, clean": by_the_paper(MAIN, sizes.main, "clean"), "our own": by_transport(MAIN, sizes.main)}
    rows, lines = [], []
    for name, result in named.items():
        lights = [seen(result.heightfield, sizes.main, 100.0 * factor) for factor in factors]
        rows.append(
            [
                (f"{name}, {f:g} x", figures.picture(light, wanted.max()))
                for f, light in zip(factors, lights, strict=True)
            ]
        )
        cells = " | ".join(
            f"{score_caustic(light, wanted).psnr_db:.1f} dB, r = {np.corrcoef(light.ravel(), wanted.ravel())[0, 1]:.2f}"
            for light in lights
        )
        lines.append(f"| {name} | {cells} |")
    figures.panels(folder / "figure-8.jpg", rows)
    table = "\n".join(lines)
    return f"""## Figure 8: through focus

*Claim*: at half and at one and a half times the focal length the pattern is slightly distorted but recognisable, and it
changes smoothly. *Ours* (the screen keeps its size; r is the correlation with the picture):

![Figure 8](paper/figure-8.jpg)

| | 0.5 x | 1 x | 1.5 x | 2 x |
|---|---|---|---|---|
{table}
"""


def figure_9(sizes: Sizes, folder: Path) -> str:
    n, rows, lines = sizes.others, [], []
    for name in OTHERS:
        wanted, clean, plain = target(name, n), by_the_paper(name, n, "clean"), by_the_paper(name, n, "none")
        peak = wanted.max()
        rows.append(
            [
                (name, figures.picture(wanted, peak)),
                ("isoparametric lines", figures.lines(clean.flow.lens_mm)),
                ("surface", figures.relief(clean.heightfield)),
                ("caustic, clean remeshing", figures.picture(clean.light, peak)),
                ("caustic, no remeshing", figures.picture(plain.light, peak)),
            ]
        )
        lines += [f"| {name}, no remeshing | {scores(plain)} |", f"| {name}, clean remeshing | {scores(clean)} |"]
        lines.append(f"| {name}, our own method | {scores(by_transport(name, n))} |")
    figures.panels(folder / "figure-9.jpg", rows, side=2.3)
    table = "\n".join(lines)
    return f"""## Figure 9: other examples

*Claim*: vector graphics and Chinese characters work as well; strong local contrast gets the mesh stuck (their c and f).
*Ours*, {n} x {n}: a vector graphic and characters drawn for this project, a portrait, and white shapes on 76 % black.

![Figure 9](paper/figure-9.jpg)

| |{TABLE[1:]}
{table}
"""


def figure_12(sizes: Sizes, folder: Path) -> str:
    n, rows, lines = sizes.others, [], []
    for name in STUCK:
        wanted = target(name, n)
        made = {way: by_the_paper(name, n, way) for way in WAYS}
        peak = wanted.max()
        rows.append(
            [
                ("lines, darts", figures.lines(made["simple"].flow.lens_mm)),
                ("lines, clean", figures.lines(made["clean"].flow.lens_mm)),
                *(
                    (f"{way}: contrast {100 * r.contrast:.0f} %", figures.picture(r.light, peak))
                    for way, r in made.items()
                ),
            ]
        )
        lines += [f"| {name}, {way}: {words} | {scores(made[way])} |" for way, words in WAYS.items()]
    edge, cells, waves = target("slanted edge", EDGE_PIXELS), [], []
    for way in WAYS:
        result = by_the_paper("slanted edge", EDGE_PIXELS, way)
        part = result.light[40:88, 20:68]
        cells.append((f"an edge, {way}", figures.picture(part, edge.max())))
        waves.append(f"{way} {edge_waviness_pixels(result.light):.2f}")
    cells.append(("the edge wanted", figures.picture(edge[40:88, 20:68], edge.max())))
    cells.append(
        ("an edge, our own", figures.picture(by_transport("slanted edge", EDGE_PIXELS).light[40:88, 20:68], edge.max()))
    )
    figures.panels(folder / "figure-12.jpg", [*rows, cells], side=2.3)
    table = "\n".join(lines)
    own = edge_waviness_pixels(by_transport("slanted edge", EDGE_PIXELS).light)
    return f"""## Figure 12 and section 5: remeshing

*Claim*: a mesh that is stuck leaves the contrast lower than asked for; with remeshing it reaches the same level as the
input, but lines get dirty and edges can become wavy; cleaner remeshing is future work. *Ours*: the paper's way
(triangles with small dt cut out, darts thrown) and a clean one: the vertices go back onto an even grid over the lens
and take the screen points that the map gives them there.

![Figure 12](paper/figure-12.jpg)

| |{TABLE[1:]}
{table}

Waviness of a straight edge 20 : 1, off the grid by atan(1/4), {EDGE_PIXELS} x {EDGE_PIXELS}: standard deviation of
where the light crosses half way, in pixels: {", ".join(waves)}, our own method {own:.2f}.
"""


WHAT_IS_MISSING = """## Not here yet

Figures 1, 10 and 11 are photographs of milled blocks. Figures 13 to 15 (milling path, scallops, their light) come with
the machining part of this project.
"""
