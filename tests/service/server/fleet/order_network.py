"""What is between page, server and agent: messages that may be late, come twice, or lose their answer, and a server
that may be full.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import Mock

from service.http.admission import Admission
from service.http.problems import Problem

_PLACES = 8


@dataclass
class Weather:
    """What is between, for all messages that one press leads to: seconds there and back of each, from the front.

    twice_after_s : by message, how much later it comes once more. lost : number of the one whose answer is lost
    """

    delays_s: list[float] = field(default_factory=list)
    twice_after_s: dict[int, float] = field(default_factory=dict)
    lost: int = -1
    sent: int = 0

    def next_delay_s(self) -> float:
        return self.delays_s.pop(0) if self.delays_s else 0.002


WEATHER: ContextVar[Weather] = ContextVar("weather")


class MessageNetwork:
    """Carries messages in simulated time.

    on_the_way : messages; in_vain : waits for an answer that is lost
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.on_the_way = self.in_vain = 0
        self._loop = loop
        self._admission = Admission(most=_PLACES, strangers=_PLACES)
        self._tasks: set[asyncio.Task[Any]] = set()

    @property
    def is_awaited(self) -> bool:
        """Somebody waits for a message, or for an answer that is not lost."""
        return len(self._tasks) > self.in_vain

    def cancel(self) -> None:
        for task in self._tasks:
            task.cancel()

    async def fill_server(self, *, strangers: bool) -> None:
        """Take all places at the server: strangers who say nothing make room for others, requests at work do not."""
        self._admission = Admission(most=_PLACES, strangers=_PLACES)
        for _ in range(_PLACES):
            place = self._admission.enter(Mock())
            if not strangers:
                place.identify()

    def empty_server(self) -> None:
        self._admission = Admission(most=_PLACES, strangers=_PLACES)

    async def call_server(self, deliver: Callable[[], Awaitable[Any]], *, is_stop: bool = False) -> Any:
        """A hop to the server, which lets in whom it has a place for (as `ProblemProtocol` does)."""

        async def enter() -> Any:
            place = self._admission.enter(Mock())
            if is_stop:
                place.answer_stop()
            else:
                place.identify()
            try:
                if self._admission.is_full and not place.is_stop:
                    raise Problem(503, "too many requests at once")
                return await deliver()
            finally:
                place.leave()

        return await self.hop(enter)

    async def hop(self, deliver: Callable[[], Awaitable[Any]]) -> Any:
        """A message on its way, delivered whatever becomes of the sender; it may come twice, or lose its answer."""
        weather = WEATHER.get(None) or Weather()
        there_s, back_s = weather.next_delay_s(), weather.next_delay_s()
        number, weather.sent = weather.sent, weather.sent + 1
        again_s = weather.twice_after_s.get(number)

        async def travel(delay_s: float) -> Any:
            self.on_the_way += 1
            try:
                await asyncio.sleep(delay_s)
                return await deliver()
            finally:
                self.on_the_way -= 1

        first = self.begin(travel(there_s))
        if again_s is not None:
            self.begin(travel(there_s + again_s))
        answer = await asyncio.shield(first)
        if number != weather.lost:
            await asyncio.sleep(back_s)
            return answer
        self.in_vain += 1
        try:
            return await asyncio.sleep(1e6)
        finally:
            self.in_vain -= 1

    def begin(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._end)
        return task

    def _end(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled():
            task.exception()
