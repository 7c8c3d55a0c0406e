"""`make bench`: figures with machine and date beside them, in out/bench.md and out/bench.json.

Figures are ratios within this run or best-of-several times on this machine; none of them is asserted.
Name sections to run only those:
python -m tests.benchmarks transport contact accuracy programs contour milled make lenses documents server stops page
"""

from __future__ import annotations

import sys

from service.processes.kernel_cache import use_current_kernels

use_current_kernels()  # before numba

from tests.benchmarks import (  # noqa: E402
    accuracy,
    black,
    contact,
    contour,
    documents,
    frames,
    how_good,
    lights,
    milled,
    page,
    photographs,
    plans,
    programs,
    quality,
    server,
    stops,
    targets,
    transport,
    whole,
)
from tests.benchmarks.reporting import run_sections  # noqa: E402
from tests.benchmarks.server import jobs  # noqa: E402

SECTIONS = {
    "transport": transport.figures,
    "targets": targets.figures,
    "quality": quality.figures,
    "photographs": photographs.figures,
    "black": black.figures,
    "lights": lights.figures,
    "frames": frames.figures,
    "contact": contact.figures,
    "accuracy": accuracy.figures,
    "programs": programs.figures,
    "contour": contour.figures,
    "contours": contour.range_figures,
    "plans": plans.figures,
    "milled": milled.figures,
    "make": whole.figures,
    "lenses": how_good.figures,
    "documents": documents.figures,
    "server": server.figures,
    "stops": stops.figures,
    "jobs": jobs.figures,
    "page": page.figures,
}

if __name__ == "__main__":
    run_sections("bench", SECTIONS, sys.argv[1:])
