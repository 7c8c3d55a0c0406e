"""Estimates are made in a process of their own, started when one is asked for and ended when none was for a minute;
so are exact estimates and looks at photographs, each in another one.

One after the other; of each caller only the newest: whoever turns a knob asks again before the last answer is there.
What takes long is not worked on when nobody waits for it: its process ends with the ask.
One thread, the keeper, owns the process (`line_child`) and lives as long as this does.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import structlog

from phrases.phrase import Phrase
from service.errors import FailedError, InputError, PictureError, SpecError
from service.http.problems import Problem
from service.processes.kernel_cache import ESTIMATES, ready_mark
from service.processes.line_child import ChildDied, ChildLate, LineChild

_NOBODY = ""  # no caller's name
_WEDGE_PIXELS = 1 << 16
_MODULE, LOOKING = "service.server.api.intake.estimator_child", "service.server.api.intake.photo_child"
_MOST_WAITING = 8
_START_S, _ANSWER_S = 60.0, 120.0  # a planned one takes 9 s where nothing else runs
LONG_S = 900.0  # after an update the first one waits for kernels to be compiled
_RETRY = {"Retry-After": "5"}
_log = structlog.get_logger("api")

Answer = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Refusals:
    too_many: Phrase
    newer: Phrase
    late: Phrase
    ended: Phrase


_REFUSALS = {
    "estimate": _Refusals(
        too_many=Phrase("too many estimates are asked for; try again"),
        newer=Phrase("a newer estimate was asked for"),
        late=Phrase("the estimate takes too long"),
        ended=Phrase("the process for estimates has ended; try again"),
    ),
    "look": _Refusals(
        too_many=Phrase("too many photographs are being measured; try again"),
        newer=Phrase("a newer photograph was sent"),
        late=Phrase("measuring the photograph takes too long"),
        ended=Phrase("the process that measures photographs has ended; try again"),
    ),
}


@dataclass(slots=True, kw_only=True, eq=False)
class _Request:
    caller: str
    asked: dict[str, Any]
    is_long: bool
    answer: Future[Answer] = field(default_factory=Future)

    def end(self, problem: Exception) -> None:
        with suppress(InvalidStateError):  # whoever waited for it has gone
            self.answer.set_exception(problem)


class Estimator:
    """`ask` from any thread; `close` ends the process.

    module : of the process
    what   : it makes, a key of _REFUSALS; in its answers, too
    """

    def __init__(self, *, idle_s: float = 60.0, module: str = _MODULE, what: str = "estimate") -> None:
        self._what = what
        self._refusals = _REFUSALS[what]
        self._idle_s = idle_s
        self._module = module
        self._condition = threading.Condition()
        self._waiting: list[_Request] = []
        self._running: _Request | None = None
        self._closed = self._killed = False
        self._thread: threading.Thread | None = None
        self._child: LineChild | None = None
        self._warm = False

    def ask(self, caller: str, asked: dict[str, Any], *, is_long: bool = False) -> Future[Answer]:
        """Return what the process answers. Ends the caller's earlier asks, or joins the same one; Problem where too
        many wait.

        is_long : the answer may take LONG_S
        """
        request = _Request(caller=caller, asked=asked, is_long=is_long)
        with self._condition:
            if self._closed:
                raise Problem(503, Phrase("the server is shutting down"), headers=_RETRY)
            for one in self._requests_of(caller):
                if one.asked == asked and not one.answer.done():
                    return one.answer
            self._end_all_of(caller)
            if len(self._waiting) >= _MOST_WAITING:
                raise Problem(503, self._refusals.too_many, headers=_RETRY)
            self._waiting.append(request)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=f"{self._what}s", daemon=True)
                self._thread.start()
            self._condition.notify()
        return request.answer

    def leave(self, caller: str) -> None:
        """End a caller's asks: it has gone, or asked for something else."""
        with self._condition:
            self._end_all_of(caller)

    def _requests_of(self, caller: str) -> list[_Request]:
        """Return a caller's asks, with the condition held."""
        return [one for one in (self._running, *self._waiting) if one is not None and one.caller == caller]

    def _end_all_of(self, caller: str) -> None:
        """End a caller's asks, with the condition held."""
        older = self._requests_of(caller)
        for one in older:
            one.end(Problem(409, self._refusals.newer))
        self._waiting = [one for one in self._waiting if one.caller != caller]
        if any(one is self._running and one.is_long for one in older) and self._child is not None:
            self._killed = True
            self._child.kill()  # its thread reaps it

    def prepare(self) -> None:
        """Compile what estimates need, where it was not yet, so that the first person need not wait for it."""
        if not ready_mark(ESTIMATES).exists():
            with suppress(Problem):  # as good as busy with it
                self.ask(_NOBODY, {"prepare": True, "max_pixels": _WEDGE_PIXELS}, is_long=True)

    @property
    def callers(self) -> set[str]:
        """Who waits for an answer."""
        with self._condition:
            return {one.caller for one in (self._running, *self._waiting) if one is not None}

    @property
    def child_pid(self) -> int | None:
        """Of the process, while there is one."""
        child = self._child
        return None if child is None else child.pid

    def close(self) -> None:
        with self._condition:
            self._closed = True
            for ask in (*self._waiting, *([self._running] if self._running else [])):
                ask.end(Problem(503, Phrase("the server is shutting down"), headers=_RETRY))
            self._waiting = []
            self._condition.notify()
            child = self._child
        if child is not None:
            child.kill()  # its thread reaps it
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while (ask := self._wait_for_next()) is not None:
            self._finish(ask)
        self._drop()

    def _wait_for_next(self) -> _Request | None:
        """Return the next one to be answered; meanwhile an idle process is ended. None: closed."""
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

    def _finish(self, ask: _Request) -> None:
        try:
            found = self._answer(ask)
        except (ChildLate, ChildDied, OSError) as error:
            self._drop()
            if ask.answer.done():  # it was not wanted any more
                return
            late = isinstance(error, ChildLate)
            _log.warning(f"no {self._what}", late=late, error=f"{type(error).__name__}: {error}"[:200])
            ask.end(Problem(503, self._refusals.late if late else self._refusals.ended, headers=_RETRY))
            return
        if (problem := self._problem(found)) is not None:
            ask.end(problem)
            return
        with suppress(InvalidStateError):
            ask.answer.set_result(found[self._what])

    def _answer(self, ask: _Request) -> dict[str, Any]:
        if self._child is None:
            self._child = LineChild(self._module, self._is_closed, start_s=_START_S)
        if ask.is_long and ask.answer.done():
            raise ChildDied  # left while the process began
        found = self._child.ask(ask.asked, LONG_S if ask.is_long or not self._warm else _ANSWER_S)
        self._warm = True
        return found

    def _is_closed(self) -> bool:
        return self._closed

    def _drop(self) -> None:
        if self._child is not None:
            self._child.end()
            self._child = None

    def _problem(self, found: dict[str, Any]) -> Exception | None:
        kinds: dict[str, Callable[..., Exception]] = {
            "picture": PictureError,
            "input": InputError,
            "failed": FailedError,
        }
        if "problems" in found:
            return SpecError([(key, words) for key, words in found["problems"]], found["use"])
        if "refused" in found:
            return kinds[found["kind"]](*found["refused"])
        if "fault" in found:
            _log.error(f"no {self._what}", error=found["fault"])
            return Problem(500, Phrase("internal server error; see the server's log"))
        return None
