"""`causticmill stream` that is stopped in a run for longer than a disk or a mill may be silent, and goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.service.mills import bench, ends, program
from tests.service.terminal import ROOT
from tests.waiting import PATIENCE_S, until

PAUSE_S = 33.0  # a disk may take 30 s, and so may a report


@pytest.mark.thorough
def test_a_run_goes_on_after_its_process_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path / "config"))
    path = program(tmp_path / "p.nc", 300)
    with bench(2.0) as mill:
        command = [sys.executable, "-m", "service.cli.main", "stream", str(path), "--port", mill.url, "--yes"]
        pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        process = subprocess.Popen(command, cwd=ROOT, text=True, **pipes)  # type: ignore[call-overload]
        until(lambda: len(mill.cut) > 20 or process.poll() is not None, what="cuts")
        os.kill(process.pid, signal.SIGSTOP)
        stopped_s = time.monotonic()
        until(lambda: time.monotonic() > stopped_s + PAUSE_S)
        os.kill(process.pid, signal.SIGCONT)
        out, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0 and "fsync" not in out and "no answer" not in out, out
        assert mill.cut == ends(300)
