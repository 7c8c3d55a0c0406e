"""A child process that many callers share. It is started when needed, answers one request after the other, and is
replaced if it ends, is late or crashes.

One thread, the keeper, owns the process: the kernel ties a process to the thread that started it, so that thread lives
as long as the process may be needed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from service.errors import ServiceError
from service.processes.child import Child, ChildError

Answer = dict[str, Any]


class ChildNotStarted(ChildError):
    """The process cannot be started."""


class ChildClosed(ChildError):
    """The child is closed: this server is ending."""


class TooManyWaiting(ChildError):
    """Too many requests are waiting; another one is not accepted."""


class Superseded(ChildError):
    """The caller has made a newer request, or has gone."""


@dataclass(slots=True, kw_only=True, eq=False)
class _Request:
    caller: str
    asked: dict[str, Any]
    is_long: bool
    answer: Future[Answer] = field(default_factory=Future)

    def end(self, error: Exception) -> None:
        with suppress(InvalidStateError):  # its caller has gone
            self.answer.set_exception(error)


class KeptChild:
    """`ask` from any thread; `close` ends the process.

    module       : of the process
    answer_s     : after which an answer is late
    long_s       : the same of long requests, and of the first one
    start_s      : after which the start of the process counts as failed
    idle_s       : after which an unused process is ended; None: never
    most_waiting : requests; None: any number
    explain      : makes the error that callers get in place of a ChildError
    """

    def __init__(
        self,
        module: str,
        *,
        answer_s: float,
        long_s: float | None = None,
        start_s: float = 20.0,
        idle_s: float | None = None,
        most_waiting: int | None = None,
        explain: Callable[[ChildError], Exception] = lambda error: error,
    ) -> None:
        self._module = module
        self._answer_s, self._long_s = answer_s, long_s or answer_s
        self._start_s, self._idle_s = start_s, idle_s
        self._most_waiting = most_waiting
        self._explain = explain
        self._condition = threading.Condition()
        self._waiting: list[_Request] = []
        self._running: _Request | None = None
        self._closed = self._killed = self._warm = False
        self._thread: threading.Thread | None = None
        self._child: Child | None = None

    def start(self) -> None:
        """Start the process before it is asked for the first time."""
        with self._condition:
            self._start_keeper(at_once=True)

    def ask(self, caller: str, asked: dict[str, Any], *, is_long: bool = False) -> Future[Answer]:
        """Return the answer of the process. This ends the caller's earlier requests, or joins an equal one."""
        request = _Request(caller=caller, asked=asked, is_long=is_long)
        with self._condition:
            if self._closed:
                raise self._explain(ChildClosed())
            for one in self._requests_of(caller):
                if one.asked == asked and not one.answer.done():
                    return one.answer
            self._end_all_of(caller)
            if self._most_waiting is not None and len(self._waiting) >= self._most_waiting:
                raise self._explain(TooManyWaiting())
            self._waiting.append(request)
            self._start_keeper()
            self._condition.notify()
        return request.answer

    def leave(self, caller: str) -> None:
        """End a caller's requests: it has gone, or made a newer request."""
        with self._condition:
            self._end_all_of(caller)

    @property
    def child_pid(self) -> int | None:
        """Id of the process, while there is one."""
        child = self._child
        return None if child is None else child.pid

    def close(self) -> None:
        """End the process; callers that wait for an answer get ChildClosed."""
        with self._condition:
            self._closed = True
            for request in (*self._waiting, *([self._running] if self._running else [])):
                request.end(self._explain(ChildClosed()))
            self._waiting = []
            self._condition.notify()
            if self._child is not None:
                self._child.kill()  # its thread reaps it
        if self._thread is not None:
            self._thread.join()

    def _start_keeper(self, *, at_once: bool = False) -> None:
        """Start the thread, and with it the process. The caller holds the condition."""
        if self._thread is None:
            name = self._module.rpartition(".")[2]
            self._thread = threading.Thread(target=self._keep, args=(at_once,), name=name, daemon=True)
            self._thread.start()

    def _requests_of(self, caller: str) -> list[_Request]:
        """Return a caller's requests. The condition must be held."""
        return [one for one in (self._running, *self._waiting) if one is not None and one.caller == caller]

    def _end_all_of(self, caller: str) -> None:
        """End a caller's requests, and the process if it works on a long one of them. The condition must be held."""
        older = self._requests_of(caller)
        for one in older:
            one.end(self._explain(Superseded()))
        self._waiting = [one for one in self._waiting if one.caller != caller]
        if any(one is self._running and one.is_long for one in older) and self._child is not None:
            self._killed = True
            self._child.kill()  # its thread reaps it

    def _keep(self, at_once: bool) -> None:
        if at_once:
            with suppress(ChildError):  # the first request tries again, and reports the error
                self._ready_child()
        while (request := self._wait_for_next()) is not None:
            self._finish(request)
        self._drop()

    def _wait_for_next(self) -> _Request | None:
        """Return the next request, None if closed. Meanwhile end an idle process."""
        with self._condition:
            self._running = None
            if self._killed:
                self._killed = False
                self._drop()
            while not self._closed:
                while self._waiting:
                    self._running = self._waiting.pop(0)
                    if not self._running.answer.done():
                        return self._running
                if not self._condition.wait(self._idle_s if self._child else None) and not self._waiting:
                    self._drop()
            return None

    def _finish(self, request: _Request) -> None:
        try:
            found = self._answer(request)
        except ChildError as error:
            self._drop()
            if not request.answer.done():  # otherwise its caller no longer wants it
                request.end(self._explain(error))
        except ServiceError as error:
            request.end(error)
        else:
            with suppress(InvalidStateError):
                request.answer.set_result(found)

    def _answer(self, request: _Request) -> Answer:
        child = self._ready_child()
        if request.is_long and request.answer.done():
            raise Superseded  # its caller left while the process started
        is_short = self._warm and not request.is_long
        found = child.ask(request.asked, within_s=self._answer_s if is_short else self._long_s)
        self._warm = True
        return found

    def _ready_child(self) -> Child:
        """Return the process; start it first if necessary. Raises ChildNotStarted."""
        if self._child is None:
            try:
                child = Child(self._module)
            except OSError as error:
                raise ChildNotStarted(str(error)) from None
            try:
                child.await_ready(self._start_s, lambda: self._closed)
            except ChildError as error:
                child.end()
                raise ChildNotStarted(str(error)) from None
            self._child = child
        return self._child

    def _drop(self) -> None:
        if self._child is not None:
            self._child.end()
            self._child = None
