"""Server-sent events: what was missed comes again, what is lost is said, and a slow reader holds nobody up."""

from __future__ import annotations

import asyncio
import json

import pytest
from starlette.types import Message as AsgiMessage

from service.http import streaming
from service.http.problems import Problem
from service.milling.agent import event_hub
from service.milling.agent.event_hub import Hub, HubStream


def numbers(hub: Hub, last_id: str) -> list[int]:
    """The payloads a reader that comes back with `last_id` is sent; -1 for a gap."""
    reader, first = hub.join(last_id)
    hub.leave(reader)
    payloads = [json.loads(message.data) for message in first if message.kind == "event"]
    return [-1 if payload.get("kind") == "gap" else payload["n"] for payload in payloads]


@pytest.mark.parametrize("ring", [3, 10])
def test_a_reader_that_comes_back_gets_exactly_what_it_missed_or_is_told_of_the_gap(ring: int) -> None:
    hub = Hub(ring=ring, readers=1)
    for n in range(6):
        hub.publish_status({"n": n})  # statuses in between take numbers, too
        hub.publish_event({"n": n})
    kept = list(range(6))[-ring:]
    ids = [f"{hub.life}-{2 * n + 2}" for n in range(6)]
    for seen, last_id in enumerate(ids):
        missed = [n for n in range(6) if n > seen]
        assert numbers(hub, last_id) == (missed if set(missed) <= set(kept) else [-1, *kept]), last_id
    assert numbers(hub, "") == []
    assert numbers(hub, "other-3") == [-1, *kept]
    assert numbers(hub, "nonsense") == [-1, *kept]


def test_every_reader_begins_with_the_latest_status_only() -> None:
    hub = Hub(ring=10, readers=1)
    for n in range(5):
        hub.publish_status({"n": n})
    _, first = hub.join("")
    assert [(message.kind, json.loads(message.data)) for message in first] == [("status", {"n": 4})]


def test_a_reader_that_does_not_read_is_dropped_and_the_others_get_all() -> None:
    async def trial() -> None:
        hub = Hub(ring=10, readers=2)
        slow, _ = hub.join("")
        quick, _ = hub.join("")
        got = 0
        for n in range(2 * event_hub._QUEUE):
            hub.publish_event({"n": n})
            message = quick.queue.get_nowait()
            assert message is not None
            got += json.loads(message.data)["n"] == n
        assert (slow.dropped, quick.dropped, got) == (True, False, 2 * event_hub._QUEUE)
        assert slow.queue.qsize() == event_hub._QUEUE + 1  # bounded; the last one is the end

    asyncio.run(trial())


def test_statuses_do_not_push_a_late_reader_out() -> None:
    hub = Hub(ring=10, readers=1)
    reader, _ = hub.join("")
    for n in range(10 * event_hub._QUEUE):
        hub.publish_status({"n": n})
    hub.publish_event({"n": 1})
    assert not reader.dropped


def test_the_number_of_readers_is_bounded() -> None:
    hub = Hub(ring=10, readers=1)
    hub.join("")
    with pytest.raises(Problem, match="1 readers already") as refused:
        hub.join("")
    assert refused.value.status == 503


def test_the_stream_has_ids_heartbeats_and_an_end() -> None:
    async def trial() -> bytes:
        hub, sent = Hub(ring=10, readers=1), bytearray()

        async def send(message: AsgiMessage) -> None:
            sent.extend(message.get("body", b""))

        async def receive() -> AsgiMessage:
            await asyncio.Event().wait()
            raise AssertionError

        hub.publish_event({"n": 0})
        stream = asyncio.ensure_future(HubStream(hub, f"{hub.life}-0", heartbeat_s=0.01)({}, receive, send))
        while b": still here" not in sent:
            await asyncio.sleep(0.005)
        hub.publish_event({"n": 1})
        hub.close()
        await asyncio.wait_for(stream, 5)
        return bytes(sent).replace(hub.life.encode(), b"L").replace(b": still here\n\n", b"")

    assert asyncio.run(trial()) == (
        b'retry: 1000\n\nid: L-1\nevent: event\ndata: {"n":0}\n\nid: L-2\nevent: event\ndata: {"n":1}\n\n'
    )


def test_a_connection_that_is_stuck_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streaming, "_SEND_WAIT_S", 0.01)

    async def trial() -> None:
        hub = Hub(ring=10, readers=1)

        async def send(message: AsgiMessage) -> None:
            if message["type"] == "http.response.body":
                await asyncio.Event().wait()

        async def receive() -> AsgiMessage:
            await asyncio.Event().wait()
            raise AssertionError

        await asyncio.wait_for(HubStream(hub, "", heartbeat_s=10)({}, receive, send), 5)
        hub.join("")  # its place is free again

    asyncio.run(trial())
