"""Stops the mill: '!' before everything else, and a reset only at standstill, because in motion it loses the position.

After a stop, nothing that is not written yet may start motion. A reset is repeated until the banner comes: an
unanswered reset does not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from machines.driver import FaultCause, Faulted, MillState, Notice, Stopped
from machines.errors import NotAllowedError
from machines.grbl.commands import CommandChannel
from machines.grbl.link import TOOL_DONE, GrblLink
from machines.grbl.replies import CRITICAL_ALARMS, Status, alarm_words
from machines.grbl.states import HELD_STATES, Phase, detail_words, stands
from machines.grbl.status import StatusReporter
from machines.grbl.streaming import Streamer
from machines.grbl.timeouts import BANNER_S, HOLD_S, PERSON_S
from phrases.phrase import Phrase

BUSY_S = 0.05  # between status requests while the mill is being stopped
RESET = b"\x18"
# After ALARM:1 and ALARM:2 GRBL 1.1 stands still for 500 ms, forgets a reset that came meanwhile, says so and waits.
MESSAGE = "Reset to continue"
MESSAGE_S = 0.6  # in case the message is lost on the way
AGAIN_S = 0.25
SLOW_AFTER_S, SLOW_S = 10.0, 1.0  # an emergency stop that is still pressed, a mill without power: ask less often


class ResetSequence:
    """One reset under way. `take` returns the byte whenever it is due; the session ends the sequence at the banner."""

    def __init__(self, now_s: float, *, first_s: float = 0.0, again_s: float = inf, ours: bool = True) -> None:
        """ours: sent to a mill that stands, so that the position is kept"""
        self.ours = ours
        self.sent = 0
        self.due_s = now_s + first_s
        self._again_s = again_s
        self._begun_s = now_s

    @staticmethod
    def at_standstill(now_s: float) -> ResetSequence:
        """Reset once; if no banner comes, the session checks again whether the mill stands."""
        return ResetSequence(now_s)

    @staticmethod
    def after_critical_alarm(now_s: float) -> ResetSequence:
        """Reset when the controller has reported that it waits, or must have done so; repeat until it reacts."""
        return ResetSequence(now_s, first_s=MESSAGE_S, again_s=AGAIN_S)

    @staticmethod
    def by_a_person(now_s: float) -> ResetSequence:
        """Reset a silent controller: it is not known whether the mill stands, so the position is not kept."""
        return ResetSequence(now_s, again_s=AGAIN_S, ours=False)

    @property
    def repeats(self) -> bool:
        return self._again_s < inf

    def take_message(self, now_s: float) -> None:
        """Note the controller's message that it waits for a reset."""
        if self.repeats:
            self.due_s = now_s

    def take(self, now_s: float) -> bytes:
        """Return the byte if it is due, else nothing."""
        if now_s < self.due_s:
            return b""
        self.sent += 1
        slow = self.repeats and now_s > self._begun_s + SLOW_AFTER_S
        self.due_s = now_s + (SLOW_S if slow else self._again_s)
        return RESET


@dataclass(slots=True, eq=False)
class ResetControl:
    """Owns the reset under way, in Phase.CLEARING: planner and receive buffer are emptied by it."""

    link: GrblLink
    streamer: Streamer
    _sequence: ResetSequence | None = None

    @property
    def sequence(self) -> ResetSequence | None:
        """The reset under way."""
        return self._sequence if self.link.phase is Phase.CLEARING else None

    def begin(self, sequence: ResetSequence, now_s: float) -> None:
        """Start a reset, or replace the present one. Of the bytes waiting to be written, only '!' is sent before it."""
        link = self.link
        self.streamer.end()
        link.text.clear()
        link.urgent = bytearray((b"!" if b"!" in link.urgent else b"") + sequence.take(now_s))
        if link.phase is not Phase.CLEARING:
            link.enter(Phase.CLEARING, now_s)
        self._sequence = sequence
        link.poll_at_s = now_s + BUSY_S

    def begin_for_person(self, now_s: float) -> None:
        """Carry out a person's reset of a mill that stands, or of one that does not answer."""
        reset = ResetSequence.by_a_person if self.link.offers_reset else ResetSequence.at_standstill
        self.begin(reset(now_s), now_s)

    def take_message(self, words: str, now_s: float) -> None:
        """Pass a message on; after a critical alarm one says that the controller waits for a reset."""
        link, sequence = self.link, self.sequence
        link.events.append(Notice(Phrase("controller: {words}", words=words)))
        if words != MESSAGE:
            return
        if sequence is not None and sequence.repeats:
            sequence.take_message(now_s)
        elif link.phase is Phase.HAILING:  # its ALARM: line came before our time
            self.begin(ResetSequence.after_critical_alarm(now_s), now_s)
            self.take_message(words, now_s)

    def watch(self, now_s: float) -> bool:
        """Check the clock. True: a reset that is sent only once has had no banner; it is not known whether the mill
        stands.
        """
        link, sequence = self.link, self.sequence
        waited_s = link.silence.waited_s - link.silence.late_s
        if sequence is None:
            return False
        if not sequence.repeats:
            return waited_s > BANNER_S
        if not sequence.ours and waited_s > PERSON_S:
            words = Phrase(
                "nothing answers, not even {count} resets: mill off, another port, or another baud rate",
                count=sequence.sent,
            )
            link.close(words, now_s, FaultCause.DEVICE)
        elif waited_s > BANNER_S and not link.silence.notified:
            link.silence.notified = True
            words = Phrase(
                "no answer to {count} resets after the alarm: is an emergency stop pressed, is the mill without power?",
                count=sequence.sent,
            )
            link.events.append(Notice(words))
        return False


RESUME_POLL_S = 0.05
HOLD_AGAIN_S = 0.4
HELD = Phrase("a hold interrupted it; it is not continued")


@dataclass(slots=True, eq=False)
class StopControl:
    """Brings the mill to rest: hold, fault, abort, alarm. Keeps the state of the last hold."""

    link: GrblLink
    streamer: Streamer
    commands: CommandChannel
    reporter: StatusReporter
    resets: ResetControl
    abort_wanted: bool = False  # to carry out with the first report: of a link that was away, or ordered in a reset
    _hold_seen: bool = False  # the mill has reported standing since the last hold
    _hold_at_s: float = 0.0
    _notified_at_s: float = 0.0
    _stop_at_s: float = 0.0  # when it began to wait for standstill
    _still_reports: int = 0  # in a row, while stopping

    @property
    def is_quiet(self) -> bool:
        """Whether nothing moves, and nothing that was sent can start motion."""
        link, report = self.link, self.link.view.report
        if link.phase not in (Phase.READY, Phase.IDENTIFYING, Phase.HAILING) or report is None:
            return False
        return report.state == "Alarm" or (report.state == "Idle" and not link.hold_under_way)

    # ------------------------------------------------------------------ orders of a person

    def hold(self, now_s: float) -> None:
        """Stop motion. Unwritten bytes are dropped, a command is ended, and a program waits for a resume."""
        link = self.link
        link.hold_wanted = link.phase is not Phase.CLEARING
        if link.phase in (Phase.CLOSED, Phase.CLEARING):
            return  # carried out with the first report; or a reset is under way, which leaves nothing to hold
        if self.reporter.state is MillState.HOMING:
            self._reset_homing(now_s)
            return
        link.put_hold()
        if self.commands.busy:
            self._hold_command(now_s)
        link.paused = True
        self._hold_seen = False
        self._note_hold()
        self._hold_at_s = link.poll_at_s = now_s

    def resume(self, now_s: float) -> None:
        """Resume a mill that is held or waits for a person."""
        link, state, report = self.link, self.reporter.state, self.link.view.report
        ready = link.phase in (Phase.HAILING, Phase.READY, Phase.COMMAND, Phase.STREAMING) and report is not None
        if not ready or state not in (MillState.HELD, MillState.TOOL, MillState.DOOR):
            raise NotAllowedError(Phrase("resume: the mill is {state}, it must be held", state=state.words))
        assert report is not None
        if report.state == "Door" and report.sub:
            raise NotAllowedError(Phrase("resume: {detail}", detail=detail_words(report)))
        if self.commands.held_line:
            raise NotAllowedError(
                Phrase(
                    "resume: the hold ended '{text}', which is not continued; send a reset (from standstill the "
                    "position is kept), then send the command again",
                    text=self.commands.held_line,
                )
            )
        link.hold_wanted = self.abort_wanted = False
        if report.state == "Check":
            link.paused = False
            return
        link.urgent += (TOOL_DONE if report.state == "Tool" else b"") + (b"" if b"~" in link.urgent else b"~")
        link.poll_at_s = min(link.poll_at_s, now_s + RESUME_POLL_S)  # repeated presses must not postpone it

    def abort(self, now_s: float, *, hold_sent: bool = False) -> None:
        """Hold, and when the mill stands clear the controller's buffers; ends with Stopped.

        hold_sent : a '!' has been sent that may still be under way. It also holds an idle controller, or one that was
        just reset, so the abort is not complete until a report shows no hold.
        """
        link = self.link
        if hold_sent:
            link.hold_wanted = True
            self._note_hold()
        if link.phase is Phase.CLOSED:
            self.abort_wanted = True
            return
        if link.phase is Phase.HAILING and link.view.report is None:
            self.abort_wanted = link.hold_wanted = True
            self._note_hold()
            link.put_hold()  # a mill that does not answer may still receive
            if link.offers_reset:
                self.resets.begin(ResetSequence.by_a_person(now_s), now_s)
            return
        self.abort_wanted = hold_sent and link.phase is Phase.CLEARING
        if link.phase in (Phase.STOPPING, Phase.CLEARING):
            return
        if self.reporter.state is MillState.HOMING:
            self._reset_homing(now_s)
            return
        if self.is_quiet:
            link.events.append(Stopped(position_kept=link.view.trusted))
            return
        self.commands.end(Phrase("aborted"))
        link.put_hold()
        self.streamer.late_answers = True
        self._begin_stop(now_s)

    def _note_hold(self) -> None:
        """Note that reports under way now do not show this hold yet."""
        self.link.hold_reports = -self.link.reports_under_way

    def _hold_command(self, now_s: float) -> None:
        """End a command, because a held controller reads no lines; the handshake restarts when the mill is resumed."""
        if self.link.phase is Phase.IDENTIFYING:
            self._greet_again(now_s)
        else:
            self.commands.held_line = self.commands.asked
            self.commands.give_up(HELD, now_s)

    def _greet_again(self, now_s: float) -> None:
        self.commands.end(Phrase("held"))
        self.link.text.clear()
        self.link.greet(now_s, recognised=True)

    def _reset_homing(self, now_s: float) -> None:
        """Stop a homing cycle, which obeys no hold; its position means nothing yet, so a reset loses nothing."""
        self.commands.end(Phrase("homing was stopped"))
        self.link.view.lose_position()
        self.resets.begin(ResetSequence.at_standstill(now_s), now_s)

    # ------------------------------------------------------------------ events from the controller

    def raise_fault(self, cause: FaultCause, words: Phrase, line: int, now_s: float, *, alarm: int = 0) -> None:
        """End the program for a fault, '!' before anything else. The first sign counts."""
        if self.link.phase is not Phase.STREAMING:
            return
        self.link.put_hold()
        self.link.events.append(Faulted(cause, words, line, now_s, alarm))
        self._begin_stop(now_s)

    def take_alarm(self, number: int, now_s: float) -> None:
        """End everything that an alarm ends; after a critical alarm begin a reset, which is all that the controller
        accepts then.
        """
        link, words = self.link, alarm_words(number)
        link.view.take_alarm(number)
        if link.phase is Phase.IDENTIFYING:
            self._greet_again(now_s)  # a banner follows most alarms, not all
        elif self.commands.busy:
            self.commands.give_up(words, now_s)
        if link.phase is Phase.STREAMING:
            self.raise_fault(FaultCause.ALARM, words, self.streamer.first_line, now_s, alarm=number)
        else:
            link.events.append(Notice(words))
        if number in CRITICAL_ALARMS:
            # It already stands and only accepts a new reset; its buffer must be cleared.
            self.resets.begin(ResetSequence.after_critical_alarm(now_s), now_s)

    def take_report(self, report: Status, now_s: float) -> None:
        """Follow hold, door and cycle start as the mill reports them; while stopping, wait for standstill."""
        link = self.link
        link.hold_reports += 1
        if report.state in HELD_STATES:
            link.paused = True
            self._hold_seen = link.hold_reports > 0
            if link.phase is Phase.IDENTIFYING:
                self._greet_again(now_s)  # no line is read now
        elif link.hold_wanted and link.phase in (Phase.READY, Phase.STREAMING):
            self._note_no_hold(report, now_s)
        elif report.state in ("Run", "Idle") and link.paused and not link.hold_wanted:
            link.paused = False
        if link.phase is Phase.STOPPING:
            self._settle(report, now_s)

    def watch(self, now_s: float) -> None:
        """Check the clock while a stop or a reset is under way."""
        if self.link.phase is Phase.STOPPING:
            self._watch_stop(now_s)
        elif self.resets.watch(now_s):
            self.link.events.append(
                Notice(Phrase("no banner after the reset: asking again whether the mill stands still"))
            )
            self.link.put_hold()
            self._await_standstill(now_s)

    def _begin_stop(self, now_s: float) -> None:
        self.link.text.clear()
        self.commands.override.end(Phrase("the program was stopped"))
        self._await_standstill(now_s)

    def _await_standstill(self, now_s: float) -> None:
        self._hold_at_s = self._notified_at_s = self._stop_at_s = now_s
        self._still_reports = 0
        self.link.enter(Phase.STOPPING, now_s)

    @property
    def _hold_again_s(self) -> float:
        return HOLD_AGAIN_S + self.link.silence.round_trip_s

    def _hold_again(self, now_s: float) -> None:
        self.link.put_hold()
        self._hold_at_s = now_s

    def _note_no_hold(self, report: Status, now_s: float) -> None:
        """Handle a mill that moves after a hold: cycle start was pressed, or the '!' was lost.

        It may have finished its motion before the next report: then it stands Idle.
        """
        if report.state not in ("Run", "Jog", "Idle") or now_s <= self._hold_at_s + self._hold_again_s:
            return
        if self._hold_seen:
            self.link.hold_wanted = self.link.paused = self._hold_seen = False
            words = Phrase("cycle start was pressed at the machine: the mill goes on after the hold")
            self.link.events.append(Notice(words))
        elif report.state != "Idle":
            self._hold_again(now_s)

    def _settle(self, report: Status, now_s: float) -> None:
        """While stopping, determine whether the mill certainly stands."""
        stream, position = self.streamer.stream, self.link.view.work_mm
        if stream is not None and position is not None and report.state in ("Run", "Hold"):
            stream.tracker.take_report(position)
        if not stands(report) or now_s < self._stop_at_s + self.link.silence.round_trip_s:
            self._still_reports = 0
            return  # it moves, or this report was made before the '!' was there
        # A standing Hold is certain. Idle may be a report from before the '!', or before the next queued line.
        self._still_reports += 1
        needed = 2 if report.state == "Hold" else 6
        if report.state == "Idle" and self._still_reports < needed and not now_s < self._hold_at_s + self._hold_again_s:
            self._hold_again(now_s)
        if self._still_reports >= needed:
            if stream is not None and position is not None and report.state in ("Idle", "Hold"):
                stream.tracker.take_standstill(position, exact_mm=self.link.view.exact_mm)
            self.resets.begin(ResetSequence.at_standstill(now_s), now_s)

    def _watch_stop(self, now_s: float) -> None:
        report = self.link.view.report
        if now_s > self._hold_at_s + self._hold_again_s and not (
            report is not None and report.state in ("Hold", "Door")
        ):
            self._hold_again(now_s)
        if now_s > self._notified_at_s + HOLD_S + self.link.silence.late_s:
            self._notified_at_s = now_s
            self.link.events.append(Notice(Phrase("the mill does not confirm the hold: use its own stop button")))
