"""The supervisor with real processes as its children: none is left alone, none outlives it but agents."""

from __future__ import annotations

import os
import re
import signal
import socket
import time
import urllib.request
from pathlib import Path

import pytest

from service.processes import lifeline
from service.server.supervisor.supervisor import Supervisor
from tests.service.server.supervisor.processes import CODE, Serving, is_alive, supervised
from tests.waiting import PATIENCE_S, until

API, WORKER = "stand_in_api", "stand_in_worker"


def is_written(path: Path) -> bool:
    """A file is there a moment before what it holds."""
    return path.exists() and path.stat().st_size > 0


def stage_of(data: Path) -> int:
    return int((data / "stage.pid").read_text())


def children_of(serving: Serving) -> tuple[int, int]:
    return serving.child(API), serving.child(WORKER)


def test_two_lines_when_it_is_ready(tmp_path: Path) -> None:
    """Where it is, and how to get a code for running mills from the page; the code itself goes to terminals only."""
    with supervised(tmp_path) as serving:
        serving.until_ready()
        until(lambda: len(serving.out) == 2, what="the second line")
        assert str(tmp_path) in serving.out[0]
        assert serving.url in serving.out[1] and serving.out[1].endswith(f"token pair --data {tmp_path}")
        assert not re.search(CODE, "\n".join(serving.out + serving.err))
        assert urllib.request.urlopen(serving.url).status == 200


def test_a_second_one_on_the_folder_is_refused(tmp_path: Path) -> None:
    with supervised(tmp_path) as first:
        first.until_ready()
        with supervised(tmp_path) as second:
            assert second.ended() == 2
            assert len(second.err) == 1 and f"{tmp_path} is in use by process {first.pid}" in second.err[0]
        assert first.process.poll() is None


def test_a_busy_port_is_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with supervised(tmp_path, CAUSTICMILL_PORT=str(port)) as serving:
            assert serving.ended() == 2
            assert len(serving.err) == 1 and str(port) in serving.err[0] and "in use" in serving.err[0]


@pytest.mark.parametrize(
    ("folder", "code", "words"),
    [("file/data", 1, "data folder"), ("/proc/causticmill", 1, "data folder"), ("file", 2, "is a file")],
)
def test_a_folder_that_cannot_be_is_one_line(tmp_path: Path, folder: str, code: int, words: str) -> None:
    (tmp_path / "file").touch()
    with supervised(tmp_path / folder) as serving:
        assert serving.ended() == code
        assert len(serving.err) == 1 and words in serving.err[0]


@pytest.mark.parametrize("module", [API, WORKER])
def test_a_killed_child_is_started_again(tmp_path: Path, module: str) -> None:
    with supervised(tmp_path) as serving:
        serving.until_ready()
        before = serving.child(module)
        serving.kill(before)
        until(lambda: serving.child(module) not in (0, before), what=f"another {module}")
        assert urllib.request.urlopen(serving.url).status == 200
        assert any("SIGKILL" in line for line in serving.err)
        assert not is_alive(before)


def test_callers_wait_while_the_api_is_started_again(tmp_path: Path) -> None:
    """The address stays bound: a caller at the worst moment is served late, not refused."""
    with supervised(tmp_path) as serving:
        serving.until_ready()
        before = serving.child(API)
        serving.kill(before)
        until(lambda: not is_alive(before), what="its end")
        assert urllib.request.urlopen(serving.url, timeout=PATIENCE_S).status == 200


def test_a_frozen_worker_is_killed_with_its_stage_and_started_again(tmp_path: Path) -> None:
    with supervised(tmp_path, CAUSTICMILL_LEASE_S="1") as serving:
        serving.until_ready()
        until(lambda: is_written(tmp_path / "stage.pid"), what="a stage")
        before, stage = serving.child(WORKER), stage_of(tmp_path)
        serving.kill(before, signal.SIGSTOP)
        until(lambda: serving.child(WORKER) not in (0, before), what="another worker")
        assert any("not heard of for 1 s" in line for line in serving.err)
        until(lambda: not is_alive(stage), what="the stage's end")


def test_a_worker_that_says_it_is_sick_is_started_again(tmp_path: Path) -> None:
    with supervised(tmp_path, CAUSTICMILL_LEASE_S="1", WORKER_DOES="sick") as serving:
        serving.until_ready()
        until(lambda: any("not heard of" in line for line in serving.err), what="the end of its patience")


@pytest.mark.thorough
def test_a_supervisor_that_was_frozen_itself_blames_nobody(tmp_path: Path) -> None:
    with supervised(tmp_path, CAUSTICMILL_LEASE_S="1") as serving:
        serving.until_ready()
        before = children_of(serving)
        serving.kill(serving.pid, signal.SIGSTOP)
        time.sleep(4)  # the time that passes is what is tested
        serving.kill(serving.pid, signal.SIGCONT)
        time.sleep(1.5)
        assert children_of(serving) == before and serving.process.poll() is None


def test_nothing_is_left_of_a_killed_supervisor_but_agents(tmp_path: Path) -> None:
    with supervised(tmp_path, CAUSTICMILL_START_AGENTS="true") as serving:
        serving.until_ready()
        pids = [tmp_path / "agent.pid", tmp_path / "stage.pid"]
        until(lambda: all(map(is_written, pids)), what="agent and stage")
        agent = int((tmp_path / "agent.pid").read_text())
        try:
            ours = [*children_of(serving), stage_of(tmp_path)]
            serving.kill(serving.pid)
            until(lambda: not any(map(is_alive, ours)), what="the end of all")
            assert is_alive(agent)
        finally:
            os.kill(agent, signal.SIGKILL)


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_word_ends_all_of_it_well(tmp_path: Path, kind: signal.Signals) -> None:
    with supervised(tmp_path) as serving:
        serving.until_ready()
        until(lambda: is_written(tmp_path / "stage.pid"), what="a stage")
        ours = [*children_of(serving), stage_of(tmp_path)]
        serving.kill(serving.pid, kind)
        assert serving.ended() == 0
        assert not any(map(is_alive, ours))
        assert "worker ends well" in serving.err


def test_the_second_word_ends_what_does_not_listen(tmp_path: Path) -> None:
    with supervised(tmp_path, WORKER_DOES="deaf") as serving:
        serving.until_ready()
        until(lambda: is_written(tmp_path / "stage.pid"), what="a stage")
        ours = [*children_of(serving), stage_of(tmp_path)]
        serving.kill(serving.pid, signal.SIGTERM)
        until(lambda: not is_alive(ours[0]), what="the API's end")
        assert is_alive(ours[1])
        serving.kill(serving.pid, signal.SIGTERM)
        assert serving.ended(within_s=15) == 0
        until(lambda: not any(map(is_alive, ours)), what="the end of all")


def test_a_second_word_that_comes_while_the_first_is_obeyed_is_heard() -> None:
    class Deaf:
        running, due_at, told = True, None, 0

        def start(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)

        def signal(self, number: int) -> None:
            self.told += 1
            if self.told == 1:
                os.kill(os.getpid(), signal.SIGTERM)
            self.running = number != signal.SIGKILL

        def look(self, *, wanted: bool) -> None:
            assert not wanted

    kinds = (signal.SIGCHLD, *lifeline.STOPPING)
    before = [signal.getsignal(kind) for kind in kinds]
    with socket.socket() as listener:
        supervisor = Supervisor(listener, {}, offer="", began=0.0)
        supervisor._children = [Deaf()]
        began = time.monotonic()
        assert supervisor.run() == 0
    for kind, handler in zip(kinds, before, strict=True):
        signal.signal(kind, handler)
    assert time.monotonic() - began < 15.0  # not only after the 20 s that children are given


def test_a_stopped_child_ends_well_too(tmp_path: Path) -> None:
    with supervised(tmp_path) as serving:
        serving.until_ready()
        until(lambda: is_written(tmp_path / "stage.pid"), what="a stage")
        serving.kill(serving.child(WORKER), signal.SIGSTOP)
        serving.kill(serving.pid, signal.SIGTERM)
        assert serving.ended(within_s=15) == 0
        assert "worker ends well" in serving.err


def test_a_refused_configuration_ends_it_in_the_childs_own_words(tmp_path: Path) -> None:
    with supervised(tmp_path, WORKER_DOES="refuses") as serving:
        assert serving.ended() == 2
        assert [line for line in serving.err if line.startswith("error:")] == [
            "error: CAUSTICMILL_SLOTS: this worker wants another value"
        ]


@pytest.mark.thorough
def test_a_refusal_of_what_was_good_before_is_tried_again(tmp_path: Path) -> None:
    """Such as a lock that the killed one before still seems to hold."""
    with supervised(tmp_path, WORKER_DOES="refuses the second time") as serving:
        serving.until_ready()
        until(lambda: is_written(tmp_path / "stage.pid"), what="a stage")
        time.sleep(5.5)  # it has lived well: the time that passes is what is tested
        serving.kill(serving.child(WORKER))
        until(lambda: (tmp_path / "starts").read_text() == "xxx", what="the third start")
        assert serving.process.poll() is None


def test_a_child_that_never_lives_ends_it(tmp_path: Path) -> None:
    """As long as it was never ready; later on it is patient for ever."""
    with supervised(tmp_path, "API=stand_in_worker", WORKER_DOES="crashes") as serving:
        assert serving.ended() == 1
        assert serving.err[-1].startswith("error: the ") and "5 times" in serving.err[-1]


def test_what_a_child_says_at_the_first_start_is_said_once(tmp_path: Path) -> None:
    """A database that is not there, or not one: another start would find the same."""
    with supervised(tmp_path, "API=", WORKER_DOES="fails") as serving:
        assert serving.ended() == 1
        assert serving.err == ["error: the database cannot be used: no such host"]
        assert (tmp_path / "starts").read_text() == "x"


def test_the_supervisor_is_small(tmp_path: Path) -> None:
    with supervised(tmp_path) as serving:
        serving.until_ready()
        status = Path(f"/proc/{serving.pid}/status").read_text()
        assert int(status.split("VmRSS:")[1].split()[0]) < 20_000
