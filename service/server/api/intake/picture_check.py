"""Checks uploaded pictures in a child process, so that no decoder ever runs in the process that serves.

One thread, the keeper, owns the child: the kernel ties a process to the thread that started it, so that thread lives
as long as the checker. Requests wait their turn.
"""

from __future__ import annotations

import queue
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from phrases.phrase import Phrase
from service.errors import FailedError, PictureError
from service.job.picture.limits import PictureFacts
from service.processes.line_child import ChildDied, ChildLate, LineChild

__all__ = ["PictureChecker", "PictureFacts"]

_MODULE = "service.server.api.intake.picture_child"


class PictureChecker:
    """`check` may be called from any thread (it blocks: use a thread pool); checks are done one after the other."""

    def __init__(self, *, time_limit_s: float = 10.0) -> None:
        self._time_limit_s = time_limit_s
        self._requests: queue.SimpleQueue[tuple[dict[str, Any], Future[PictureFacts]] | None] = queue.SimpleQueue()
        self._child: LineChild | None = None
        self._closed = False
        self._gate = threading.Lock()
        self._keeper = threading.Thread(target=self._keep, name="pictures", daemon=True)
        self._keeper.start()

    def check(self, path: Path, name: str, max_pixels: int) -> PictureFacts:
        """Decode the picture whole. PictureError, which calls it by `name`, where it cannot be used.

        FailedError where no picture can be checked: the checker is closed, or its process cannot be started.
        """
        answer: Future[PictureFacts] = Future()
        with self._gate:
            if self._closed:
                raise FailedError(Phrase("pictures are no longer checked: the server is shutting down"))
            self._requests.put(({"path": str(path), "name": name, "max_pixels": max_pixels}, answer))
        return answer.result()

    def close(self) -> None:
        """End the child, after the checks that were asked for."""
        with self._gate:  # nothing comes after the None
            self._closed = True
            self._requests.put(None)
        self._keeper.join()

    def _keep(self) -> None:
        try:
            self._child = LineChild(_MODULE, lambda: self._closed)
        except (OSError, ChildDied, ChildLate):
            self._child = None  # the first check tries again, and tells
        while (request := self._requests.get()) is not None:
            asked, answer = request
            try:
                answer.set_result(self._check(asked))
            except Exception as error:
                answer.set_exception(error)
        self._drop()

    def _check(self, asked: dict[str, Any]) -> PictureFacts:
        """Check a picture. A child that dies is no proof against it: it is tried once more in a new one."""
        name = asked["name"]
        for _ in range(2):
            child = self._ready_child()
            try:
                return _facts(child.ask(asked, self._time_limit_s))
            except ChildLate:
                self._drop()
                limit_s = self._time_limit_s
                words = Phrase("{name}: takes longer than {limit_s:g} s to decode", name=name, limit_s=limit_s)
                raise PictureError(words) from None
            except (ChildDied, OSError):
                self._drop()
        raise PictureError(
            Phrase("{name}: the picture is damaged (decoding it ended the process that did it)", name=name)
        )

    def _ready_child(self) -> LineChild:
        if self._child is None:
            try:
                self._child = LineChild(_MODULE)
            except (OSError, ChildDied, ChildLate):
                words = Phrase("pictures cannot be checked: the process that does it does not start")
                raise FailedError(words) from None
        return self._child

    def _drop(self) -> None:
        if self._child is not None:
            self._child.end()
            self._child = None


def _facts(answer: dict[str, Any]) -> PictureFacts:
    if "refused" in answer:
        raise PictureError(*answer["refused"])
    return PictureFacts(**answer["facts"])
