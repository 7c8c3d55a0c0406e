"""The MDX-40A on its own USB link: one block under way, the mill's byte counter says when the next may go.

The counter means *taken into the mill's buffer*, a few blocks before they are cut; progress of the cut is read from the
reported position. No USB command is confirmed to pause a running job, so on a hold nothing more is sent. The mill
finishes the few blocks it has and stands; the VIEW button pauses it at once, opening the cover stops it as an emergency
stop.
"""

from __future__ import annotations

from collections.abc import Iterator

from machines.driver import (
    OVERRIDE_PERCENT,
    Command,
    CommandDone,
    DriverFacts,
    Event,
    FaultCause,
    Faulted,
    MillState,
    MillStatus,
    Override,
    ProgramLine,
    Require,
    StatusChannel,
    StreamProgress,
    TrustPosition,
    allow_always,
)
from machines.errors import MachineError, NotAllowedError, PortError
from machines.roland.job_control import JobControl
from machines.roland.usb_device import PING_ERROR, Mdx40aDevice, check_command_set, to_work_mm
from phrases.phrase import Phrase

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


class RolandUsbDriver:
    """machines.driver.Driver for an open device; closed with it, or when the link is lost."""

    facts = FACTS
    protections = (
        "the USB link checks every transfer (CRC)",
        "the mill's byte counter must match the bytes of each block",
    )

    def __init__(self, device: Mdx40aDevice, *, dialect: str) -> None:
        self._dialect = dialect
        self._device: Mdx40aDevice | None = device
        self._channel = StatusChannel()
        self._job = JobControl(self._channel, dialect)
        self._report_at_s = 0.0

    @property
    def status(self) -> MillStatus:
        return self._channel.status

    @property
    def progress(self) -> StreamProgress:
        return self._channel.progress

    def connect(self) -> None:
        device = self._device
        if device is None:
            raise NotAllowedError(Phrase("the link was lost: connect to the mill again"))
        self._channel.enter(MillState.CONNECTING, Phrase("asking the mill for its state"))
        try:
            model = device.model()
        except PortError as error:
            self._lose(error)
            return
        self._channel.update(controller=model, epoch=self.status.epoch + 1)
        self._report_at_s = device.clock()
        self._job.note_change(self._report_at_s)

    def poll(self, timeout_s: float) -> tuple[Event, ...]:
        device = self._device
        if device is not None:
            try:
                self._poll(device, device.clock() + timeout_s)
            except PortError as error:
                self._lose(error)
        return self._channel.take_events()

    def _poll(self, device: Mdx40aDevice, deadline_s: float) -> None:
        """Read and feed until something has happened, the deadline has passed, or `wake` is called."""
        while True:
            now_s = device.clock()
            if now_s >= self._report_at_s:
                self._take_report(device, now_s)
            self._job.turn(device)
            now_s = device.clock()
            if self._channel.events or now_s >= deadline_s:
                return
            due_s = min(self._report_at_s, deadline_s, now_s + self._job.next_turn_s)
            device.wait(max(0.0, due_s - now_s))
            if device.clock() < due_s - 1e-6:
                return  # woken

    def wake(self) -> None:
        if self._device is not None:
            self._device.wake()

    def urge(self, stop: str) -> bool:
        return False  # no command over this link is known to pause a job

    def start(self, lines: Iterator[ProgramLine], require: Require = allow_always) -> None:
        device, state = self._device, self.status.state
        if device is None or state is not MillState.IDLE:
            raise NotAllowedError(
                Phrase("a program can start only when the mill is idle, it is {state}", state=state.words)
            )
        try:
            check_command_set(device, self._dialect)
            self._job.start(device, lines, require)
        except PortError as error:
            self._lose(error)
        self._hold_if_stopped(require)

    def hold(self) -> None:
        if self._device is not None:
            self._job.hold(self._device.clock())

    def resume(self, require: Require = allow_always) -> None:
        device = self._device
        if device is None or not self._job.is_held:
            raise NotAllowedError(
                Phrase("there is nothing to resume: the mill is {state}", state=self.status.state.words)
            )
        try:
            self._job.resume(device, require)
        except PortError as error:
            self._lose(error)
        self._hold_if_stopped(require)

    def _hold_if_stopped(self, require: Require) -> None:
        """Hold if a stop came while the first block was being written."""
        try:
            require()
        except MachineError:
            self.hold()

    def abort(self) -> None:
        device = self._device
        if device is None:
            raise NotAllowedError(Phrase("the link is lost: press VIEW or open the cover to stop the mill"))
        try:
            self._job.abort(device)
        except PortError as error:
            self._lose(error)

    def command(self, command: Command, require: Require = allow_always) -> None:
        device = self._device
        if device is None:
            raise NotAllowedError(Phrase("the mill is not connected"))
        match command:
            case TrustPosition():
                self._channel.update(position_trusted=True)
            case Override("feed" | "spindle" as what, percent):
                low, high = OVERRIDE_PERCENT
                if not low <= percent <= high:
                    raise NotAllowedError(
                        Phrase(
                            "{what} override {percent} %: allowed: {low}..{high}",
                            what=what,
                            percent=percent,
                            low=low,
                            high=high,
                        )
                    )
                feed, rapid, spindle = self.status.overrides
                require()
                if what == "feed":
                    device.set_feed_override(percent)
                    feed = percent
                else:
                    device.set_spindle_override(percent)
                    spindle = percent
                self._channel.update(overrides=(feed, rapid, spindle))
            case _:
                raise NotAllowedError(
                    Phrase(
                        "{command} is not offered on this link: use the mill's own panel",
                        command=type(command).__name__,
                    )
                )
        self._channel.events.append(CommandDone(command))

    def close(self) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        try:
            if self._job.feed is not None:
                device.end_job()
        except PortError:
            pass  # it is gone already: nothing can be sent to it
        finally:
            self._job.feed = None
            device.close()

    def _take_report(self, device: Mdx40aDevice, now_s: float) -> None:
        self._report_at_s = now_s + _REPORT_S
        job, before = self._job, self.status
        ping, state = device.ping(), device.read_state()
        if state.moves or state.machine_mm != before.machine_mm:
            job.note_change(now_s)
        origin_mm = job.feed.origin_mm if job.feed is not None else before.work_offset_mm
        work_mm = to_work_mm(state.machine_mm, origin_mm)
        trusted = before.position_trusted or state.phase in ("idle", "moving")  # it homes by itself at power-up
        self._channel.update(
            machine_mm=state.machine_mm,
            work_mm=work_mm,
            work_offset_mm=origin_mm,
            spindle_rpm=float(state.spindle_rpm),
            spindle_on=state.spindle_on,
            position_trusted=trusted and not state.error,
        )
        if work_mm is not None and job.feed is not None:
            job.feed.follower.take_position(work_mm)
        job.follow(device, state, now_s, failed=bool(ping & PING_ERROR) or state.error)

    def _lose(self, error: PortError) -> None:
        device, self._device = self._device, None
        now_s = device.clock() if device is not None else 0.0
        line = self.progress.sent_line
        self._job.drop()
        if device is not None:
            device.close()  # release the interface, so that the mill can be opened again
        self._channel.update(position_trusted=False)
        self._channel.enter(MillState.DISCONNECTED, error.words)
        words = Phrase("{error}; the mill finishes the few blocks it holds, the spindle may stay on", error=error.words)
        self._channel.events.append(Faulted(FaultCause.PORT_LOST, words, line, now_s))
