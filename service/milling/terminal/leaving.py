"""Whether the controller may still hold lines when this command ends, and what is done so that it does not.

Lines that a controller holds are cut by the next cycle start at the machine, after the command has gone: a line known
to be damaged, too. They are certainly gone when the controller has said its banner since they were sent, or has
carried out the last line of the program. No other end is silent.
"""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

from machines.clock import Timeout
from machines.driver import MillState, MillStatus
from machines.mill.orders import Stop
from machines.mill.thread import MillThread
from machines.mill.view import MillSnapshot
from machines.runs import RunState
from service.errors import printable
from service.milling.terminal.confirm import stop_mill
from service.milling.terminal.screen import left_words

CLEAR_WAIT_S = 20.0  # hold to standstill is 4 s on a slow mill, a reset after a limit switch 2 s more
_LOOK_S = 0.1
_SETTLE_S = 4.5
_ON_ITS_WAY = (MillState.HOLDING, MillState.HELD, MillState.ALARM, MillState.CONNECTING, MillState.DOOR, MillState.TOOL)

STILL_HELD = (
    "THE CONTROLLER MAY STILL HOLD LINES OF THE PROGRAM: do not press cycle start, it would cut them. "
    "Press the mill's own reset (or switch it off) before anything else"
)


class Buffers:
    """What the controller may hold of what this command has sent. Counts banners: `status.epoch`."""

    def __init__(self, thread: MillThread) -> None:
        self._thread = thread
        self._epoch = 0
        self.run_id = ""
        self._empty = True

    def fill(self, run_id: str = "") -> None:
        """Note that something is about to be sent that moves the mill: a run, or a homing cycle."""
        self._epoch, self.run_id = self._thread.snapshot.status.epoch, run_id
        self._empty = False

    def mark_empty(self) -> None:
        """Note that what was sent has been carried out."""
        self._empty = True

    def are_empty(self, snapshot: MillSnapshot | None = None) -> bool:
        """Return whether it is certain that nothing is held any more."""
        snapshot = snapshot or self._thread.snapshot
        run = snapshot.run
        finished = run is not None and run.id == self.run_id and run.state is RunState.FINISHED
        self._empty = self._empty or finished or snapshot.status.epoch > self._epoch
        return self._empty

    def will_be_empty(self, snapshot: MillSnapshot) -> bool:
        """Return whether the driver is still stopping the mill, and resets it when it stands."""
        return snapshot.status.state in _ON_ITS_WAY

    def clear(self) -> bool:
        """Stop the mill, reset it from standstill, wait for its banner; whether that came."""
        if self.are_empty():
            return True
        stop_mill(self._thread, Stop.ABORT)
        timeout = Timeout(CLEAR_WAIT_S)
        while not self.are_empty() and not timeout.is_over:
            snapshot = self._thread.snapshot
            if snapshot.status.state is MillState.DISCONNECTED:
                return False
            self._thread.wait_for_change(snapshot.version, _LOOK_S)
        return self.are_empty()


@contextlib.contextmanager
def clear_at_the_end(thread: MillThread, next_command: str) -> Iterator[Buffers]:
    """Stop and clear the mill however the block ends by an error, ours or a signal's, or say loudly that it is not.

    Where anything was under way, say in which state the mill is left and how a run goes on.
    """
    buffers = Buffers(thread)
    try:
        yield buffers
    except BaseException:
        with ignore_signals():
            under_way = not buffers.are_empty()
            if not buffers.clear():
                _say_loudly(STILL_HELD)
            if under_way:
                await_status(thread, lambda status: buffers.are_empty() and is_partly_unknown(status))
                _say_loudly(left_words(thread.snapshot.status))
                if buffers.run_id:
                    _say_loudly(f"to go on: {next_command}")
        raise


def is_partly_unknown(status: MillStatus) -> bool:
    """Return whether a mill that is linked has not reported all of its state: GRBL reports its spindle only now and
    then.
    """
    if status.state is MillState.DISCONNECTED:
        return False
    return status.state is MillState.CONNECTING or status.work_mm is None or status.spindle_on is None


def await_status(thread: MillThread, is_open: Callable[[MillStatus], bool]) -> MillSnapshot:
    """Wait for a short time while `is_open` expects more reports; return the last snapshot."""
    timeout = Timeout(_SETTLE_S)
    snapshot = thread.snapshot
    while is_open(snapshot.status) and not timeout.is_over:
        snapshot = thread.wait_for_change(snapshot.version, 2 * _LOOK_S)
    return snapshot


@contextlib.contextmanager
def ignore_signals() -> Iterator[None]:
    """Ignore signals inside: a second Ctrl-C must not end what makes the mill safe. Main thread only."""
    before = ignore_signals_for_good()
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


def ignore_signals_for_good() -> dict[signal.Signals, Any]:
    """Ignore signals from here to the end of the command, its last words included; return the handlers from before."""
    kinds = [
        kind
        for kind in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
        if signal.getsignal(kind) not in (signal.SIG_IGN, None)
    ]
    return {kind: signal.signal(kind, lambda *_: None) for kind in kinds}


def _say_loudly(words: str) -> None:
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"error: {printable(words)}", file=sys.stderr, flush=True)
