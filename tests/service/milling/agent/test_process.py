"""What an agent is as a process: its signals, its death, its memory, and what keeps it from starting."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.milling.agent.client import CHECKS
from tests.service.milling.agent.process import ROOT, AgentProcess
from tests.service.mills import LONG_LINES, Bench, ends, program
from tests.waiting import PATIENCE_S


@pytest.fixture
def agent(tmp_path: Path, mill: Bench) -> Iterator[AgentProcess]:
    with AgentProcess(tmp_path / "data", mill.url) as found:
        found.until(lambda status: status["status"]["state"] == "idle")
        yield found


@pytest.mark.thorough
def test_a_program_is_brought_parked_confirmed_and_cut_whole(agent: AgentProcess, mill: Bench, tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 60)
    sha256 = agent.upload(path)
    run = agent.post("/v1/runs", 201, program=sha256, name="first")
    assert (run["state"], run["program"], mill.cut) == ("parked", sha256, [])
    problem = agent.post(f"/v1/runs/{run['id']}:start", 409, operator="Ada", checks=["tool", "zero", "clear"])
    assert "stock" in problem["detail"]
    assert mill.cut == []
    agent.post(f"/v1/runs/{run['id']}:start", 202, operator="Ada", checks=CHECKS)
    agent.until(lambda status: agent.get(f"/v1/runs/{run['id']}")["state"] == "finished")
    assert mill.cut == ends(60)


@pytest.mark.thorough
def test_a_hold_is_quick_while_twenty_readers_listen_and_some_do_not_read(
    agent: AgentProcess, mill: Bench, tmp_path: Path
) -> None:
    """Readers that never read cost bounded memory, and no hold waits for them."""
    agent.start(program(tmp_path / "p.nc", LONG_LINES))
    host, _, port = agent.url.removeprefix("http://").partition(":")
    request = f"GET /v1/events HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {agent.token}\r\n\r\n"
    with contextlib.ExitStack() as stack:
        for _ in range(20):
            reader = stack.enter_context(socket.create_connection((host, int(port))))
            reader.sendall(request.encode())
        agent.until(lambda status: status["progress"]["executed_line"] > 8)
        begun_s = time.monotonic()
        agent.post("/v1/control/hold", 202)
        assert time.monotonic() - begun_s < 10.0  # alone a few ms; on a busy machine more, but never a client's timeout
        agent.until(lambda status: status["status"]["state"] == "held")
        assert agent.rss_mb() < 70


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_an_agent_that_is_stopped_holds_the_mill_first_and_shows_the_run_as_interrupted_afterwards(
    tmp_path: Path, mill: Bench, number: signal.Signals
) -> None:
    with AgentProcess(tmp_path / "data", mill.url) as agent:
        agent.until(lambda status: status["status"]["state"] == "idle")
        run = agent.start(program(tmp_path / "p.nc", LONG_LINES))
        agent.until(lambda status: status["progress"]["executed_line"] > 8)
        with agent.events() as events:
            next(events)
            code, said = agent.stop(number)
        assert (code, "feed hold" in said) == (0, True), said
        assert "Traceback" not in said
    assert mill.stands
    cut = len(mill.cut)
    with AgentProcess(tmp_path / "data", mill.url) as agent:
        agent.until(lambda status: status["status"]["state"] not in ("connecting", "disconnected"))
        assert agent.get(f"/v1/runs/{run}")["state"] == "interrupted"
        assert [entry["bytes"] > 0 for entry in agent.get("/v1/programs")["programs"]] == [True]
    assert len(mill.cut) == cut


@pytest.mark.thorough
def test_a_killed_agent_leaves_a_run_that_the_next_one_shows_as_interrupted(tmp_path: Path, mill: Bench) -> None:
    with AgentProcess(tmp_path / "data", mill.url) as agent:
        agent.until(lambda status: status["status"]["state"] == "idle")
        run = agent.start(program(tmp_path / "p.nc", LONG_LINES))
        agent.until(lambda status: status["progress"]["executed_line"] > 8)
        agent.process.kill()
    with AgentProcess(tmp_path / "data", mill.url) as agent:
        agent.until(lambda status: status["status"]["state"] not in ("connecting", "disconnected"))
        assert agent.get(f"/v1/runs/{run}")["state"] == "interrupted"
        assert agent.get(f"/v1/runs/{run}/recovery")


def refusal(*options: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "service.cli.main", "mill", "--machine", "grbl", *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    lines = done.stderr.splitlines()
    assert (done.returncode in (1, 2), len(lines)) == (True, 1), done.stderr
    return lines[0]


@pytest.mark.thorough
def test_a_second_agent_ends_in_one_line(agent: AgentProcess, mill: Bench, tmp_path: Path) -> None:
    other, port = str(tmp_path / "other"), agent.url.rpartition(":")[2]
    assert port in refusal("--port", mill.url, "--bind-port", port, "--data", other)
    assert "data" in refusal("--port", mill.url, "--bind-port", "0", "--data", str(agent.folder))
    assert mill.url in refusal("--port", mill.url, "--bind-port", "0", "--data", other)
    assert agent.status()["status"]["state"] == "idle"


@pytest.mark.thorough
def test_the_agent_stays_small(agent: AgentProcess, mill: Bench, tmp_path: Path) -> None:
    agent.start(program(tmp_path / "p.nc", 100))
    agent.until(lambda status: status["progress"]["executed_line"] > 20)
    assert 10 < agent.rss_mb() < 52
