"""The API as a process: says when it serves, stops cleanly, stays lean, and refuses what would not be safe."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from service.server.database.connection import connect
from service.settings import ServerSettings
from tests.service.server.api.server import migrate, png
from tests.waiting import PATIENCE_S, until

HEAVY = ("numpy", "scipy", "numba", "matplotlib", "PIL", "skimage", "trimesh")
START = [sys.executable, "-m", "service.server.api.main"]


def environment(data: Path, **values: str) -> dict[str, str]:
    given = {f"CAUSTICMILL_{name.upper()}": value for name, value in values.items()}
    usual = {"CAUSTICMILL_DATA": str(data), "CAUSTICMILL_PORT": "0", "CAUSTICMILL_FREE_DISK_MB": "0"}
    return os.environ | usual | {"CAUSTICMILL_PREPARE": "false"} | given


def migrated(data: Path) -> None:
    migrate(ServerSettings(data=data))


@contextmanager
def api_process(
    data: Path, command: list[str] = START, **values: str
) -> Iterator[tuple[subprocess.Popen[str], httpx.Client]]:
    process = subprocess.Popen(
        command, env=environment(data, **values), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("causticmill on http://127.0.0.1:"), line + process.communicate()[1]
        with httpx.Client(base_url=line.split()[-1], timeout=PATIENCE_S) as client:
            yield process, client
    finally:
        process.kill()
        process.communicate()


@pytest.mark.thorough
def test_it_says_when_it_serves_and_ends_within_seconds_when_told(tmp_path: Path) -> None:
    migrated(tmp_path)
    with api_process(tmp_path) as (process, client):
        job = client.post("/v1/jobs", files={"image": png()}).json()
        ended = threading.Event()

        def follow() -> None:
            with client.stream("GET", f"/v1/jobs/{job['id']}/events") as answer:
                for _ in answer.iter_bytes():
                    pass
            ended.set()

        threading.Thread(target=follow, daemon=True).start()
        until(lambda: "causticmill_followers 1.0" in client.get("/metrics").text)
        process.send_signal(signal.SIGTERM)
        assert ended.wait(PATIENCE_S)
        assert process.wait(PATIENCE_S) in (0, -signal.SIGTERM)
    with api_process(tmp_path) as (_, client):
        assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "queued"


@pytest.mark.thorough
def test_it_waits_for_the_tables(tmp_path: Path) -> None:
    threading.Timer(1.0, migrated, [tmp_path]).start()
    with api_process(tmp_path) as (_, client):
        assert client.get("/v1/jobs").json() == {"jobs": [], "next": None}


def test_what_a_killed_server_left_is_removed(tmp_path: Path) -> None:
    migrated(tmp_path)
    (tmp_path / "uploads").mkdir()
    (tmp_path / "uploads" / "0123.upload").write_bytes(b"half a picture")
    with api_process(tmp_path):
        assert list((tmp_path / "uploads").iterdir()) == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    "values", [{"host": "0.0.0.0"}, {"host": "0.0.0.0", "behind_proxy": "true"}, {"port": "99999"}]
)
def test_what_is_not_safe_ends_in_one_line(tmp_path: Path, values: dict[str, str]) -> None:
    migrated(tmp_path)
    done = subprocess.run(
        START, env=environment(tmp_path, **values), capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


def test_the_process_imports_no_mathematics(tmp_path: Path) -> None:
    code = (
        "import sys, json, service.server.api.main as m\nfrom service.job.stages.table import plan, shares, stage_key\n"
    )
    code += "print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(json.loads(done.stdout))
    assert [name for name in HEAVY if name in loaded] == []


def pss_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    return int(next(line for line in text.splitlines() if line.startswith("Pss:")).split()[1]) / 1000


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="needs Linux")
def test_a_large_download_costs_no_memory(tmp_path: Path) -> None:
    """400 MB, twice at a time: the process must not grow by more than a few pieces."""
    migrated(tmp_path)
    with api_process(tmp_path) as (process, client):
        job_id = client.post("/v1/jobs", files={"image": png()}).json()["id"]
        put_large(tmp_path, job_id, 400_000_000)
        before, peak, done = pss_mb(process.pid), 0.0, []

        def fetch() -> None:
            size = 0
            with client.stream("GET", f"/v1/jobs/{job_id}/artifacts/heightfield.npz") as answer:
                for piece in answer.iter_raw(1 << 20):
                    size += len(piece)
            done.append(size)

        threads = [threading.Thread(target=fetch) for _ in range(2)]
        began = time.monotonic()
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            peak = max(peak, pss_mb(process.pid))
            threads[0].join(0.05)
        for thread in threads:
            thread.join()
        print(f"{800 / (time.monotonic() - began):.0f} MB/s, {before:.0f} -> {peak:.0f} MB")
        assert done == [400_000_000] * 2
        assert peak - before < 64


def put_large(data: Path, job_id: str, size: int) -> None:
    """An artifact of zeros."""
    from service.server.database.connection import begin_writing
    from service.server.database.tables import artifacts
    from service.store.local import LocalStore

    path = data / "large"
    with path.open("wb") as file:
        file.truncate(size)
    stored = LocalStore(data / "objects").put_file(path)
    path.unlink()
    database = connect(ServerSettings(data=data).sqlalchemy_url)
    row = {"job_id": job_id, "name": "heightfield.npz", "sha256": stored.sha256, "bytes": size, "stage": "map"}
    with begin_writing(database) as connection:
        connection.execute(artifacts.insert().values(**row, created_at=0.0))
    database.dispose()
