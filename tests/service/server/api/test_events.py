"""Following jobs over server-sent events."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from service.server.database.connection import begin_writing
from service.server.database.tables import events, jobs, progress
from tests.service.server.api.server import ApiServer, api_server, problem
from tests.waiting import PATIENCE_S, until


@dataclass
class Seen:
    """What one follower got, each with the moment."""

    kinds: list[tuple[str, float]] = field(default_factory=list)
    ids: list[int] = field(default_factory=list)
    data: list[dict] = field(default_factory=list)
    over: bool = False

    def at(self, kind: str) -> float | None:
        return next((at for seen, at in self.kinds if seen == kind), None)


def follow(server: ApiServer, job_id: str, seen: Seen, last_id: str | None = None) -> None:
    """Read the stream to its end."""
    headers = {"Last-Event-ID": last_id} if last_id else {}
    with server.client.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers) as answer:
        assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/event-stream")
        for line in answer.iter_lines():
            name, _, value = line.partition(": ")
            if name == "event":
                seen.kinds.append((value, time.monotonic()))
            elif name == "id":
                seen.ids.append(int(value))
            elif name == "data":
                seen.data.append(json.loads(value))
    seen.over = True


def following(server: ApiServer, job_id: str, last_id: str | None = None) -> tuple[threading.Thread, Seen]:
    seen = Seen()
    thread = threading.Thread(target=follow, args=(server, job_id, seen, last_id), daemon=True)
    thread.start()
    return thread, seen


def end(server: ApiServer, job_id: str) -> None:
    server.put_state(job_id, "succeeded", ended_at=time.time())
    server.put_event(job_id, "ended", state="succeeded", attempt=1, error=None)


def put_progress(server: ApiServer, job_id: str, share: float) -> None:
    with begin_writing(server.services.database) as connection:
        connection.execute(jobs.update().where(jobs.c.id == job_id).values(state="running", stage="map"))
        connection.execute(progress.delete().where(progress.c.job_id == job_id))
        connection.execute(progress.insert().values(job_id=job_id, stage="map", share=share, at=time.time()))


def test_history_then_live_events_then_the_end(server: ApiServer) -> None:
    job_id = server.submit()["id"]
    server.put_event(job_id, "started", attempt=1)
    thread, seen = following(server, job_id)
    until(lambda: len(seen.kinds) == 2)
    put_progress(server, job_id, 0.25)
    until(lambda: seen.at("progress"))
    server.put_event(job_id, "stage.committed", stage="image")
    end(server, job_id)
    thread.join(PATIENCE_S)
    assert seen.over
    assert [kind for kind, _ in seen.kinds] == ["queued", "started", "progress", "stage.committed", "ended"]
    assert seen.ids == [1, 2, 3, 4]
    assert seen.data[2]["stage"] == "map" and seen.data[2]["share"] == 0.25
    assert seen.data[-1]["state"] == "succeeded" and seen.data[-1]["at"].endswith("Z")


def test_a_reader_that_comes_back_gets_what_it_missed_and_no_more(server: ApiServer) -> None:
    job_id = server.submit()["id"]
    for number in range(5):
        server.put_event(job_id, "stage.committed", stage=f"pass-{number}")
    thread, seen = following(server, job_id, "3")
    until(lambda: len(seen.ids) == 3)
    end(server, job_id)
    thread.join(PATIENCE_S)
    assert seen.ids == [4, 5, 6, 7] and seen.over
    assert server.client.get(f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": "7"}).status_code == 204
    again = Seen()
    follow(server, job_id, again, "6")
    assert again.ids == [7]


def test_a_stream_goes_on_over_an_end_that_was_retried(server: ApiServer) -> None:
    job_id = server.submit()["id"]
    server.client.post(f"/v1/jobs/{job_id}:cancel").raise_for_status()
    server.client.post(f"/v1/jobs/{job_id}:retry").raise_for_status()
    thread, seen = following(server, job_id)
    until(lambda: seen.at("retried"))
    assert not seen.over
    server.client.post(f"/v1/jobs/{job_id}:cancel").raise_for_status()
    thread.join(PATIENCE_S)
    assert seen.over and [kind for kind, _ in seen.kinds].count("ended") == 2


def test_a_deleted_job_ends_its_streams(server: ApiServer) -> None:
    job_id = server.submit()["id"]
    thread, seen = following(server, job_id)
    until(lambda: seen.kinds)
    server.client.delete(f"/v1/jobs/{job_id}").raise_for_status()
    thread.join(PATIENCE_S)
    assert seen.over


def test_an_id_from_another_life_of_the_database_begins_anew(server: ApiServer) -> None:
    """After a restore the events are fewer: waiting for the one after it would never end."""
    job_id = server.submit()["id"]
    thread, seen = following(server, job_id, "900")
    until(lambda: seen.kinds)
    end(server, job_id)
    thread.join(PATIENCE_S)
    assert seen.over and seen.ids == [1, 2]


@pytest.mark.parametrize("last_id", ["x", "-1", "1.5", "9" * 20])
def test_a_wrong_last_event_id_is_named(server: ApiServer, last_id: str) -> None:
    job_id = server.submit()["id"]
    headers = {"Last-Event-ID": last_id}
    problem(server.client.get(f"/v1/jobs/{job_id}/events", headers=headers), 422, "Last-Event-ID")


def test_fifty_followers_hear_of_progress_and_of_the_end_within_a_second(server: ApiServer) -> None:
    jobs_made = [server.submit()["id"] for _ in range(5)]
    readers = [following(server, jobs_made[number % 5]) for number in range(50)]
    until(lambda: all(seen.at("queued") for _, seen in readers))
    for job_id in jobs_made:
        put_progress(server, job_id, 0.5)
    told = time.monotonic()
    until(lambda: all(seen.at("progress") for _, seen in readers))
    late = max(seen.at("progress") - told for _, seen in readers)
    for job_id in jobs_made:
        end(server, job_id)
    told = time.monotonic()
    for thread, _ in readers:
        thread.join(PATIENCE_S)
    late_end = max(seen.at("ended") - told for _, seen in readers)
    assert all(seen.over for _, seen in readers)
    assert late < 5 and late_end < 5  # the figures of an idle machine are in the bench
    until(lambda: server.services.feed.followers == 0)


def test_a_reader_that_does_not_read_is_dropped_and_holds_nobody_up(server: ApiServer) -> None:
    job_id = server.submit()["id"]
    with stuck_reader(server, job_id):
        until(lambda: server.services.feed.followers == 1)
        thread, seen = following(server, job_id)
        words = "x" * 2000
        with begin_writing(server.services.database) as connection:
            rows = [
                {"job_id": job_id, "seq": seq, "at": 0.0, "kind": "stage.started", "data": {"stage": words}}
                for seq in range(2, 9000)
            ]
            connection.execute(events.insert(), rows)
        end(server, job_id)
        thread.join(PATIENCE_S)
        assert seen.over and seen.ids == list(range(1, 9001))
        until(lambda: server.services.feed.followers == 0)  # the stuck one as well


class stuck_reader:
    """A connection that asks for a stream and never reads it."""

    def __init__(self, server: ApiServer, job_id: str) -> None:
        self._socket = socket.create_connection(("127.0.0.1", server.port))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self._socket.sendall(f"GET /v1/jobs/{job_id}/events HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        self._socket.close()


@pytest.fixture
def own_server(tmp_path: Path) -> Iterator[ApiServer]:
    with api_server(tmp_path / "data") as running:
        yield running


def test_a_server_that_stops_ends_its_streams_itself(own_server: ApiServer) -> None:
    """It does not wait for them as for other requests, and they are not cut off when it has waited long enough."""
    own_server.server.config.timeout_graceful_shutdown = None  # for ever
    thread, seen = following(own_server, own_server.submit()["id"])
    until(lambda: seen.kinds)
    own_server.server.should_exit = True
    thread.join(PATIENCE_S)
    assert seen.over
