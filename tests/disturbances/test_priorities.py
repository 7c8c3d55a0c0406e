"""On a busy computer agents of mills go first, then the server, and whatever computes comes last."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import pytest

from service.processes.linux import BEHIND, FIRST
from tests.disturbances.floor import running_floor
from tests.service.server.api.server import png
from tests.service.server.supervisor.processes import descendants
from tests.waiting import seen


def nice_values(pid: int) -> set[int]:
    """Of all threads of a process; empty once it has ended."""
    found = set()
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            found.add(int((task / "stat").read_text().rpartition(")")[2].split()[16]))
    return found


def names(pids: list[int]) -> dict[str, int]:
    """Processes by what they call themselves, or by the module that they run."""
    found = {}
    for pid in pids:
        with contextlib.suppress(OSError):
            own = Path(f"/proc/{pid}/comm").read_text().strip()
            words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
            module = next((word for word in reversed(words) if word.startswith("service.")), "")
            found[own if own.startswith("cm-") else module] = pid
    return found


@pytest.mark.thorough
def test_agents_go_first_and_whatever_computes_gives_way(tmp_path: Path) -> None:
    """What may not raise itself stays where it is, and says nothing."""
    first = FIRST if os.geteuid() == 0 else os.nice(0)
    with running_floor(tmp_path, lines=1) as floor:
        assert nice_values(floor.agent_process.pid) == {first}
        with floor.server as client:
            posted = client.post("/v1/jobs", files={"image": ("p.png", png(400))})
            assert posted.status_code == 202, posted.text
            asked = {"spec": "{}"}
            answer = client.post("/v1/estimates", data=asked, files={"image": ("p.png", png(40))})
            assert answer.status_code in (200, 422), answer.text
        computing = {"cm-forkserver", "cm-stage", "cm-pictures", "cm-estimates"}
        running = seen(
            lambda: names(descendants(floor.serving.pid)), lambda found: computing <= set(found), every_s=0.02
        )
        serving = {"service.server.api.main", "service.server.worker.main"}
        assert {name: nice_values(running[name]) for name in serving} == {name: {os.nice(0)} for name in serving}
        for name in computing:
            assert nice_values(running[name]) in ({BEHIND}, set()), name
