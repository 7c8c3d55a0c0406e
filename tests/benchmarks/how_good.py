"""The six lenses of docs/how-good.md, made as a person makes them: its figures."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from docs.how_good import LENSES, measures
from tests.benchmarks.timing import Figure

_UNITS = {
    "hours": "h",
    "minutes": "min",
    "milled_db": "dB",
    "finished_db": "dB",
    "lens_db": "dB",
    "seen_db": "dB",
    "wall_off_db": "dB",
}


def figures() -> Iterator[Figure]:
    for lens in LENSES:
        with tempfile.TemporaryDirectory() as folder:
            job = Path(folder) / lens.name
            lens.make(job)
            found = measures(job)
        for name, unit in _UNITS.items():
            yield Figure(f"how good, {lens.name}: {name}", found[name], unit)
