"""The job of an MDX-40A: one program within the job bracket, held, aborted and ended by the mill's reports."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import inf

from machines.driver import (
    FaultCause,
    Faulted,
    MillState,
    Notice,
    ProgramDone,
    ProgramLine,
    Require,
    StatusChannel,
    Stopped,
    StreamProgress,
    allow_always,
)
from machines.errors import MachineError, PortError
from machines.roland.block_feed import BlockFeed, FeedFault
from machines.roland.usb_device import DeviceState, Mdx40aDevice, read_work_origin_mm, to_work_mm
from phrases.phrase import NO_WORDS, Phrase, join

_STILL_S = 0.6  # three reports without motion
_STALL_S = 60.0  # neither counter nor position changes, and it is not paused
_PAUSED = Phrase("the mill waits (VIEW lamp): hold its VIEW button for 3 s to go on")
_DRAINS = Phrase(
    "no more blocks are fed; the mill finishes the few it holds. To stop it at once: VIEW button (pause) or cover "
    "(emergency)"
)


class JobControl:
    """Owns the program under way, the orders to it, and the time since which the mill stands.

    feed : from start until the mill has executed or dropped it
    """

    def __init__(self, channel: StatusChannel, dialect: str) -> None:
        self.feed: BlockFeed | None = None
        self._channel = channel
        self._dialect = dialect
        self._held = self._aborting = False
        self._still_since_s = self._changed_s = 0.0

    @property
    def next_turn_s(self) -> float:
        """Seconds until the byte counter should be read again."""
        return self.feed.wait_s if self.feed is not None and self.feed.block is not None else inf

    def note_change(self, now_s: float) -> None:
        """Note that the mill moves, or may begin to."""
        self._still_since_s = self._changed_s = now_s

    @property
    def is_held(self) -> bool:
        """Return whether a program waits for a resume."""
        return self.feed is not None and self._held and not self._aborting

    def start(self, device: Mdx40aDevice, lines: Iterator[ProgramLine], require: Require) -> None:
        """Send the first block of a program. Close the job again if `require` raises: then nothing was sent."""
        origin_mm = read_work_origin_mm(device, self._dialect)
        here_mm = to_work_mm(device.read_state().machine_mm, origin_mm)
        self.feed = BlockFeed(device, lines, dialect=self._dialect, origin_mm=origin_mm, here_mm=here_mm)
        device.begin_job()
        self._held = self._aborting = False
        self.note_change(device.clock())
        if origin_mm is None:
            words = Phrase("the work origin cannot be read: lines count as executed only at the end")
            self._channel.events.append(Notice(words))
        self._channel.enter(MillState.RUN, NO_WORDS)
        try:
            self.turn(device, require)
        except PortError:
            raise
        except MachineError:
            self._end(device)
            self._channel.enter(MillState.IDLE, NO_WORDS)
            raise

    def hold(self, now_s: float) -> None:
        if self.feed is None or self._held:
            return
        self._held = True
        self._channel.events.append(Notice(_DRAINS))
        self._channel.enter(MillState.HOLDING, _DRAINS)
        self._still_since_s = now_s

    def resume(self, device: Mdx40aDevice, require: Require) -> None:
        """Feed the held program again."""
        require()
        self._held = False
        try:
            self.turn(device, require)
        except PortError:
            raise
        except MachineError:
            self._held = True
            raise
        self._changed_s = device.clock()
        if self.feed is not None:
            self._channel.enter(MillState.RUN, NO_WORDS)

    def abort(self, device: Mdx40aDevice) -> None:
        self._held = self._aborting = True
        self._channel.end_stream()
        device.stop_motion()
        self._still_since_s = device.clock()
        self._channel.enter(MillState.HOLDING, Phrase("stopping"))

    def drop(self) -> None:
        """Drop the program: the link is lost."""
        self.count()
        self.feed = None
        self._held = self._aborting = False
        self._channel.end_stream()

    def turn(self, device: Mdx40aDevice, require: Require = allow_always) -> None:
        """Read the mill's byte count, and send the next block if the state and `require` allow it."""
        feed = self.feed
        if feed is None or self._aborting:
            return
        left_at, ended = feed.frame_left_at, feed.ended
        try:
            feed.turn(device, may_send=not self._held, require=require)
        except FeedFault as fault:
            self._stop_by_fault(device, fault.cause, fault.words, device.clock())
            return
        if feed.frame_left_at != left_at:
            words = Phrase(
                "line {line} changes the work frame: lines count as executed only at the end", line=feed.frame_left_at
            )
            self._channel.events.append(Notice(words))
        if feed.ended and not ended:
            self._still_since_s = device.clock()  # the blocks that it still holds may not have begun to move
        self.count()

    def follow(self, device: Mdx40aDevice, state: DeviceState, now_s: float, *, failed: bool) -> None:
        """Compare the job with a report, and end it if the report says so."""
        feed, still = self.feed, now_s - self._still_since_s >= _STILL_S
        if feed is not None and (failed or state.door_open):
            self._end_by_device_fault(device, feed, state, now_s, failed=failed)
        elif self._aborting:
            if still:
                self._end(device)
                self._channel.events.append(Stopped(position_kept=True))
                self._channel.enter(MillState.IDLE, NO_WORDS)
        elif feed is not None:
            self._settle(device, feed, state, now_s, still=still)
        else:
            self._show_idle(device, state, failed=failed)
        self.count()

    def _settle(self, device: Mdx40aDevice, feed: BlockFeed, state: DeviceState, now_s: float, *, still: bool) -> None:
        channel = self._channel
        if state.view_lamp:
            self._changed_s = now_s
            channel.enter(MillState.HELD, _PAUSED)
        elif self._held and still:
            channel.enter(MillState.HELD, Phrase("held; feeding stopped"))
        elif self._held:
            channel.enter(MillState.HOLDING, _DRAINS)
        elif feed.ended and still and state.phase == "idle":
            feed.follower.finish()
            self._end(device)
            channel.events.append(ProgramDone())
            channel.enter(MillState.IDLE, NO_WORDS)
        elif now_s - max(self._changed_s, feed.changed_s) > _STALL_S:
            words = Phrase("neither the byte counter nor the position has moved for {seconds:g} s", seconds=_STALL_S)
            self._stop_by_fault(device, FaultCause.STALL, words, now_s)
        else:
            channel.enter(MillState.RUN, NO_WORDS)

    def _show_idle(self, device: Mdx40aDevice, state: DeviceState, *, failed: bool) -> None:
        channel = self._channel
        if failed:
            if channel.status.state is not MillState.ALARM:
                channel.enter(
                    MillState.ALARM,
                    Phrase("{error}; switch the mill off and on to clear it", error=device.error_words()),
                )
        elif state.door_open:
            channel.enter(MillState.DOOR, Phrase("the cover is open"))
        elif state.phase in ("homing", "starting"):
            channel.enter(MillState.HOMING, Phrase("the mill is starting up"))
        elif state.moves:
            channel.enter(MillState.RUN, Phrase("moved from its panel"))
        else:
            channel.enter(MillState.IDLE, NO_WORDS)

    def _end_by_device_fault(
        self, device: Mdx40aDevice, feed: BlockFeed, state: DeviceState, now_s: float, *, failed: bool
    ) -> None:
        causes = [Phrase("the cover was opened: the mill has made an emergency stop")] if state.door_open else []
        if failed:
            report = Phrase("the mill reports: {error}", error=device.error_words())
            if feed.block:
                text = feed.block.line.text[:40].decode("latin-1")
                report = Phrase("{report}; it has not accepted '{text}'", report=report, text=text)
            command_set = Phrase(
                "if it refuses every block, its command set (RML-1 or NC) is wrong; switch it off and on to clear"
            )
            causes += [report, command_set]
        words = join("; ", causes)
        self._stop_by_fault(device, FaultCause.DEVICE, words, now_s)
        self._channel.update(position_trusted=False)
        if state.door_open and not failed:
            self._channel.enter(MillState.DOOR, words)

    def _stop_by_fault(self, device: Mdx40aDevice, cause: FaultCause, words: Phrase, now_s: float) -> None:
        """End the stream, and stop the mill in the only known way."""
        feed = self.feed
        line = feed.block.line.number if feed and feed.block else self._channel.progress.sent_line
        device.stop_motion()
        self._end(device)
        self._channel.events.append(Faulted(cause, words, line, now_s))
        self._channel.enter(MillState.ALARM, words)

    def _end(self, device: Mdx40aDevice) -> None:
        if self.feed is not None:
            self.count()
            device.end_job()
        self.feed = None
        self._aborting = self._held = False
        progress = self._channel.progress
        self._channel.progress = replace(progress, streaming=False, bytes_in_flight=0, lines_in_flight=0)

    def count(self) -> None:
        """Update the progress."""
        feed = self.feed
        if feed is None:
            return
        self._channel.progress = StreamProgress(
            sent_line=feed.sent_line,
            sent_offset=feed.sent_offset,
            answered_line=feed.answered_line,
            executed_line=feed.follower.executed_line,
            bytes_in_flight=len(feed.block.data) if feed.block else 0,
            lines_in_flight=1 if feed.block else 0,
            streaming=not self._aborting,
        )
