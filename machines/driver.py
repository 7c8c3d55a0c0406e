"""The common interface of all drivers: commands to a mill's controller, its reports, and facts about its link.

A driver is owned by one thread, which calls `poll` in a loop; every other call comes from the same thread. Time is
the driver's clock in seconds (injected), so that a simulated mill can run in simulated time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Protocol

from phrases.phrase import NO_WORDS, Phrase

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ProgramLine:
    """One block as it is sent: no comment, no blank, no line end.

    number : line of the program file, from 1; 0 for a block that is not of the program (re-entry)
    offset : byte offset of that line in the file
    """

    number: int
    offset: int
    text: bytes


class MillState(Enum):
    """The state of the machine, as far as the driver knows. All drivers use the same words."""

    DISCONNECTED = "disconnected"
    CONNECTING = "connecting"
    IDLE = "idle"
    RUN = "run"
    HOLDING = "holding"  # decelerating, or about to
    HELD = "held"  # stands still, position kept
    JOG = "jog"
    HOMING = "homing"
    DOOR = "door"
    CHECK = "check"
    ALARM = "alarm"  # locked until unlocked or homed
    SLEEP = "sleep"
    TOOL = "tool"  # waits for a tool change or a cycle start asked for by the program

    @property
    def words(self) -> Phrase:
        """The same in a sentence."""
        return _STATE_WORDS[self]


_STATE_WORDS = {
    MillState.DISCONNECTED: Phrase("disconnected"),
    MillState.CONNECTING: Phrase("connecting"),
    MillState.IDLE: Phrase("idle"),
    MillState.RUN: Phrase("run"),
    MillState.HOLDING: Phrase("holding"),
    MillState.HELD: Phrase("held"),
    MillState.JOG: Phrase("jog"),
    MillState.HOMING: Phrase("homing"),
    MillState.DOOR: Phrase("door"),
    MillState.CHECK: Phrase("check"),
    MillState.ALARM: Phrase("alarm"),
    MillState.SLEEP: Phrase("sleep"),
    MillState.TOOL: Phrase("tool"),
}


class FaultCause(Enum):
    """The first sign of a fault."""

    ERROR_REPLY = "error reply"
    ALARM = "alarm"
    RESET = "controller restarted"
    PORT_LOST = "port lost"
    REPLY_COUNT = "replies do not match lines"
    GARBLED_REPLY = "garbled reply"
    STALL = "no reply in time"
    OFF_PATH = "position off the programmed path"
    ECHO = "echo differs from what was sent"
    PROGRAM_CHANGED = "program changed on disk"
    DEVICE = "device reports a fault"

    @property
    def words(self) -> Phrase:
        """The same in a sentence."""
        return _CAUSE_WORDS[self]


_CAUSE_WORDS = {
    FaultCause.ERROR_REPLY: Phrase("error reply"),
    FaultCause.ALARM: Phrase("alarm"),
    FaultCause.RESET: Phrase("controller restarted"),
    FaultCause.PORT_LOST: Phrase("port lost"),
    FaultCause.REPLY_COUNT: Phrase("replies do not match lines"),
    FaultCause.GARBLED_REPLY: Phrase("garbled reply"),
    FaultCause.STALL: Phrase("no reply in time"),
    FaultCause.OFF_PATH: Phrase("position off the programmed path"),
    FaultCause.ECHO: Phrase("echo differs from what was sent"),
    FaultCause.PROGRAM_CHANGED: Phrase("program changed on disk"),
    FaultCause.DEVICE: Phrase("device reports a fault"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverFacts:
    """Facts about a kind of link, in words for the setup sheet and the operator.

    capacity        : the limit of the bytes under way, e.g. "counted bytes, at most 128 (RX size from $I)"
    acknowledgement : what an answer means, e.g. "ok = parsed and queued, up to 17 blocks before it is executed"
    stop            : what stops motion, e.g. "feed hold '!' at once; reset only from Hold"
    position        : where positions come from, e.g. "status report, 5 per second"
    tried_on        : the controllers with which this driver has been run
    """

    kind: str
    capacity: str
    acknowledgement: str
    stop: str
    position: str
    tried_on: str


@dataclass(frozen=True, slots=True, kw_only=True)
class MillStatus:
    """The latest status of the mill. Positions in mm; None if the link does not report them.

    position_trusted : machine coordinates are the same as at homing or zero-setting
    overrides        : feed, rapid, spindle in percent
    complete         : every field that the link reports only at intervals has come since it was opened
    """

    state: MillState = MillState.DISCONNECTED
    detail: Phrase = NO_WORDS  # in words: "Door: ajar", "ALARM:2 soft limit ..."
    code: str = ""  # the same for programs, of MillCode; "": the detail is all
    alarm: int = 0  # number of the alarm that it is locked by
    machine_mm: Triple | None = None
    work_mm: Triple | None = None
    work_offset_mm: Triple | None = None
    feed_mm_per_min: float | None = None
    spindle_rpm: float | None = None
    spindle_on: bool | None = None
    overrides: tuple[int, int, int] = (100, 100, 100)
    pins: str = ""
    position_trusted: bool = False
    complete: bool = True
    controller: str = ""  # version words of the controller, "Grbl 1.1h"
    buffer_bytes: int | None = None  # capacity for bytes under way
    epoch: int = 0  # counts controller restarts


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamProgress:
    """How far a program has come. Lines are numbers of the program file, 0 before the first.

    sent_line       : last line written to the link
    answered_line   : last line the controller has answered (taken into its buffers)
    executed_line   : every line up to this one has certainly been cut: the position proved it, or the buffers are too
    small to hold it any longer. Resuming at executed_line + 1 skips nothing
    """

    sent_line: int = 0
    sent_offset: int = 0
    answered_line: int = 0
    executed_line: int = 0
    bytes_in_flight: int = 0
    lines_in_flight: int = 0
    streaming: bool = False


# Events: what a poll can bring.
@dataclass(frozen=True, slots=True)
class StateChanged:
    before: MillState
    after: MillState


@dataclass(frozen=True, slots=True)
class Faulted:
    """The stream has stopped by itself; the driver has sent a hold wherever the mill can still hear it."""

    cause: FaultCause
    words: Phrase
    line: int = 0  # program line the sign belongs to, 0 if none
    at_s: float = 0.0
    alarm: int = 0  # its number, where it is one


@dataclass(frozen=True, slots=True)
class ProgramDone:
    """Every line was sent, answered and executed, and the mill stands still."""


@dataclass(frozen=True, slots=True)
class Stopped:
    """An abort is complete: the mill stands still and its buffers are empty."""

    position_kept: bool


@dataclass(frozen=True, slots=True)
class Restarted:
    """The controller started anew (banner): its buffers, modal state and G92 are gone.

    place_kept : machine coordinates mean what they meant before: it was our own reset of a mill that stood
    """

    banner: str
    place_kept: bool


@dataclass(frozen=True, slots=True)
class FrameChanged:
    """A setting that defines machine coordinates was changed: the position is not trusted any more."""

    words: Phrase


@dataclass(frozen=True, slots=True)
class CommandDone:
    """A command ended. `answer` holds its result, e.g. the probed position; `failure` is empty on success."""

    command: Command
    failure: Phrase = NO_WORDS
    answer: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Notice:
    """A message of the controller for the operator ([MSG:...], unknown lines)."""

    words: Phrase


Event = StateChanged | Faulted | ProgramDone | Stopped | Restarted | FrameChanged | CommandDone | Notice


@dataclass(slots=True)
class StatusChannel:
    """The reports of a driver: the latest status and progress, and the events since they were last taken."""

    status: MillStatus = field(default_factory=MillStatus)
    progress: StreamProgress = field(default_factory=StreamProgress)
    events: list[Event] = field(default_factory=list)

    def update(self, **fields: Any) -> None:
        """Change fields of the status."""
        self.status = replace(self.status, **fields)

    def enter(self, state: MillState, detail: Phrase) -> None:
        """Change the state; add an event if it is different."""
        if state is not self.status.state:
            self.events.append(StateChanged(self.status.state, state))
        self.update(state=state, detail=detail)

    def end_stream(self) -> None:
        """Note that no program is streamed any more."""
        self.progress = replace(self.progress, streaming=False)

    def take_events(self) -> tuple[Event, ...]:
        events, self.events = tuple(self.events), []
        return events


# Commands: what an operator can order outside the stream.
@dataclass(frozen=True, slots=True)
class Home:
    """Homing cycle ($H)."""


@dataclass(frozen=True, slots=True)
class Unlock:
    """Clear a lock ($X)."""


@dataclass(frozen=True, slots=True)
class Reset:
    """Soft reset. Refused while the mill moves: hold first."""


# What a person may ask for; lowest and highest.
JOG_MM = (-5000.0, 5000.0)
JOG_FEED = (1.0, 20_000.0)  # [mm/min]
PROBE_DEPTH_MM = (0.001, 200.0)
PROBE_FEED = (1.0, 1000.0)  # [mm/min]
PLATE_MM = (-100.0, 100.0)
RETRACT_MM = (0.0, 100.0)
CORNER_PLATE_MM = (0.0, 100.0)  # its thickness, on the block and beside it
CUTTER_RADIUS_MM = (0.01, 50.0)
MARGIN_MM = (0.0, 1000.0)
BESIDE_MM = (1.0, 100.0)  # up, aside and down to where the side of a plate is touched
OVERRIDE_PERCENT = (10, 200)  # of feed and spindle
HAND_RPM = (0.0, 1_000_000.0)  # the profile of the mill says more


@dataclass(frozen=True, slots=True)
class Jog:
    """Move by `by_mm` (or to work coordinates, `to_mm`, None = stay) at a feed; ended by JogCancel or arrival."""

    by_mm: Triple = (0.0, 0.0, 0.0)
    feed_mm_per_min: float = 500.0


@dataclass(frozen=True, slots=True)
class Leg:
    """A straight way to a place in machine coordinates. It changes Z alone, or X and Y alone."""

    to_mm: Triple
    feed_mm_per_min: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Travel:
    """Jog along these legs, each from standstill to standstill; the first that does not arrive is the last.

    name : in words, for the log
    """

    name: Phrase
    legs: tuple[Leg, ...]


@dataclass(frozen=True, slots=True)
class JogCancel:
    """Stop a jog, keeping the position."""


@dataclass(frozen=True, slots=True)
class ProbeZ:
    """Touch off: down until contact (G38.2), then set work Z there to `plate_mm`, then back up."""

    depth_mm: float
    feed_mm_per_min: float = 50.0
    plate_mm: float = 0.0
    retract_mm: float = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeCorner:
    """Touch a plate on the block's front left corner from above, left and front; then set the work zero of X, Y, Z.

    The tool begins over the plate, near the corner, and ends there.

    depth_mm         : greatest way down to the plate
    plate_mm         : thickness of the plate, over the block: Z0 is the block's top
    wall_x_mm        : from the block's left edge out to the face that is touched from the left
    wall_y_mm        : from its front edge out to the face that is touched from the front
    cutter_radius_mm : of the tool, at the height where it touches
    margin_mm        : distance of X0 Y0 inside the block's left and front edges
    aside_mm         : left, then forward of the start, where the tool goes down; probed back at most
    below_mm         : under the plate's top, where its sides are touched
    retract_mm       : over the plate's top, where the tool goes across
    """

    depth_mm: float
    plate_mm: float
    wall_x_mm: float
    wall_y_mm: float
    cutter_radius_mm: float
    margin_mm: float
    feed_mm_per_min: float = 100.0
    aside_mm: float = 20.0
    below_mm: float = 5.0
    retract_mm: float = 5.0


@dataclass(frozen=True, slots=True)
class SetZero:
    """Make the present position the work zero of these axes (G10 L20), e.g. "XY" or "Z". The operator vouches."""

    axes: str = "XYZ"


@dataclass(frozen=True, slots=True)
class TrustPosition:
    """The operator states that machine coordinates are right although homing was not run (mill without switches)."""


@dataclass(frozen=True, slots=True)
class Override:
    """Set an override: "feed" or "spindle" within OVERRIDE_PERCENT, "rapid" 25, 50 or 100 percent."""

    what: str
    percent: int


@dataclass(frozen=True, slots=True)
class CheckMode:
    """Dry run on the controller ($C) on or off."""

    on: bool


@dataclass(frozen=True, slots=True)
class ReadSettings:
    """Read settings ($$), offsets ($#) and parser state ($G) anew; the answer holds them."""


@dataclass(frozen=True, slots=True)
class Spindle:
    """Switch the spindle on, clockwise, at `rpm`, or off (None). Outside programs only."""

    rpm: float | None


@dataclass(frozen=True, slots=True)
class SendBlock:
    """One block typed by the operator, when the mill is idle."""

    text: str


Command = (
    Home | Unlock | Reset | Jog | Travel | JogCancel | ProbeZ | ProbeCorner | SetZero | TrustPosition | Override
    | CheckMode | ReadSettings | Spindle | SendBlock
)  # fmt: skip


Require = Callable[[], None]
"""Raises MachineError if an order may not be carried out any more.

A driver calls it when everything else is done and only the write of the order's first bytes is left: no disk, no lock,
no wait comes between. It calls it once more after the write, and holds the mill where a stop came in that moment. For a
`Travel` it calls it before each leg.
"""


def allow_always() -> None:
    """Raise nothing: the order moves nothing, or a person at the mill's own terminal gave it."""


class Driver(Protocol):
    """One mill on one link. All calls from one thread; only `wake` and `urge` may come from others.

    `poll` reads and writes, waiting at most `timeout_s` for input, and returns what happened. A link that is lost
    comes back as `Faulted(PORT_LOST)` and state DISCONNECTED, never as an exception. Calls that are not allowed in
    the present state raise NotAllowedError and change nothing.

    The first bytes of `start`, `resume` and `command` leave within the call; where `require` raises, none has left and
    nothing is changed. Lines that a command sends later, before anything moves, are checked by `require` again.
    """

    @property
    def facts(self) -> DriverFacts: ...
    @property
    def status(self) -> MillStatus: ...
    @property
    def progress(self) -> StreamProgress: ...
    @property
    def protections(self) -> tuple[str, ...]:
        """The link protections that are active now, in words; never overstated."""
        ...

    def connect(self) -> None:
        """Begin the handshake; `status.state` leaves CONNECTING when it is done. Never moves the mill."""
        ...

    def poll(self, timeout_s: float) -> tuple[Event, ...]: ...
    def wake(self) -> None:
        """End a `poll` that is waiting (from any thread)."""
        ...

    def urge(self, stop: str) -> bool:
        """Write what stops motion ("hold", "abort", "jog-cancel") to the link at once, from any thread.

        False if the link has no byte for it or does not take it now. The owner's own call follows in any case.
        """
        ...

    def start(self, lines: Iterator[ProgramLine], require: Require) -> None:
        """Stream these blocks; only from IDLE (or CHECK)."""
        ...

    def hold(self) -> None:
        """Stop motion as fast as the link allows, position kept; allowed in every state, at any time."""
        ...

    def resume(self, require: Require) -> None:
        """Go on after hold."""
        ...

    def abort(self) -> None:
        """Hold, and when the mill stands still clear its buffers; ends with Stopped."""
        ...

    def command(self, command: Command, require: Require) -> None:
        """Carry out one command; ends with CommandDone."""
        ...

    def close(self) -> None: ...
