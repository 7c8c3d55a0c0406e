"""Figures 9 and 12: other pictures, and what remeshing does for those on which the mesh sticks."""

from __future__ import annotations

from pathlib import Path

from tests.paper import figures
from tests.paper.cases import WAYS, by_the_paper, by_transport, edge_waviness_pixels, target
from tests.paper.section import TABLE, Section, Sizes, scores

OTHERS = ("vector", "astronaut", "characters", "logo")
STUCK = ("vector", "logo")
EDGE = "slanted edge"
EDGE_PART = (0.31, 0.69, 0.16, 0.54)  # of the picture: top, bottom, left, right


def figure_9(sizes: Sizes, folder: Path) -> Section:
    n, rows, lines = sizes.others, [], []
    for name in OTHERS:
        wanted, peak = target(name, n), target(name, n).max()
        clean, plain, ours = by_the_paper(name, n, "clean"), by_the_paper(name, n, "none"), by_transport(name, n)
        rows.append(
            [
                (name, figures.picture(wanted, peak)),
                ("isoparametric lines", figures.lines(plain.flow.lens_mm)),
                ("surface", figures.relief(plain.heightfield)),
                ("caustic, no remeshing", figures.picture(plain.light, peak)),
                ("caustic, clean remeshing", figures.picture(clean.light, peak)),
                ("caustic, our own method", figures.picture(ours.light, peak)),
            ]
        )
        lines += [f"| {name}, no remeshing | {scores(plain)} |", f"| {name}, clean remeshing | {scores(clean)} |"]
        lines.append(f"| {name}, our own method | {scores(ours)} |")
    figures.panels(folder / "figure-9.jpg", rows, side=2.1)
    table = "\n".join(lines)
    vector, words, logo = (by_the_paper(name, n, "none") for name in ("vector", "characters", "logo"))
    return Section(
        f"9 | vector graphics and Chinese characters work; strong local contrast sticks | SSIM {vector.score.ssim:.2f} "
        f"and {words.score.ssim:.2f}; white on 76 % black sticks at {100 * logo.contrast:.0f} % of the contrast",
        f"""## Figure 9: other examples

*Claim*: vector graphics and Chinese characters work as well; strong local contrast gets the mesh stuck, which leaves
the picture recognisable with too little contrast (their c and f). *Ours*, {n} x {n}: a vector graphic and characters
(light, sun, moon, mountain) drawn for this project, a portrait, and white shapes on 76 % black. The first four columns
as in the paper, without remeshing; then with it, and our own method.

![Figure 9](paper/figure-9.jpg)

| |{TABLE[1:]}
{table}

The dark specks beside edges without remeshing are the triangles that stick. Black, which the paper's method cannot make
at all, is 1 % of the mean here; the streaks across it are most likely light of creases, which a lens grid rounds off
(our own method has them too, fainter).
""",
    )


def figure_12(sizes: Sizes, folder: Path) -> Section:
    n, rows, lines = sizes.remeshed, [], []
    for name in STUCK:
        made, peak = {way: by_the_paper(name, n, way) for way in WAYS}, target(name, n).max()
        caustics = [
            (f"{way}: contrast {100 * r.contrast:.0f} %", figures.picture(r.light, peak)) for way, r in made.items()
        ]
        rows.append(
            [
                ("lines, simple", figures.lines(made["simple"].flow.lens_mm)),
                ("lines, clean", figures.lines(made["clean"].flow.lens_mm)),
                ("surface, clean", figures.relief(made["clean"].heightfield)),
                *caustics,
            ]
        )
        lines += [f"| {name}, {way}: {words} | {scores(made[way])} |" for way, words in WAYS.items()]
    edge, own = target(EDGE, n), by_transport(EDGE, n).light
    lights = {"wanted": edge} | {way: by_the_paper(EDGE, n, way).light for way in WAYS} | {"our own": own}
    cells = [(f"an edge, {name}", figures.picture(a, edge.max(), part=EDGE_PART)) for name, a in lights.items()]
    figures.panels(
        folder / "figure-12.jpg", [*rows, [("all of it", figures.picture(edge, edge.max())), *cells]], side=2.1
    )
    waves = {name: edge_waviness_pixels(light) for name, light in lights.items()}
    reached = {way: 100 * by_the_paper("logo", n, way).contrast for way in WAYS}
    table = "\n".join(lines)
    return Section(
        f"12 | remeshing brings the contrast to the input's, but edges get wavy | white on black: contrast "
        f"{reached['none']:.0f} % without, {reached['simple']:.0f} % with darts, {reached['clean']:.0f} % clean; "
        f"edge wavy by {waves['simple']:.2f} pixels with darts, {waves['clean']:.2f} clean, {waves['none']:.2f} "
        "without",
        f"""## Figure 12 and section 5: remeshing

*Claim*: a mesh that is stuck leaves the contrast lower than asked for; with remeshing it reaches the same level as the
input, but lines get dirty and edges can become wavy; cleaner remeshing is future work. *Ours*: the paper's way
(triangles with small dt cut out, darts thrown) and a clean one: the vertices go back onto an even grid over the lens
and take the screen points that the map gives them there. {n} x {n}:

![Figure 12](paper/figure-12.jpg)

| |{TABLE[1:]}
{table}

Waviness of a straight edge 20 : 1, off the grid by atan(1/4), {n} x {n}: standard deviation of
where the light crosses half way, in pixels: {", ".join(f"{name} {wave:.2f}" for name, wave in waves.items())}.
""",
    )
