"""Checks uploaded pictures in a child process, so that no decoder ever runs in the process that serves.

One thread, the keeper, owns the child: the kernel ties a process to the thread that started it, so that thread lives
as long as the checker. Requests wait their turn.
"""

from __future__ import annotations

import json
import os
import queue
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from service.errors import FailedError, PictureError
from service.picture_limits import PictureFacts

__all__ = ["PictureChecker", "PictureFacts"]

_ROOT = Path(__file__).parents[2]
_START_S, _LOOK_S = 20.0, 0.1
_ANSWER_BYTES = 65536


class _Died(Exception):
    """The child ended instead of answering."""


class _Late(Exception):
    """The child did not answer in time."""


class PictureChecker:
    """`check` may be called from any thread (it blocks: use a thread pool); checks are done one after the other."""

    def __init__(self, *, time_limit_s: float = 10.0) -> None:
        self._time_limit_s = time_limit_s
        self._requests: queue.SimpleQueue[tuple[dict[str, Any], Future[PictureFacts]] | None] = queue.SimpleQueue()
        self._child: _Child | None = None
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
                raise FailedError("pictures are not checked any more: the server is ending")
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
            self._child = _Child(lambda: self._closed)
        except (OSError, _Died, _Late):
            self._child = None  # the first check tries again, and tells
        while (request := self._requests.get()) is not None:
            asked, answer = request
            try:
                answer.set_result(self._checked(asked))
            except Exception as error:
                answer.set_exception(error)
        self._drop()

    def _checked(self, asked: dict[str, Any]) -> PictureFacts:
        """A child that dies is no proof against the picture: it is tried once more in a new one."""
        name = asked["name"]
        for _ in range(2):
            child = self._ready_child()
            try:
                return _facts(child.ask(asked, self._time_limit_s))
            except _Late:
                self._drop()
                raise PictureError(f"{name}: takes longer than {self._time_limit_s:g} s to decode") from None
            except (_Died, OSError):
                self._drop()
        raise PictureError(f"{name}: the picture is damaged (decoding it ended the process that did it)")

    def _ready_child(self) -> _Child:
        if self._child is None:
            try:
                self._child = _Child(lambda: False)
            except (OSError, _Died, _Late):
                raise FailedError("pictures cannot be checked: the process for it does not start") from None
        return self._child

    def _drop(self) -> None:
        if self._child is not None:
            self._child.end()
            self._child = None


class _Child:
    def __init__(self, given_up: Callable[[], bool]) -> None:
        places = os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "service.api.picture_child", str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # decoders print what a stranger's file makes them print
            env={**os.environ, "PYTHONPATH": places},
            start_new_session=True,
            bufsize=0,
        )
        try:
            self._await_start(given_up)
        except BaseException:
            self.end()
            raise

    def _await_start(self, given_up: Callable[[], bool]) -> None:
        """On a busy computer this takes long: a server that ends meanwhile does not wait for it."""
        assert self._process.stdout is not None
        until = time.monotonic() + _START_S
        while not select.select([self._process.stdout], [], [], _LOOK_S)[0]:
            if given_up() or time.monotonic() > until:
                raise _Late
        self._answer(_START_S)

    def ask(self, asked: dict[str, Any], within_s: float) -> dict[str, Any]:
        assert self._process.stdin is not None
        text = json.dumps(asked).encode() + b"\n"
        while text:
            text = text[self._process.stdin.write(text) :]
        return self._answer(within_s)

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
        for end in (self._process.stdin, self._process.stdout):
            if end is not None:
                end.close()

    def _answer(self, within_s: float) -> dict[str, Any]:
        assert self._process.stdout is not None
        until, text = time.monotonic() + within_s, b""
        while not text.endswith(b"\n"):
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, until - time.monotonic()))
            if not ready:
                raise _Late
            piece = os.read(self._process.stdout.fileno(), _ANSWER_BYTES)
            if not piece or len(text) > _ANSWER_BYTES:
                raise _Died
            text += piece
        try:
            found: dict[str, Any] = json.loads(text)
        except ValueError:
            raise _Died from None
        return found


def _facts(answer: dict[str, Any]) -> PictureFacts:
    if "refused" in answer:
        raise PictureError(*answer["refused"])
    return PictureFacts(**answer["facts"])
