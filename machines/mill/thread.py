"""The thread that owns a Mill. Others put calls to it and read snapshots; nobody else touches the mill.

A call wakes the poll, so that a hold is on the wire within milliseconds. Snapshots are frozen and replaced whole:
reading one takes no lock.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from machines.errors import MachineError, NotAllowedError
from machines.mill.mill import Mill, MillSnapshot

T = TypeVar("T")

_POLL_S = 0.25
_CALL_S = 60.0


class _Call(Generic[T]):
    """One call on its way to the owner thread, and its answer on the way back.

    Whoever waited in vain was told that nothing came of it, so a call that has not begun by then never begins: a start
    must not come true a minute later, when nobody stands at the mill.
    """

    def __init__(self, function: Callable[[Mill], T]) -> None:
        self._function = function
        self._done = threading.Event()
        self._lock = threading.Lock()
        self._begun = self._given_up = False
        self._value: T | None = None
        self._error: BaseException | None = None

    def carry_out(self, mill: Mill) -> None:
        with self._lock:
            if self._given_up:
                return
            self._begun = True
        try:
            self._value = self._function(mill)
        except BaseException as error:
            self._error = error
        self._done.set()

    def refuse(self, error: BaseException) -> None:
        self._error = error
        self._done.set()

    def answer(self, timeout_s: float) -> T:
        if not self._done.wait(timeout_s):
            with self._lock:
                self._given_up = not self._begun
            fate = "it was taken back" if self._given_up else "it is under way and may still be carried out"
            raise MachineError(
                f"the mill's thread gave no answer within {timeout_s:g} s, {fate}; use the mill's own stop button"
            )
        if self._error is not None:
            raise self._error
        return self._value  # type: ignore[return-value]


class MillThread:
    """Runs `mill.step` until stopped."""

    def __init__(self, mill: Mill) -> None:
        self._mill = mill
        self._calls: deque[_Call] = deque()
        self._snapshot = mill.snapshot
        self._changed = threading.Condition()
        self._ending = False
        self._ended = False
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"mill {mill.name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def snapshot(self) -> MillSnapshot:
        return self._snapshot

    def wait_for_change(self, version: int, timeout_s: float) -> MillSnapshot:
        """The first snapshot that is not `version`, or the present one when the time is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._snapshot.version != version or self._ended, timeout_s)
        return self._snapshot

    def call(self, function: Callable[[Mill], T], timeout_s: float = _CALL_S) -> T:
        """Carry out `function` on the owner thread; its result or its exception comes back."""
        if threading.current_thread() is self._thread:
            return function(self._mill)
        call = _Call(function)
        with self._changed:
            if self._ended or not self._thread.is_alive():
                why = f": {self._failure}" if self._failure is not None else ""
                raise NotAllowedError(f"the mill's thread is not running{why}; start the agent again")
            self._calls.append(call)
        self._mill.wake()
        return call.answer(timeout_s)

    def stop(self, *, detach: bool = False) -> None:
        """End the thread and let go of the mill. Refused while it moves, unless `detach` says that it may go on."""
        if self._thread.is_alive():
            self.call(lambda mill: self._end(mill, detach))
            self._thread.join(_CALL_S)
        elif not self._ended:
            self._ended = True
            self._mill.close(detach=detach)

    def _end(self, mill: Mill, detach: bool) -> None:
        mill.may_close(detach=detach)
        self._ending = True

    def _run(self) -> None:
        try:
            while not self._ending:
                self._mill.step(_POLL_S)
                self._carry_out_calls()
                self._publish()
        except BaseException as error:
            self._failure = error
            self._mill.note_failure(error)
        finally:
            self._finish()

    def _carry_out_calls(self) -> None:
        while self._calls and not self._ending:
            call = self._calls.popleft()
            call.carry_out(self._mill)
            self._publish()

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
                left = list(self._calls)
                self._calls.clear()
                self._changed.notify_all()
            why = f" ({self._failure})" if self._failure is not None else ""
            for call in left:
                call.refuse(NotAllowedError(f"the mill's thread has ended{why}; start the agent again"))
