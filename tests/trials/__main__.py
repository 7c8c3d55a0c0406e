"""`make soak`: the long trials, as figures in out/soak.md and out/soak.json; a broken law is exit 1.

    python -m tests.trials [clean faults echo kills agent wire big latency orders load estimate renderer interpreter
                           storm-sqlite storm-postgres]

Laws (nothing lost, nothing doubled, nothing foreign) are asserted; times and rates are only written down.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable

from tests.benchmarks.reporting import run_sections
from tests.benchmarks.timing import Figure
from tests.trials import interpreter, renderer, sections
from tests.trials.server import sections as server

SECTIONS: dict[str, Callable[[], Iterable[Figure]]] = {
    "clean": sections.clean,
    "faults": sections.faults,
    "echo": sections.echo,
    "kills": sections.kills,
    "agent": sections.agent,
    "wire": sections.wire,
    "big": sections.big,
    "latency": sections.latency,
    "orders": sections.orders,
    "load": sections.load,
    "estimate": sections.estimate,
    "renderer": renderer.figures,
    "interpreter": interpreter.figures,
    "storm-sqlite": server.sqlite_storm,
    "storm-postgres": server.postgres_storm,
}

if __name__ == "__main__":
    broken = [figure for figure in run_sections("soak", SECTIONS, sys.argv[1:]) if figure.note.startswith("BROKEN")]
    sys.exit(1 if broken else 0)
