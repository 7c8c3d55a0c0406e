"""The agent as its callers meet it: on a loopback port, with a real driver on a simulated mill's pty.

It is a thread of this process; where a law is about its own process, a test has that.
"""

from __future__ import annotations

import concurrent.futures
import hashlib
import http.server
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.service.milling.agent.client import CHECKS, AgentClient
from tests.service.milling.agent.in_process import running_agent
from tests.service.mills import LONG_LINES, Bench, bench, program
from tests.service.server.fleet.shop import own_folders


@pytest.fixture
def agent(tmp_path: Path, mill: Bench, monkeypatch: pytest.MonkeyPatch) -> Iterator[AgentClient]:
    own_folders(monkeypatch, tmp_path)
    with running_agent(tmp_path / "data", mill.url) as found:
        found.until(lambda status: status["status"]["state"] == "idle")
        yield found


@pytest.fixture(scope="module")
def idle_agent(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AgentClient]:
    """One that is never told to do anything, for all that it refuses."""
    folder = tmp_path_factory.mktemp("idle_agent")
    with pytest.MonkeyPatch.context() as monkeypatch, bench(8.0) as mill:
        own_folders(monkeypatch, folder)
        with running_agent(folder / "data", mill.url) as found:
            found.until(lambda status: status["status"]["state"] == "idle")
            yield found


def test_hold_resume_and_abort(agent: AgentClient, mill: Bench, tmp_path: Path) -> None:
    run = agent.start(program(tmp_path / "p.nc", LONG_LINES))
    agent.until(lambda status: status["progress"]["executed_line"] > 8)
    agent.post(f"/v1/runs/{run}:hold", 202)
    agent.until(lambda status: status["status"]["state"] == "held")
    cut = len(mill.cut)
    assert agent.get(f"/v1/runs/{run}")["state"] == "held"
    agent.post(f"/v1/runs/{run}:resume", 202)
    agent.until(lambda status: status["progress"]["executed_line"] > cut + 5)
    agent.post("/v1/control/hold", 202)
    agent.post("/v1/control/abort", 202)
    agent.until(lambda status: agent.get(f"/v1/runs/{run}")["state"] == "aborted")
    assert not any(segment.kind == "slip" for segment in mill.mill.recording.segments)


def test_overrides_jog_and_zero(agent: AgentClient, mill: Bench) -> None:
    agent.post("/v1/control/jog", 202, by_mm=[5, 0, 0], feed_mm_per_min=1000)

    def said(words: str) -> dict[str, Any]:
        return agent.until(lambda status: words in [event["words"] for event in status["events"]])

    assert said("Jog X +5 mm: done")["status"]["work_mm"] == [5.0, 0.0, 0.0]
    agent.post("/v1/control/zero", 202, axes="X")
    said("X = 0 here: done, at machine X 5.000 mm")
    agent.until(lambda status: status["status"]["work_mm"] == [0.0, 0.0, 0.0])
    agent.post("/v1/control/override", 202, what="feed", percent=120)
    said("Feed at 120 %: done")
    agent.until(lambda status: status["status"]["overrides"][0] == 120)
    agent.post("/v1/control/block", 202, text="M3 S1000")
    said("Line M3 S1000: done")


def test_a_line_that_changes_what_protects_the_mill_is_asked_for_again(agent: AgentClient) -> None:
    """It goes only where "confirm" is said, and what it would do is told."""
    refusal = agent.post("/v1/control/block", 409, text="G10 L20 P1 X5")
    assert (refusal["code"], refusal["field"]) == ("confirm", "confirm")
    assert (
        refusal["effect"]
        == "'G10 L20 P1 X5' sets a work zero or a tool's length: what is cut afterwards lies elsewhere"
    )
    assert refusal["detail"].startswith(refusal["effect"]) and '"confirm": true' in refusal["detail"]
    assert agent.post("/v1/control/block", 422, text="G10 L20 P1 X5", confirm="yes")["field"] == "confirm"
    assert agent.status()["status"]["work_mm"] == [0.0, 0.0, 0.0]
    agent.post("/v1/control/block", 202, text="G10 L20 P1 X5", confirm=True)
    agent.until(lambda status: status["status"]["work_mm"] == [5.0, 0.0, 0.0])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("path", "body", "status", "field"),
    [
        ("/v1/control/jog", {"by_mm": [1, 2]}, 422, "by_mm"),
        ("/v1/control/jog", {"by_mm": [1, 2, "3"]}, 422, "by_mm.2"),
        ("/v1/control/jog", {}, 422, "by_mm"),
        ("/v1/control/jog", {"by_mm": [1, 2, 3], "speed": 1}, 422, "speed"),
        ("/v1/control/override", {"what": "feed", "percent": 300}, 422, "percent"),
        ("/v1/control/override", {"what": "rapid", "percent": 30}, 422, "percent"),
        ("/v1/control/override", {"what": "drive", "percent": 100}, 422, "what"),
        ("/v1/control/check", {"on": "yes"}, 422, "on"),
        ("/v1/control/block", {"text": "G0 X1\nG0 X2"}, 422, "text"),
        ("/v1/control/block", {"text": "!"}, 422, "text"),
        ("/v1/control/zero", {"axes": "A"}, 422, "axes"),
        ("/v1/control/probe", {"depth_mm": 0}, 422, "depth_mm"),
        ("/v1/control/explode", {}, 404, None),
        ("/v1/runs", {"program": "0" * 64, "name": "x"}, 404, "program"),
        ("/v1/runs", {"program": "../../x", "name": "x"}, 422, "sha256"),
        ("/v1/runs/none:start", {"operator": "Ada", "checks": CHECKS}, 404, "run"),
        ("/v1/programs", {"url": "file:///etc/passwd", "sha256": "0" * 64}, 422, "url"),
        ("/v1/nothing", {}, 404, None),
    ],
)
def test_refusals_are_problems_that_name_the_field(
    idle_agent: AgentClient, path: str, body: dict[str, object], status: int, field: str | None
) -> None:
    answer = idle_agent.http.post(path, json=body)
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert (problem["status"], problem.get("field")) == (status, field)
    assert problem["detail"] and "\n" not in problem["detail"]


@pytest.mark.thorough
@pytest.mark.parametrize("content", [b"{", b"[1]", b"\xff", b'"x"', b"[" * 50000, b"x" * 70000])
def test_bodies_that_are_not_objects(idle_agent: AgentClient, content: bytes) -> None:
    answer = idle_agent.http.post("/v1/runs", content=content)
    assert answer.status_code in (400, 413)
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("text", "words"), [("G21 G90\nG1 X1 F100\nT1 M6\nM2\n", "line 3"), ("\n(words)\n", "not one block")]
)
def test_a_bad_program_is_refused_in_words(idle_agent: AgentClient, tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "bad.nc"
    path.write_text(text)
    problem = idle_agent.post("/v1/runs", 422, program=idle_agent.upload(path), name="bad")
    assert (problem["field"], words in problem["detail"]) == ("program", True)


@pytest.mark.thorough
def test_a_program_is_fetched_by_hash_and_a_wrong_one_is_not_kept(agent: AgentClient, tmp_path: Path) -> None:
    data = program(tmp_path / "p.nc", 500).read_bytes()
    sha256 = hashlib.sha256(data).hexdigest()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.headers["Authorization"] == "Bearer job-token" else 401)
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, format: str, *args: object) -> None: ...

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_address[1]}/p.nc"
        assert agent.post("/v1/programs", 502, url=url, sha256=sha256)["field"] == "url"
        problem = agent.post("/v1/programs", 422, url=url, sha256="0" * 64, token="job-token")
        assert "nothing is kept" in problem["detail"]
        assert agent.get("/v1/programs")["programs"] == []
        assert agent.post("/v1/programs", 201, url=url, sha256=sha256, token="job-token")["bytes"] == len(data)
        assert agent.post("/v1/programs", 200, url=url, sha256=sha256, token="job-token")["sha256"] == sha256
        server.shutdown()
    assert agent.post("/v1/programs", 502, url=url, sha256="1" * 64)["field"] == "url"


@pytest.mark.thorough
def test_the_same_key_parks_once_even_across_a_new_start(
    tmp_path: Path, mill: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job server that lost the answer asks again: it must not find two runs."""
    own_folders(monkeypatch, tmp_path)
    path, other = program(tmp_path / "p.nc", 20), program(tmp_path / "q.nc", 21)
    with running_agent(tmp_path / "data", mill.url) as agent:
        sha256 = agent.upload(path)
        body = {"program": sha256, "name": "p", "key": "job-7/pass-1"}
        with concurrent.futures.ThreadPoolExecutor(4) as pool:
            answers = list(pool.map(lambda _: agent.http.post("/v1/runs", json=body), range(4)))
        assert sorted(answer.status_code for answer in answers) == [200, 200, 200, 201]
        assert len({answer.json()["id"] for answer in answers}) == 1
        problem = agent.post("/v1/runs", 409, program=agent.upload(other), key="job-7/pass-1")
        assert problem["field"] == "key"
    with running_agent(tmp_path / "data", mill.url) as agent:
        run = agent.post("/v1/runs", 200, **body)
        assert run["id"] == answers[0].json()["id"]
        assert len(agent.get("/v1/runs")["runs"]) == 1


@pytest.mark.thorough
def test_a_program_is_deleted_unless_a_run_may_need_it(agent: AgentClient, mill: Bench, tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", 20)
    sha256 = agent.upload(path)
    assert agent.http.delete(f"/v1/programs/{sha256}").status_code == 204
    assert agent.http.delete(f"/v1/programs/{sha256}").status_code == 404
    agent.upload(path)
    run = agent.post("/v1/runs", 201, program=sha256, name="p")["id"]
    refused = agent.http.delete(f"/v1/programs/{sha256}")
    assert (refused.status_code, run in refused.json()["detail"]) == (409, True)
    agent.post(f"/v1/runs/{run}:start", 202, operator="Ada", checks=CHECKS)
    assert agent.http.delete(f"/v1/programs/{sha256}").status_code == 409
    agent.until(lambda status: agent.get(f"/v1/runs/{run}")["state"] == "finished")
    assert agent.http.delete(f"/v1/programs/{sha256}").status_code == 204
    assert agent.http.delete("/v1/programs/..%2Ftoken").status_code in (404, 422)


@pytest.mark.thorough
def test_a_slow_body_does_not_stop_a_hold(agent: AgentClient, mill: Bench, tmp_path: Path) -> None:
    agent.start(program(tmp_path / "p.nc", LONG_LINES))
    host, _, port = agent.url.removeprefix("http://").partition(":")
    head = (
        f"POST /v1/runs HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {agent.token}\r\nContent-Length: 99\r\n\r\n"
    )
    with socket.create_connection((host, int(port))) as slow:
        slow.sendall(head.encode() + b"{")
        agent.post("/v1/control/hold", 202)
        agent.until(lambda status: status["status"]["state"] == "held")


@pytest.mark.thorough
def test_events_come_live_and_what_was_missed_comes_again(agent: AgentClient, mill: Bench, tmp_path: Path) -> None:
    with agent.events() as events:
        first = next(events)
        assert first["event"] == "status"
        run = agent.start(program(tmp_path / "p.nc", 20))
        seen = next(event for event in events if event["event"] == "event")
    agent.until(lambda status: agent.get(f"/v1/runs/{run}")["state"] == "finished")
    with agent.events(seen["id"]) as events:
        missed = next(events)
        assert missed["event"] == "event"
        assert int(missed["id"].partition("-")[2]) > int(seen["id"].partition("-")[2])
    with agent.events("other-1") as events:
        assert "gap" in next(events)["data"]
