"""A gigabyte over loopback, beside two plain peers with the same client."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import sqlalchemy as sa

from service.server.database.tables import artifacts
from service.store.local import LocalStore
from tests.benchmarks.server.customer import SMALL, Customer
from tests.benchmarks.server.footprint import pss_mb
from tests.benchmarks.server.rows import row
from tests.benchmarks.server.sizes import BIG_BYTES
from tests.benchmarks.timing import Figure
from tests.trials.server.deployment import Deployment, free_port
from tests.trials.server.processes import wait_until

_TIMES = 3
_NAME = "big.npz"
_PEER = """
import sys, uvicorn
from starlette.applications import Starlette
from starlette.responses import FileResponse
from starlette.routing import Route
app = Starlette(routes=[Route("/" + sys.argv[2], lambda request: FileResponse(sys.argv[2]))])
uvicorn.run(app, host="127.0.0.1", port=int(sys.argv[1]), log_level="critical")
"""


def figures(deployment: Deployment, customer: Customer) -> Iterator[Figure]:
    job_id = customer.done(SMALL)["id"]
    with tempfile.TemporaryDirectory(dir=deployment.folder) as folder:
        big = Path(folder) / _NAME
        _write(big)
        _offer(deployment.data[0], job_id, big)
        size = f"of {BIG_BYTES / 1e9:g} GB"
        url = f"{deployment.url}/v1/jobs/{job_id}/artifacts/{_NAME}"
        before = pss_mb(deployment, "api")
        first, after_one = _rate(url, times=1), pss_mb(deployment, "api")
        rate = max(first, _rate(url))
        growth = pss_mb(deployment, "api") - after_one
        yield row(f"download {size}", rate, "MB/s", n=_TIMES + 1, least=200.0, note="best; curl, loopback")
        words = f"{before:.0f} MB before the first, {after_one:.0f} MB after it"
        yield row(f"API memory, growth by {_TIMES} more downloads", growth, "MB", n=_TIMES, note=words)
        whole = _rate(f"{deployment.url}/v1/jobs/{job_id}/archive.zip")
        yield row("download of everything as a zip", whole, "MB/s", n=_TIMES, note="made while it is sent")
        for name, words in (
            ("uvicorn + FileResponse", [sys.executable, "-c", _PEER]),
            ("python -m http.server", [sys.executable, "-m", "http.server", "--bind", "127.0.0.1"]),
        ):
            yield row(f"  peer: the same from {name}", _peer_rate(words, Path(folder)), "MB/s", n=_TIMES)


def _peer_rate(words: list[str], folder: Path) -> float:
    port = free_port()
    command = [*words, str(port), *([_NAME] if "-c" in words else [])]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        url = f"http://127.0.0.1:{port}/{_NAME}"
        assert wait_until(lambda: _answers(url), 20.0)
        return _rate(url)
    finally:
        process.kill()
        process.wait()


def _answers(url: str) -> bool:
    try:
        return httpx.head(url, timeout=5.0, trust_env=False).status_code < 500
    except httpx.HTTPError:
        return False


def _rate(url: str, times: int = _TIMES) -> float:
    """MB/s as curl measures it, the best."""
    rates = []
    for _ in range(times):
        done = subprocess.run(
            ["curl", "-fsS", "-o", os.devnull, "-w", "%{speed_download}", url],
            check=True,
            capture_output=True,
            text=True,
        )
        rates.append(float(done.stdout) / 1e6)
    return max(rates)


def _write(path: Path) -> None:
    piece = os.urandom(1_000_000)
    with path.open("wb") as file:
        for _ in range(BIG_BYTES // len(piece)):
            file.write(piece)


def _offer(data: Path, job_id: str, big: Path) -> None:
    """Put it among the job's files, as a stage would have."""
    stored = LocalStore(data / "objects").put_file(big)
    row: dict[str, Any] = {"job_id": job_id, "name": _NAME, "sha256": stored.sha256, "bytes": stored.bytes}
    engine = sa.create_engine(f"sqlite:///{data / 'causticmill.sqlite'}")
    with engine.begin() as connection:
        connection.execute(artifacts.insert().values(**row, stage="map", created_at=time.time()))
    engine.dispose()
