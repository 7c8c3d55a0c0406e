"""A child process, from the caller's side: sends requests as lines of JSON and reads messages (`child_work`).

A `Child` does work that its caller's own process must not do: pictures and estimates (`kept_child` shares one between
callers), pre-flight, compiling in advance. A stage's process is forked and not started, but its messages are read by
the same `Words` and `result_of`.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import IO, Any

from phrases.phrase import restore
from service.errors import FailedError, InputError, PictureError, SpecError, printable
from service.processes.linux import signal_group
from service.processes.source_tree import python_path

_LOOK_S = 0.1
_PIECE_BYTES = 1 << 18
_LINE_BYTES = 64_000_000  # longer messages are ignored
_ENDS = {"result", "refused", "failed", "crashed"}


class ChildError(Exception):
    """A child process gave no answer."""


class ChildDied(ChildError):
    """The process ended instead of answering, or did not start; the words say how."""


class ChildCrashed(ChildError):
    """The child's work ended with an error that the caller cannot correct; the message names it."""


class ChildLate(ChildError):
    """The child did not answer in time."""


def result_of(word: dict[str, Any]) -> dict[str, Any]:
    """Return the result in a child's last message; raise its ServiceError, or ChildCrashed, if it reports one."""
    phrases = word.get("phrases", {})
    found = {key: restore(value, phrases) for key, value in word.items() if key != "phrases"}
    match found:
        case {"result": dict() as result}:
            return result
        case {"refused": list(), "problems": list() as problems, "use": dict() as use}:
            raise SpecError([(key, sentence) for key, sentence in problems], use)
        case {"refused": list() as lines, "kind": "picture"}:
            raise PictureError(*lines)
        case {"refused": list() as lines}:
            raise InputError(*lines)
        case {"failed": list() as lines}:
            raise FailedError(*lines)
        case {"crashed": str() as cause}:
            raise ChildCrashed(printable(cause))
    raise ChildDied("it said nothing")


class Words:
    """Reads a child's messages as they arrive. Anything else is skipped; nothing grows without bound.

    is_open : the child may still send something; last: its last message, {} before that
    """

    def __init__(self, pipe: int) -> None:
        self.is_open = True
        self.is_ready = False
        self.last: dict[str, Any] = {}
        self._pipe = pipe
        self._share: float | None = None
        self._rest = bytearray()
        self._poll = select.poll()
        self._poll.register(pipe, select.POLLIN)

    def read(self, timeout_s: float) -> None:
        """Read the available bytes, or wait for them this long."""
        if self._poll.poll(timeout_s * 1000):
            self._take()

    def drain(self) -> None:
        """Read everything that a dead child has still written."""
        while self.is_open and self._poll.poll(0):
            self._take()

    def take_share(self) -> float | None:
        """Return the progress, 0 to 1, if it is new."""
        share, self._share = self._share, None
        return share

    def _take(self) -> None:
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._pipe, _PIECE_BYTES)
            self.is_open = bool(data)
            *lines, rest = data.split(b"\n")
            for line in lines:
                self._hear(bytes(self._rest) + line)
                self._rest.clear()
            self._rest += rest
            if len(self._rest) > _LINE_BYTES:
                self._rest.clear()

    def _hear(self, line: bytes) -> None:
        try:
            word = json.loads(line)
        except (ValueError, RecursionError):
            return
        if not isinstance(word, dict) or self.last:
            return
        share = word.get("share")
        if share is None:
            self.is_ready = self.is_ready or "ready" in word
            self.last = word if word.keys() & _ENDS else {}
        elif isinstance(share, int | float) and share == share:
            self._share = min(1.0, max(0.0, float(share)))


class Child:
    """A process that runs `module`, whose `main` is `answer_requests`, and leads its own group.

    It dies with the *thread* that started it, so that thread must outlive it. Other threads may only call `kill`.
    """

    def __init__(self, module: str) -> None:
        """Start it; OSError if that fails."""
        self._ending = threading.Lock()  # its process id may be reused once it was waited for
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # a stranger's file can make decoders print anything
            env={**os.environ, "PYTHONPATH": python_path()},
            start_new_session=True,
            bufsize=0,
        )
        assert self._process.stdout is not None
        self._words = Words(self._process.stdout.fileno())

    @property
    def pid(self) -> int:
        return self._process.pid

    def await_ready(self, within_s: float, given_up: Callable[[], bool] = lambda: False) -> None:
        """Wait until it has imported its modules; ChildDied, or ChildLate if it takes longer or is given up."""
        until = time.monotonic() + within_s
        while not self._words.is_ready:
            if given_up() or time.monotonic() > until:
                raise ChildLate
            self._read(_LOOK_S)

    def ask(
        self,
        request: dict[str, Any],
        *,
        within_s: float = float("inf"),
        on_share: Callable[[float], None] | None = None,
    ) -> dict[str, Any]:
        """Return the result of a request; ServiceError as its work raises it, ChildError if there is none."""
        self.begin(request)
        return self.finish(within_s=within_s, on_share=on_share)

    def begin(self, request: dict[str, Any]) -> None:
        """Send it a request; `finish` reports if it has died."""
        assert self._process.stdin is not None
        text = json.dumps(request).encode() + b"\n"
        with contextlib.suppress(OSError):
            while text:
                text = text[self._process.stdin.write(text) :]

    def finish(
        self, *, within_s: float = float("inf"), on_share: Callable[[float], None] | None = None
    ) -> dict[str, Any]:
        """Return the result of the request that was begun, as `ask` does."""
        until = time.monotonic() + within_s
        while not self._words.last:
            if (left_s := until - time.monotonic()) <= 0:
                raise ChildLate
            self._read(min(left_s, 60.0))
            if (share := self._words.take_share()) is not None and on_share is not None:
                on_share(share)
        word, self._words.last = self._words.last, {}
        return result_of(word)

    def kill(self) -> None:
        """Kill its group, from any thread: a caller that waits for its answer gets ChildDied."""
        self._signal(signal.SIGKILL)

    def end(self, number: int = signal.SIGKILL) -> None:
        """End it and everything that it has started with this signal; return when it has ended.

        Its input ends as well: a compiler's callback may swallow the exception that a signal raises.
        """
        self._signal(number)
        self._close(self._process.stdin)
        self._wait()
        self._close(self._process.stdout)

    @staticmethod
    def _close(pipe: IO[bytes] | None) -> None:
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()

    def _signal(self, number: int) -> None:
        # macOS permits no signal to a dead process that was not waited for
        with self._ending, contextlib.suppress(PermissionError):
            if self._process.returncode is None:
                signal_group(self._process.pid, number)

    def _wait(self) -> int:
        """Wait for its end, then end its group while its process id is still its own."""
        if self._process.returncode is None and sys.platform == "linux":
            os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
            self.kill()
        with self._ending:
            return self._process.wait()

    def _read(self, timeout_s: float) -> None:
        self._words.read(timeout_s)
        if not self._words.is_open and not self._words.last:
            raise ChildDied(self._explain_end())

    def _explain_end(self) -> str:
        self.kill()  # it may only have closed its pipes
        code = self._wait()
        return f"signal {-code}" if code < 0 else f"code {code}"
