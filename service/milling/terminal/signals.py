"""Ctrl-C and its kin while a mill moves: the hold goes out at once, whatever the main thread is doing.

Python runs signal handlers between bytecodes of the main thread, which may be stuck writing to a full pipe. So the
handlers do nothing; the interpreter writes each signal's number into a pipe (`set_wakeup_fd`) that a thread reads. It
calls `at_once` and passes the number on to the main thread through a second pipe, for its `select`.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

WATCHED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_END = 0


@dataclass(frozen=True, slots=True)
class Signals:
    """`descriptor` becomes readable when a signal has come; `take` returns the numbers and empties it."""

    descriptor: int

    def take(self) -> list[int]:
        try:
            return list(os.read(self.descriptor, 64))
        except BlockingIOError:
            return []


@contextlib.contextmanager
def watch_signals(at_once: Callable[[], None]) -> Iterator[Signals]:
    """Take the signals over; the handlers from before are put back at the end. Main thread only.

    One that is ignored stays so: a run under `nohup` outlives its terminal.
    """
    kinds = [kind for kind in WATCHED if signal.getsignal(kind) is not signal.SIG_IGN]
    raw_in, raw_out = os.pipe()
    main_in, main_out = os.pipe()
    for descriptor in (raw_out, main_in, main_out):
        os.set_blocking(descriptor, False)

    def watch() -> None:
        while (number := os.read(raw_in, 1)[0]) != _END:
            if number in WATCHED:
                at_once()
                os.write(main_out, bytes([number]))

    watcher = threading.Thread(target=watch, name="signals", daemon=True)
    watcher.start()
    before = {kind: signal.signal(kind, lambda *_: None) for kind in kinds}
    wakeup = signal.set_wakeup_fd(raw_out, warn_on_full_buffer=False)
    try:
        yield Signals(main_in)
    finally:
        signal.set_wakeup_fd(wakeup)
        for kind, handler in before.items():
            signal.signal(kind, handler)
        os.write(raw_out, bytes([_END]))
        watcher.join(timeout=2.0)
        if not watcher.is_alive():
            for descriptor in (raw_in, raw_out, main_in, main_out):
                os.close(descriptor)
