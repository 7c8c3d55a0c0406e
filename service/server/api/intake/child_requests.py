"""Requests of the API to child processes: checks of uploaded pictures, so that no decoder runs in the serving process;
estimates; and evaluations of photographs.

Estimates, exact estimates and evaluations of photographs each have a separate process, which is started on demand and
ends after an idle minute. Each process handles one request after the other, and only the newest of each caller, because
a person who moves a slider asks again before the last answer arrives. A long request is not continued when no one waits
for it: its process ends with the request.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import structlog

from phrases.phrase import Phrase
from service.errors import FailedError, PictureError
from service.http.problems import Problem
from service.job.picture import PictureFacts
from service.processes.child import ChildCrashed, ChildDied, ChildError, ChildLate
from service.processes.kept_child import ChildClosed, KeptChild, Superseded, TooManyWaiting
from service.processes.kernel_cache import ESTIMATES, ready_mark

_PICTURES = "service.server.api.intake.picture_child"
_TRIES = 2  # a dead child does not prove that the picture is bad


class PictureChecker:
    """Checks pictures in a child process, one after the other. `check` may be called from any thread; it blocks: use a
    thread pool.
    """

    def __init__(self, *, time_limit_s: float = 10.0) -> None:
        self._time_limit_s = time_limit_s
        self._child = KeptChild(_PICTURES, answer_s=time_limit_s)
        self._child.start()
        self._numbers = count()

    def check(self, path: Path, name: str, max_pixels: int) -> PictureFacts:
        """Decode the whole picture. PictureError, with the picture's `name`, if it is not usable.

        FailedError if no picture can be checked: the checker is closed, or its process cannot be started.
        """
        try:
            return PictureFacts(**self._ask({"path": str(path), "name": name, "max_pixels": max_pixels}))
        except ChildLate:
            limit_s = self._time_limit_s
            words = Phrase("{name}: takes longer than {limit_s:g} s to decode", name=name, limit_s=limit_s)
            raise PictureError(words) from None
        except (ChildDied, ChildCrashed):
            raise PictureError(
                Phrase("{name}: the picture is damaged (decoding it ended the process that did it)", name=name)
            ) from None
        except ChildClosed:
            raise FailedError(Phrase("pictures are no longer checked: the server is shutting down")) from None
        except ChildError:
            raise FailedError(Phrase("pictures cannot be checked: the process that does it does not start")) from None

    def close(self) -> None:
        """End the child."""
        self._child.close()

    @property
    def child_pid(self) -> int | None:
        """Id of the process, while there is one."""
        return self._child.child_pid

    def _ask(self, asked: dict[str, Any]) -> dict[str, Any]:
        for _ in range(_TRIES - 1):
            try:
                return self._ask_once(asked)
            except (ChildDied, ChildCrashed):
                continue
        return self._ask_once(asked)

    def _ask_once(self, asked: dict[str, Any]) -> dict[str, Any]:
        return self._child.ask(f"check {next(self._numbers)}", asked).result()


LOOKING = "service.server.api.intake.photo_child"
LONG_S = 900.0  # after an update the first one waits for kernels to be compiled
_ESTIMATES = "service.server.api.intake.estimator_child"
_NOBODY = ""  # no caller's name
_WEDGE_PIXELS = 1 << 16
_MOST_WAITING = 8
_START_S, _ANSWER_S = 60.0, 120.0  # a planned one takes 9 s where nothing else runs
_RETRY = {"Retry-After": "5"}
_log = structlog.get_logger("api")


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


class Estimator(KeptChild):
    """A kept child whose refusals are problems of the API.

    what : the kind of its results, a key of _REFUSALS
    """

    def __init__(self, *, idle_s: float = 60.0, module: str = _ESTIMATES, what: str = "estimate") -> None:
        super().__init__(
            module,
            answer_s=_ANSWER_S,
            long_s=LONG_S,
            start_s=_START_S,
            idle_s=idle_s,
            most_waiting=_MOST_WAITING,
            explain=self._problem,
        )
        self._what = what

    def prepare(self) -> None:
        """Compile the kernels of estimates if they are not compiled yet, so that the first person need not wait."""
        if not ready_mark(ESTIMATES).exists():
            with suppress(Problem):  # counts as busy with it
                self.ask(_NOBODY, {"prepare": True, "max_pixels": _WEDGE_PIXELS}, is_long=True)

    def _problem(self, error: ChildError) -> Problem:
        refusals = _REFUSALS[self._what]
        match error:
            case ChildClosed():
                return Problem(503, Phrase("the server is shutting down"), headers=_RETRY)
            case TooManyWaiting():
                return Problem(503, refusals.too_many, headers=_RETRY)
            case Superseded():
                return Problem(409, refusals.newer)
            case ChildCrashed():
                _log.error(f"no {self._what}", error=str(error))
                return Problem(500, Phrase("a fault inside the server; its log says which"))
        late = isinstance(error, ChildLate)
        _log.warning(f"no {self._what}", late=late, error=f"{type(error).__name__}: {error}"[:200])
        return Problem(503, refusals.late if late else refusals.ended, headers=_RETRY)
