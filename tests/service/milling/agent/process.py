"""A real agent: the installed command in a process of its own, told over HTTP on a loopback port."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.service.milling.agent.client import AgentClient
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[4]


class AgentProcess(AgentClient):
    def __init__(self, folder: Path, port_url: str, *options: str) -> None:
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "service.cli.main", "mill", "--machine", "grbl", "--port", port_url),
                *("--bind-port", "0", "--data", str(folder), *options),
            ],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.said: list[str] = []
        super().__init__(folder, self._read_url())

    def _read_url(self) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said.append(line)
            if found := re.search(r"http://\S+", line):
                return found.group()
        raise AssertionError(self.process.communicate()[1])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.http.close()
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()

    def stop(self, number: signal.Signals = signal.SIGTERM) -> tuple[int, str]:
        """Tell it to stop; exit code and what it said on stderr."""
        self.process.send_signal(number)
        errors = self.process.communicate(timeout=PATIENCE_S)[1]
        return self.process.returncode, errors

    def rss_mb(self) -> float:
        return memory_mb(self.process.pid)


def memory_mb(pid: int) -> float:
    """Resident memory of a process (0 once it has ended)."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024
    return 0.0


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
