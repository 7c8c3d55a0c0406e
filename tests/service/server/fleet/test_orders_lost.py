"""Orders on a bad line: sent once or not at all, never late, and never those of somebody who has control no more."""

from __future__ import annotations

import concurrent.futures
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.http.admission import Limiter
from service.http.problems import GRANT
from tests.levels import mostly_thorough
from tests.service.server.api.server import api_server, problem
from tests.service.server.fleet.rogue import HANGS_S, Answer, Rogue, as_json, rogue_agent
from tests.service.server.fleet.shop import Shop, give, own_folders
from tests.service.server.fleet.test_rogue_agents import BABBLE
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
    lost = floor.operator.post(f"{HERE}/jog", json=JOG, headers=ada | {GRANT: "g"})
    assert "LOOK AT THE MILL" in problem(lost, 504, "machine")["detail"]
    time.sleep(0.5)
    assert sent(rogue, "jog") == 1


@pytest.mark.thorough
@pytest.mark.parametrize("what", list(BABBLE))
def test_an_order_with_a_mad_answer_is_sent_once(far: tuple[Shop, Rogue], what: str) -> None:
    floor, rogue = far
    ada = control(floor, "Ada")
    rogue.answers = lambda _method, _path: BABBLE[what]
    answer = floor.operator.post(f"{HERE}/home", headers=ada | {GRANT: "g"})
    assert answer.status_code in (202, 409, 502)
    assert sent(rogue, "home") == 1


@pytest.mark.parametrize("what", mostly_thorough(("hold", "abort", "jog-cancel"), quick=("abort",)))
def test_what_stops_the_mill_is_sent_again_and_its_fate_known_soon(far: tuple[Shop, Rogue], what: str) -> None:
    floor, rogue = far
    rogue.answers = lambda _method, _path: None
    began = time.monotonic()
    assert "LOOK AT THE MILL" in problem(floor.operator.post(f"{HERE}/{what}"), 504)["detail"]
    assert time.monotonic() - began < HANGS_S / 3 and sent(rogue, what) == 2


def test_an_order_whose_grant_comes_late_is_not_sent(far: tuple[Shop, Rogue]) -> None:
    """It is refused, and so is the order with it; a stop does not wait for it."""
    floor, rogue = far
    ada = control(floor, "Ada")
    free = threading.Event()

    def answers(_method: str, path: str) -> Answer:
        if path == "/v1/grants":
            free.wait(PATIENCE_S)
            return as_json({"grant": "late"}, 201)
        return as_json(STATUS, 202)

    rogue.strict, rogue.answers = True, answers
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        slow = pool.submit(give, floor.operator, f"{HERE}/jog", machine=NAME, json=JOG, headers=ada)
        until(lambda: any(path == "/v1/grants" for _, path in rogue.asked))
        assert floor.operator.post(f"{HERE}/hold").status_code == 202
        problem(slow.result(), 503, "machine")
        free.set()
    time.sleep(0.3)
    assert (sent(rogue, "jog"), sent(rogue, "hold")) == (0, 1)


@pytest.mark.parametrize("what", ["hold", "abort", "jog-cancel"])
def test_to_stop_a_mill_is_never_too_much(far: tuple[Shop, Rogue], monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    """A caller who has asked for more than they may stops the mill all the same."""
    floor, _ = far
    monkeypatch.setattr(Limiter, "wait_s", lambda _limiter, _caller: 1.0)
    problem(floor.operator.post(f"{HERE}/home"), 429)
    assert floor.operator.post(f"{HERE}/{what}").status_code == 202
    with httpx.Client(base_url=floor.server.address, timeout=PATIENCE_S) as anybody:
        assert anybody.post(f"{HERE}/{what}").status_code == 202, "whoever stands at the server's own computer"
        elsewhere = {"X-Forwarded-For": "192.0.2.1"}
        problem(anybody.post(f"{HERE}/{what}", headers=elsewhere), 429)


def test_the_machine_without_an_agent_is_told_of_as_such(far: tuple[Shop, Rogue]) -> None:
    floor, _ = far
    with httpx.Client(base_url=floor.server.address, headers=floor.operator.headers, timeout=PATIENCE_S) as client:
        problem(client.post("/v1/machines/none/control", json={"operator": "Ada"}), 404, "machine")
        problem(client.post("/v1/machines/none/control/hold"), 404, "machine")
        problem(client.get("/v1/machines/none/events"), 404, "machine")
