"""A real agent: the installed command in a process of its own, told over HTTP on a loopback port."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from tests.waiting import PATIENCE_S, seen

ROOT = Path(__file__).parents[3]


class AgentProcess:
    def __init__(self, folder: Path, port_url: str, *options: str) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "service.cli", "mill", "--machine", "grbl", "--port", port_url),
                *("--bind-port", "0", "--data", str(folder), *options),
            ],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.said: list[str] = []
        self.control = ""
        self.url = self._url()
        self.token = (folder / "token").read_text().strip()
        self.http = httpx.Client(
            base_url=self.url, headers={"Authorization": f"Bearer {self.token}"}, timeout=PATIENCE_S, trust_env=False
        )

    def _url(self) -> str:
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

    def get(self, path: str) -> Any:
        answer = self.http.get(path)
        answer.raise_for_status()
        return answer.json()

    def post(self, path: str, status: int, **body: object) -> Any:
        answer = self.give(path, body)
        assert answer.status_code == status, answer.text
        return answer.json()

    def give(self, path: str, body: object) -> httpx.Response:
        """As the job server does: an order is given under a grant, asked for at the press, by who has control."""
        if not (path.startswith("/v1/control/") or path.endswith((":start", ":resume", ":recover"))):
            return self.http.post(path, json=body)
        return self.http.post(path, json=body, headers=self.granted())

    def granted(self) -> dict[str, str]:
        """Headers of one order."""
        taken = self.http.post(
            "/v1/lease",
            json={"operator": "Ada", "principal": "ada", "take_over": True},
            headers={"Causticmill-Control": self.control},
        )
        self.control = str(taken.json()["control"])
        headers = {"Causticmill-Control": self.control}
        return headers | {"Causticmill-Grant": self.http.post("/v1/grants", headers=headers).json()["grant"]}

    def status(self) -> Any:
        return self.get("/v1/status")

    def until(self, good: Callable[[Any], bool]) -> Any:
        """Wait for a status; returns it."""
        return seen(self.status, good, every_s=0.02)

    def upload(self, path: Path) -> str:
        data = path.read_bytes()
        sha256 = hashlib.sha256(data).hexdigest()
        answer = self.http.put(f"/v1/programs/{sha256}", content=data)
        assert answer.status_code in (200, 201), answer.text
        return sha256

    @contextlib.contextmanager
    def events(self, last_id: str = "") -> Iterator[Iterator[dict[str, str]]]:
        headers = {"Last-Event-ID": last_id} if last_id else {}
        with self.http.stream("GET", "/v1/events", headers=headers) as answer:
            assert answer.status_code == 200
            yield _events(answer.iter_lines())

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


def _events(lines: Iterator[str]) -> Iterator[dict[str, str]]:
    event: dict[str, str] = {}
    for line in lines:
        if not line:
            if "data" in event:
                yield event
            event = {}
        elif not line.startswith(":"):
            name, _, value = line.partition(": ")
            event[name] = value
