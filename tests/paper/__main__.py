"""make paper: docs/paper.md, the figures of Yue et al. 2014 with our pictures and numbers beside each claim.

python -m tests.paper [--pixels 256] [--steps-pixels 512] [--remeshed-pixels 128] [--output docs]
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
from pathlib import Path

from tests.paper.machining import figure_13, figure_14
from tests.paper.milled import figure_15
from tests.paper.others import figure_9, figure_12
from tests.paper.portrait import figure_4, figure_5, figure_6, figure_7, figure_8
from tests.paper.section import Sizes

FIGURES = (figure_4, figure_5, figure_6, figure_7, figure_8, figure_9, figure_12, figure_13, figure_14, figure_15)

HEAD = """# The paper's figures, made again

Written by `make paper` (`python -m tests.paper`). Paper: Y. Yue, K. Iwasaki, B.-Y. Chen, Y. Dobashi, T. Nishita,
*Poisson-Based Continuous Surface Generation for Goal-Based Caustics*, ACM TOG 33(3), 2014. Block 100 x 100 mm, focal
length 100 mm, index 1.49 as there. The paper's picture may not be passed on; ours are in `examples/`, with
their sources.

How scores are made: exact Snell refraction through the C2 spline of the heightfield (vertices twice as fine as the
pictures), flux tubes, no fitted gain. PSNR and SSIM over the target's peak; *misplaced*: half the absolute difference
over the light; *contrast*: slope of the light against the target, 100 % where all of it is there. *No remeshing* is the
method of the paper's sections 3 and 4, *simple* that of its section 5, *clean* our answer to its future work. "Our own
method" is `method = "transport"`, the default of causticmill, with two corrections.
"""

MISSING = """## Not here

Figures 1, 10 and 11 are photographs of milled blocks; 2 and 3 are drawings.
"""


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pixels", type=int, default=256)
    parser.add_argument("--steps-pixels", type=int, default=512, help="for Figs 4 to 8, which the paper shows at 512")
    parser.add_argument("--remeshed-pixels", type=int, default=128, help="for Fig. 12, where darts are slow")
    parser.add_argument("--milled-mm", type=float, default=100.0, help="side of the lens that Figs 13 to 15 mill")
    parser.add_argument("--output", type=Path, default=Path(__file__).parents[2] / "docs")
    chosen = parser.parse_args(arguments)
    pictures = chosen.output / "paper"
    pictures.mkdir(parents=True, exist_ok=True)
    sizes = Sizes(
        main=chosen.steps_pixels,
        others=chosen.pixels,
        remeshed=chosen.remeshed_pixels,
        milled_mm=chosen.milled_mm,
    )
    sections = []
    for figure in FIGURES:
        sections.append(figure(sizes, pictures))
        print(f"| {sections[-1].verdict} |", flush=True)
    claims = "\n".join(f"| {section.verdict} |" for section in sections)
    parts = [HEAD, _conditions(), f"| figure | the paper's claim | ours |\n|---|---|---|\n{claims}\n"]
    text = "\n".join([*parts, *(section.text for section in sections), MISSING])
    (chosen.output / "paper.md").write_text(text, encoding="utf-8")


def _conditions() -> str:
    return (
        "CPU seconds are those of one process, the first use's compiling included where it falls in them: "
        f"Python {platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores, "
        f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}, load {os.getloadavg()[0]:.0f} (work beside adds).\n"
    )


if __name__ == "__main__":
    main()
