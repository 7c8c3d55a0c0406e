"""The inside of every child process: its limits, the requests that it reads and the words that it answers with.

Words are JSON lines: {"ready": true} first where it is to answer several requests; for each of them {"share": 0.5} any
number of times, then one of {"result": {...}}, {"refused": [lines], "kind" or "problems", "use"} for what people can
mend, {"failed": [lines]}, {"crashed": text} for all else; beside texts their "phrases". `child` reads them.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from typing import Any

from phrases.phrase import Phrase, phrases_in
from service.errors import InputError, PictureError, ServiceError, SpecError, printable, sentence_of_os_error
from service.processes.linux import address_space_bytes, die_with_parent, name_process
from service.processes.priority import give_way

Work = Callable[[dict[str, Any], Callable[[float], None]], dict[str, Any]]
"""Does what a request asks for, says how far it is (0 to 1), returns the result: all plain JSON."""

_SHARE_EVERY_S = 0.1
_HOPELESS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EROFS)  # trying again changes nothing


def answer_requests(
    name: str,
    work: Work,
    *,
    beside_bytes: int = 0,
    bytes_per_pixel: int = 0,
    barred: Iterable[int] = (resource.RLIMIT_CORE,),
    parent_ends_it_with: int = signal.SIGKILL,
) -> None:
    """Answer one request after the other until the input ends. argv: the process to die with.

    beside_bytes, bytes_per_pixel : address space beyond what it starts with: always, and by `max_pixels` of the
                                    request; without them it has no limit
    barred                        : resources of which it gets nothing
    """
    if sys.platform == "linux":
        die_with_parent(int(sys.argv[1]), parent_ends_it_with)
        name_process(name)
    give_way()
    for kind in barred:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(kind, (0, 0))
    words = WordPipe(os.dup(1))
    os.dup2(2, 1)  # what a library prints is no answer
    base = address_space_bytes() if sys.platform == "linux" else 0
    words.send({"ready": True})
    for line in sys.stdin:
        request = json.loads(line)
        if beside_bytes:
            with contextlib.suppress(OSError, ValueError):  # not every system has such a limit
                limit_memory(base + beside_bytes + bytes_per_pixel * request["max_pixels"])
        words.send(word_of(lambda request=request: work(request, words.send_share)))  # type: ignore[misc]


def word_of(work: Callable[[], dict[str, Any]], *, no_memory: Phrase | None = None) -> dict[str, Any]:
    """Return the last word about some work: what it returns, or what it raises.

    no_memory : says that there was too little memory, where that is to be told apart
    """
    try:
        word = {"result": work()}
    except (Exception, SystemExit) as error:  # of a library: the process has its say
        word = _word_of_error(error, no_memory)
    return {**word, "phrases": phrases_in(word)}


def _word_of_error(error: Exception | SystemExit, no_memory: Phrase | None) -> dict[str, Any]:
    match error:
        case SpecError():
            return {"refused": error.lines, "problems": error.problems, "use": error.use}
        case InputError():
            return {"refused": error.lines, "kind": "picture" if isinstance(error, PictureError) else "input"}
        case ServiceError():
            return {"failed": error.lines}
    traceback.print_exc()
    if no_memory is not None and _is_short_of_memory(error):
        return {"failed": [no_memory]}
    if isinstance(error, OSError) and error.errno in _HOPELESS:
        return {"failed": [sentence_of_os_error(error, doing=Phrase("cannot use"))]}
    return {"crashed": printable(f"{type(error).__name__}: {' '.join(str(error).split())[:300]}")}


def _is_short_of_memory(error: BaseException) -> bool:
    no_thread = isinstance(error, RuntimeError) and "start new thread" in str(error)
    return isinstance(error, MemoryError) or no_thread or (isinstance(error, OSError) and error.errno == errno.ENOMEM)


def limit_memory(most_bytes: int, *, for_good: bool = False) -> None:
    """Limit the address space, and allow no core. for_good: it cannot be raised again, even from here."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = most_bytes if hard == resource.RLIM_INFINITY else min(most_bytes, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, most if for_good else hard))


class WordPipe:
    """The pipe to who asked. Progress is dropped while the pipe is full: nothing waits, nothing piles up."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self._lock = threading.Lock()
        self._shared_at = 0.0

    def send_share(self, share: float) -> None:
        now = time.monotonic()
        with self._lock:
            if now - self._shared_at < _SHARE_EVERY_S and share < 1.0:
                return
            self._shared_at = now
            os.set_blocking(self._pipe, False)
            with contextlib.suppress(BlockingIOError):
                os.write(self._pipe, _line({"share": float(share)}))  # shorter than PIPE_BUF: whole or not at all

    def send(self, word: dict[str, Any]) -> None:
        """Send a word that must not be lost."""
        text = _line(word)
        with self._lock:
            os.set_blocking(self._pipe, True)
            while text:
                text = text[os.write(self._pipe, text) :]


def _line(word: dict[str, Any]) -> bytes:
    return json.dumps(word).encode() + b"\n"
