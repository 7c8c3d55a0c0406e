"""Places of connections: strangers have few, stops need none, and whoever is known keeps theirs."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from service.http.acceptor import _names_stop
from service.http.admission import Admission, Place

MOST, STRANGERS = 3, 2
EVENTS = ("comes", "comes", "comes", "is heard", "stops", "is known", "is answered", "goes")


class _Transport:
    def __init__(self) -> None:
        self.aborted = False

    def abort(self) -> None:
        self.aborted = True


class _Crowd:
    """Connections and what they do; `open` are those that have not gone or been closed."""

    def __init__(self) -> None:
        self.admission = Admission(most=MOST, strangers=STRANGERS)
        self.open: list[tuple[Place, Any]] = []

    def do(self, event: str, which: int) -> None:
        if event == "comes":
            transport = _Transport()
            self.open.append((self.admission.enter(transport), transport))  # type: ignore[arg-type]
        elif self.open:
            place, _ = self.open[which % len(self.open)]
            steps = {
                "is heard": place.stop_waiting,
                "stops": place.answer_stop,
                "is known": place.identify,
                "is answered": place.await_request,
                "goes": place.leave,
            }
            steps[event]()
            if event == "goes":
                del self.open[which % len(self.open)]

    def closed_now(self) -> list[Place]:
        closed = [place for place, transport in self.open if transport.aborted]
        self.open = [(place, transport) for place, transport in self.open if not transport.aborted]
        return closed


@example(
    [("comes", 0), ("stops", 0), ("comes", 0), ("stops", 1), ("comes", 0), ("stops", 2), ("comes", 0), ("comes", 0)]
)
@given(st.lists(st.tuples(st.sampled_from(EVENTS), st.integers(0, 20)), max_size=60))
def test_no_stop_is_closed_and_nobody_who_is_known_while_there_is_a_stranger(story: list[tuple[str, int]]) -> None:
    async def run() -> None:
        crowd = _Crowd()
        for event, which in story:
            before = [place for place, _ in crowd.open]
            crowd.do(event, which)
            waiting = [place for place, transport in crowd.open if place.is_awaited and not place.is_known]
            for place in crowd.closed_now():
                assert not place.is_stop
                if place.is_known:
                    assert all(other.is_known or other.is_stop for other in before), "a stranger kept the place"
            still = [place for place in waiting if place in [one for one, _ in crowd.open]]
            assert len(still) <= STRANGERS
            assert crowd.admission.count == len(crowd.open)
            if len(crowd.open) > MOST:
                assert crowd.admission.is_full

    asyncio.run(run())


def test_of_strangers_the_one_that_has_kept_us_waiting_longest_is_closed() -> None:
    async def run() -> None:
        admission = Admission(most=100, strangers=2)
        transports = [_Transport() for _ in range(4)]
        places = [admission.enter(transport) for transport in transports[:3]]  # type: ignore[arg-type]
        assert [one.aborted for one in transports] == [True, False, False, False]
        places[1].await_request()  # it was answered, and is now the one who has just come
        admission.enter(transports[3])  # type: ignore[arg-type]
        assert [one.aborted for one in transports] == [True, False, True, False]

    asyncio.run(run())


@pytest.mark.parametrize(
    ("head", "is_stop"),
    [
        (b"POST /v1/machines/m/control/hold HTTP/1.1\r\nHost: x\r\n", True),
        (b"POST /v1/machines/m/control/jog-cancel?x=1 HTTP/1.1\r\n", True),
        (b"POST /v1/runs/r%3Aabort HTTP/1.1\r\n", True),
        (b"GET /v1/machines/m/control/hold HTTP/1.1\r\n", False),
        (b"POST /v1/machines/m/control/home HTTP/1.1\r\n", False),
        (b"POST /v1/jobs?x=/control/hold HTTP/1.1\r\n", False),
        (b"POST /v1/machines/m/control/ho", False),
        (b"\xff\xfe", False),
        (b"", False),
    ],
)
def test_the_first_line_names_a_stop(head: bytes, is_stop: bool) -> None:
    assert _names_stop(head) == is_stop
