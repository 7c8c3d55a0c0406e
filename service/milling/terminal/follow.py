"""Watches a run from the terminal until it ends: keys, signals, the display. The mill is driven by its own thread.

Without a terminal a signal is an order to stop for good: hold, then abort from hold. On a terminal Ctrl-C holds and
asks. When this loop ends, for any reason, the mill stands, or the last line says plainly that it may still move.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from machines.clock import Timeout
from machines.driver import OVERRIDE_PERCENT, Override
from machines.errors import MachineError
from machines.mill.mill import Mill
from machines.mill.orders import Stop
from machines.mill.thread import MillThread
from machines.mill.view import MillSnapshot
from machines.preflight.preflight import Preflight
from machines.runs import RunState
from service.milling.terminal.confirm import give_order, stop_mill
from service.milling.terminal.keys import Keys, Question, Signals, Wish, keys_in
from service.milling.terminal.leaving import CLEAR_WAIT_S, Buffers
from service.milling.terminal.screen import Screen, StreamView

_LOOK_S = 0.25
_ABORT_WAIT_S = 20.0
_ASK_EVERY_S = 2.0
_REPORTED_S = 5.0
_STEP_PERCENT = 10
_NEWS = ("notice", "journal")


class Ended(Enum):
    FINISHED = "finished"
    ABORTED = "aborted"
    FAULT = "fault"
    LEFT = "left held"
    ABANDONED = "abandoned"  # the mill could not be brought to a standstill from here


_FINAL = {
    RunState.FINISHED: Ended.FINISHED,
    RunState.ABORTED: Ended.ABORTED,
    RunState.INTERRUPTED: Ended.FAULT,
}


@dataclass(frozen=True, slots=True)
class Outcome:
    ended: Ended
    snapshot: MillSnapshot
    cleared: bool  # the controller's buffers are certainly empty
    words: str = ""  # why this end was chosen here, if the mill gives no reason


class RunFollower:
    """One run, followed."""

    def __init__(
        self,
        thread: MillThread,
        buffers: Buffers,
        run_id: str,
        facts: Preflight,
        screen: Screen,
        *,
        keyboard: int | None,
    ) -> None:
        self._thread = thread
        self._buffers = buffers
        self._run_id = run_id
        self._facts = facts
        self._screen = screen
        self._keyboard = keyboard
        self._keys = Keys()
        self._aborting: Timeout | None = None  # until the mill reports standstill
        self._settling: Timeout | None = None  # until the controller reports empty buffers
        self._asked_s = time.monotonic()
        self._words = ""
        self._protected: tuple[str, ...] = ()
        self._last_printed = thread.snapshot.events[-1].number if thread.snapshot.events else 0
        self._feed_asked = (float("-inf"), 100)
        self._was: RunState | None = None

    def follow(self, signals: Signals) -> Outcome:
        while True:
            snapshot = self._thread.snapshot
            ended = self._find_end(snapshot)
            self._note_state(snapshot)
            self._print_news(snapshot)
            self._screen.show(self._make_view(snapshot))
            if ended is not None:
                return self._make_outcome(ended)
            self._end_if_nobody_can_resume(snapshot)
            sources = [signals.descriptor] if self._keyboard is None else [signals.descriptor, self._keyboard]
            ready, _, _ = select.select(sources, [], [], _LOOK_S)
            for number in signals.take() if signals.descriptor in ready else ():
                if (over := self._obey_signal(number)) is not None:
                    return self._make_outcome(over)
            if self._keyboard is not None and self._keyboard in ready and (over := self._obey_key()) is not None:
                return self._make_outcome(over)

    def _make_outcome(self, ended: Ended) -> Outcome:
        snapshot = self._thread.snapshot
        return Outcome(ended, snapshot, self._buffers.are_empty(snapshot), self._words)

    def _note_state(self, snapshot: MillSnapshot) -> None:
        before, self._was = self._was, snapshot.run.state if snapshot.run is not None else None
        if before is RunState.HELD and self._was in (RunState.RUNNING, RunState.RECOVERING):
            self._keys.note_running()

    def _print_news(self, snapshot: MillSnapshot) -> None:
        """Print above the panel, once each, the events that a person should not miss."""
        for entry in snapshot.events:
            if entry.number > self._last_printed and entry.kind in _NEWS:
                self._screen.say(f"{entry.kind}: {entry.words}")
            self._last_printed = max(self._last_printed, entry.number)

    def _is_driven(self) -> bool:
        """Return whether the mill's thread answers."""
        now = time.monotonic()
        if now < self._asked_s + _ASK_EVERY_S:
            return True
        self._asked_s = now
        try:
            self._thread.call(lambda _: None)
        except MachineError as error:
            self._screen.say(str(error))
            return False
        return True

    def _end_if_nobody_can_resume(self, snapshot: MillSnapshot) -> None:
        """Abort a run from hold, with the reason, if it is held because its journal cannot be written and no one is at
        the keyboard.
        """
        run = snapshot.run
        if self._keyboard is not None or self._aborting is not None or run is None or run.state is not RunState.HELD:
            return
        failures = [entry.words for entry in snapshot.events if entry.kind == "journal"]
        if failures:
            self._words = failures[-1]
            self._carry_out(Wish.ABORT)

    def _find_end(self, snapshot: MillSnapshot) -> Ended | None:
        run = snapshot.run
        if not self._is_driven():
            return Ended.ABANDONED
        if run is not None and run.id == self._run_id and run.state in _FINAL:
            return _FINAL[run.state] if self._is_settled(snapshot) else None
        if self._aborting is not None and self._aborting.is_over:
            return Ended.ABANDONED
        return None

    def _is_settled(self, snapshot: MillSnapshot) -> bool:
        """Return whether the controller's buffers are empty, or waiting for that is useless or has taken too long."""
        self._settling = self._settling or Timeout(CLEAR_WAIT_S)
        if self._buffers.are_empty(snapshot) or not self._buffers.will_be_empty(snapshot):
            return True
        return self._settling.is_over

    def _obey_signal(self, number: int) -> Ended | None:
        if self._keyboard is not None and number == signal.SIGINT:
            wish = self._keys.interrupt()
            return None if wish is None else self._carry_out(wish)
        if number == signal.SIGHUP:
            self._keyboard = None  # the terminal is gone
        if self._aborting is None:
            self._screen.say(f"{signal.Signals(number).name}: feed hold, then abort")
            return self._carry_out(Wish.ABORT)
        return None

    def _obey_key(self) -> Ended | None:
        assert self._keyboard is not None
        try:
            data = os.read(self._keyboard, 256)
        except OSError:
            data = b""
        if not data:  # the terminal is gone: no one watches the mill any more
            self._keyboard = None
            return self._carry_out(Wish.ABORT)
        for key in keys_in(data):
            if (wish := self._keys.key(key)) is not None and (over := self._carry_out(wish)) is not None:
                return over
        return None

    def _carry_out(self, wish: Wish) -> Ended | None:
        match wish:
            case Wish.HOLD:
                stop_mill(self._thread, Stop.HOLD)
            case Wish.RESUME:
                self._give_order("resume", Mill.resume)
            case Wish.FASTER:
                self._step_feed(_STEP_PERCENT)
            case Wish.SLOWER:
                self._step_feed(-_STEP_PERCENT)
            case Wish.ABORT:
                self._keys.question = Question.ABORTING
                self._aborting = Timeout(_ABORT_WAIT_S)
                stop_mill(self._thread, Stop.ABORT)
            case Wish.LEAVE:
                return self._leave()
            case Wish.GIVE_UP:
                return Ended.ABANDONED
        return None

    def _leave(self) -> Ended | None:
        """Leave the mill in its hold; refuse while it still moves."""
        run = self._thread.snapshot.run
        if run is None or run.state is not RunState.HELD:
            self._screen.say("the mill does not stand yet; press l again when it does")
            return None
        return Ended.LEFT

    def _step_feed(self, change: int) -> None:
        """Step the feed override; keys may come faster than the mill reports the effect of the last one."""
        now, asked = time.monotonic(), self._feed_asked
        base = asked[1] if now < asked[0] + _REPORTED_S else self._thread.snapshot.status.overrides[0]
        low, high = OVERRIDE_PERCENT
        percent = min(high, max(low, base + change))
        self._feed_asked = (now, percent)
        self._give_order("override", lambda mill: mill.command(Override("feed", percent)))

    def _give_order(self, doing: str, order: Callable[[Mill], object]) -> None:
        try:
            give_order(self._thread, doing, order)
        except MachineError as error:
            self._screen.say(f"not done: {error}")

    def _protections(self, snapshot: MillSnapshot) -> tuple[str, ...]:
        """Return the protections of this run; the last known ones while the link is away."""
        self._protected = snapshot.protections or self._protected
        return self._protected

    def _make_view(self, snapshot: MillSnapshot) -> StreamView:
        status, progress, run = snapshot.status, snapshot.progress, snapshot.run
        capacity = "?" if status.buffer_bytes is None else str(status.buffer_bytes)
        over = run is not None and run.state in _FINAL
        spindle = "" if status.spindle_rpm is None else f"{status.spindle_rpm:.0f} rpm"
        return StreamView(
            state=status.state.value,
            detail=status.detail,
            run_state=run.state.value if run is not None else "",
            line=progress.sent_line,
            executed_line=run.executed_line if run is not None else 0,
            total_lines=self._facts.lines,
            time_left_s=run.time_left_s if run is not None else None,
            position_mm=status.work_mm,
            buffer=f"{progress.bytes_in_flight} of {capacity} bytes, {progress.lines_in_flight} lines",
            feed_mm_per_min=status.feed_mm_per_min,
            spindle=spindle,
            overrides=status.overrides,
            protections=self._protections(snapshot),
            question=self._keys.prompt if self._keyboard is not None and not over else "",
        )


def make_immediate_hold(thread: MillThread) -> Callable[[], None]:
    """Return the function that a signal calls before anything else: the hold."""
    return lambda: stop_mill(thread, Stop.HOLD)


def find_keyboard() -> int | None:
    """Return the terminal's descriptor; None unless both input and output are a terminal."""
    return sys.stdin.fileno() if sys.stdin.isatty() and sys.stdout.isatty() else None
