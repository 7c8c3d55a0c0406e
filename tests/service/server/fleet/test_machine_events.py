"""Following a mill: how it stands at once, what happens once, through an agent's restart and a server's."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.server.fleet.agent_client import AgentLink
from service.server.fleet.agent_launcher import start_agents
from tests.service.mills import Bench
from tests.service.server.fleet.shop import MACHINE, Shop, await_agent, give, kill_agents, shop
from tests.waiting import PATIENCE_S, seen

HERE = f"/v1/machines/{MACHINE}"
Event = tuple[str, str, Any]


def events(lines: Iterator[str]) -> Iterator[Event]:
    """Id, name and data of each event."""
    now = {"id": "", "event": "", "data": ""}
    for line in lines:
        name, _, value = line.partition(": ")
        if name in now:
            now[name] = value
        elif not line and now["data"]:
            yield now["id"], now["event"], json.loads(now["data"])
            now = {"id": "", "event": "", "data": ""}


def x_mm(now: Any) -> float:
    """Of a machine's status; 0 where it is not known yet."""
    work_mm = (now["mill"] or {}).get("work_mm")
    return float(work_mm[0]) if work_mm else 0.0


class Reader:
    """Reads a machine's stream, and knows the last id and every log entry it has had."""

    def __init__(self) -> None:
        self.last_id = ""
        self.logs: list[int] = []
        self.words: list[str] = []
        self.states: list[Any] = []

    def follow(self, floor: Shop, good: Callable[[Any], bool], then: Callable[[], None] | None = None) -> Any:
        """Up to the first status that is good; `then` is called after the first event."""
        headers = {"Last-Event-ID": self.last_id} if self.last_id else {}
        with floor.operator.stream("GET", f"{HERE}/events", headers=headers, timeout=PATIENCE_S) as answer:
            assert answer.headers["content-type"].startswith("text/event-stream")
            return self.read(events(answer.iter_lines()), good, then)

    def read(self, found: Iterator[Event], good: Callable[[Any], bool], then: Callable[[], None] | None = None) -> Any:
        limit = time.monotonic() + PATIENCE_S
        for event_id, name, data in found:
            assert time.monotonic() < limit, data
            self.last_id = event_id or self.last_id
            if name == "log":
                self.logs.append(data.get("number", 0))
                self.words.append(data.get("words", ""))
            else:
                assert name == "status"
                self.states.append(data)
                if good(data):
                    return data
            if then is not None:
                then()
                then = None
        raise AssertionError("the stream has ended")


def state(*words: str) -> Callable[[Any], bool]:
    return lambda now: now["mill"] is not None and now["mill"]["state"] in words


def test_the_first_event_is_how_it_stands_and_the_latest_log_follows(floor: Shop) -> None:
    seen(lambda: floor.get(HERE)["mill"]["spindle_on"], lambda on: on is not None, what="all that a mill says at first")
    with floor.operator.stream("GET", f"{HERE}/events") as answer:
        found = events(answer.iter_lines())
        _, name, first = next(found)
        assert name == "status" and first == floor.get(HERE)
        _, name, entry = next(found)
        assert name == "log" and entry["number"] == 1 and {"at_s", "kind", "words"} <= entry.keys()


def test_what_happens_while_a_reader_comes_is_told(floor: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the server has asked how the mill stands, and before it hears of what is new."""
    ask = AgentLink.get
    coming = [True]

    async def held_meanwhile(link: AgentLink, path: str, **how: Any) -> Any:
        answer = await ask(link, path, **how)
        if path == "/v1/status" and coming:
            coming.clear()
            await link.send_urgent("/v1/control/hold")
            await asyncio.sleep(0.5)  # the agent tells whoever listens by then
        return answer

    seen(lambda: floor.get(HERE), state("idle"), what="a mill that stands")
    monkeypatch.setattr(AgentLink, "get", held_meanwhile)
    reader = Reader()
    reader.follow(floor, lambda now: now["mill"]["stops"] == 2, lambda: floor.post(f"{HERE}/control/abort", 202))
    assert "hold" in reader.words
    assert reader.logs == list(range(1, len(reader.logs) + 1))


def test_orders_and_control_are_told(floor: Shop) -> None:
    reader = Reader()
    control = ""

    def take_and_jog() -> None:
        nonlocal control
        control = floor.post(f"{HERE}/control", 201, operator="Ada")["control"]
        jog = {"by_mm": [30, 0, 0], "feed_mm_per_min": 200}  # more than a second of this mill's time
        order = give(floor.operator, f"{HERE}/control/jog", json=jog, headers={"Causticmill-Control": control})
        assert order.status_code == 202

    reader.follow(floor, state("jog"), take_and_jog)
    now = reader.follow(floor, lambda now: x_mm(now) == 30)
    assert now["control"]["operator"] == "Ada"
    assert any(0 < x_mm(now) < 30 for now in reader.states), "the position is live"
    floor.operator.delete(f"{HERE}/control", headers={"Causticmill-Control": control})
    reader.follow(floor, lambda now: now["control"] is None)
    assert reader.logs == list(range(1, len(reader.logs) + 1)), "each entry once, over three connections"


@pytest.mark.thorough
def test_a_run_is_seen_from_parking_to_its_end(floor: Shop) -> None:
    reader, job = Reader(), floor.job((150,))
    reader.follow(
        floor, lambda now: now["run"] is not None and now["run"]["state"] == "parked", lambda: _park(floor, job)
    )
    run = floor.get(HERE)["run"]
    reader.follow(floor, lambda now: now["run"] is None, lambda: _start(floor, run))
    shares = [now["run"]["share"] for now in reader.states if now["run"] is not None]
    assert shares == sorted(shares) and len(set(shares)) > 3
    told = [now["mill"]["buffer_share"] for now in reader.states]
    fill = [share for share in told if share is not None]  # of a link that tells
    assert all(0 <= share <= 1 for share in fill) and max(fill) > 0.5 and fill[-1] == 0, fill
    assert floor.get(f"/v1/runs/{run['id']}")["state"] == "finished", "written down by who looked"
    assert reader.logs == list(range(1, len(reader.logs) + 1))


@pytest.mark.thorough
def test_it_goes_on_while_the_agent_is_away(floor_of_processes: Shop) -> None:
    floor = floor_of_processes
    reader = Reader()
    with floor.operator.stream("GET", f"{HERE}/events") as answer:
        found = events(answer.iter_lines())
        reader.read(found, state("idle"))
        kill_agents(floor.data)
        away = reader.read(found, lambda now: not now["agent"]["reachable"])
        assert away["mill"] is None and away["agent"]["words"]
        floor.post(f"{HERE}/control", 503, operator="Ada")
        start_agents(floor.settings)
        await_agent(floor.folder)
        back = reader.read(found, state("idle"))
        assert back["agent"]["reachable"] and back["control"] is None
        floor.post(f"{HERE}/control", 201, operator="Ada")
        reader.read(found, lambda now: now["control"] is not None)


@pytest.mark.thorough
def test_a_reader_misses_nothing_over_a_servers_restart(tmp_path: Path, mill: Bench) -> None:
    reader = Reader()
    with shop(tmp_path / "data", mill) as floor:
        reader.follow(floor, state("idle"))
    with shop(tmp_path / "data", mill) as floor:
        control = floor.post(f"{HERE}/control", 201, operator="Ada")["control"]
        headers = {"Causticmill-Control": control}
        assert give(floor.operator, f"{HERE}/control/settings", headers=headers).status_code == 202
        floor.until_idle()
        reader.follow(floor, state("idle"))
        reader.follow(floor, state("idle"))
    assert reader.logs == list(range(1, len(reader.logs) + 1))


def test_who_may_follow(floor: Shop) -> None:
    with floor.client("jobs:write", "machine:run") as other:
        assert other.get(f"{HERE}/events").status_code == 403
    assert httpx.get(f"{floor.server.address}{HERE}/events", timeout=PATIENCE_S).status_code == 401


def _park(floor: Shop, job: str) -> None:
    floor.park(job)


def _start(floor: Shop, run: Any) -> None:
    floor.start(floor.get(f"/v1/runs/{run['id']}"))
