"""Orders on a bad line: sent once or not at all, never late, and never those of somebody who has control no more."""

from __future__ import annotations

import concurrent.futures
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.api.limits import Limiter
from tests.service.api.server import api_server, problem
from tests.service.fleet.rogue import HANGS_S, Answer, Rogue, as_json, rogue_agent
from tests.service.fleet.shop import Shop, own_folders
from tests.service.fleet.test_rogue_agents import BABBLE
from tests.waiting import PATIENCE_S, until

NAME = "far"
HERE = f"/v1/machines/{NAME}/control"
JOG = {"by_mm": [1, 0, 0]}
STATUS = {"status": {"state": "idle", "work_mm": [0, 0, 0]}, "connected": True, "events": []}


@pytest.fixture
def far(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Shop, Rogue]]:
    """A server that knows one mill, whose agent does what a test wants."""
    own_folders(monkeypatch, tmp_path)
    with rogue_agent(NAME) as rogue:
        (tmp_path / "token").write_text("x" * 40 + "\n")
        (tmp_path / "token").chmod(0o600)
        listing = tmp_path / "agents.toml"
        listing.write_text(f'[[agents]]\nmachine = "{NAME}"\nurl = "{rogue.url}"\ntoken_file = "token"\n')
        with api_server(tmp_path / "data", agents_file=listing) as server:
            floor = Shop(tmp_path / "data", None, server, None)  # type: ignore[arg-type]
            with floor.client("jobs:read", "machine:run") as floor.operator:
                rogue.answers = lambda _method, _path: as_json(STATUS)
                until(lambda: floor.get(f"/v1/machines/{NAME}")["agent"]["reachable"])
                yield floor, rogue


def control(floor: Shop, name: str, *, over: bool = False) -> dict[str, str]:
    body = {"operator": name, "take_over": over}
    return {"Causticmill-Control": floor.post(HERE, 201, **body)["control"]}


def sent(rogue: Rogue, what: str) -> int:
    return sum(path == f"/v1/control/{what}" for _, path in rogue.asked)


@pytest.mark.thorough
def test_an_order_without_an_answer_is_sent_once_and_says_so(far: tuple[Shop, Rogue]) -> None:
    floor, rogue = far
    ada = control(floor, "Ada")
    rogue.answers = lambda _method, _path: None
    lost = floor.operator.post(f"{HERE}/jog", json=JOG, headers=ada)
    assert "LOOK AT THE MILL" in problem(lost, 504, "machine")["detail"]
    time.sleep(0.5)
    assert sent(rogue, "jog") == 1


@pytest.mark.thorough
@pytest.mark.parametrize("what", list(BABBLE))
def test_an_order_with_a_mad_answer_is_sent_once(far: tuple[Shop, Rogue], what: str) -> None:
    floor, rogue = far
    ada = control(floor, "Ada")
    rogue.answers = lambda _method, _path: BABBLE[what]
    answer = floor.operator.post(f"{HERE}/home", headers=ada)
    assert answer.status_code in (202, 409, 502)
    assert sent(rogue, "home") == 1


@pytest.mark.parametrize("what", ["hold", "abort", "jog-cancel"])
def test_what_stops_the_mill_is_sent_again_and_its_fate_known_soon(far: tuple[Shop, Rogue], what: str) -> None:
    floor, rogue = far
    rogue.answers = lambda _method, _path: None
    began = time.monotonic()
    assert "LOOK AT THE MILL" in problem(floor.operator.post(f"{HERE}/{what}"), 504)["detail"]
    assert time.monotonic() - began < HANGS_S / 3 and sent(rogue, what) == 2


def slow_to_home(rogue: Rogue) -> threading.Event:
    """It takes every order at once but `home`, which it answers when the event is set."""
    free = threading.Event()

    def answers(_method: str, path: str) -> Answer:
        if path == "/v1/control/home":
            free.wait(PATIENCE_S)
        return as_json(STATUS, 202)

    rogue.answers = answers
    return free


def test_an_order_that_would_be_late_is_not_sent(far: tuple[Shop, Rogue]) -> None:
    """The agent is slow with one; the next waits a little, is refused, and is not on its way later either."""
    floor, rogue = far
    ada = control(floor, "Ada")
    free = slow_to_home(rogue)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        slow = pool.submit(floor.operator.post, f"{HERE}/home", headers=ada)
        until(lambda: sent(rogue, "home") == 1)
        assert "not sent" in problem(floor.operator.post(f"{HERE}/jog", json=JOG, headers=ada), 503)["detail"]
        stopped = floor.operator.post(f"{HERE}/hold")
        assert stopped.status_code == 202, "a hold waits for nothing"
        free.set()
        assert slow.result().status_code == 202
    assert (sent(rogue, "jog"), sent(rogue, "hold")) == (0, 1)
    assert floor.operator.post(f"{HERE}/jog", json=JOG, headers=ada).status_code == 202


def test_an_order_that_waits_while_control_changes_hands_is_not_sent(far: tuple[Shop, Rogue]) -> None:
    floor, rogue = far
    ada = control(floor, "Ada")
    free = slow_to_home(rogue)
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        first = pool.submit(floor.operator.post, f"{HERE}/home", headers=ada)
        until(lambda: sent(rogue, "home") == 1)
        waits = pool.submit(floor.operator.post, f"{HERE}/jog", json=JOG, headers=ada)
        time.sleep(0.3)
        control(floor, "Bob", over=True)
        free.set()
        assert first.result().status_code == 202
        assert "lost control" in problem(waits.result(), 409)["detail"]
    assert sent(rogue, "jog") == 0


@pytest.mark.parametrize("what", ["hold", "abort", "jog-cancel"])
def test_to_stop_a_mill_is_never_too_much(far: tuple[Shop, Rogue], monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    """A caller who has asked for more than they may stops the mill all the same."""
    floor, _ = far
    monkeypatch.setattr(Limiter, "wait_s", lambda _limiter, _caller: 1.0)
    problem(floor.operator.post(f"{HERE}/home"), 429)
    assert floor.operator.post(f"{HERE}/{what}").status_code == 202
    with floor.client("jobs:read") as watcher:
        problem(watcher.post(f"{HERE}/{what}"), 429)


def test_the_machine_without_an_agent_is_told_of_as_such(far: tuple[Shop, Rogue]) -> None:
    floor, _ = far
    with httpx.Client(base_url=floor.server.address, headers=floor.operator.headers, timeout=PATIENCE_S) as client:
        problem(client.post("/v1/machines/none/control", json={"operator": "Ada"}), 404, "machine")
        problem(client.post("/v1/machines/none/control/hold"), 404, "machine")
        problem(client.get("/v1/machines/none/events"), 404, "machine")
