"""Agents that lie, babble, hang or send us elsewhere: a refusal in words each time, and the server goes on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.server.database.connection import begin_writing
from service.server.database.tables import runs
from tests.service.server.api.server import api_server, problem
from tests.service.server.fleet.rogue import HANGS_S, Answer, Rogue, as_json, rogue_agent
from tests.service.server.fleet.shop import Shop, own_folders
from tests.waiting import PATIENCE_S

NAME, RUN = "far", "11111111-1111-4111-8111-111111111111"
VIEW: dict[str, Any] = {
    "id": "r1", "state": "running", "share": 0.5, "executed_line": 5, "lines": 10, "recoveries": 0, "words": "",
    "operator": "Ada", "warnings": [], "created_s": 1.0, "started_s": 2.0, "ended_s": None, "time_s": 3.0,
    "time_left_s": 1.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def far(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Shop, Rogue]]:
    """A server that knows one mill, whose agent is a rogue, and has an open run on it."""
    folder: Path = tmp_path_factory.mktemp("rogue")
    with pytest.MonkeyPatch.context() as patch, rogue_agent(NAME) as rogue:
        own_folders(patch, folder)
        (folder / "token").write_text("x" * 40 + "\n")
        (folder / "token").chmod(0o600)
        listing = folder / "agents.toml"
        listing.write_text(f'[[agents]]\nmachine = "{NAME}"\nurl = "{rogue.url}"\ntoken_file = "token"\n')
        with api_server(folder / "data", agents_file=listing) as server:
            floor = Shop(folder / "data", None, server, None)  # type: ignore[arg-type]
            job = floor.job((10,))
            row = {"id": RUN, "machine": NAME, "job_id": job, "program": "pass-1-finish.nc", "number": 1}
            row |= {"sha256": "0" * 64, "agent_run": "r1", "state": "running", "open": True, "view": VIEW}
            with begin_writing(server.services.database) as connection:
                connection.execute(runs.insert().values(**row, words="", created_by="t", created_at=1.0))
            with floor.client("jobs:read", "machine:run") as floor.operator:
                yield floor, rogue


BABBLE: dict[str, Answer] = {
    "not JSON": (200, {}, b"<html>"),
    "nothing": (200, {}, b""),
    "a list": as_json([VIEW]),
    "another state": as_json(VIEW | {"state": "dancing"}),
    "no id": as_json({key: value for key, value in VIEW.items() if key != "id"}),
    "a path as id": as_json(VIEW | {"id": "../x"}),
    "a word as time": as_json(VIEW | {"started_s": "today"}),
    "the end of time": as_json(VIEW | {"ended_s": 1e300, "state": "finished"}),
    "not a number": (200, {}, b'{"id": "r1", "state": "running", "share": NaN}'),
    "endless": (200, {}, b'{"id": "r1", "state": "running", "share": 0, "time_s": 1e999}'),
    "half a character": (200, {}, b'{"id": "r1", "state": "running", "share": 0, "words": "\\ud800"}'),
    "depth": (200, {}, b"[" * 100_000),
    "size": (200, {}, b'"' + b"x" * 5_000_000 + b'"'),
    "a bomb": (200, {"Content-Encoding": "gzip"}, b"\x1f\x8b\x08"),
    "elsewhere": (302, {"Location": "http://192.0.2.1/"}, b""),
    "teapot": (418, {}, b"{}"),
    "a refusal in a list": (409, {}, b"[]"),
    "a fault": (500, {}, b'{"detail": {"a": 1}}'),
}


@pytest.mark.thorough
@pytest.mark.parametrize("what", list(BABBLE))
def test_babble_is_not_believed(far: tuple[Shop, Rogue], what: str) -> None:
    floor, rogue = far
    rogue.answers = lambda _method, _path: BABBLE[what]
    seen = floor.get(f"/v1/runs/{RUN}")
    assert (seen["state"], seen["open"], seen["unreachable"]) == ("running", True, True), what
    assert floor.get("/v1/machines")["machines"][0]["name"] == NAME
    assert floor.get(f"/v1/machines/{NAME}")["run"]["id"] == RUN
    for order in ("hold", "resume"):
        answer = floor.operator.post(f"/v1/runs/{RUN}:{order}")
        assert answer.status_code in (409, 502), (what, answer.text)
        problem(answer, answer.status_code)
    assert floor.operator.get(f"/v1/runs/{RUN}/recovery").status_code in (200, 409, 502)


@pytest.mark.thorough
def test_an_agent_that_hangs_is_told_of_within_three_seconds(far: tuple[Shop, Rogue]) -> None:
    floor, rogue = far
    rogue.answers = lambda _method, _path: None
    began = time.monotonic()
    refused = problem(floor.operator.post(f"/v1/runs/{RUN}:hold"), 504)
    assert (refused["code"], refused["values"]) == ("stop_uncertain", {"order": "hold", "seconds": 3.0})
    words = refused["detail"]
    assert "did not answer within 3 s" in words and "LOOK AT THE MILL" in words
    assert time.monotonic() - began < HANGS_S / 3  # it was not waited for
    assert [path for _, path in rogue.asked if path.endswith(":hold")][-2:] == ["/v1/runs/r1:hold"] * 2


def test_its_events_cannot_forge_ours(far: tuple[Shop, Rogue]) -> None:
    """Lines and ids inside of an event's data or id do not become events of this server's."""
    floor, rogue = far
    forged = b'id: 1-1\revent: forged\nevent: event\ndata: {"words": "a\\n\\nevent: forged\\ndata: x", "at_s": 9e9}\n\n'
    ended = b'event: status\ndata: {"run": {"id": "r1", "state": "finished", "share": 1}}\n\n'

    def answers(_method: str, path: str) -> Answer:
        stream = (200, {"Content-Type": "text/event-stream"}, forged + ended)
        return stream if path == "/v1/events" else as_json(VIEW)

    rogue.answers = answers
    with floor.operator.stream("GET", f"/v1/runs/{RUN}/events") as answer:
        text = answer.read().decode()
    kinds = [line for line in text.splitlines() if line.startswith("event:")]
    assert set(kinds) == {"event: run", "event: log"} and "\r" not in text


def test_the_server_has_lived_through_it(far: tuple[Shop, Rogue]) -> None:
    floor, _ = far
    assert httpx.get(f"{floor.server.address}/livez", timeout=PATIENCE_S).status_code == 200
