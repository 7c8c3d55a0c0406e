"""Memory and processor time of a deployment's processes."""

from __future__ import annotations

import contextlib
import os
import re
import time
from pathlib import Path

from tests.trials.server.deployment import Deployment
from tests.trials.server.processes import processes

_TICK = os.sysconf("SC_CLK_TCK")


def pss_mb(deployment: Deployment, *kinds: str) -> float:
    """Proportional set size of its processes, or of those of some kinds."""
    return sum(pss_of(process.pid) for process in processes(deployment.mark) if not kinds or process.kind in kinds)


def pss_of(pid: int) -> float:
    with contextlib.suppress(OSError):
        found = re.search(r"^Pss:\s+(\d+) kB", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.MULTILINE)
        return int(found.group(1)) / 1000 if found else 0.0
    return 0.0


def processor_share(deployment: Deployment, over_s: float) -> float:
    """Share of one core that its processes take together."""
    before, begun = _processor_s(deployment), time.monotonic()
    time.sleep(over_s)
    after = _processor_s(deployment)
    return sum(after[pid] - before.get(pid, 0.0) for pid in after) / (time.monotonic() - begun)


def _processor_s(deployment: Deployment) -> dict[int, float]:
    found = {}
    for process in processes(deployment.mark):
        with contextlib.suppress(OSError):
            after_name = Path(f"/proc/{process.pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
            found[process.pid] = (int(after_name[11]) + int(after_name[12])) / _TICK
    return found
