"""What somebody elsewhere is told of the mills, each thing once; and how it gets there."""

from __future__ import annotations

import asyncio
import http.server
import json
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import InputError
from service.server.database.runs import LIVE_WORDS
from service.server.fleet.notifications import Delivery, MillWatch, Notification, list_ways_out
from service.server.schemas.runs import MachineView, RunView
from service.settings import ServerSettings
from tests.page.machine_states import MACHINE, RUN
from tests.service.mills import Bench
from tests.service.server.fleet.shop import shop
from tests.waiting import until

LOOKS = st.lists(
    st.tuples(
        st.booleans(),
        st.sampled_from(["idle", "run", "held", "alarm", "door", "tool"]),
        st.sampled_from([None, "a", "b"]),
        st.sampled_from(["parked", "running", "held", "interrupted", "aborted", "finished"]),
    ),
    max_size=30,
)


def mill(
    reachable: bool = True, state: str = "idle", run: str | None = None, run_state: str = "running"
) -> MachineView:
    own = MACHINE["mill"] | {"state": state, "alarm": 2}
    fields = {"share": 0.5, "executed_line": 1, "lines": 9, "time_s": 9.0, "time_left_s": 4.0, "operator": "Ada"}
    fields["lift_mm"] = None
    about = {"id": run, "state": run_state, "job": RUN["job"], "program": "p.nc", "words": "", "code": "", "values": {}}
    agent = MACHINE["agent"] | {"reachable": reachable}
    return MachineView.model_validate(
        MACHINE | {"agent": agent, "mill": own if reachable else None, "run": None if run is None else about | fields}
    )


def run_view(**changes: Any) -> RunView:
    return RunView.model_validate(RUN | {"created_at": 1.0} | changes)


@given(LOOKS)
def test_each_trouble_is_told_when_it_begins_and_not_again(looks):
    watch, known = MillWatch(), ""
    for reachable, state, run, run_state in looks:
        look = [mill(reachable, state, run, run_state)]
        told = watch.compare(look, [])
        assert watch.compare(look, []) == [] and all(one.event == "needs_hand" for one in told)
        locked = state in ("alarm", "door", "tool")
        trouble = (locked or (run and run_state == "interrupted")) if reachable else run and run_state in LIVE_WORDS
        assert bool(known or told) == bool(trouble) or not trouble
        assert not told or trouble
        known = (told[-1].words if told else known) if trouble else ""
        assert bool(known) == bool(trouble)


@given(st.lists(st.dictionaries(st.sampled_from("abcd"), st.sampled_from(["parked", "running", "finished"]))))
def test_each_end_is_told_once_but_none_from_before_the_first_look(looks):
    watch, before, ended = MillWatch(), None, set()
    for look in looks:
        look = (before or {}) | look | dict.fromkeys(ended, "finished")
        runs = [run_view(id=run, state=state) for run, state in look.items()]
        told = watch.compare([], runs)
        ended = {run for run, state in look.items() if state == "finished"}
        was = ended if before is None else {run for run, state in before.items() if state == "finished"}
        assert {one.run for one in told} == ended - was and len(told) == len(ended - was)
        before = look


def test_a_program_that_is_done_is_told_of_with_the_tool_that_is_due():
    watch = MillWatch(lambda: 5.0)
    watch.compare([], [])
    done = run_view(state="finished")
    (told,) = watch.compare([], [done])
    assert (told.event, told.at) == ("tool_change", 5.0)
    assert "pass-2-finish.nc is finished. Next: pass-3-finish.nc" in told.words
    (last,) = watch.compare([], [done, done.model_copy(update={"id": "other", "next": None})])
    assert last.event == "finished"


def notification(number: int) -> Notification:
    return Notification(machine="shop", event="needs_hand", words=f"shop: trouble {number}", at=float(number))


@given(faults=st.lists(st.integers(0, 5), min_size=1, max_size=12), tries=st.integers(1, 3))
def test_what_a_way_takes_within_its_tries_arrives_once_and_in_order_whatever_another_does(faults, tries):
    """faults: how often each notification is refused."""
    left, taken, other = dict(enumerate(faults)), [], []

    def send(one: Notification) -> None:
        left[int(one.at)] -= 1
        if left[int(one.at)] >= 0:
            raise OSError("away")
        taken.append(one.at)

    async def deliver() -> None:
        delivery = Delivery({"one": send, "other": lambda one: other.append(one.at)}, again_s=(0.0,) * (tries - 1))
        running = asyncio.create_task(delivery.run())
        for number in range(len(faults)):
            await delivery.enqueue(notification(number))
        expected = [number for number, refused in enumerate(faults) if refused < tries]
        tried = [min(refused + 1, tries) for refused in faults]
        while len(other) < len(faults) or sum(faults) - sum(left.values()) < sum(tried):
            await asyncio.sleep(0)
        while len(taken) < len(expected):
            await asyncio.sleep(0)
        running.cancel()
        assert (taken, other) == (expected, list(range(len(faults))))

    asyncio.run(deliver())


class _Mailbox(socketserver.StreamRequestHandler):
    """As much of SMTP as a message needs."""

    def handle(self) -> None:
        self.wfile.write(b"220 here\r\n")
        text: list[str] = []
        while line := self.rfile.readline():
            if line[:4].upper() == b"DATA":
                self.wfile.write(b"354 go on\r\n")
                while (line := self.rfile.readline()) not in (b".\r\n", b""):
                    text.append(line.decode())
                self.server.messages.append("".join(text))  # type: ignore[attr-defined]
            ends = line[:4].upper() == b"QUIT"
            self.wfile.write(b"221 bye\r\n" if ends else b"250 yes\r\n")
            if ends:
                return


class _Webhook(http.server.BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.messages.append(json.loads(body))  # type: ignore[attr-defined]
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def serving(handler: type[socketserver.BaseRequestHandler]) -> Iterator[tuple[str, list[Any]]]:
    """(host:port, what has arrived)."""
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), handler) as server:
        server.messages = []  # type: ignore[attr-defined]
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"127.0.0.1:{server.server_address[1]}", server.messages  # type: ignore[attr-defined]
        server.shutdown()


def test_a_mailbox_gets_the_words():
    with serving(_Mailbox) as (address, messages):
        settings = ServerSettings(notify_email="shop@example.org", smtp_url=f"smtp://{address}")
        list_ways_out(settings)["e-mail"](notification(3))
    (message,) = messages
    assert "Subject: shop: trouble 3" in message and "To: shop@example.org" in message


@pytest.mark.parametrize("wrong", [{"notify_url": "ftp://x"}, {"notify_email": "shop"}, {"smtp_url": "localhost"}])
def test_an_address_that_is_none_is_refused_by_name(wrong):
    with pytest.raises(InputError, match="CAUSTICMILL_" + next(iter(wrong)).upper()):
        ServerSettings.load(**wrong)


@pytest.mark.thorough
def test_a_web_address_is_told_of_a_program_that_ends(tmp_path: Path, mill: Bench) -> None:
    with (
        serving(_Webhook) as (address, messages),
        shop(tmp_path / "data", mill, notify_url=f"http://{address}/") as floor,
    ):
        run = floor.park(floor.job((40, 60)))
        floor.start(run)
        floor.until_finished(run)
        until(lambda: messages)
    assert {one["event"] for one in messages} == {"tool_change"} and messages[0]["run"] == run["id"]
    assert "Next: pass-2-finish.nc" in messages[0]["words"]
