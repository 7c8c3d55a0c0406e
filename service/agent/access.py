"""From the event loop to the mill's own thread and back.

Holds and aborts have threads of their own: they never queue behind a pre-flight or a slow question.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from machines.errors import NotAllowedError
from machines.mill.mill import Mill
from machines.mill.thread import MillThread
from machines.mill.view import MillSnapshot

T = TypeVar("T")
_FRESH_S = 4.0


class MillAccess:
    """The mill as coroutines see it."""

    def __init__(self, thread: MillThread) -> None:
        self._thread = thread
        self._urgent = ThreadPoolExecutor(4, thread_name_prefix="urgent")
        self._calls = ThreadPoolExecutor(8, thread_name_prefix="call")

    @property
    def snapshot(self) -> MillSnapshot:
        return self._thread.snapshot

    def status(self) -> dict[str, Any]:
        return self._thread.snapshot.as_dict()

    async def call(self, function: Callable[[Mill], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._calls, self._thread.call, function)

    async def order(self, function: Callable[[Mill], T]) -> T:
        """A call that is for now: one that could not begin within 4 s never does, and its caller is told so."""
        latest_s = time.monotonic() + _FRESH_S

        def fresh() -> T:
            left_s = latest_s - time.monotonic()
            if left_s <= 0:
                raise NotAllowedError("the agent was busy for too long: the order was taken back, nothing was sent")
            return self._thread.call(function, left_s)

        return await asyncio.get_running_loop().run_in_executor(self._calls, fresh)

    async def urgent(self, function: Callable[[Mill], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._urgent, self._thread.call, function)

    async def work(self, function: Callable[[], T]) -> T:
        """Something slow that is not the mill's, such as a pre-flight."""
        return await asyncio.get_running_loop().run_in_executor(self._calls, function)

    def close(self) -> None:
        self._urgent.shutdown(wait=False, cancel_futures=True)
        self._calls.shutdown(wait=False, cancel_futures=True)
