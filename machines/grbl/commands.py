"""Commands outside a program, line by line: each line waits for the answer to the one before. Time is passed in.

Overrides go by realtime bytes: one step of each size per report, because the firmware merges equal bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from machines.driver import (
    OVERRIDE_PERCENT,
    CheckMode,
    Command,
    CommandDone,
    FrameChanged,
    Home,
    JogCancel,
    MillState,
    Override,
    Require,
    Travel,
    TrustPosition,
    allow_always,
)
from machines.errors import MachineError, NotAllowedError
from machines.grbl.asking import PARSER_TAG, Answer, Ask, CommandSequence, Outcome, SequenceFailedError, WaitStill
from machines.grbl.link import GrblLink
from machines.grbl.replies import Push, Reply, Setting, Status, error_words, show
from machines.grbl.sequences import make_sequence
from machines.grbl.settings import is_parser_state
from machines.grbl.states import Phase
from machines.grbl.timeouts import BANNER_S
from phrases.phrase import NO_WORDS, Phrase

# what -> (place in Ov:, back to 100 %, +10, -10, +1, -1)
_STEPS = {
    "feed": (0, 0x90, 0x91, 0x92, 0x93, 0x94),
    "spindle": (2, 0x99, 0x9A, 0x9B, 0x9C, 0x9D),
}
_RAPID = {100: 0x95, 50: 0x96, 25: 0x97}
REPORTS_TO_CHANGE = 6  # reports without any change after which a step is sent again
GIVE_UP_S = 15.0
MOST_STEPS = 20  # steps from one end to the other, each taking a round trip


def find_refusal(what: str, percent: int) -> Phrase | None:
    """Say why this override cannot be set; None if it can."""
    if what == "rapid":
        if percent in _RAPID:
            return None
        return Phrase("rapid override {percent} %: only 25, 50 and 100 exist", percent=percent)
    if what not in _STEPS:
        return Phrase("override '{what}'; allowed: feed, rapid and spindle", what=what)
    low, high = OVERRIDE_PERCENT
    if low <= percent <= high:
        return None
    return Phrase("{what} override {percent} %: from {low} to {high}", what=what, percent=percent, low=low, high=high)


def _read_percent(what: str, overrides: tuple[int, int, int]) -> int:
    """Return this override of a report's Ov."""
    return overrides[1] if what == "rapid" else overrides[_STEPS[what][0]]


def _make_step(what: str, now_percent: int, percent: int) -> bytes:
    """Return the realtime bytes that bring the override nearer to its target: at most one coarse and one fine step."""
    if now_percent == percent:
        return b""
    if what == "rapid":
        return bytes([_RAPID[percent]])
    _, back, up10, down10, up1, down1 = _STEPS[what]
    if percent == 100:
        return bytes([back])
    away = percent - now_percent
    coarse, fine = divmod(abs(away), 10)
    out = bytearray()
    if coarse:
        out.append(up10 if away > 0 else down10)
    if fine:
        out.append(up1 if away > 0 else down1)
    return bytes(out)


@dataclass(slots=True, eq=False)
class OverrideControl:
    """Brings one override at a time to its value, checked against reports. Works alongside all other commands."""

    link: GrblLink
    _command: Override | None = None
    _require: Require = allow_always  # each step takes effect by itself and is checked by itself
    _step: bytes = b""  # to be written
    _until_s: float = 0.0
    _reports: int = 0  # since the last step

    @property
    def active(self) -> bool:
        return self._command is not None

    def begin(self, command: Override, now_s: float, require: Require) -> None:
        self.end(Phrase("replaced by a newer override"))
        self._command, self._require = command, require
        self._until_s = now_s + GIVE_UP_S + MOST_STEPS * self.link.silence.round_trip_s
        self._reports = REPORTS_TO_CHANGE
        self.link.poll_at_s = now_s

    def end(self, failure: Phrase = NO_WORDS) -> None:
        """Report the end of the override under way, if there is one."""
        command, self._command, self._step = self._command, None, b""
        if command is not None:
            self.link.events.append(CommandDone(command, failure))

    def take_report(self, report: Status, now_s: float) -> None:
        """Compare a report with the target; queue the next step."""
        command, view = self._command, self.link.view
        if command is None:
            return
        self._reports += 1
        if report.overrides is None and self._reports < REPORTS_TO_CHANGE:
            return
        percent = _read_percent(command.what, view.overrides)
        step = _make_step(command.what, percent, command.percent)
        if not step and (report.overrides is not None or view.override_reports):
            self.end()
        elif now_s > self._until_s:
            self.end(Phrase("{what} override stays at {percent} %", what=command.what, percent=percent))
        elif self._reports >= 2:
            self._step = step
            # Steps are relative, so none is computed from a report that is older than the last step.
            self._reports = -self.link.reports_under_way

    def queue_step(self) -> None:
        """Queue the waiting step for the next write. End the override if its order is no longer valid."""
        if not self._step:
            return
        step, self._step = self._step, b""
        try:
            self._require()
        except MachineError as refusal:
            self.end(refusal.words)
            return
        self.link.urgent += step


STILL_REPORTS = 2  # a report may have been made just before the motion of an answered line began
CANCEL_REPORTS = 3  # a controller forgets the end of a jog whose line it has not read yet
JOG_CANCEL = b"\x85"
OnEnd = Callable[[Phrase, dict[str, object], float], None]
"""Called after a sequence that has ended by itself, with its failure in words, its answer and the time."""


@dataclass(slots=True, eq=False)
class CommandChannel:
    """Carries out commands: one sequence at a time, which has the link to itself, and an override alongside it.

    command      : of the sequence under way; None if there is none, and during the handshake
    held_line    : line of a sequence that a hold has ended: the controller may still carry it out
    banner_due_s : until then a banner is the answer to $C
    """

    link: GrblLink
    override: OverrideControl
    command: Command | None = None
    held_line: str = ""
    banner_due_s: float = 0.0
    _sequence: CommandSequence | None = None  # only in IDENTIFYING and COMMAND
    _require: Require = allow_always  # until its first line that is not a query has left; for a way, to its end
    _waiting: Ask | WaitStill | None = None
    _begun_s: float = 0.0  # of our own time
    _heard: list[Reply] = field(default_factory=list)
    _first: Answer | None = None  # of a line that is asked twice
    _odd: bytes = b""  # a line received meanwhile that no controller sends
    _still: int = 0
    _cancel_reports: int = 0  # after as many reports without a jog, its end need not be requested again
    _on_end: OnEnd = field(init=False)

    @property
    def busy(self) -> bool:
        return self._sequence is not None

    @property
    def asked(self) -> str:
        """The line whose answer is awaited; "" if none is."""
        return self._waiting.text.decode("ascii") if isinstance(self._waiting, Ask) else ""

    @property
    def homes(self) -> bool:
        """A homing cycle is under way."""
        return isinstance(self.command, Home)

    def carry_out(self, command: Command, state: MillState, now_s: float, require: Require) -> None:
        """Begin a command that is allowed now."""
        link = self.link
        if isinstance(command, Override):
            self.override.begin(command, now_s, require)
        elif isinstance(command, TrustPosition):
            link.view.vouch("XYZ")
            link.events.append(CommandDone(command))
        elif isinstance(command, JogCancel):
            link.urgent += JOG_CANCEL
            self._cancel_reports = CANCEL_REPORTS
            if isinstance(self.command, Travel):
                self._require = _refuse_next_leg
            link.events.append(CommandDone(command))
        elif isinstance(command, CheckMode) and command.on == (state is MillState.CHECK):
            link.events.append(CommandDone(command))
        else:
            link.hold_wanted = link.paused = False
            self._cancel_reports = 0
            link.enter(Phase.COMMAND, now_s)
            if isinstance(command, CheckMode) and not command.on:
                self.banner_due_s = now_s + BANNER_S + link.silence.late_s
            self.command = command
            self.run(make_sequence(command, link.view.settings, link.view.modes), self._end_command, now_s, require)

    def run(self, sequence: CommandSequence, on_end: OnEnd, now_s: float, require: Require = allow_always) -> None:
        self._sequence, self._on_end, self._require = sequence, on_end, require
        self._advance(None, now_s)

    def take_reply(self, reply: Push | Setting) -> None:
        """Keep a line that comes before `ok` as part of the answer."""
        if isinstance(self._waiting, Ask):
            self._heard.append(reply)

    def take_answer(self, error: int, now_s: float) -> None:
        """Take `ok` (0) or an error number for the answer of the line sent last, unless it answers an earlier one."""
        ask = self._waiting
        if not isinstance(ask, Ask):
            return
        failure = NO_WORDS
        if error:
            failure = Phrase("{asked}: {error}", asked=self.asked, error=error_words(error))
        elif ask.expect and not any(_is(reply, ask.expect) for reply in self._heard):
            if not any(isinstance(reply, Push) and reply.tag == ask.expect for reply in self._heard):
                return
            failure = Phrase("{asked}: its answer was damaged on the way", asked=self.asked)
        answer, silence = Answer(failure, tuple(self._heard)), self.link.silence
        if ask.expect and not failure and self._first is None:
            silence.note_answer(silence.spent_s - self._begun_s)
        if ask.twice and self._first is None:
            self._first, self._heard = answer, []
            return
        if self._first is not None:
            answer = replace(self._first, failure=self._first.failure or failure, again=answer.heard)
        self._advance(answer, now_s)

    def take_odd_line(self, raw: bytes) -> None:
        """Keep a line that no controller sends: it shows why there is no other answer."""
        self._odd = raw

    def take_report(self, report: Status, now_s: float) -> None:
        """Count reports of standstill while one is awaited; take an override one step further."""
        if isinstance(self._waiting, WaitStill):
            self._still = self._still + 1 if report.state in ("Idle", "Check") else 0
            if self._still >= STILL_REPORTS:
                self._advance(Answer(machine_mm=self.link.view.machine_mm), now_s)
        if self._cancel_reports and report.state == "Jog":
            self.link.urgent += JOG_CANCEL
        elif self._cancel_reports:
            self._cancel_reports -= 1
        self.override.take_report(report, now_s)

    def watch(self, now_s: float) -> None:
        """Give up a command when its answer is overdue."""
        waiting, silence = self._waiting, self.link.silence
        if waiting is None or silence.spent_s < self._begun_s + waiting.timeout_s + silence.late_s:
            return
        what, waited_s = self.asked or Phrase("standstill"), silence.spent_s - self._begun_s
        words = Phrase("{what}: no answer in {timeout_s:.0f} s", what=what, timeout_s=waited_s)
        if self._odd:
            words = Phrase(
                "{words}, but '{text}', which is not a reply that a controller sends", words=words, text=show(self._odd)
            )
        self._advance(Answer(words, tuple(self._heard)), now_s)

    def end(self, words: Phrase) -> None:
        """End the sequence under way and the override, with a reason."""
        if self._sequence is not None:
            self._sequence.close()
            self._sequence = self._waiting = None
        command, self.command = self.command, None
        if command is not None:
            self.link.events.append(CommandDone(command, words))
        self.override.end(words)

    def give_up(self, words: Phrase, now_s: float) -> None:
        """End the command under way and make the link ready for the next."""
        self.end(words)
        if self.link.phase is Phase.COMMAND:
            self.link.enter(Phase.READY, now_s)

    def _advance(self, answer: Answer | None, now_s: float) -> None:
        """Go on to the next line of the sequence, or to its end."""
        sequence = self._sequence
        assert sequence is not None
        self._heard, self._first, self._still, self._odd = [], None, 0, b""
        try:
            self._waiting = waiting = next(sequence) if answer is None else sequence.send(answer)
            if isinstance(waiting, Ask) and not waiting.is_question:
                self._require()  # the line is sent in this same call of the driver, before anything that could wait
                if not isinstance(self.command, Travel):
                    self._require = allow_always
        except StopIteration as stop:
            self._finish(stop.value, NO_WORDS, now_s)
        except (SequenceFailedError, MachineError) as failed:
            sequence.close()
            self._finish(Outcome(), failed.words, now_s)
        else:
            self._begun_s = self.link.silence.spent_s
            if isinstance(waiting, Ask):
                self.link.text += (waiting.text + b"\n") * (2 if waiting.twice else 1)

    def _finish(self, outcome: Outcome, failure: Phrase, now_s: float) -> None:
        """Take over what a sequence leaves behind."""
        self._sequence = self._waiting = None
        view = self.link.view
        changes = view.take_settings(outcome.settings) if outcome.settings is not None else ()
        if changes:
            words = Phrase("the position is no longer trusted: {settings}", settings=", ".join(changes))
            self.link.events.append(FrameChanged(words))
        view.vouch(outcome.vouched)
        self._on_end(failure, outcome.answer, now_s)

    def _end_command(self, failure: Phrase, answer: dict[str, object], now_s: float) -> None:
        command, self.command = self.command, None
        assert command is not None
        self.link.enter(Phase.READY, now_s)
        self.link.events.append(CommandDone(command, failure, answer))


def _refuse_next_leg() -> None:
    raise NotAllowedError(Phrase("ended on the way; the rest of it is left out"))


def _is(reply: Reply, expect: str) -> bool:
    if expect == "$":
        return isinstance(reply, Setting)
    parser_state = expect == PARSER_TAG
    return isinstance(reply, Push) and reply.tag == expect and (not parser_state or is_parser_state(reply.body))
