"""The MDX-40A on its own USB link: one block under way, the mill's byte counter says when the next may go.

The counter says *taken into the mill's buffer*, a few blocks before they are cut; what is cut comes from the reported
position. Nothing over USB is confirmed to pause a running job, so hold means: feed no more. The mill finishes the few
blocks it has and stands; the VIEW button pauses it at once, opening the cover stops it as an emergency stop.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from machines.driver import (
    Command,
    CommandDone,
    DriverFacts,
    Event,
    FaultCause,
    Faulted,
    MillState,
    MillStatus,
    Notice,
    Override,
    ProgramDone,
    ProgramLine,
    StateChanged,
    Stopped,
    StreamProgress,
    Triple,
    TrustPosition,
)
from machines.errors import NotAllowedError, PortError
from machines.roland.block_feed import BlockFeed, FeedFault
from machines.roland.mdx40a import COMMAND_SETS, PING_ERROR, DeviceState, Mdx40aDevice

FACTS = DriverFacts(
    kind="Roland MDX-40A, USB",
    capacity="one block under way; the mill's byte counter tells when it has been taken",
    acknowledgement="counter = taken into the mill's buffer, a few blocks before they are cut",
    stop="feeding stops and the mill finishes the few blocks it holds; VIEW button pauses, cover = emergency stop; "
    "abort also sends the motion stop of jogging, whose effect on a job is not confirmed",
    position="state block, 1/1000 mm, 5 per second",
    tried_on="only a simulated MDX-40A, through the rollingmill library's own classes; never a real one",
)
_REPORT_S = 0.2
_STILL_S = 0.6  # three reports without motion
_STALL_S = 60.0  # neither counter nor position moves, nobody paused it
_USER_SLOT, _EXOFS_SLOT, _G54_SLOT = 1, 2, 3
_PAUSED = "the mill waits (VIEW lamp): hold its VIEW button for 3 s to go on"
_DRAINS = (
    "no more blocks are fed; the mill finishes the few it holds. At once: VIEW button (pause) or cover (emergency)"
)


class RolandUsbDriver:
    """machines.driver.Driver for an open device; closed with it, or when the link is lost."""

    def __init__(self, device: Mdx40aDevice, *, dialect: str = "roland-nc") -> None:
        self._dialect = dialect
        self._device: Mdx40aDevice | None = device
        self._status = MillStatus()
        self._progress = StreamProgress()
        self._events: list[Event] = []
        self._feed: BlockFeed | None = None  # from start until the mill has executed or dropped it
        self._held = self._aborting = False
        self._report_at_s = self._still_since_s = self._changed_s = 0.0

    @property
    def facts(self) -> DriverFacts:
        return FACTS

    @property
    def status(self) -> MillStatus:
        return self._status

    @property
    def progress(self) -> StreamProgress:
        return self._progress

    @property
    def protections(self) -> tuple[str, ...]:
        return (
            "the USB link checks every transfer (CRC)",
            "the mill's byte counter must match the bytes of each block",
        )

    def connect(self) -> None:
        device = self._device
        if device is None:
            raise NotAllowedError("the link was lost: open the mill anew")
        self._set(MillState.CONNECTING, "asking the mill for its state")
        try:
            model = device.model()
        except PortError as error:
            self._lost(error)
            return
        now_s = device.clock()
        self._status = replace(self._status, controller=model, epoch=self._status.epoch + 1)
        self._report_at_s = self._still_since_s = self._changed_s = now_s

    def poll(self, timeout_s: float) -> tuple[Event, ...]:
        device = self._device
        if device is not None:
            deadline_s = device.clock() + timeout_s
            try:
                while True:
                    now_s = device.clock()
                    if now_s >= self._report_at_s:
                        self._take_report(device, now_s)
                    self._turn(device)
                    now_s = device.clock()
                    if self._events or now_s >= deadline_s:
                        break
                    feed = self._feed
                    asks = feed is not None and feed.block is not None
                    due_s = min(self._report_at_s, deadline_s, now_s + feed.wait_s if feed and asks else deadline_s)
                    device.wait(max(0.0, due_s - now_s))
                    if device.clock() < due_s - 1e-6:
                        break  # woken
            except PortError as error:
                self._lost(error)
        events, self._events = tuple(self._events), []
        return events

    def wake(self) -> None:
        if self._device is not None:
            self._device.wake()

    def urge(self, stop: str) -> bool:
        return False  # nothing over this link is known to pause a job

    def start(self, lines: Iterator[ProgramLine]) -> None:
        device = self._device
        if device is None or self._status.state is not MillState.IDLE:
            raise NotAllowedError(f"a program can start only when the mill is idle, it is {self._status.state.value}")
        try:
            self._check_command_set(device)
            origin_mm = self._work_origin_mm(device)
            here_mm = _minus(device.read_state().machine_mm, origin_mm)
            self._feed = BlockFeed(device, lines, dialect=self._dialect, origin_mm=origin_mm, here_mm=here_mm)
            device.begin_job()
        except PortError as error:
            self._lost(error)
            return
        self._held = self._aborting = False
        self._changed_s = self._still_since_s = device.clock()
        if origin_mm is None:
            self._events.append(Notice("the work origin cannot be read: lines count as executed only at the end"))
        self._count()
        self._set(MillState.RUN, "")

    def hold(self) -> None:
        if self._feed is None or self._held:
            return
        self._held = True
        self._events.append(Notice(_DRAINS))
        self._set(MillState.HOLDING, _DRAINS)
        if self._device is not None:
            self._still_since_s = self._device.clock()

    def resume(self) -> None:
        if self._feed is None or not self._held or self._aborting:
            raise NotAllowedError(f"there is nothing to resume: the mill is {self._status.state.value}")
        self._held = False
        if self._device is not None:
            self._changed_s = self._device.clock()
        self._set(MillState.RUN, "")

    def abort(self) -> None:
        device = self._device
        if device is None:
            raise NotAllowedError("the link is lost: press VIEW or open the cover to stop the mill")
        self._held = self._aborting = True
        self._progress = replace(self._progress, streaming=False)
        try:
            device.stop_motion()
        except PortError as error:
            self._lost(error)
            return
        self._still_since_s = device.clock()
        self._set(MillState.HOLDING, "stopping")

    def command(self, command: Command) -> None:
        device = self._device
        if device is None:
            raise NotAllowedError("the mill is not connected")
        match command:
            case TrustPosition():
                self._status = replace(self._status, position_trusted=True)
            case Override("feed" | "spindle" as what, percent):
                if not 10 <= percent <= 200:
                    raise NotAllowedError(f"{what} override {percent} %: allowed: 10..200")
                feed, rapid, spindle = self._status.overrides
                if what == "feed":
                    device.set_feed_override(percent)
                    feed = percent
                else:
                    device.set_spindle_override(percent)
                    spindle = percent
                self._status = replace(self._status, overrides=(feed, rapid, spindle))
            case _:
                raise NotAllowedError(f"{type(command).__name__} is not offered on this link: use the mill's own panel")
        self._events.append(CommandDone(command))

    def close(self) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        try:
            if self._feed is not None:
                device.end_job()
        except PortError:
            pass  # it is gone already: there is nothing left to tell it
        finally:
            self._feed = None
            device.close()

    # Reports.

    def _take_report(self, device: Mdx40aDevice, now_s: float) -> None:
        self._report_at_s = now_s + _REPORT_S
        ping, state = device.ping(), device.read_state()
        if state.moves or state.machine_mm != self._status.machine_mm:
            self._still_since_s = self._changed_s = now_s
        still = now_s - self._still_since_s >= _STILL_S
        feed = self._feed
        origin_mm = feed.origin_mm if feed is not None else self._status.work_offset_mm
        work_mm = _minus(state.machine_mm, origin_mm)
        trusted = self._status.position_trusted or state.phase in ("idle", "moving")  # it homes at power-up by itself
        self._status = replace(
            self._status,
            machine_mm=state.machine_mm,
            work_mm=work_mm,
            work_offset_mm=origin_mm,
            spindle_rpm=float(state.spindle_rpm),
            spindle_on=state.spindle_on,
            position_trusted=trusted and not state.error,
        )
        if work_mm is not None and feed is not None:
            feed.follower.at(work_mm)
        failed = bool(ping & PING_ERROR) or state.error
        if feed is not None and (failed or state.door_open):
            self._device_fault(device, state, failed, now_s)
        elif self._aborting:
            self._settle_abort(device, still)
        elif feed is not None:
            self._settle_job(device, feed, state, still, now_s)
        else:
            self._settle_idle(device, state, failed)
        self._count()

    def _settle_abort(self, device: Mdx40aDevice, still: bool) -> None:
        if still:
            self._end_job(device)
            self._events.append(Stopped(position_kept=True))
            self._set(MillState.IDLE, "")

    def _settle_job(self, device: Mdx40aDevice, feed: BlockFeed, state: DeviceState, still: bool, now_s: float) -> None:
        if state.view_lamp:
            self._changed_s = now_s
            self._set(MillState.HELD, _PAUSED)
        elif self._held:
            self._set(MillState.HELD if still else MillState.HOLDING, _DRAINS if not still else "held; feeding stopped")
        elif feed.ended and still and state.phase == "idle":
            feed.follower.stands_at_the_end()
            self._end_job(device)
            self._events.append(ProgramDone())
            self._set(MillState.IDLE, "")
        elif now_s - max(self._changed_s, feed.changed_s) > _STALL_S:
            words = f"neither the byte counter nor the position has moved for {_STALL_S:g} s"
            self._stop_by_fault(device, FaultCause.STALL, words, now_s)
        else:
            self._set(MillState.RUN, "")

    def _settle_idle(self, device: Mdx40aDevice, state: DeviceState, failed: bool) -> None:
        if failed:
            if self._status.state is not MillState.ALARM:
                self._set(MillState.ALARM, f"{device.error_words()}; switch the mill off and on to clear it")
        elif state.door_open:
            self._set(MillState.DOOR, "the cover is open")
        elif state.phase in ("homing", "starting"):
            self._set(MillState.HOMING, "the mill is starting up")
        else:
            self._set(MillState.RUN if state.moves else MillState.IDLE, "moved from its panel" if state.moves else "")

    def _device_fault(self, device: Mdx40aDevice, state: DeviceState, failed: bool, now_s: float) -> None:
        door = "the cover was opened: the mill has made an emergency stop" if state.door_open else ""
        words = door
        if failed:
            block = self._feed.block if self._feed else None
            said = f"the mill reports: {device.error_words()}"
            at = f"; it has not taken '{block.line.text[:40].decode('latin-1')}'" if block else ""
            words = "; ".join(part for part in (door, said + at) if part)
            words += (
                "; if it refuses every block, its command set (RML-1 or NC) is wrong; switch it off and on to clear"
            )
        self._stop_by_fault(device, FaultCause.DEVICE, words, now_s)
        self._status = replace(self._status, position_trusted=False)
        self._set(MillState.DOOR if state.door_open and not failed else MillState.ALARM, words)

    def _stop_by_fault(self, device: Mdx40aDevice, cause: FaultCause, words: str, now_s: float) -> None:
        """The stream ends; the mill is told to stop in the one way that is known."""
        feed = self._feed
        line = feed.block.line.number if feed and feed.block else self._progress.sent_line
        device.stop_motion()
        self._end_job(device)
        self._events.append(Faulted(cause, words, line, now_s))
        self._set(MillState.ALARM, words)

    def _end_job(self, device: Mdx40aDevice) -> None:
        if self._feed is not None:
            self._count()
            device.end_job()
        self._feed = None
        self._aborting = self._held = False
        self._progress = replace(self._progress, streaming=False, bytes_in_flight=0, lines_in_flight=0)

    def _turn(self, device: Mdx40aDevice) -> None:
        feed = self._feed
        if feed is None or self._aborting:
            return
        left_at, ended = feed.frame_left_at, feed.ended
        try:
            feed.turn(device, may_send=not self._held)
        except FeedFault as fault:
            self._stop_by_fault(device, fault.cause, str(fault), device.clock())
            return
        if feed.frame_left_at != left_at:
            words = f"line {feed.frame_left_at} changes the work frame: lines count as executed only at the end"
            self._events.append(Notice(words))
        if feed.ended and not ended:
            self._still_since_s = device.clock()  # what it still holds may not have begun to move
        self._count()

    def _count(self) -> None:
        feed = self._feed
        if feed is None:
            return
        self._progress = StreamProgress(
            sent_line=feed.sent_line,
            sent_offset=feed.sent_offset,
            answered_line=feed.answered_line,
            executed_line=feed.follower.executed_line,
            bytes_in_flight=len(feed.block.data) if feed.block else 0,
            lines_in_flight=1 if feed.block else 0,
            streaming=not self._aborting,
        )

    # Before a program.

    def _check_command_set(self, device: Mdx40aDevice) -> None:
        """The wrong set hangs the mill until it is switched off: ask before the first byte."""
        is_rml, found = self._dialect == "rml-1", device.command_set()
        if found is not None and found == (1 if is_rml else 0):
            wanted = "RML-1" if is_rml else "NC code"
            raise NotAllowedError(
                f"the mill's command set is {COMMAND_SETS[found]}, the program is {wanted}: "
                "set it to 'selected automatically' in the mill's setup"
            )

    def _work_origin_mm(self, device: Mdx40aDevice) -> Triple | None:
        if self._dialect == "rml-1":
            return device.origin_mm(_USER_SLOT)
        origin, extra = device.origin_mm(_G54_SLOT), device.origin_mm(_EXOFS_SLOT)
        if origin is None or extra is None:
            return None
        return (origin[0] + extra[0], origin[1] + extra[1], origin[2] + extra[2])

    def _lost(self, error: PortError) -> None:
        device, line = self._device, self._progress.sent_line
        now_s = device.clock() if device is not None else 0.0
        self._count()
        self._device = self._feed = None
        if device is not None:
            device.close()  # lets go of the interface, so that the mill can be opened anew
        self._held = self._aborting = False
        self._progress = replace(self._progress, streaming=False)
        self._status = replace(self._status, position_trusted=False)
        self._set(MillState.DISCONNECTED, str(error))
        words = f"{error}; the mill finishes the few blocks it holds, the spindle may stay on"
        self._events.append(Faulted(FaultCause.PORT_LOST, words, line, now_s))

    def _set(self, state: MillState, detail: str) -> None:
        if state is not self._status.state:
            self._events.append(StateChanged(self._status.state, state))
        self._status = replace(self._status, state=state, detail=detail)


def _minus(place_mm: Triple, origin_mm: Triple | None) -> Triple | None:
    if origin_mm is None:
        return None
    return (place_mm[0] - origin_mm[0], place_mm[1] - origin_mm[1], place_mm[2] - origin_mm[2])
