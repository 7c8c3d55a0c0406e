"""Figures with machine and date beside them, as Markdown and JSON in out/."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from tests.benchmarks.timing import Figure

Sections = Mapping[str, Callable[[], Iterable[Figure]]]


def machine() -> dict[str, str]:
    """What the figures were measured on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        model = next((ln.split(":")[1].strip() for ln in cpuinfo.read_text().splitlines() if "model name" in ln), model)
    load = " ".join(f"{value:.1f}" for value in os.getloadavg())
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "machine": f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "load before": load,
    }


def run_sections(name: str, sections: Sections, chosen: Sequence[str]) -> list[Figure]:
    """Run the chosen sections (all, if none is), print each figure as it comes, and write out/<name>.md and .json."""
    unknown = sorted(set(chosen) - set(sections))
    if unknown:
        sys.exit(f"no such section: {', '.join(unknown)}; there are {', '.join(sections)}")
    about = machine()
    results: list[Figure] = []
    for section in chosen or sections:
        for figure in sections[section]():
            results.append(figure)
            print(f"{figure.name:<66} {figure.value:>12,.4g} {figure.unit}  {figure.note}", flush=True)
    out = Path("out")
    out.mkdir(exist_ok=True)
    lines = [f"# causticmill {name}", "", *(f"- {key}: {value}" for key, value in about.items()), ""]
    lines += ["| what | figure | unit | note |", "|---|---|---|---|"]
    lines += [f"| {f.name} | {f.value:,.4g} | {f.unit} | {f.note} |" for f in results]
    (out / f"{name}.md").write_text("\n".join(lines) + "\n")
    (out / f"{name}.json").write_text(json.dumps({**about, "figures": [f.__dict__ for f in results]}, indent=1) + "\n")
    return results
