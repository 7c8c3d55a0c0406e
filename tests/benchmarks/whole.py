"""The command as a user runs it: `causticmill make` at full size, in a process of its own."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.pictures import EXAMPLES
from tests.benchmarks.timing import Figure


def figures() -> Iterator[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "job"
        command = [
            str(Path(sys.executable).with_name("causticmill")),
            "make",
            str(EXAMPLES / "camera.png"),
            "-o",
            str(out),
            *("--preset", "paper"),
        ]
        started = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        wall = time.perf_counter() - started
        report = json.loads((out / "report.json").read_text())
    peak_gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
    yield Figure("make, camera 512, paper preset, 100 x 100 mm", wall, "s", "written, checked, with pictures")
    yield Figure("its largest process", peak_gb, "GB")
    for stage, spent in report["timings_s"].items():
        yield Figure(f"  stage {stage}", spent, "s")
    for item in report["passes"]:
        note = f"{item['lines']:,} lines, {item['bytes'] / 1e6:.0f} MB, gouge {item['gouge_um']:.4f} um"
        yield Figure(f"  machine time of {item['file']}", item["time_s"] / 3600, "h", note)
