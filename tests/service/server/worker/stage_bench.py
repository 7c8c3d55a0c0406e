"""What tests of stage processes share: a place to run odd stages, a worker to kill, questions about processes."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.processes.linux import own_children
from service.server.worker.stage_process import StageEnd, StageProcesses
from service.settings import ServerSettings
from tests.waiting import until

PROMPT_S = 20.0  # on a busy computer; the figure itself, some hundredths of a second, is for the benchmarks

HERE = Path(__file__).parent
ROOT = HERE.parents[3]


class Bench:
    """StageProcesses with the odd stages, and what a test wants to know about them."""

    def __init__(self, folder: Path, entry: str = "odd_stages:run", **settings: Any) -> None:
        given = {"data": folder, "lease_s": 20.0, "stage_memory_mb": 600, **settings}
        self.folder = folder
        self.log = folder / "stage.log"
        self.processes = StageProcesses(ServerSettings.load(**given), entry=entry)
        self.shares: list[float] = []

    def run(self, do: str, stop: Callable[[], str | None] = lambda: None, **order: Any) -> StageEnd:
        return self.processes.run({"do": do, **order}, log=self.log, on_progress=self.shares.append, stop=stop)

    def stopped_when_told(self, do: str, reason: str = "cancelled", **order: Any) -> tuple[StageEnd, float, list[int]]:
        """Stop a stage as soon as it has told its process numbers: the end, the seconds that took, the numbers."""
        told = self.folder / f"pids-{threading.get_ident()}"
        told.unlink(missing_ok=True)
        asked: list[float] = []

        def stop() -> str | None:
            if told.exists():
                asked.append(time.monotonic())
                return reason
            return None

        end = self.run(do, stop, tell=str(told), **order)
        return end, time.monotonic() - asked[0], pids_in(told)


def pids_in(file: Path) -> list[int]:
    return [int(word) for word in file.read_text().split()]


def lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def fork_servers() -> list[int]:
    """Fork-server processes of this test process; one that ends while they are looked at is none."""
    found = []
    for pid in own_children():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if Path(f"/proc/{pid}/comm").read_text().strip() == "cm-forkserver":
                found.append(pid)
    return found


def fork_server_pid() -> int:
    (pid,) = fork_servers()
    return pid


def start_worker(folder: Path, do: str, lease_s: float = 20.0, entry: str = "odd_stages:run") -> subprocess.Popen[str]:
    """A real worker process that runs one stage."""
    order = json.dumps({"do": do, "tell": str(folder / "pids")})
    return subprocess.Popen(
        [sys.executable, str(HERE / "worker_process.py"), str(folder), order, str(lease_s), entry],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(HERE / "entries")])},
        stdout=subprocess.PIPE,
        text=True,
        cwd=folder,
    )


def a_worker(folder: Path, do: str, lease_s: float = 20.0) -> tuple[subprocess.Popen[str], list[int]]:
    """A worker whose stage runs; the worker, and the numbers that the stage told."""
    worker, told = start_worker(folder, do, lease_s), folder / "pids"
    until(told.exists)
    return worker, pids_in(told)


def parent_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
