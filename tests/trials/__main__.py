"""`make soak`: the long trials, as figures in out/soak.md and out/soak.json; a broken law is exit 1. docs/soak.md says
of each when it was last run, on which commit, and what was seen.

    python -m tests.trials [clean faults echo kills agent wire big latency orders load estimate recommended chips
                           renderer cad interpreter witness storm-sqlite storm-postgres]

Laws (nothing lost, nothing doubled, nothing foreign) are asserted; times and rates are only written down.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from tests.benchmarks.reporting import machine, run_sections
from tests.benchmarks.timing import Figure
from tests.trials import cad, chips, interpreter, recommended, renderer, sections, witness
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
    "recommended": recommended.figures,
    "chips": chips.figures,
    "renderer": renderer.figures,
    "cad": cad.figures,
    "interpreter": interpreter.figures,
    "witness": witness.figures,
    "storm-sqlite": server.sqlite_storm,
    "storm-postgres": server.postgres_storm,
}

LAST_RUNS = Path("docs/soak.md")
_HEAD = """# When each long trial was last run

`make soak` runs them all, `python -m tests.trials SECTION` one; each writes its row here.

| trial | commit | when | machine | seen |
|---|---|---|---|---|
"""


def recording(name: str, trial: Callable[[], Iterable[Figure]]) -> Callable[[], Iterator[Figure]]:
    """The same trial, which writes down its end."""

    def run() -> Iterator[Figure]:
        about, state, seen = machine(), commit(), []
        for figure in trial():
            seen.append(figure)
            yield figure
        words = "; ".join(f"{one.name}: {one.value:,.4g} {one.unit}, {one.note}".rstrip(", ") for one in seen)
        where = f"{about['machine']}, load {about['load before'].split()[0]}"
        write_last_run(name, [state, about["date"], where, words.replace("|", "/")])

    return run


def write_last_run(name: str, cells: list[str]) -> None:
    """A row of each trial that was ever run, in the order of SECTIONS."""
    text = LAST_RUNS.read_text() if LAST_RUNS.exists() else _HEAD
    rows = {row.split("|")[1].strip(): row for row in text.removeprefix(_HEAD).splitlines()}
    rows[name] = f"| {' | '.join([name, *cells])} |"
    LAST_RUNS.write_text(_HEAD + "".join(f"{rows[one]}\n" for one in SECTIONS if one in rows))


def commit() -> str:
    """Of what is run; with a star where it is not all committed, the rows of these trials excepted."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], capture_output=True, text=True, check=True).stdout.strip()

    return git("rev-parse", "--short", "HEAD") + "*" * bool(git("status", "--porcelain", "--", ".", f":!{LAST_RUNS}"))


if __name__ == "__main__":
    trials = {name: recording(name, trial) for name, trial in SECTIONS.items()}
    broken = [figure for figure in run_sections("soak", trials, sys.argv[1:]) if figure.note.startswith("BROKEN")]
    sys.exit(1 if broken else 0)
