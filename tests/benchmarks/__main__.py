"""`make bench`: figures with machine and date beside them, in out/bench.md and out/bench.json.

Figures are ratios within this run or best-of-several times on this machine; none of them is asserted.
Name sections to run only those: python -m tests.benchmarks transport contact programs make
"""

from __future__ import annotations

import json
import os
import platform
import sys
from datetime import UTC, datetime
from pathlib import Path

from service.kernel_cache import use_current_kernels

use_current_kernels()  # before numba

from tests.benchmarks import contact, programs, transport, whole  # noqa: E402
from tests.benchmarks.timing import Figure  # noqa: E402

SECTIONS = {
    "transport": transport.figures,
    "contact": contact.figures,
    "programs": programs.figures,
    "make": whole.figures,
}


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


def main() -> None:
    chosen = sys.argv[1:] or list(SECTIONS)
    unknown = sorted(set(chosen) - set(SECTIONS))
    if unknown:
        sys.exit(f"no such benchmark: {', '.join(unknown)}; there are {', '.join(SECTIONS)}")
    about = machine()
    results: list[Figure] = []
    for name in chosen:
        for figure in SECTIONS[name]():
            results.append(figure)
            print(f"{figure.name:<66} {figure.value:>12,.4g} {figure.unit}  {figure.note}", flush=True)
    out = Path("out")
    out.mkdir(exist_ok=True)
    lines = ["# causticmill figures", "", *(f"- {key}: {value}" for key, value in about.items()), ""]
    lines += ["| what | figure | unit | note |", "|---|---|---|---|"]
    lines += [f"| {f.name} | {f.value:,.4g} | {f.unit} | {f.note} |" for f in results]
    (out / "bench.md").write_text("\n".join(lines) + "\n")
    (out / "bench.json").write_text(json.dumps({**about, "figures": [f.__dict__ for f in results]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
