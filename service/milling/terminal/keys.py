"""The meaning of keys and Ctrl-C while a program runs, the terminal mode for single keys, and the delivery of signals.

`Keys` is pure: it knows the open question and turns each key into one `Wish`. Nothing here talks to the mill.

Ctrl-C and similar signals send the hold at once, whatever the main thread is doing. Python runs signal handlers between
bytecodes of the main thread, which may be stuck writing to a full pipe. So the handlers do nothing; the interpreter
writes each signal's number into a pipe (`set_wakeup_fd`) that a thread reads. It calls `at_once` and passes the number
on to the main thread through a second pipe, for its `select`.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum

_ESCAPE = re.compile(r"\x1b(\[[0-9;?]*[ -/]*[@-~]|O.|.)?", re.DOTALL)
WATCHED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
APART_S = 2.0  # a key held down repeats every 33 ms, a shaking hand a few times a second: all of that is one press
_END = 0


class Wish(Enum):
    """The wish of the person at the terminal."""

    HOLD = "hold"
    RESUME = "resume"
    ABORT = "abort"
    FASTER = "faster"
    SLOWER = "slower"
    LEAVE = "leave held"
    GIVE_UP = "give up"  # a further Ctrl-C while the abort is under way


class Question(Enum):
    """The question that the keys answer at the moment; the text is shown on the screen, one row of at most 76
    characters.
    """

    NONE = "h hold   r resume   a abort   + - feed   q or Ctrl-C: hold, then ask"
    STOP = "Hold: r resume   a abort   l leave it held and quit"
    ABORT = "Abort the run? It can be recovered later.  y yes   n no"
    ABORTING = "Aborting: hold, then reset once it stands."


_INTERRUPTS = {Question.STOP: "   Ctrl-C again: abort", Question.ABORTING: " Ctrl-C: quit without waiting"}


class Keys:
    """The state of the dialogue during a run.

    A Ctrl-C holds at any time. It answers a question only if none has come for APART_S.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.question = Question.NONE
        self._clock = clock
        self._interrupted_s = float("-inf")

    @property
    def prompt(self) -> str:
        """The meanings of the keys now; Ctrl-C is named only if it would count."""
        counts = self._clock() >= self._interrupted_s + APART_S
        return self.question.value + (_INTERRUPTS.get(self.question, "") if counts else "")

    def key(self, key: str) -> Wish | None:
        """Interpret one key; None if it means nothing now."""
        match self.question, key.lower():
            case Question.NONE, "h" | " " | "!":
                return Wish.HOLD
            case Question.NONE, "r" | "~":
                return Wish.RESUME
            case Question.NONE, "+" | "=":
                return Wish.FASTER
            case Question.NONE, "-":
                return Wish.SLOWER
            case Question.NONE, "a":
                self.question = Question.ABORT
            case Question.NONE, "q":
                self.question = Question.STOP
                return Wish.HOLD
            case Question.STOP, "r" | "~":
                self.question = Question.NONE
                return Wish.RESUME
            case Question.STOP, "l":
                return Wish.LEAVE
            case (Question.STOP, "a") | (Question.ABORT, "y"):
                self.question = Question.ABORTING
                return Wish.ABORT
            case Question.ABORT, "h" | " " | "!":  # a hold counts even while a question is open
                self.question = Question.STOP
                return Wish.HOLD
            case Question.ABORT, _:
                self.question = Question.NONE
        return None

    def interrupt(self) -> Wish | None:
        """Interpret Ctrl-C: hold and ask; again, after a pause: abort; again, after a pause: give up waiting."""
        now_s = self._clock()
        same_press = now_s < self._interrupted_s + APART_S
        self._interrupted_s = now_s
        match self.question:
            case Question.STOP | Question.ABORTING if same_press:
                return None
            case Question.STOP:
                self.question = Question.ABORTING
                return Wish.ABORT
            case Question.ABORTING:
                return Wish.GIVE_UP
        self.question = Question.STOP
        return Wish.HOLD

    def note_running(self) -> None:
        """Note that the mill runs again without a key: questions about a held mill are void."""
        if self.question is Question.STOP:
            self.question = Question.NONE


def keys_in(data: bytes) -> str:
    """Return the plain keys in the terminal's input, without arrows and function keys."""
    return _ESCAPE.sub("", data.decode("ascii", errors="ignore"))


@contextlib.contextmanager
def single_keys(descriptor: int | None = None) -> Iterator[None]:
    """Read keys at once and unechoed. Ctrl-C stays a signal; Ctrl-Z, Ctrl-\\ and Ctrl-S do nothing.

    If this program were suspended or frozen, the mill would run dry in the middle of a cut, with the spindle on.
    """
    descriptor = sys.stdin.fileno() if descriptor is None else descriptor
    before = termios.tcgetattr(descriptor)
    now = termios.tcgetattr(descriptor)
    now[0] &= ~(termios.IXON | termios.IXOFF)
    now[3] &= ~(termios.ICANON | termios.ECHO)
    for key in (termios.VSUSP, termios.VQUIT):
        now[6][key] = b"\0"
    now[6][termios.VMIN], now[6][termios.VTIME] = 1, 0
    termios.tcsetattr(descriptor, termios.TCSADRAIN, now)
    try:
        yield
    finally:
        with contextlib.suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


@dataclass(frozen=True, slots=True)
class Signals:
    """`descriptor` becomes readable when a signal has come; `take` returns the numbers and empties it."""

    descriptor: int

    def take(self) -> list[int]:
        try:
            return list(os.read(self.descriptor, 64))
        except BlockingIOError:
            return []


def list_heard_signals() -> list[signal.Signals]:
    """Return the signals that stop a run: a shell ignores SIGINT for a job in the background, nohup SIGHUP."""
    return [kind for kind in WATCHED if signal.getsignal(kind) is not signal.SIG_IGN]


@contextlib.contextmanager
def watch_signals(at_once: Callable[[], None]) -> Iterator[Signals]:
    """Take over the signals, and restore the previous handlers at the end. Main thread only.

    An ignored signal stays ignored: a run under `nohup` outlives its terminal.
    """
    kinds = list_heard_signals()
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
