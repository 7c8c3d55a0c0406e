"""The inside of every child process: its limits, the requests that it reads, and the messages with which it answers.

Messages are JSON lines: first {"ready": true}, if the process answers several requests; for each request {"share": 0.5}
any number of times, then one of {"result": {...}}, {"refused": [lines], "kind" or "problems", "use"} for faults that
people can mend, {"failed": [lines]}, or {"crashed": text} for all others; beside texts their "phrases". `child` reads
them.

A stage's process, which the fork server forks, answers one request on its own pipe in the same format, and watches the
worker's heartbeats; everything printed goes to the stage's log.
"""

from __future__ import annotations

import contextlib
import errno
import faulthandler
import importlib
import json
import os
import resource
import select
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from phrases.phrase import Phrase, phrases_in
from service.errors import InputError, PictureError, ServiceError, SpecError, printable, sentence_of_os_error
from service.processes.linux import address_space_bytes, die_with_parent, give_way, name_process

Work = Callable[[dict[str, Any], Callable[[float], None]], dict[str, Any]]
"""Carries out a request, reports its progress (0 to 1), and returns the result: all plain JSON."""

_SHARE_EVERY_S = 0.1
_HOPELESS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EROFS)  # trying again changes nothing
_TAKE_ME_FIRST = "500"


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

    beside_bytes, bytes_per_pixel : address space in addition to that at its start: always, and by `max_pixels` of the
                                    request; without them it has no limit
    barred                        : resources that it may not use at all
    """
    if sys.platform == "linux":
        die_with_parent(int(sys.argv[1]), parent_ends_it_with)
        name_process(name)
    give_way()
    for kind in barred:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(kind, (0, 0))
    words = WordPipe(os.dup(1))
    os.dup2(2, 1)  # output of libraries must not be taken for an answer
    base = address_space_bytes() if sys.platform == "linux" else 0
    words.send({"ready": True})
    for line in sys.stdin:
        request = json.loads(line)
        if beside_bytes:
            with contextlib.suppress(OSError, ValueError):  # not every system has such a limit
                limit_memory(base + beside_bytes + bytes_per_pixel * request["max_pixels"])
        words.send(word_of(lambda request=request: work(request, words.send_share)))  # type: ignore[misc]


def word_of(work: Callable[[], dict[str, Any]], *, no_memory: Phrase | None = None) -> dict[str, Any]:
    """Return the final message about some work: its result, or its error.

    no_memory : makes the message for too little memory; None: there is no special message
    """
    try:
        word = {"result": work()}
    except (Exception, SystemExit) as error:  # from a library: the process still reports it
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
    """Limit the address space, and forbid core dumps. for_good: it cannot be raised again, even from here."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = most_bytes if hard == resource.RLIM_INFINITY else min(most_bytes, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, most if for_good else hard))


class WordPipe:
    """The pipe to the caller. Progress messages are dropped while the pipe is full: nothing waits, nothing piles up."""

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
        """Send a message that must not be lost."""
        text = _line(word)
        with self._lock:
            os.set_blocking(self._pipe, True)
            while text:
                text = text[os.write(self._pipe, text) :]


def _line(word: dict[str, Any]) -> bytes:
    return json.dumps(word).encode() + b"\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class ChildOrder:
    """What the fork server hands to a child. Files: `order` JSON to read, `words` to write, `beats` to read, `log`."""

    parent: int
    entry: str
    memory_mb: int
    silence_s: float
    order: int
    words: int
    beats: int
    log: int


def find_entry(name: str) -> Work:
    """Return the function `module:function` that does a stage's work."""
    module, _, function = name.partition(":")
    found: Work = getattr(importlib.import_module(module), function)
    return found


def run_child(given: ChildOrder) -> NoReturn:
    """Run the process from the fork to its end; never return to the fork server's code."""
    code = 70
    try:
        _set_up_stage_process(given)
        words = WordPipe(given.words)
        threading.Thread(target=_watch, args=(given.beats, given.silence_s), name="beats", daemon=True).start()
        words.send(word_of(lambda: _work(given, words), no_memory=out_of_memory(given.memory_mb)))
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        _flush_output()
        os._exit(code)


def _work(given: ChildOrder, words: WordPipe) -> dict[str, Any]:
    with os.fdopen(given.order, "rb") as file:
        order = json.load(file)
    return find_entry(given.entry)(order, words.send_share)


def _set_up_stage_process(given: ChildOrder) -> None:
    os.setsid()  # a group of its own: one signal reaches everything that the stage starts
    signal.set_wakeup_fd(-1)
    for kind in (signal.SIGTERM, signal.SIGCHLD, signal.SIGINT, signal.SIGHUP):
        signal.signal(kind, signal.SIG_DFL)  # with the default action the process ends without needing the interpreter
    die_with_parent(given.parent)
    name_process("cm-stage")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(given.log, 1)
    os.dup2(given.log, 2)
    _close_all_but({given.order, given.words, given.beats})
    with contextlib.suppress(OSError):  # if memory is short, the kernel should kill this process and not the server
        Path("/proc/self/oom_score_adj").write_text(_TAKE_ME_FIRST, encoding="ascii")
    limit_memory(address_space_bytes() + given.memory_mb * 1_000_000, for_good=True)
    faulthandler.enable(2)  # the stage's log shows where a signal hit


def _close_all_but(kept: set[int]) -> None:
    """Close other children's pipes, which are also open here and would hide the end of those children."""
    first = 3
    for number in (*sorted(kept), os.sysconf("SC_OPEN_MAX")):
        os.closerange(first, number)
        first = number + 1


def _watch(beats: int, silence_s: float) -> None:
    """End the whole group when the worker, or the fork server in between, has ended or hangs."""
    while True:
        ready, _, _ = select.select([beats], [], [], silence_s)
        if not ready or not os.read(beats, 65536):
            os.write(2, b"no beat from the worker: this process ends itself\n")
            os.killpg(0, signal.SIGKILL)


def out_of_memory(memory_mb: int) -> Phrase:
    return Phrase(
        "out of memory: a stage may take {memory_mb} MB here (CAUSTICMILL_STAGE_MEMORY_MB); a smaller image.pixels "
        "needs less",
        memory_mb=memory_mb,
    )


def _flush_output() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
