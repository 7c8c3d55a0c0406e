"""Server-sent events: what was missed comes again, what is lost is said, and a slow reader holds nobody up."""

from __future__ import annotations

import asyncio
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.types import Message as AsgiMessage

from service.http import event_hub
from service.http.event_hub import MOST_WAITING, Hub, HubStream, Message, Reader
from service.http.problems import Problem


def joined(hub: Hub[Reader]) -> Reader:
    reader = Reader()
    hub.add(reader)
    return reader


def opened(hub: Hub[Reader], last_id: str, *, heartbeat_s: float) -> HubStream:
    reader = Reader()
    return HubStream(hub, reader, lambda: hub.add(reader, last_id), heartbeat_s=heartbeat_s)


def numbers(hub: Hub[Reader], last_id: str) -> list[int]:
    """The payloads a reader that comes back with `last_id` is sent; -1 for a gap."""
    reader = Reader()
    first = hub.add(reader, last_id)
    hub.remove(reader)
    payloads = [json.loads(message.data) for message in first if message.kind == "event"]
    return [-1 if payload.get("kind") == "gap" else payload["n"] for payload in payloads]


@pytest.mark.parametrize("ring", [3, 10])
def test_a_reader_that_comes_back_gets_exactly_what_it_missed_or_is_told_of_the_gap(ring: int) -> None:
    hub: Hub[Reader] = Hub(ring=ring, readers=1)
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
    hub: Hub[Reader] = Hub(ring=10, readers=1)
    for n in range(5):
        hub.publish_status({"n": n})
    first = hub.add(Reader())
    assert [(message.kind, json.loads(message.data)) for message in first] == [("status", {"n": 4})]


@given(st.lists(st.integers(0, 3), max_size=40), st.integers(1, 5))
def test_what_a_reader_gets_has_no_gap_and_who_is_late_gets_the_end(reads: list[int], most: int) -> None:
    """After each event so many are read: those who keep up get all, a late one what comes first, then the end."""
    hub: Hub[Reader] = Hub(readers=2)
    late, quick = Reader(most), Reader(1)
    hub.add(late)
    hub.add(quick)
    got: list[int | None] = []
    for number, count in enumerate(reads):
        hub.send(Message("event", str(number)), list(hub.readers))
        message = quick.queue.get_nowait()
        assert message is not None and message.data == str(number)
        for _ in range(min(count, late.queue.qsize())):
            got.append(None if (message := late.queue.get_nowait()) is None else int(message.data))
    assert quick in hub.readers and late.queue.qsize() <= most + 1
    while not late.queue.empty():
        got.append(None if (message := late.queue.get_nowait()) is None else int(message.data))
    events = got if late in hub.readers else got[:-1]
    assert events == list(range(len(events)))
    assert len(events) == len(reads) if late in hub.readers else got[-1] is None


def test_statuses_do_not_push_a_late_reader_out() -> None:
    hub: Hub[Reader] = Hub(ring=10, readers=1)
    reader = joined(hub)
    for n in range(10 * MOST_WAITING):
        hub.publish_status({"n": n})
    hub.publish_event({"n": 1})
    assert reader in hub.readers


def test_the_number_of_readers_is_bounded() -> None:
    hub: Hub[Reader] = Hub(ring=10, readers=1)
    joined(hub)
    with pytest.raises(Problem, match="1 readers already") as refused:
        joined(hub)
    assert refused.value.status == 503


def test_the_stream_has_ids_heartbeats_and_an_end() -> None:
    async def trial() -> bytes:
        hub: Hub[Reader] = Hub(ring=10, readers=1)
        sent = bytearray()

        async def send(message: AsgiMessage) -> None:
            sent.extend(message.get("body", b""))

        async def receive() -> AsgiMessage:
            await asyncio.Event().wait()
            raise AssertionError

        hub.publish_event({"n": 0})
        stream = asyncio.ensure_future(opened(hub, f"{hub.life}-0", heartbeat_s=0.01)({}, receive, send))
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
    monkeypatch.setattr(event_hub, "_SEND_WAIT_S", 0.01)

    async def trial() -> None:
        hub: Hub[Reader] = Hub(ring=10, readers=1)

        async def send(message: AsgiMessage) -> None:
            if message["type"] == "http.response.body":
                await asyncio.Event().wait()

        async def receive() -> AsgiMessage:
            await asyncio.Event().wait()
            raise AssertionError

        await asyncio.wait_for(opened(hub, "", heartbeat_s=10)({}, receive, send), 5)
        joined(hub)  # its place is free again

    asyncio.run(trial())
