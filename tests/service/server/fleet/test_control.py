"""Control of a mill: one person at a time moves it, everybody stops it, and no order ever comes true twice or late."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from machines.mill.orders import LEASE_S, Stop
from service.http.problems import GRANT
from service.server.fleet.agent_client import AgentLink
from service.server.fleet.agent_launcher import start_agents
from tests.service.milling.agent.client import AgentClient
from tests.service.mills import Bench
from tests.service.server.api.server import api_server, problem
from tests.service.server.fleet.shop import CHECKS, MACHINE, Shop, await_agent, give, kill_agents, shop
from tests.waiting import PATIENCE_S, seen, until

HEADER = "Causticmill-Control"
HERE = f"/v1/machines/{MACHINE}/control"


class Person:
    """Somebody with a page of their own. `control`: what they show with each order."""

    def __init__(self, floor: Shop, name: str) -> None:
        self.name = name
        self.http = floor.client("jobs:read", "machine:run")
        self.control = ""

    @property
    def headers(self) -> dict[str, str]:
        return {HEADER: self.control} if self.control else {}

    def take(self, *, over: bool = False, status: int = 201) -> Any:
        answer = self.http.post(HERE, json={"operator": self.name, "take_over": over}, headers=self.headers)
        assert answer.status_code == status, answer.text
        if status in (200, 201):
            self.control = answer.json()["control"]
        return answer.json()

    def order(self, name: str, /, **body: Any) -> httpx.Response:
        return give(self.http, f"{HERE}/{name}", json=body, headers=self.headers)

    def until_taken(self, name: str, /, **body: Any) -> None:
        """A controller that is busy, homes, or has just restarted refuses an order; the person tries again."""
        wait = ("busy", "connecting", "homing")
        order = lambda: ((answer := self.order(name, **body)).status_code, answer.text)  # noqa: E731
        code, words = seen(order, lambda got: got[0] == 202 or not any(one in got[1] for one in wait))
        assert code == 202, words

    def jog(self, x_mm: float, feed: float = 5000) -> httpx.Response:
        return self.order("jog", by_mm=[x_mm, 0, 0], feed_mm_per_min=feed)


BODIES: dict[str, dict[str, Any]] = {
    "home": {}, "unlock": {}, "reset": {}, "resume": {}, "trust-position": {}, "settings": {},
    "jog": {"by_mm": [1, 0, 0]}, "probe": {"depth_mm": 5}, "zero": {}, "check": {"on": True},
    "override": {"what": "spindle", "percent": 110}, "block": {"text": "G0 X1"},
    "probe-corner": {
        "depth_mm": 5, "plate_mm": 1, "wall_x_mm": 1, "wall_y_mm": 1, "cutter_radius_mm": 1, "margin_mm": 1,
    },
}  # fmt: skip
"""Every order beside a run."""


@contextlib.contextmanager
def people(floor: Shop) -> Iterator[tuple[Person, Person]]:
    ada, bob = Person(floor, "Ada"), Person(floor, "Bob")
    with ada.http, bob.http:
        yield ada, bob


def until_x(floor: Shop, x_mm: float) -> None:
    """The mill stands there."""

    def there() -> bool:
        mill = floor.get(f"/v1/machines/{MACHINE}")["mill"]
        return bool(mill and mill["work_mm"]) and mill["state"] == "idle" and abs(mill["work_mm"][0] - x_mm) < 0.01

    until(there)


def holder(floor: Shop) -> Any:
    return floor.get(f"/v1/machines/{MACHINE}")["control"]


def test_who_has_control_moves_the_mill_and_nobody_else(floor: Shop) -> None:
    with people(floor) as (ada, bob):
        refused = problem(ada.jog(10), 409, HEADER)
        assert "take control first" in refused["detail"] and refused["control"] is None
        told = ada.take()
        assert told["expires_s"] == LEASE_S and holder(floor) == {"operator": "Ada", "since": told["since"]}
        assert ada.jog(10).status_code == 202
        until_x(floor, 10)
        for person in (bob, Person(floor, "Eve")):
            refused = problem(person.jog(10), 409, HEADER)
            assert "Ada has had control" in refused["detail"] and refused["control"]["operator"] == "Ada"
            assert "Ada" in person.take(status=409)["detail"]
        bob.control = "x" * 24
        problem(bob.jog(10), 409, HEADER)
        assert floor.bench.stands
        until_x(floor, 10)


@pytest.mark.parametrize("what", ["hold", "abort", "jog-cancel"])
def test_everybody_stops_the_mill_at_any_time(floor: Shop, what: str) -> None:
    """Without control, with an old one, in the middle of an order of who has it."""
    with people(floor) as (ada, bob):
        ada.take()
        bob.control = "x" * 24
        assert ada.jog(200, feed=600).status_code == 202
        until(lambda: not floor.bench.stands)
        for _ in range(3):
            assert bob.order(what).status_code == 202
        until(lambda: floor.bench.stands)
        assert floor.get(f"/v1/machines/{MACHINE}")["mill"]["work_mm"][0] < 199
        assert holder(floor)["operator"] == "Ada"


def test_take_over_ends_the_former_holders_orders(floor: Shop) -> None:
    with people(floor) as (ada, bob):
        ada.take()
        assert bob.take(over=True)["operator"] == "Bob"
        lost = problem(ada.jog(10), 409, HEADER)
        assert "lost control" in lost["detail"] and lost["control"]["operator"] == "Bob"
        assert ada.http.delete(HERE, headers=ada.headers).status_code == 409
        assert bob.jog(5).status_code == 202
        until_x(floor, 5)
        assert bob.http.delete(HERE, headers=bob.headers).status_code == 204
        assert holder(floor) is None
        problem(bob.jog(5), 409, HEADER)


def test_control_is_kept_by_asking_again_and_ends_without_a_sign(floor: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    with people(floor) as (ada, bob):
        first = ada.take()
        again = ada.take(status=200)
        assert (again["since"], again["control"]) == (first["since"], first["control"])
        with monkeypatch.context() as later:
            later.setattr("machines.mill.orders.LEASE_S", 0.0)  # as if she had not been heard of for so long
            lost = problem(ada.jog(1), 409, HEADER)
            assert lost["code"] == "control_lost" and "take control again" in lost["detail"]
        until(lambda: holder(floor) is None)
        bob.take()
        assert "lost control" in problem(ada.jog(1), 409, HEADER)["detail"]


@pytest.mark.thorough
def test_runs_obey_who_has_control_and_scripts_where_nobody_has(floor: Shop) -> None:
    job = floor.job((400,))
    with people(floor) as (ada, bob):
        said = {"operator": "x", "checks": CHECKS}

        def post(person: Person, path: str, **body: Any) -> int:
            return give(person.http, path, json=body, headers=person.headers).status_code

        ada.take()
        assert post(bob, f"/v1/machines/{MACHINE}/runs", job=job) == 409
        run = ada.http.post(f"/v1/machines/{MACHINE}/runs", json={"job": job}, headers=ada.headers).json()
        run = floor.until_state(run, "parked")
        here = f"/v1/runs/{run['id']}"
        assert post(bob, f"{here}:start", **said) == 409 and floor.bench.cut == []
        assert post(ada, f"{here}:start", **said) == 202
        floor.until_cut(4)
        assert post(bob, f"{here}:hold") == 202, "whoever sees that something is wrong"
        floor.until_state(run, "held")
        assert post(bob, f"{here}:resume") == 409
        cut = len(floor.bench.cut)
        ada.http.delete(HERE, headers=ada.headers)
        assert post(ada, f"{here}:resume") == 409, "who shows a control that has ended is not taken at their word"
        assert len(floor.bench.cut) == cut
        assert post(bob, f"{here}:resume") == 202
        floor.until_state(run, "running", "finished")
        assert post(bob, f"{here}:abort") == 202


def await_taken(order: Callable[[], httpx.Response]) -> None:
    """A mill that has just been connected still answers what is asked of it at first, and takes no order meanwhile."""
    seen(order, lambda answer: answer.status_code == 202, what="an order that is taken")


@pytest.mark.thorough
def test_control_outlives_the_server_and_holds_for_two_of_them(tmp_path: Path, mill: Bench) -> None:
    with shop(tmp_path / "data", mill) as floor, people(floor) as (ada, _):
        ada.take()
        with api_server(tmp_path / "data") as second:
            headers = {"Authorization": ada.http.headers["Authorization"]}
            jog = {"by_mm": [1, 0, 0], "feed_mm_per_min": 5000}
            with httpx.Client(base_url=second.address, headers=headers, timeout=PATIENCE_S) as other:
                assert give(other, f"{HERE}/jog", json=jog).status_code == 409
                await_taken(lambda: give(other, f"{HERE}/jog", json=jog, headers=ada.headers))
        control, secret = ada.control, ada.http.headers["Authorization"]
    with shop(tmp_path / "data", mill) as floor:
        assert holder(floor)["operator"] == "Ada"
        headers = {"Authorization": secret, HEADER: control}
        with httpx.Client(base_url=floor.server.address, headers=headers, timeout=PATIENCE_S) as again:
            await_taken(lambda: give(again, f"{HERE}/jog", json=jog, headers={HEADER: control}))
        until_x(floor, 2)


@pytest.mark.parametrize("what", ["jog", "start"])
def test_a_stop_by_one_server_ends_an_order_that_waits_in_another(
    floor: Shop, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """It is about to leave its server; its grant has ended with the stop."""
    waits, free, send = threading.Event(), threading.Event(), AgentLink.send_once

    async def send_late(*arguments: Any, **named: Any) -> Any:
        waits.set()
        while not free.is_set():
            await asyncio.sleep(0.01)
        return await send(*arguments, **named)

    with (
        people(floor) as (ada, _),
        api_server(floor.data) as second,
        concurrent.futures.ThreadPoolExecutor(1) as pool,
    ):
        run = floor.park(floor.job())
        ada.take()
        path, body = {
            "jog": (f"{HERE}/jog", {"by_mm": [1, 0, 0]}),
            "start": (f"/v1/runs/{run['id']}:start", {"operator": "Ada", "checks": CHECKS}),
        }[what]
        granted = ada.http.post(f"/v1/machines/{MACHINE}/grants", headers=ada.headers).json()["grant"]
        with monkeypatch.context() as slow:
            slow.setattr(AgentLink, "send_once", send_late)
            order = pool.submit(ada.http.post, path, json=body, headers=ada.headers | {GRANT: granted})
            assert waits.wait(PATIENCE_S)
            stop = f"{second.address}{HERE}/jog-cancel"
            until(lambda: httpx.post(stop, timeout=PATIENCE_S).status_code == 202)
            free.set()
            assert problem(order.result(), 409).get("code") in ("grant_stopped", "grant_expired")


@pytest.mark.parametrize("at", ["server", "agent"])
def test_no_order_is_taken_without_a_grant(control_floor: tuple[Shop, Person], at: str) -> None:
    """At once or after any delay, once or twice; what stops the mill needs none."""
    floor, ada = control_floor
    ada.control = ada.take(over=True, status=200 if ada.control else 201)["control"]
    told = ada.http.post(f"/v1/machines/{MACHINE}/runs", json={"job": floor.job()}, headers=ada.headers).json()
    run = floor.until_state(told, "parked")
    with AgentClient(floor.folder, floor.card().url).http as agent:
        http, base = (ada.http, HERE) if at == "server" else (agent, "/v1/control")
        said = {"operator": "Ada", "checks": [*CHECKS, "position"]}
        orders: dict[str, Any] = {f"{base}/{what}": body for what, body in BODIES.items()}
        orders |= {f"/v1/runs/{run['id']}:start": {"operator": "Ada", "checks": CHECKS}}
        orders |= {f"/v1/runs/{run['id']}:resume": {}, f"/v1/runs/{run['id']}:recover": said | {"plan": "seen"}}
        for path, body in orders.items():
            for _ in range(2):
                answer = http.post(path, json=body, headers=ada.headers)
                assert answer.status_code == 428, f"{path}: {answer.text}"
                refused = answer.json()
                assert (refused["code"], refused["field"]) == ("grant_missing", GRANT)
                assert "POST .../grants" in refused["detail"]
        assert floor.bench.stands
        for stop in Stop:
            assert http.post(f"{base}/{stop}", headers=ada.headers).status_code == 202
        assert http.post(f"/v1/runs/{run['id']}:abort").status_code == 202
    floor.until_idle()  # a hold that an abort follows leaves no mill held


def test_the_holders_secret_is_shown_to_the_holder_alone(floor: Shop) -> None:
    with people(floor) as (ada, _):
        ada.take()
        seen = [floor.operator.get(path).text for path in ("/v1/machines", f"/v1/machines/{MACHINE}")]
        assert not any(ada.control in text for text in seen)


def test_what_the_agent_refuses_comes_through_word_for_word(control_floor: tuple[Shop, Person]) -> None:
    """And so does the answer to what it asks. The agent's own tests have all that it refuses."""
    floor, ada = control_floor
    assert problem(ada.order("jog", by_mm=[1, 2, 9000]), 422)["field"] == "by_mm.2"
    assert floor.bench.stands
    floor.until_idle()
    asked = problem(ada.order("block", text="$20=0"), 409)
    assert (asked["code"], asked["field"]) == ("confirm", "confirm")
    assert asked["effect"].startswith("'$20=0' switches the soft limits off: ")
    ada.until_taken("block", text="$20=0", confirm=True)


@pytest.fixture(scope="module")
def control_floor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Shop, Person]]:
    from tests.service.mills import bench
    from tests.service.server.fleet.shop import own_folders, write_profile

    folder = tmp_path_factory.mktemp("control")
    with pytest.MonkeyPatch.context() as patch, bench(8.0) as mill:
        own_folders(patch, folder)
        write_profile(mill.url)
        try:
            with shop(folder / "data", mill) as floor, people(floor) as (ada, _):
                ada.take()
                yield floor, ada
        finally:
            kill_agents(folder)


@pytest.mark.thorough
def test_an_order_to_an_agent_that_is_away_never_comes_true(floor_of_processes: Shop) -> None:
    floor = floor_of_processes
    with people(floor) as (ada, _):
        ada.take()
        kill_agents(floor.data)
        problem(ada.jog(10), 503, "machine")
        start_agents(floor.settings)
        await_agent(floor.folder)
        until_x(floor, 0)
        time.sleep(0.5)
        until_x(floor, 0)
        problem(ada.jog(3), 409, HEADER)  # control ends with the agent
        ada.control = ""
        ada.take()
        assert ada.jog(3).status_code == 202
        until_x(floor, 3)


def test_home_zero_probe_and_blocks_reach_the_mill(floor: Shop) -> None:
    """The words of the order arrive as they were meant."""
    with people(floor) as (ada, _):
        ada.take()
        assert ada.jog(20).status_code == 202
        until_x(floor, 20)
        ada.until_taken("zero", axes="X")
        until_x(floor, 0)
        ada.until_taken("block", text="G0 X7")
        until_x(floor, 7)
        ada.until_taken("probe", depth_mm=10, feed_mm_per_min=1000, plate_mm=1, retract_mm=0)
        until(lambda: floor.get(f"/v1/machines/{MACHINE}")["mill"]["work_mm"][2] == pytest.approx(1, abs=0.01))
        floor.until_idle()
        ada.until_taken("settings")
        until(lambda: "homing" in problem(ada.order("home"), 409)["detail"])  # this mill has no switches
