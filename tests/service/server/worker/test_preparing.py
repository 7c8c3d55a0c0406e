"""The small job that compiles what others need: made once, at its own cost, and gone with the worker."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from service.processes.kernel_cache import JOBS, ready_mark
from service.server.worker import warmup
from tests.service.server.supervisor.processes import is_alive
from tests.waiting import PATIENCE_S, until

BEGIN_AND_DIE = """
import sys, time
from pathlib import Path
from service.server.worker import warmup
process = warmup.begin()
while not list(Path(sys.argv[1]).iterdir()):
    time.sleep(0.05)
print(process.pid, flush=True)
"""


def test_nothing_is_begun_where_all_is_compiled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    ready_mark(JOBS).touch()
    assert warmup.begin() is None


def test_it_ends_with_the_worker_and_leaves_no_folder(tmp_path: Path) -> None:
    scratch, cache = tmp_path / "scratch", tmp_path / "cache"
    scratch.mkdir()
    cache.mkdir()
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "TMPDIR": str(scratch)}
    command = [sys.executable, "-c", BEGIN_AND_DIE, str(scratch)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    pid = int(done.stdout)
    until(lambda: not is_alive(pid), what="the end of the process")
    until(lambda: not any(scratch.iterdir()), what="the end of its folders, also that of the process it began")
    assert not list(cache.glob("*.ready"))


@pytest.mark.thorough
def test_the_job_is_one_that_can_be_made() -> None:
    mark = ready_mark(JOBS)
    mark.unlink(missing_ok=True)
    process = warmup.begin()
    assert process is not None
    assert process.finish(within_s=PATIENCE_S) == {}
    process.end()
    assert mark.exists()
