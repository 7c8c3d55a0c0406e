"""A slow call that many ask for at once is made once, in a thread of its own (single flight)."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

Result = TypeVar("Result")


class SharedCall(Generic[Result]):
    """Callers share the call that is under way; one that hangs keeps a single thread, which no other work needs.

    For one event loop.
    """

    def __init__(self, call: Callable[[], Result]) -> None:
        self._call = call
        self._running: Future[Result] | None = None
        self._began_s = 0.0

    async def result(self, timeout_s: float) -> Result:
        """Return the result; TimeoutError where the call takes longer, at once where it has done so already."""
        if self._running is None or self._running.done():
            self._running, self._began_s = Future(), time.monotonic()
            # A daemon: a check that hangs does not keep the process from ending.
            threading.Thread(target=self._run, args=(self._running,), name="shared call", daemon=True).start()
        left_s = self._began_s + timeout_s - time.monotonic()
        if left_s <= 0 and not self._running.done():
            raise TimeoutError
        done = asyncio.wrap_future(self._running)
        await asyncio.wait({done}, timeout=max(0.0, left_s))  # does not cancel it: others wait for it, too
        if not done.done():
            raise TimeoutError
        return done.result()

    def _run(self, running: Future[Result]) -> None:
        try:
            running.set_result(self._call())
        except BaseException as error:
            running.set_exception(error)
