"""The thread that owns a Mill. Other threads submit calls to it and read snapshots; no other thread touches the mill.

A call wakes the poll, so that a hold is on the wire within milliseconds. Snapshots are frozen and replaced as a whole,
so reading one takes no lock.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from machines.clock import LOOK_S, Timeout
from machines.errors import MachineError, MillCode, NotAllowedError
from machines.mill.mill import Mill
from machines.mill.orders import NOBODY, Caller, OrderGate, Stop
from machines.mill.view import MillSnapshot

T = TypeVar("T")

_POLL_S = 0.25
_CALL_S = 60.0


class MillThread:
    """Runs `mill.step` until stopped."""

    def __init__(self, mill: Mill) -> None:
        self._mill = mill
        self._stops: deque[tuple[Future[Any], Callable[[Mill], Any]]] = deque()
        self._calls: deque[tuple[Future[Any], Callable[[Mill], Any]]] = deque()
        self._snapshot = mill.snapshot
        self._changed = threading.Condition()
        self.turns = 0  # of the owner thread, which checks for calls in each
        self._ending = False
        self._ended = False
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"mill {mill.name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def orders(self) -> OrderGate:
        return self._mill.orders

    @property
    def snapshot(self) -> MillSnapshot:
        return self._snapshot

    def wait_for_change(self, version: int, timeout_s: float) -> MillSnapshot:
        """Return the first snapshot with another version than `version`, or the present one when the time is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._snapshot.version != version or self._ended, timeout_s)
        return self._snapshot

    def call(self, function: Callable[[Mill], T], timeout_s: float = _CALL_S) -> T:
        """Run `function` on the owner thread; return its result or raise its exception.

        A caller that waits in vain gets an error which says that the call was not made; a call that has not begun by
        then never begins.
        """
        if threading.current_thread() is self._thread:
            return function(self._mill)
        future, timeout = self.submit(function), Timeout(timeout_s)
        while not timeout.is_over:
            with contextlib.suppress(TimeoutError):
                return future.result(min(LOOK_S, timeout_s / 2.0))
            if future.done():
                return future.result()  # the call's own TimeoutError, or the call has just ended
        raise no_answer(timeout_s, taken_back=future.cancel())

    def submit(self, function: Callable[[Mill], T]) -> Future[T]:
        """Let the owner thread run `function`; never waits. `cancel` takes back a call that has not begun."""
        return self._put(self._calls, function)

    def halt(self, stop: Stop, caller: Caller = NOBODY) -> tuple[bool, Future[None]]:
        """Stop the mill; never waits. Return whether a byte that stops it was sent, and the future of the owner
        thread's part.

        The stop is counted first, so that no older order is carried out any more. Then the byte is sent without waiting
        for the owner thread, whose own part comes before all other calls.
        """
        self._mill.orders.count_stop(stop)
        written = self._mill.urge(stop.value)
        return written, self._put(self._stops, lambda mill: mill.carry_out_stop(stop, caller))

    def _is_running(self) -> bool:
        return not self._ended and self._thread.is_alive()

    def _put(self, queue: deque[tuple[Future[Any], Callable[[Mill], Any]]], function: Callable[[Mill], T]) -> Future[T]:
        future: Future[T] = Future()
        with self._changed:
            if not self._is_running():
                raise _make_ended_error("is not running", self._failure)
            queue.append((future, function))
        self._mill.wake()
        return future

    def stop(self, *, detach: bool = False) -> None:
        """End the thread and release the mill. Refused while the mill moves, unless `detach` allows it to go on."""
        if self._thread.is_alive():
            self.call(lambda mill: self._end(mill, detach))
            self._thread.join(_CALL_S)
        elif not self._ended:
            self._ended = True
            self._mill.close(detach=detach)

    def _end(self, mill: Mill, detach: bool) -> None:
        mill.require_closable(detach=detach)
        self._ending = True

    def _run(self) -> None:
        try:
            while not self._ending:
                self.turns += 1
                self._mill.step(_POLL_S)
                self._carry_out_calls()
                self._publish()
        except BaseException as error:
            self._failure = error
            self._mill.note_failure(error)
        finally:
            self._finish()

    def _carry_out_calls(self) -> None:
        while (self._stops or self._calls) and not self._ending:
            future, function = self._stops.popleft() if self._stops else self._calls.popleft()
            if future.set_running_or_notify_cancel():
                try:
                    value = function(self._mill)
                except BaseException as error:
                    self._publish()
                    future.set_exception(error)
                else:
                    self._publish()  # a caller that gets the answer also finds the matching snapshot
                    future.set_result(value)

    def _publish(self) -> None:
        snapshot = self._mill.snapshot
        if snapshot is not self._snapshot:
            with self._changed:
                self._snapshot = snapshot
                self._changed.notify_all()

    def _finish(self) -> None:
        try:
            self._mill.close(detach=True)
        finally:
            with self._changed:
                self._ended = True
                self._snapshot = self._mill.snapshot
                left = [*self._stops, *self._calls]
                self._stops.clear()
                self._calls.clear()
                self._changed.notify_all()
            for future, _ in left:
                if future.set_running_or_notify_cancel():
                    future.set_exception(_make_ended_error("has ended", self._failure))


def _make_ended_error(how: str, failure: BaseException | None) -> NotAllowedError:
    why = f": {failure}" if failure is not None else ""
    values = {"reason": "" if failure is None else str(failure)}
    return NotAllowedError(
        f"the mill's thread {how}{why}; start the agent again", code=MillCode.OWNER_ENDED, values=values
    )


def no_answer(timeout_s: float, *, taken_back: bool) -> MachineError:
    """Return the error for a caller whose time is over."""
    fate = "it was taken back" if taken_back else "it is under way and may still be carried out"
    return MachineError(
        f"the mill's thread gave no answer within {timeout_s:g} s, {fate}; use the mill's own stop button",
        code=MillCode.OWNER_SILENT,
        values={"seconds": timeout_s, "taken_back": taken_back},
    )
