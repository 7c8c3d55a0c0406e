"""Clears the controller's buffers when this command ends, or warns that they may still hold lines.

The next cycle start at the machine, after the command has ended, cuts the lines that a controller still holds, even one
known to be damaged. They are certainly gone if the controller has sent its banner since they were sent, or has carried
out the last line of the program. Every other end prints a warning.
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
from service.milling.terminal.screen import describe_mill_left

CLEAR_WAIT_S = 20.0  # hold to standstill is 4 s on a slow mill, a reset after a limit switch 2 s more
_LOOK_S = 0.1
_SETTLE_S = 4.5
_ON_ITS_WAY = (MillState.HOLDING, MillState.HELD, MillState.ALARM, MillState.CONNECTING, MillState.DOOR, MillState.TOOL)

STILL_HELD = (
    "THE CONTROLLER MAY STILL HOLD LINES OF THE PROGRAM: do not press cycle start, it would cut them. "
    "Press the mill's own reset (or switch it off) before anything else"
)


class Buffers:
    """The lines of this command that the controller may still hold. Counts banners: `status.epoch`."""

    def __init__(self, thread: MillThread) -> None:
        self._thread = thread
        self._epoch = 0
        self.run_id = ""
        self._empty = True

    def fill(self, run_id: str = "") -> None:
        """Note that a run or a homing cycle, which moves the mill, is about to be sent."""
        self._epoch, self.run_id = self._thread.snapshot.status.epoch, run_id
        self._empty = False

    def mark_empty(self) -> None:
        """Note that all lines sent have been carried out."""
        self._empty = True

    def are_empty(self, snapshot: MillSnapshot | None = None) -> bool:
        """Return whether the buffers are certainly empty."""
        snapshot = snapshot or self._thread.snapshot
        run = snapshot.run
        finished = run is not None and run.id == self.run_id and run.state is RunState.FINISHED
        self._empty = self._empty or finished or snapshot.status.epoch > self._epoch
        return self._empty

    def will_be_empty(self, snapshot: MillSnapshot) -> bool:
        """Return whether the driver is still stopping the mill and will reset it at standstill."""
        return snapshot.status.state in _ON_ITS_WAY

    def clear(self) -> bool:
        """Stop the mill, reset it from standstill, wait for its banner; return whether it came."""
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
    """If the `with` block ends by any error or signal, stop and clear the mill, or warn loudly that it is not cleared.

    If anything was under way, print the state in which the mill is left and how to continue a run.
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
                _say_loudly(describe_mill_left(thread.snapshot.status))
                if buffers.run_id:
                    _say_loudly(f"to go on: {next_command}")
        raise


def is_partly_unknown(status: MillStatus) -> bool:
    """Return whether a connected mill has not reported all of its state yet: GRBL reports its spindle only at
    intervals.
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
    """Ignore signals in the `with` block: a second Ctrl-C must not interrupt making the mill safe. Main thread only."""
    before = ignore_signals_for_good()
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


def ignore_signals_for_good() -> dict[signal.Signals, Any]:
    """Ignore signals from here to the end of the command, including its last lines; return the previous handlers."""
    kinds = [
        kind
        for kind in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
        if signal.getsignal(kind) not in (signal.SIG_IGN, None)
    ]
    return {kind: signal.signal(kind, lambda *_: None) for kind in kinds}


def _say_loudly(words: str) -> None:
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"error: {printable(words)}", file=sys.stderr, flush=True)
