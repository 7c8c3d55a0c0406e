"""Following runs: through an agent's restart, in any number, to the end."""

from __future__ import annotations

import concurrent.futures
import json
from collections.abc import Iterator
from typing import Any

import pytest

from service.server.fleet.agent_launcher import start_agents
from tests.service.server.fleet.shop import Shop, await_agent, kill_agents
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.thorough


def test_a_run_is_followed_through_an_agents_restart_to_its_end(floor_of_processes: Shop) -> None:
    floor = floor_of_processes
    run = floor.park(floor.job((200,)))
    states: list[str] = []
    with floor.operator.stream("GET", f"/v1/runs/{run['id']}/events") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        lines = answer.iter_lines()
        _follow(lines, states, lambda now: now["state"] == "parked")
        kill_agents(floor.data)
        _follow(lines, states, lambda now: now["unreachable"])
        start_agents(floor.settings)
        await_agent(floor.folder)
        _follow(lines, states, lambda now: not now["unreachable"])
        floor.until_idle()
        floor.start(run)
        last = _follow(lines, states, lambda now: now["state"] == "finished")
        assert last["share"] == 1.0 and not any(lines)
    assert "running" in states
    again = floor.operator.get(f"/v1/runs/{run['id']}/events", headers={"Last-Event-ID": "x-1"})
    assert again.status_code == 204


def test_more_followers_than_an_agent_has_room_for_miss_nothing(floor: Shop) -> None:
    """The agent takes 32 readers. One that leaves in the middle and comes back has every event once, to the end."""
    run = floor.park(floor.job((400,)))
    with concurrent.futures.ThreadPoolExecutor(42) as pool:
        followers = [pool.submit(_read_events, floor, run, leaves=number == 0) for number in range(42)]
        floor.start(run)
        floor.until_cut(20)
        floor.post(f"/v1/runs/{run['id']}:hold", 202)
        floor.until_state(run, "held")
        floor.post(f"/v1/runs/{run['id']}:resume", 202)
        seen = [follower.result(PATIENCE_S) for follower in followers]
    assert {states[-1] for states, _ in seen} == {"finished"}
    known = sorted({number for _, logs in seen for number in logs})
    assert len(known) > 3
    for _, logs in seen:  # each from when it came on, to the end that it saw
        assert logs == [number for number in known if logs[0] <= number <= logs[-1]]


def _read_events(floor: Shop, run: Any, *, leaves: bool) -> tuple[list[str], list[int]]:
    """States and numbers of log entries; who leaves does so after each log entry, with the last id."""
    states: list[str] = []
    logs: list[int] = []
    last_id, over = "", False
    while not over:
        headers = {"Last-Event-ID": last_id} if last_id else {}
        with floor.operator.stream("GET", f"/v1/runs/{run['id']}/events", headers=headers) as answer:
            if answer.status_code == 204:
                return [*states, "finished"], logs
            for line in answer.iter_lines():
                last_id = line[4:] if line.startswith("id: ") else last_id
                data = json.loads(line[6:]) if line.startswith("data: ") else {}
                if "at_s" in data:
                    logs.append(data["number"])
                    if leaves:
                        break
                elif data:
                    states.append(data["state"])
                    over = not data["open"]
    return states, logs


def _follow(lines: Iterator[str], states: list[str], good: Any) -> Any:
    for line in lines:
        if line.startswith("data: ") and "state" in (now := json.loads(line[6:])) and "unreachable" in now:
            states.append(now["state"])
            if good(now):
                return now
    raise AssertionError(f"the stream ended; states seen: {states}")
