"""Which mills there are and how their agents are found: profiles, agent.json, the list of agents elsewhere."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from service.errors import InputError
from service.milling.agent.card import CARD_FILE, read_card
from service.server.fleet.agent_launcher import start_agents
from service.server.fleet.registry import read_machines, remote_machines
from service.settings import ServerSettings
from tests.service.milling.agent.process import AgentProcess
from tests.service.mills import Bench, bench
from tests.service.server.api.server import api_server
from tests.service.server.fleet.shop import (
    MACHINE,
    Shop,
    agent_pids,
    await_agent,
    give,
    kill_agents,
    own_folders,
    shop,
    write_profile,
)
from tests.waiting import seen

_STARTER = """
import os, signal, sys
from pathlib import Path
from service.server.fleet.agent_launcher import start_agents
from service.settings import ServerSettings
print(start_agents(ServerSettings(data=Path(sys.argv[1]))), flush=True)
os.killpg(0, signal.SIGKILL)
"""


def test_an_agent_outlives_its_starter_and_is_found_again(tmp_path: Path, mill: Bench) -> None:
    settings = ServerSettings(data=tmp_path / "data")
    starter = subprocess.run(
        [sys.executable, "-c", _STARTER, str(settings.data)], start_new_session=True, capture_output=True, text=True
    )
    assert starter.returncode == -signal.SIGKILL, starter.stderr
    first = await_agent(settings.agents_folder / MACHINE)
    assert os.getsid(first.pid) not in (os.getsid(0), 0) and _parent(first.pid) != os.getpid()
    assert "has its agent already" in start_agents(settings)[0][1]
    assert read_card(settings.agents_folder / MACHINE) == first and agent_pids(tmp_path) == [first.pid]
    assert _environment(first.pid).keys().isdisjoint({"CAUSTICMILL_DATA", "CAUSTICMILL_DATABASE_URL"})


def test_two_servers_that_start_at_once_make_one_agent(tmp_path: Path, mill: Bench) -> None:
    settings = ServerSettings(data=tmp_path / "data")
    start_agents(settings)
    [(_, told)] = start_agents(settings)
    await_agent(settings.agents_folder / MACHINE)
    log = settings.agents_folder / MACHINE / "agent.log"  # of both: where the second found nothing taken yet, its end
    ends = ("has its agent", "another agent", "in use", "busy")
    seen(lambda: told + log.read_text(), lambda words: any(why in words for why in ends))
    assert len(agent_pids(tmp_path)) == 1


def test_the_card_is_there_while_the_agent_is(tmp_path: Path, mill: Bench) -> None:
    with AgentProcess(tmp_path / "own", mill.url) as agent:
        card = read_card(tmp_path / "own")
        assert card is not None
        assert (card.machine, card.url, card.pid) == ("grbl", agent.url, agent.process.pid)
        assert Path(card.token_file).read_text().strip() == agent.token
        agent.stop()
    assert read_card(tmp_path / "own") is None


@pytest.mark.thorough
def test_a_card_that_points_to_another_mills_agent_is_not_believed(floor_of_processes: Shop) -> None:
    """As after a crash, when the port has been given to somebody else: nothing is sent there but the question."""
    floor = floor_of_processes
    with bench(1.0) as other, AgentProcess(floor.data / "other", other.url) as agent:
        kill_agents(floor.folder)
        card = json.loads((floor.folder / CARD_FILE).read_text())
        (floor.folder / CARD_FILE).write_text(json.dumps(card | {"url": agent.url}))
        job = floor.job()
        assert "token" in floor.park(job, 503)["detail"]
        stolen = card | {"url": agent.url, "token_file": str(floor.data / "other" / "token")}
        (floor.folder / CARD_FILE).write_text(json.dumps(stolen))
        assert "'grbl'" in floor.park(job, 503)["detail"]
        assert agent.get("/v1/runs")["runs"] == []


def test_a_broken_profile_costs_itself_only(floor: Shop) -> None:
    write_profile("", name="broken", text='extends = "grbl"\nsafe_z_mm = "high"\n')
    write_profile("", name="paper-only", text='extends = "grbl"\ndescription = "no port"\n')
    machines = {one["name"]: one for one in floor.get("/v1/machines")["machines"]}
    assert sorted(machines) == ["broken", MACHINE]
    assert "safe_z_mm" in machines["broken"]["problem"] and machines["broken"]["agent"]["reachable"] is False
    assert machines[MACHINE]["agent"]["reachable"] and machines[MACHINE]["profile"]["dialect"] == "grbl"
    assert dict(start_agents(floor.settings))["broken"] == machines["broken"]["problem"]
    assert floor.get("/v1/machines/paper-only", 404)["field"] == "machine"


def test_an_agent_that_a_person_started_is_found_in_its_own_folder(tmp_path: Path, mill: Bench) -> None:
    own = tmp_path / "state" / "causticmill" / MACHINE
    command = [sys.executable, "-m", "service.cli.main", "mill", "--machine", MACHINE, "--bind-port", "0"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as person:
        card = await_agent(own)
        assert card.pid == person.pid
        settings = ServerSettings(data=tmp_path / "data")
        assert str(own) in start_agents(settings)[0][1]
        with api_server(tmp_path / "data") as server:
            token = server.services.tokens.create("a", ["jobs:read"])[1]
            found = server.client.get(f"/v1/machines/{MACHINE}", headers={"Authorization": f"Bearer {token}"}).json()
            assert found["agent"]["reachable"], found
        person.terminate()


@pytest.mark.thorough
def test_agents_elsewhere_come_from_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own_folders(monkeypatch, tmp_path)
    with bench(8.0) as far, AgentProcess(tmp_path / "far", far.url) as agent:
        listing = tmp_path / "agents.toml"
        listing.write_text(f'[[agents]]\nmachine = "grbl"\nurl = "{agent.url}"\ntoken_file = "far/token"\n')
        agent.until(lambda status: status["status"]["state"] == "idle")
        with api_server(tmp_path / "data", agents_file=listing) as server:
            floor = Shop(tmp_path / "data", far, server, None)  # type: ignore[arg-type]
            with floor.client("jobs:read", "machine:run") as floor.operator:
                (seen,) = floor.get("/v1/machines")["machines"]
                assert (seen["name"], seen["remote"], seen["agent"]["reachable"]) == ("grbl", True, True)
                run = floor.park(floor.job(), machine="grbl")
                said = {"operator": "Ada", "checks": run["required_checks"]}
                started = give(floor.operator, f"/v1/runs/{run['id']}:start", machine="grbl", json=said)
                assert started.status_code == 202, started.text
                floor.until_state(run, "finished")
                listing.write_text("[[agents]]\n")
                assert "agents file" in floor.get("/v1/machines")["problems"][0]


@pytest.mark.parametrize(
    "text",
    [
        "agents = 1",
        "[[agents]]\nmachine = 'a'",
        "[[agents]]\nmachine = 'a'\nurl = 'ftp://x'\ntoken_file = 't'",
        "[[agents]]\nmachine = 'a'\nurl = 'http://x:99999'\ntoken_file = 't'",
        "[[agents]]\nmachine = 'a/b'\nurl = 'https://x'\ntoken_file = 't'",
        "[[agents]]\nmachine = 'a'\nurl = 'https://x'\ntoken_file = 't'\n" * 2,
        "[[agents]]\nmachine = 'a'\nurl = 'http://x'\ntoken_file = 't'\nprivate_network = 'yes'",
        "[[agents]",
    ],
)
def test_a_bad_list_of_agents_is_refused_in_words(tmp_path: Path, text: str) -> None:
    (tmp_path / "agents.toml").write_text(text)
    with pytest.raises(InputError, match=r"agents\.toml"):
        remote_machines(tmp_path / "agents.toml")


@pytest.mark.parametrize(
    ("url", "more", "taken"),
    [
        ("http://shop-pc:8765", "", False),
        ("http://192.168.1.7:8765", "private_network = false", False),
        ("http://shop-pc:8765", "private_network = true", True),
        ("https://shop-pc", "", True),
        ("http://127.0.0.1:8765", "", True),
        ("http://[::1]:8765", "", True),
    ],
)
def test_nothing_goes_to_an_agent_elsewhere_in_the_clear(tmp_path: Path, url: str, more: str, taken: bool) -> None:
    listing = tmp_path / "agents.toml"
    listing.write_text(f"[[agents]]\nmachine = 'a'\nurl = '{url}'\ntoken_file = 't'\n{more}")
    if taken:
        assert [machine.url for machine in remote_machines(listing)] == [url]
        return
    with pytest.raises(InputError, match=r"unencrypted; allowed: https://.*private_network"):
        remote_machines(listing)


def test_no_profile_of_ones_own_means_no_machines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own_folders(monkeypatch, tmp_path)
    assert read_machines(ServerSettings(data=tmp_path)) == ({}, [])


@pytest.mark.thorough
def test_a_hold_is_on_the_wire_at_once_even_behind_hand_overs(tmp_path: Path, mill: Bench) -> None:
    """Asserted loosely here; the figure is the benchmark's."""
    with shop(tmp_path / "data", mill) as floor:
        run = floor.park(floor.job((500,)))
        floor.start(run)
        floor.until_cut(3)
        began = time.monotonic()
        floor.post(f"/v1/runs/{run['id']}:hold", 202)
        assert time.monotonic() - began < 10.0
        floor.until_state(run, "held")


def _parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def _environment(pid: int) -> dict[str, str]:
    pairs = Path(f"/proc/{pid}/environ").read_bytes().decode().split("\0")
    return dict(pair.partition("=")[::2] for pair in pairs if pair)
