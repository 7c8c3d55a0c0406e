"""make paper: docs/paper.md, the figures of Yue et al. 2014 with our pictures and numbers beside each claim.

python -m tests.paper [--pixels 256] [--steps-pixels 512] [--output docs]
"""

from __future__ import annotations

import argparse
import platform
from pathlib import Path

from tests.paper.sections import Sizes, all_sections

HEAD = """# The paper's figures, made again

Written by `make paper` (`python -m tests.paper`). Paper: Y. Yue, K. Iwasaki, B.-Y. Chen, Y. Dobashi, T. Nishita,
*Poisson-Based Continuous Surface Generation for Goal-Based Caustics*, ACM TOG 33(3), 2014. Block 100 x 100 mm, focal
length 100 mm, index 1.49 as there. The paper's picture may not be passed on; ours are in `examples/`, with
their sources.

How scores are made: exact Snell refraction through the C2 spline of the heightfield (vertices twice as fine as the
pictures), flux tubes, no fitted gain. PSNR and SSIM over the target's peak; *misplaced*: half the absolute difference
over the light; *contrast*: slope of the light against the target, 100 % where all of it is there. "Our own method" is
`method = "transport"`, the default of causticmill, with two corrections; all else is the paper's method.
CPU seconds of one process, kernels compiled on first use included.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pixels", type=int, default=256)
    parser.add_argument("--steps-pixels", type=int, default=512, help="for Figs 5 to 8, which the paper shows at 512")
    parser.add_argument("--output", type=Path, default=Path(__file__).parents[2] / "docs")
    chosen = parser.parse_args()
    pictures = chosen.output / "paper"
    pictures.mkdir(parents=True, exist_ok=True)
    parts = [HEAD, f"Python {platform.python_version()}, {platform.machine()}.\n"]
    for section in all_sections(Sizes(main=chosen.steps_pixels, others=chosen.pixels), pictures):
        parts.append(section)
        print(section, flush=True)
    (chosen.output / "paper.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
