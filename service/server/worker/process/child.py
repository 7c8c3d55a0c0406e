"""The inside of a stage's process: limits, the watch over the worker's beats, and the words it sends on its pipe.

Words are JSON lines: {"share": 0.5} any number of times, then one of {"result": ...}, {"failed": [lines]},
{"refused": [lines], "field": key}, {"crashed": words}; beside lines their "phrases". Everything printed goes to the
stage's log.
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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from phrases.phrase import Phrase, phrases_in
from service.errors import InputError, PictureError, ServiceError, SpecError, printable, sentence_of_os_error
from service.processes.linux import address_space_bytes, die_with_parent, name_process

Entry = Callable[[dict[str, Any], Callable[[float], None]], dict[str, Any]]

_PROGRESS_EVERY_S = 0.1
_TAKE_ME_FIRST = "500"
_HOPELESS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EROFS)  # trying again changes nothing


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


def find_entry(name: str) -> Entry:
    """Return the function `module:function` that does a stage's work."""
    module, _, function = name.partition(":")
    found: Entry = getattr(importlib.import_module(module), function)
    return found


def run_child(given: ChildOrder) -> NoReturn:
    """Live the whole life of the process after the fork; never return to the fork server's code."""
    code = 70
    try:
        _set_up_stage_process(given)
        words = MessagePipe(given.words)
        threading.Thread(target=_watch, args=(given.beats, given.silence_s), name="beats", daemon=True).start()
        words.send_last(_work(given, words))
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        _flush_output()
        os._exit(code)


def _set_up_stage_process(given: ChildOrder) -> None:
    os.setsid()  # a group of its own: one signal reaches everything that the stage starts
    signal.set_wakeup_fd(-1)
    for kind in (signal.SIGTERM, signal.SIGCHLD, signal.SIGINT, signal.SIGHUP):
        signal.signal(kind, signal.SIG_DFL)  # the plain end of a process needs no interpreter to be reached
    die_with_parent(given.parent)
    name_process("cm-stage")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(given.log, 1)
    os.dup2(given.log, 2)
    _close_all_but({given.order, given.words, given.beats})
    with contextlib.suppress(OSError):  # short of memory, the kernel shall take this process and not the server
        Path("/proc/self/oom_score_adj").write_text(_TAKE_ME_FIRST, encoding="ascii")
    _limit_memory(given.memory_mb)
    faulthandler.enable(2)  # the stage's log shows where a signal struck


def _close_all_but(kept: set[int]) -> None:
    """Close other children's pipes, which are open here, too: their ends would never be seen."""
    first = 3
    for number in (*sorted(kept), os.sysconf("SC_OPEN_MAX")):
        os.closerange(first, number)
        first = number + 1


def _limit_memory(memory_mb: int) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = address_space_bytes() + memory_mb * 1_000_000
    if hard != resource.RLIM_INFINITY:
        most = min(most, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _watch(beats: int, silence_s: float) -> None:
    """End the whole group when the worker, or the fork server between, is gone or stands still."""
    while True:
        ready, _, _ = select.select([beats], [], [], silence_s)
        if not ready or not os.read(beats, 65536):
            os.write(2, b"no beat from the worker: this process ends itself\n")
            os.killpg(0, signal.SIGKILL)


class MessagePipe:
    """The pipe to the worker. Progress is dropped while the pipe is full: nothing waits, nothing piles up."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self._lock = threading.Lock()
        self._told_at = 0.0
        os.set_blocking(pipe, False)

    def send_share(self, share: float) -> None:
        now = time.monotonic()
        with self._lock:
            if now - self._told_at < _PROGRESS_EVERY_S:
                return
            self._told_at = now
            try:
                os.write(self._pipe, _line({"share": float(share)}))  # shorter than PIPE_BUF: whole or not at all
            except BlockingIOError:
                return

    def send_last(self, word: dict[str, Any]) -> None:
        text = _line(word)
        with self._lock:
            os.set_blocking(self._pipe, True)
            while text:
                text = text[os.write(self._pipe, text) :]


def _line(word: dict[str, Any]) -> bytes:
    return json.dumps(word).encode() + b"\n"


def _work(given: ChildOrder, words: MessagePipe) -> dict[str, Any]:
    """Do the work; whatever becomes of it is one word."""
    try:
        with os.fdopen(given.order, "rb") as file:
            order = json.load(file)
        return {"result": find_entry(given.entry)(order, words.send_share)}
    except InputError as error:
        return {"refused": error.lines, "phrases": phrases_in(error.lines), "field": _field(error)}
    except ServiceError as error:
        return _tell_failure(*error.lines)
    except BaseException as error:  # SystemExit of a library, too: the process has its say before it ends
        traceback.print_exc()
        return _word_of(error, given.memory_mb)


def _word_of(error: BaseException, memory_mb: int) -> dict[str, Any]:
    no_thread = isinstance(error, RuntimeError) and "start new thread" in str(error)
    no_memory = isinstance(error, OSError) and error.errno == errno.ENOMEM
    if isinstance(error, MemoryError) or no_thread or no_memory:
        return _tell_failure(out_of_memory(memory_mb))
    if isinstance(error, OSError) and error.errno in _HOPELESS:
        return _tell_failure(sentence_of_os_error(error, doing=Phrase("cannot use")))
    return {"crashed": printable(f"{type(error).__name__}: {' '.join(str(error).split())[:300]}")}


def _tell_failure(*lines: str) -> dict[str, Any]:
    return {"failed": lines, "phrases": phrases_in(lines)}


def out_of_memory(memory_mb: int) -> Phrase:
    return Phrase(
        "out of memory: a stage may take {memory_mb} MB here (CAUSTICMILL_STAGE_MEMORY_MB); a smaller image.pixels "
        "needs less",
        memory_mb=memory_mb,
    )


def _field(error: InputError) -> str:
    match error:
        case PictureError():
            return "image"
        case SpecError() if error.problems:
            return f"spec.{error.problems[0][0]}"
    return ""


def _flush_output() -> None:
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            continue
