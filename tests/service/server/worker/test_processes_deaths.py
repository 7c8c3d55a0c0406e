"""Whoever dies or freezes around a stage: no process stays, and no job hangs."""

from __future__ import annotations

import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.processes.linux import list_living_members
from service.server.worker.stage_process import Crashed, Done, StageProcesses, Stopped
from service.settings import ServerSettings
from tests.service.server.worker.stage_bench import (
    HERE,
    PROMPT_S,
    Bench,
    a_worker,
    fork_server_pid,
    fork_servers,
    lives,
    parent_of,
    pids_in,
    start_worker,
)
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="stages run under Linux only")


@pytest.mark.parametrize("do", ["sleep", "hold_interpreter", "family"])
def test_a_killed_worker_leaves_nothing(tmp_path: Path, do: str) -> None:
    worker, pids = a_worker(tmp_path, do)
    fork_server = parent_of(pids[0])
    worker.kill()
    worker.communicate()
    assert until(lambda: not any(map(lives, [fork_server, *pids]))) < PROMPT_S


@pytest.mark.thorough
@pytest.mark.parametrize("do", ["sleep", "hold_interpreter", "family"])
def test_the_stage_of_a_frozen_worker_ends_by_itself(tmp_path: Path, do: str) -> None:
    lease_s = 8.0
    worker, pids = a_worker(tmp_path, do, lease_s=lease_s)
    worker.send_signal(signal.SIGSTOP)
    assert until(lambda: not any(map(lives, pids))) < lease_s  # nobody takes over earlier
    worker.send_signal(signal.SIGCONT)
    said, _ = worker.communicate(timeout=PATIENCE_S)
    assert said.strip() == str(Stopped("fenced"))


@pytest.mark.thorough
def test_the_stage_ends_by_itself_when_the_fork_server_freezes_with_the_worker(tmp_path: Path) -> None:
    worker, pids = a_worker(tmp_path, "sleep", lease_s=8.0)
    fork_server = parent_of(pids[0])
    for pid in (fork_server, worker.pid):
        os.kill(pid, signal.SIGSTOP)
    try:
        assert until(lambda: not any(map(lives, pids))) < 8.0
    finally:
        for pid in (fork_server, worker.pid):
            os.kill(pid, signal.SIGKILL)
        worker.communicate()


@pytest.mark.parametrize("do", ["sleep", "family", "hold_interpreter"])
def test_a_killed_fork_server_is_a_crash_and_the_next_stage_works(bench: Bench, do: str) -> None:
    told = bench.folder / "pids"
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(bench.run, do, tell=str(told))
        until(told.exists)
        os.kill(fork_server_pid(), signal.SIGKILL)
        assert isinstance(future.result(timeout=PATIENCE_S), Crashed)
    pids = pids_in(told)
    assert not list_living_members(pids[0])
    assert not any(map(lives, pids[:2]))
    assert isinstance(bench.run("echo"), Done)
    for pid in filter(lives, pids):  # the one that left the group has nobody any more who knows of it
        os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("do", ["sleep", "hold_interpreter"])
def test_a_worker_killed_together_with_its_fork_server_leaves_nothing(tmp_path: Path, do: str) -> None:
    worker, pids = a_worker(tmp_path, do, lease_s=60.0)
    for pid in (parent_of(pids[0]), worker.pid):
        os.kill(pid, signal.SIGKILL)
    worker.communicate()
    assert until(lambda: not any(map(lives, pids))) < PROMPT_S


def test_a_frozen_fork_server_does_not_keep_a_stage_from_being_stopped(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.server.worker.stage_process._REAP_S", 0.5)
    told = bench.folder / "pids"
    wanted: list[str] = []
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(bench.run, "sleep", lambda: wanted[0] if wanted else None, tell=str(told))
        until(told.exists)
        os.kill(fork_server_pid(), signal.SIGSTOP)
        wanted.append("cancelled")
        assert future.result(timeout=PATIENCE_S) == Stopped("cancelled")
    assert not lives(pids_in(told)[0])
    assert isinstance(bench.run("echo"), Done)


def test_a_worker_that_cannot_ask_whether_it_is_wanted_does_not_beat(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """stop() hangs as a database does: the stage ends itself, and the worker has to claim the job anew."""
    monkeypatch.setenv("PYTHONPATH", str(HERE / "entries"))
    bench = Bench(tmp_path, lease_s=2.0)
    told = bench.folder / "pids"

    def stop() -> str | None:
        if told.exists():
            time.sleep(3.0)
        return None

    assert bench.run("sleep", stop, tell=str(told)) == Stopped("fenced")
    bench.processes.close()


def test_a_log_that_cannot_be_written_leaves_no_file_open(bench: Bench, tmp_path: Path) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(IsADirectoryError):
        bench.processes.run({}, log=tmp_path, on_progress=lambda _: None, stop=lambda: None)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_an_idle_fork_server_ends_and_comes_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.processes.fork_server_client._IDLE_S", 0.2)
    assert isinstance(bench.run("echo"), Done)
    until(lambda: fork_servers() == [])
    assert isinstance(bench.run("echo"), Done)


def test_a_fork_server_that_cannot_start_is_a_crash_in_words(bench: Bench, tmp_path: Path) -> None:
    processes = StageProcesses(ServerSettings.load(data=tmp_path), entry="no_such_module:run")
    end = processes.run({}, log=bench.log, on_progress=lambda _: None, stop=lambda: None)
    assert isinstance(end, Crashed) and "could not be started" in end.words
    processes.close()


def test_a_fork_server_in_the_middle_of_its_imports_dies_with_the_worker(tmp_path: Path) -> None:
    worker = start_worker(tmp_path, "none", entry="slow_import:run")
    until((tmp_path / "importing").exists)
    (fork_server,) = pids_in(tmp_path / "importing")
    worker.kill()
    worker.communicate()
    assert until(lambda: not lives(fork_server)) < PROMPT_S


def test_a_stage_that_waits_for_the_fork_server_can_be_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(HERE / "entries"))
    bench = Bench(tmp_path, "slow_import:run")
    told = tmp_path / "importing"
    assert bench.run("none", lambda: "cancelled" if told.exists() else None) == Stopped("cancelled")
    os.kill(pids_in(told)[0], signal.SIGKILL)
    bench.processes.close()
