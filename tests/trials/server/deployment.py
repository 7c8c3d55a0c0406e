"""The job server as it is really started: `serve` alone on SQLite, or API and several workers on PostgreSQL."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import httpx

from tests.trials.server.processes import MARK, kill, processes, wait_until

ROOT = Path(__file__).parents[3]
COMMAND = (sys.executable, "-m", "service.cli.main")
_READY_S = 60.0
_STOP_S = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One command that a person or systemd keeps alive."""

    words: tuple[str, ...]
    data: Path
    environment: Mapping[str, str] = field(default_factory=dict)


class Deployment:
    """Starts the parts, starts again whichever ends, and stops them all."""

    def __init__(self, folder: Path, parts: list[Part], *, port: int) -> None:
        self.folder = folder
        self.mark = uuid.uuid4().hex
        self.url = f"http://127.0.0.1:{port}"
        self.restarts = 0
        self._forsaken: set[int] = set()
        self._parts = parts
        self._running: list[subprocess.Popen[bytes]] = []
        self._stopping = threading.Event()
        self._keeper = threading.Thread(target=self._keep, name="keeper", daemon=True)

    @property
    def data(self) -> list[Path]:
        return [part.data for part in self._parts]

    def __enter__(self) -> Self:
        self._running = [self._start(part) for part in self._parts]
        self._keeper.start()
        if not wait_until(self.ready, _READY_S, every_s=0.1):
            self.__exit__(None, None, None)
            raise AssertionError(f"not ready in {_READY_S:g} s: {self.log()[-2000:]}")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()
        kill(process.pid for process in processes(self.mark))

    def ready(self) -> bool:
        try:
            return httpx.get(f"{self.url}/readyz", timeout=5.0, trust_env=False).status_code == 200
        except httpx.HTTPError:
            return False

    def log(self) -> str:
        return "".join(path.read_text(errors="replace") for path in sorted(self.folder.glob("part-*.log")))

    def stop(self) -> float:
        """SIGTERM to each part; the exit is waited for. Seconds that it took."""
        begun = time.monotonic()
        self._stopping.set()
        if self._keeper.is_alive():
            self._keeper.join()
        for process in self._running:
            process.send_signal(signal.SIGCONT)
            process.terminate()
        for process in self._running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_STOP_S)
        return time.monotonic() - begun

    def forsake(self, pid: int) -> None:
        """The part of this process is not started again."""
        self._forsaken.add(pid)

    def _keep(self) -> None:
        while not self._stopping.wait(0.1):
            for number, process in enumerate(self._running):
                if process.pid in self._forsaken or self._stopping.is_set():
                    continue
                if process.poll() is not None:
                    self._running[number] = self._start(self._parts[number])
                    self.restarts += 1

    def _start(self, part: Part) -> subprocess.Popen[bytes]:
        log = self.folder / f"part-{self._parts.index(part)}.log"
        environment = {**os.environ, **_QUIET, **part.environment, MARK: self.mark}
        with log.open("ab") as out:
            return subprocess.Popen(
                [*COMMAND, *part.words, "--data", str(part.data)], cwd=ROOT, env=environment, stdout=out, stderr=out
            )


_QUIET = {
    "CAUSTICMILL_START_AGENTS": "false",
    "CAUSTICMILL_PREPARE": "false",
    "CAUSTICMILL_REQUESTS_PER_S": "2000",
    "CAUSTICMILL_JOBS_PER_MIN": "60000",
}


def embedded(folder: Path, *, environment: Mapping[str, str] | None = None) -> Deployment:
    """`causticmill serve`: everything in one folder, on SQLite."""
    port = free_port()
    data = folder / "data"
    return Deployment(
        folder, [Part(words=("serve", "--port", str(port)), data=data, environment=environment or {})], port=port
    )


def farm(
    folder: Path,
    database_url: str,
    *,
    workers: int = 2,
    api_works: bool = True,
    environment: Mapping[str, str] | None = None,
) -> Deployment:
    """API with a worker, and further workers with data folders of their own, on PostgreSQL and one shared store."""
    port = free_port()
    shared = {
        "CAUSTICMILL_DATABASE_URL": database_url,
        "CAUSTICMILL_STORE_URL": (folder / "store").as_uri(),
        "CAUSTICMILL_STORE_IS_SHARED": "true",
        **(environment or {}),
    }
    (folder / "store").mkdir(parents=True)
    serve = ("serve", "--port", str(port), *(() if api_works else ("--no-worker",)))
    parts = [Part(words=serve, data=folder / "host-1", environment=shared)]
    for number in range(2, workers + (1 if api_works else 2)):
        own = {"CAUSTICMILL_EXECUTOR": f"trial-{number}"}
        parts.append(Part(words=("worker",), data=folder / f"host-{number}", environment=shared | own))
    return Deployment(folder, parts, port=port)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
