"""From the event loop to the mill's own thread and back.

Holds and aborts have threads of their own: they never queue behind a pre-flight or a slow question.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from machines.mill.mill import Mill
from machines.mill.thread import MillThread
from machines.mill.view import MillSnapshot

T = TypeVar("T")


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

    async def urgent(self, function: Callable[[Mill], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._urgent, self._thread.call, function)

    async def work(self, function: Callable[[], T]) -> T:
        """Something slow that is not the mill's, such as a pre-flight."""
        return await asyncio.get_running_loop().run_in_executor(self._calls, function)

    def close(self) -> None:
        self._urgent.shutdown(wait=False, cancel_futures=True)
        self._calls.shutdown(wait=False, cancel_futures=True)
