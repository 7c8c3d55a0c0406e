"""The inside of a stage's process, which the fork server forks: its limits, and the watch over the worker's beats.

It answers one request on a pipe of its own, in the words of every child (`processes/child_work`). Everything printed
goes to the stage's log.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import json
import os
import select
import signal
import sys
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from phrases.phrase import Phrase
from service.processes.child_work import WordPipe, Work, limit_memory, word_of
from service.processes.linux import address_space_bytes, die_with_parent, name_process

_TAKE_ME_FIRST = "500"


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
    """Live the whole life of the process after the fork; never return to the fork server's code."""
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
        signal.signal(kind, signal.SIG_DFL)  # the plain end of a process needs no interpreter to be reached
    die_with_parent(given.parent)
    name_process("cm-stage")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(given.log, 1)
    os.dup2(given.log, 2)
    _close_all_but({given.order, given.words, given.beats})
    with contextlib.suppress(OSError):  # short of memory, the kernel shall take this process and not the server
        Path("/proc/self/oom_score_adj").write_text(_TAKE_ME_FIRST, encoding="ascii")
    limit_memory(address_space_bytes() + given.memory_mb * 1_000_000, for_good=True)
    faulthandler.enable(2)  # the stage's log shows where a signal struck


def _close_all_but(kept: set[int]) -> None:
    """Close other children's pipes, which are open here, too: their ends would never be seen."""
    first = 3
    for number in (*sorted(kept), os.sysconf("SC_OPEN_MAX")):
        os.closerange(first, number)
        first = number + 1


def _watch(beats: int, silence_s: float) -> None:
    """End the whole group when the worker, or the fork server between, is gone or stands still."""
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
