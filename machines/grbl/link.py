"""The link to a controller: options, phase, the answering controller, the mill's known state, bytes waiting to be
written.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from machines.driver import Event, FaultCause, Faulted, Restarted, Stopped
from machines.grbl.replies import Empty, Reply, name_foreign, show
from machines.grbl.states import Phase, may_move
from machines.grbl.timeouts import SilenceClock
from machines.grbl.view import MachineView
from phrases.phrase import NO_WORDS, Phrase

DEFAULT_RX_BYTES = 128  # GRBL 1.1 on an Uno, the smallest in the field; FluidNC's $I does not say


@dataclass(frozen=True, slots=True, kw_only=True)
class GrblOptions:
    """How a link to a GRBL controller is used.

    poll_s, run_poll_s : between status requests, and while a program runs
    rx_bytes           : receive buffer; None asks $I, and takes DEFAULT_RX_BYTES where that does not say
    corridor_mm        : how far a reported position may be off the programmed path, on top of rounding, steps and arc
                         chords ($12)
    identify_s         : until a port on which nothing like a controller answers is given up
    """

    poll_s: float = 0.2
    run_poll_s: float = 0.1
    rx_bytes: int | None = None
    corridor_mm: float = 0.010
    identify_s: float = 6.0
    dialect: str = "grbl"


TOOL_DONE = b"\xa3"
STARTING = b"~" + TOOL_DONE  # realtime bytes that can start motion
PLAIN = bytes(range(0x20, 0x7F)) + b"\t\r\n"
# Shown when nothing answers, or not yet; a person may then send a reset.
SILENT = Phrase(
    "nothing answers '?'. After a limit alarm a controller accepts nothing but a reset, and while it homes it does "
    "not answer either: look at the mill; if it stands still, send a reset"
)
QUICK_S = 0.1  # longest time between '?' while something waits for the next report
NOISE_SHARE = 0.25  # bytes that are not text: far more at a wrong baud rate, none from a text protocol


class Greeting:
    """Collects the answers to '?'."""

    def __init__(self, *, recognised: bool = False) -> None:
        self.recognised = recognised
        self.banner = False
        self._text = b""  # first bytes heard, for the message
        self._foreign: tuple[str, bytes] | None = None  # firmware that cannot be used, and the line that shows it
        self._rest = b""
        self._bytes = self._noise = 0

    def take(self, reply: Reply, line: bytes) -> None:
        self._bytes += len(line)
        self._noise += len(line.translate(None, PLAIN))
        if not isinstance(reply, Empty) and not self._text:
            self._text = line[:60]
        if self._foreign is None and (name := name_foreign(line)) is not None:
            self._foreign = name, line[:60]

    def count_unended(self, rest: bytes) -> None:
        """Count the bytes after the last line end."""
        self._rest = rest

    @property
    def is_foreign(self) -> bool:
        """Return whether an unsupported firmware has answered."""
        return self._foreign is not None

    @property
    def speaks(self) -> bool:
        """Whether something other than a report has come: another device, another baud rate."""
        return bool(self._bytes or self._rest) and not self.recognised and not self.banner

    @property
    def words(self) -> Phrase:
        if self.banner:
            return Phrase("the controller has started, asking for its state")
        return Phrase("asking '?'") if not self.recognised else Phrase("waiting for a report")

    def verdict(self) -> Phrase:
        """Return why this controller cannot be used, when its time to answer is over."""
        if self._foreign is not None:
            name, line = self._foreign
            return Phrase(
                "this is {name} ('{shown}'), which is not supported: the board needs GRBL 1.1, grblHAL or FluidNC",
                name=name,
                shown=show(line),
            )
        heard = self._bytes + len(self._rest)
        noise = self._noise + len(self._rest.translate(None, PLAIN))
        if not heard:
            return Phrase(
                "nothing answers '?': is the mill switched on, is this its port, and is the baud rate right (GRBL: "
                "115200)? After a limit alarm (ALARM:1, ALARM:2) a controller accepts nothing but a reset: look at "
                "the mill, then send one"
            )
        if noise > NOISE_SHARE * heard:
            return Phrase("answers with noise, not text: wrong baud rate? (GRBL: 115200)")
        shown = show(self._text or self._rest[:60])
        return Phrase(
            "something answers ('{shown}'), but it is not a GRBL controller: is this the right port?", shown=shown
        )


@dataclass(slots=True)
class GrblLink:
    """State that all parts of a session share. Only `enter` changes the phase.

    urgent, text : to be written: realtime bytes, and lines of a command
    restart      : a banner that waits for its first report, and whether it ends a stop
    hold_wanted  : a hold was requested, and nothing has ended it since
    hold_reports : reports since the last hold; while it is 0 or less, they may be older than its arrival
    paused       : no new line of a program: held, door, or asked for offers_reset : nothing answers: it may be a
    controller after a limit alarm, and a person may send it a reset
    """

    options: GrblOptions
    view: MachineView = field(default_factory=MachineView)
    silence: SilenceClock = field(default_factory=SilenceClock)
    greeting: Greeting = field(default_factory=Greeting)
    phase: Phase = Phase.CLOSED
    failure: Phrase = NO_WORDS  # why the phase is CLOSED, in words
    controller: str = ""  # name and version
    epoch: int = 0  # counts restarts of the controller
    urgent: bytearray = field(default_factory=bytearray)
    text: bytearray = field(default_factory=bytearray)
    events: list[Event] = field(default_factory=list)
    restart: tuple[str, bool] | None = None
    hold_wanted: bool = False
    hold_reports: int = 0
    paused: bool = False
    offers_reset: bool = False
    poll_at_s: float = 0.0
    watch_at_s: float = 0.0

    @property
    def reports_under_way(self) -> int:
        """Return how many reports may still come that were made before a byte written now arrives."""
        return self.silence.unanswered + int(self.silence.round_trip_s / min(self.options.run_poll_s, QUICK_S))

    @property
    def hold_under_way(self) -> bool:
        """Return whether a hold was requested whose effect no report shows yet."""
        return self.hold_wanted and self.hold_reports <= 0

    def enter(self, phase: Phase, now_s: float) -> None:
        """Begin a phase; its first '?' and its first look at the clock are due at once."""
        if not may_move(self.phase, phase):
            raise AssertionError(f"no way from {self.phase.value} to {phase.value}")
        self.phase = phase
        self.silence.begin_wait()
        self.poll_at_s = self.watch_at_s = now_s
        self.offers_reset = False

    def greet(self, now_s: float, *, recognised: bool) -> None:
        """Begin to ask '?' until a report comes."""
        self.greeting = Greeting(recognised=recognised)
        self.enter(Phase.HAILING, now_s)

    def close(self, words: Phrase, now_s: float, cause: FaultCause | None, line: int = 0) -> None:
        """Close the link; nothing is written any more."""
        self.failure = words
        self.urgent.clear()
        self.text.clear()
        self.hold_wanted = self.paused = False
        self.report_restart()
        self.view.lose_position()
        self.enter(Phase.CLOSED, now_s)
        if cause is not None:
            self.events.append(Faulted(cause, words, line, now_s))

    def put_hold(self) -> None:
        """Put '!' before everything that waits to be written; drop what could start motion again."""
        self.urgent = bytearray(b"!" + self.urgent.translate(None, STARTING))

    def report_restart(self) -> None:
        """Report a restart, and the end of a stop if it is one, with the verdict on the position."""
        if self.restart is None:
            return
        (banner, stops), self.restart = self.restart, None
        kept = self.view.judge_place()
        self.events.append(Restarted(banner, kept))
        if stops:
            self.events.append(Stopped(position_kept=kept))
