"""A running job server, its customers, and a wire that breaks."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from types import TracebackType
from typing import Self

import httpx

from tests.service.server.api.server import ApiServer
from tests.trials.server.deployment import Deployment
from tests.trials.server.pictures import picture
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[3]
SMALL = ("--preset", "draft", "--set", "image.pixels=48", "--set", "optics.width_mm=8", "--set", "optics.height_mm=8")
SHARED = (*SMALL, "--set", "optics.throw_mm=33")


FILES = {
    "target.png": 5_000,
    "heightfield.npz": 90_000,
    "lens.stl": 30_000,
    "pass-1-rough.nc": 8_000,
    "report.html": 3_000,
    "thumbnail.png": 900,
    "surface.bin": 700,
}


@dataclass(frozen=True)
class Shop:
    url: str
    folder: Path

    def picture(self, number: int = 0) -> Path:
        path = self.folder / f"picture-{number}.png"
        path.write_bytes(picture(number, 48))
        return path

    def count(self) -> int:
        return len(httpx.get(f"{self.url}/v1/jobs?limit=200", trust_env=False, timeout=PATIENCE_S).json()["jobs"])


@dataclass(frozen=True)
class ShopWithoutWorker(Shop):
    """A server in this process; its job is as it is once its stages are done, though nobody computed it."""

    server: ApiServer
    _job: list[str] = field(default_factory=list)

    def job(self) -> str:
        """Id of that job."""
        if not self._job:
            self._job.append(self.server.submit()["id"])
            for number, (name, size) in enumerate(FILES.items()):
                self.server.put_artifact(self._job[0], name, Random(number).randbytes(size))
            self.server.put_stage(self._job[0], "heightfield")
            self.server.put_state(self._job[0], "succeeded", ended_at=time.time())
        return self._job[0]


@dataclass(frozen=True)
class ShopWithWorker(Shop):
    """A server as `serve` starts it."""

    deployment: Deployment
    _made: list[subprocess.CompletedProcess[str]] = field(default_factory=list)

    @property
    def out(self) -> Path:
        """Where the files of `made` are."""
        return self.folder / "out"

    def made(self) -> subprocess.CompletedProcess[str]:
        """The one job that has succeeded: SHARED, submitted and fetched with one command; made once."""
        if not self._made:
            words = ("submit", str(self.picture(1)), *SHARED, "-o", str(self.out))
            self._made.append(run(*words, server=self.url))
        return self._made[0]

    def job(self) -> str:
        """Id of that job."""
        done = self.made()
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()[0]


def run(*words: str, server: str | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command, to its end."""
    with begun(*words, server=server, **environment) as process:
        out, errors = process.communicate(timeout=PATIENCE_S)
    return subprocess.CompletedProcess(process.args, process.returncode, out, errors)


@contextlib.contextmanager
def begun(*words: str, server: str | None = None, **environment: str) -> Iterator[subprocess.Popen[str]]:
    """The command, under way; killed at the end."""
    place = {"CAUSTICMILL_SERVER": server} if server is not None else {}
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli.main", *words],
        cwd=ROOT,
        env=os.environ | place | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        if process.stdout is not None and not process.stdout.closed:
            process.communicate()


class BadWire:
    """A TCP relay before a server: each connection is cut when `cut` says so, asked with what came back so far.

    swallow: the piece that led to the cut is lost with it
    """

    def __init__(self, url: str, cut: Callable[[int, bytes], bool], *, swallow: bool = False) -> None:
        self._swallow = swallow
        target = httpx.URL(url)
        self._target = (target.host, target.port or 80)
        self._cut = cut
        self.cuts = 0
        self.connections = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._accept, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()

    def _accept(self) -> None:
        while True:
            try:
                caller, _ = self._listener.accept()
            except OSError:
                return
            self.connections += 1
            threading.Thread(target=self._relay, args=(caller, self.connections), daemon=True).start()

    def _relay(self, caller: socket.socket, number: int) -> None:
        came = b""
        with caller, contextlib.suppress(OSError), socket.create_connection(self._target) as server:
            while True:
                ready, _, _ = select.select([caller, server], [], [])
                for source in ready:
                    data = source.recv(16384)
                    if not data:
                        return
                    came += data if source is server else b""
                    cut = source is server and self._cut(number, came)
                    if not (cut and self._swallow):
                        (server if source is caller else caller).sendall(data)
                    if cut:
                        self.cuts += 1
                        return
