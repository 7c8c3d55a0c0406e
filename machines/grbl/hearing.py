"""What a session makes of each reply: the handshake's, the stream's, a command's, and of status reports."""

from __future__ import annotations

from machines.driver import (
    CommandDone,
    FaultCause,
    Faulted,
    Notice,
)
from machines.grbl import echo, overrides, replies, resetting
from machines.grbl.codes import CRITICAL_ALARMS, POSITION_LOST_ALARMS, alarm_words, error_words
from machines.grbl.errands import identify
from machines.grbl.following import SessionFollowing
from machines.grbl.greeting import Greeting
from machines.grbl.resetting import ResetSequence
from machines.grbl.runner import ErrandRunner
from machines.grbl.settings import ControllerSettings
from machines.grbl.states import Phase, stands
from machines.grbl.streaming import Stream


class SessionHearing(SessionFollowing):
    """One line from the controller after the other."""

    def _line(self, line: bytes, now_s: float) -> None:
        reply = replies.parse(line)
        if isinstance(reply, replies.Banner):
            self._note_restart(reply.text, now_s)
        elif self.phase is Phase.HAILING:
            self._take_greeting(reply, line, now_s)
        elif isinstance(reply, replies.Status):
            self._take_report(reply, now_s)
        elif isinstance(reply, replies.Ok):
            self._answered(0, now_s)
        elif isinstance(reply, replies.ErrorReply):
            self._answered(reply.number, now_s)
        elif isinstance(reply, replies.AlarmReply):
            self._note_alarm(reply.number, now_s)
        elif isinstance(reply, replies.Echo):
            self._take_echo(reply.text, now_s)
        elif isinstance(reply, replies.Message):
            self._told(reply.text, now_s)
        elif isinstance(reply, replies.Push | replies.Setting):
            if self._errand is not None:
                self._errand.heard(reply)
        elif isinstance(reply, replies.Garbled):
            self._garbled(reply.raw, now_s)

    def _take_greeting(self, reply: replies.Reply, line: bytes, now_s: float) -> None:
        """Before the handshake only a status report, an alarm or a banner means anything."""
        self._hail.heard(reply, line)
        if isinstance(reply, replies.Message):
            self._told(reply.text, now_s)
        elif isinstance(reply, replies.AlarmReply):
            self._note_alarm(reply.number, now_s)
        elif isinstance(reply, replies.Status):
            self._patience.report_came()
            self._offers_reset = False
            self.view.take(reply, now_s)
            self._hail.recognised = True
            self._tell_restart()
            if self._abort_wanted:
                self.abort(now_s)
            elif self._hold_wanted and not stands(reply):
                self._put_hold()  # asked for while the link was away
            elif reply.state in ("Idle", "Alarm", "Check"):
                self._move(Phase.IDENTIFYING, now_s)
                self._errand = ErrandRunner(identify(self._banner), None, self._write, self._patience.spent_s)

    def _told(self, words: str, now_s: float) -> None:
        """A message: for the operator, and perhaps that nothing but a reset is heard."""
        self._events.append(Notice(f"controller: {words}"))
        if words != resetting.MESSAGE:
            return
        if self._reset is not None and self._reset.repeats:
            self._reset.message_came(now_s)
        elif self.phase is Phase.HAILING:  # its ALARM: line came before our time
            self._begin_reset(ResetSequence.after_critical_alarm(now_s), now_s)
            self._told(words, now_s)

    def _write(self, text: bytes) -> None:
        self._text += text

    def _answered(self, error: int, now_s: float) -> None:
        if self._errand is not None:
            if self._errand.answered(error, self._patience.spent_s):
                self._after_errand(now_s)
            return
        stream = self._stream
        if stream is None or self.phase is not Phase.STREAMING:
            self._take_late_answer(stream, error)
            return
        self._sign_heard_s = self._patience.heard_s
        self._idle_reports = self._standing_reports = 0
        words = error_words(error) if error else "ok"
        if not stream.window.used:
            self._fault(FaultCause.REPLY_COUNT, f"{words} came although every line was answered already", 0, now_s)
        elif self._echoes and not stream.echoed:
            line = stream.first_line
            self._fault(FaultCause.ECHO, f"line {line} was answered ({words}) without its echo", line, now_s)
        elif error:
            assert stream.first is not None
            block = stream.first[0]
            self._fault(
                FaultCause.ERROR_REPLY,
                f"line {block.number} '{shown(block.text)}' was refused: {words}",
                block.number,
                now_s,
            )
        else:
            stream.answered()

    def _take_late_answer(self, stream: Stream | None, error: int) -> None:
        """An answer to a line of a stream that is dead already, or of a command that a hold has ended."""
        self._held_line = ""
        if stream is None or not self._late_answers or not stream.window.used:
            return
        if error or self._echoes:
            self._late_answers = False
        else:
            stream.answered()

    def _take_echo(self, text: bytes, now_s: float) -> None:
        stream = self._stream
        if stream is None or self.phase is not Phase.STREAMING:
            self._echoes = True
            return
        first = stream.first
        if first is None:
            self._fault(FaultCause.ECHO, f"the controller has read '{shown(text)}', which was not sent", 0, now_s)
        elif stream.echoed or echo.differs(first[0].text, text):
            number = first[0].number
            self._fault(
                FaultCause.ECHO,
                f"line {number} was sent as '{shown(first[0].text)}', but read as '{shown(text)}'",
                number,
                now_s,
            )
        else:
            self._echoes = stream.echoed = True

    def _note_alarm(self, number: int, now_s: float) -> None:
        self.view.alarmed(number)
        words = alarm_words(number)
        if self._errand is not None:
            self._end_errand(words)
            if self.phase is Phase.ERRAND:
                self._move(Phase.READY, now_s)
        if self.phase is Phase.STREAMING:
            self._fault(FaultCause.ALARM, words, self._stream.first_line if self._stream else 0, now_s)
        else:
            self._events.append(Notice(words))
        if number in CRITICAL_ALARMS:
            # Stands already and will hear nothing but a new reset; what it holds must not survive.
            self._begin_reset(ResetSequence.after_critical_alarm(now_s), now_s)

    def _garbled(self, raw: bytes, now_s: float) -> None:
        if self.phase is Phase.STREAMING:
            line = self._stream.first_line if self._stream else 0
            self._fault(
                FaultCause.GARBLED_REPLY,
                f"'{shown(raw)}' is nothing a controller says: damaged on the way",
                line,
                now_s,
            )
        elif self.phase is not Phase.CLEARING:
            self._events.append(Notice(f"not understood: '{shown(raw)}'"))

    def _note_restart(self, banner: str, now_s: float) -> None:
        """A banner: a new epoch. Everything the controller held is gone."""
        self._tell_restart()
        ours, report = self.phase is Phase.CLEARING, self.view.report
        checked_off = not ours and now_s < self._banner_due_s
        sure = self._reset is not None and self._reset.ours and (report is None or report.state != "Sleep")
        kept = (ours and sure and self.view.alarm not in POSITION_LOST_ALARMS) or checked_off
        self._banner_due_s = 0.0
        was_streaming, line = self.phase is Phase.STREAMING, self._stream.first_line if self._stream else 0
        known = self.controller
        self.epoch += 1
        self._banner, self.controller = banner, _name(banner)
        self._urgent.clear()
        self._text.clear()
        self._echoes = False
        self._hold_wanted = self._paused = self._abort_wanted = self._late_answers = False
        self._held_line = ""
        self._steer = None
        self.view.new_epoch(position_kept=kept)
        self._restart = banner, ours or self.phase is Phase.STOPPING
        self._end_errand("" if checked_off else "the controller restarted")
        self._end_stream()
        self._hail = Greeting(recognised=bool(known))
        self._hail.banner = True
        self._move(Phase.HAILING, now_s)
        if was_streaming:
            words = f"the controller restarted by itself ('{banner}'): reset button, power or a reset line"
            self._events.append(Faulted(FaultCause.RESET, words, line, now_s))

    def _take_report(self, report: replies.Status, now_s: float) -> None:
        view = self.view
        self._patience.report_came()
        self._offers_reset = self._silence_told = False
        if view.take(report, now_s):
            self._sign_heard_s = self._patience.heard_s
        if self._stream is not None:
            self._stream.count.reported(now_s)
        if report.state not in ("Idle", "Check"):
            self._standing_reports = 0
        else:
            self._standing_reports += 1
            if self._standing_reports == 1:
                self._standing_heard_s = self._patience.heard_s
        if self._errand is not None:
            idle = report.state in ("Idle", "Check")
            self._errand.reported(idle=idle, machine_mm=view.machine_mm, now_s=self._patience.spent_s)
            self._after_errand(now_s)
        if self._steer is not None:
            self._steer_override(report, now_s)
        self._hold_reports += 1
        if report.state in ("Hold", "Door", "Sleep", "Tool"):
            self._paused = True
            self._hold_seen = self._hold_reports > 0
            self._sign_heard_s = self._patience.heard_s  # waiting for a person is not a stall
            if self.phase is Phase.IDENTIFYING:
                self._hail_again(now_s)  # no line is read now
        elif report.state == "Run" and self._hold_wanted and self.phase is Phase.STREAMING:
            self._note_running(now_s)
        elif report.state in ("Run", "Idle") and self._paused and not self._hold_wanted:
            self._paused = False
        if self.phase is Phase.STREAMING:
            self._follow(report, now_s)
        elif self.phase is Phase.STOPPING:
            self._settle(report, now_s)

    def _after_errand(self, now_s: float) -> None:
        errand = self._errand
        if errand is None or not errand.ended:
            return
        self._errand = None
        outcome = errand.outcome
        if outcome is not None:
            if outcome.settings is not None:
                self.view.settings = outcome.settings
                self._modes = outcome.settings.parser_state or self._modes
            self.view.vouch(outcome.vouched)
        if self.phase is Phase.IDENTIFYING:
            self._note_identity(errand, now_s)
            return
        if self.phase is Phase.ERRAND:
            self._move(Phase.READY, now_s)
        if errand.command is not None:
            answer = outcome.answer if outcome is not None else {}
            self._events.append(CommandDone(errand.command, errand.failure, answer))

    def _note_identity(self, errand: ErrandRunner, now_s: float) -> None:
        if errand.failure:
            words = f"something answers, but it is not a GRBL controller: {errand.failure}"
            self._close(words, now_s, Faulted(FaultCause.DEVICE, words, 0, now_s))
            return
        self.view.identified = True
        self._hold_wanted = False
        self.controller = self.controller or f"Grbl {self.settings.version.partition('.')[0]}"
        if self.settings.version:
            self.controller = _controller_words(self._banner, self.settings)
        self._move(Phase.READY, now_s)

    def _steer_override(self, report: replies.Status, now_s: float) -> None:
        assert self._steer is not None
        command, until_s = self._steer
        self._steer_reports += 1
        if report.overrides is None and self._steer_reports < overrides.PATIENCE_REPORTS:
            return
        shown = overrides.value_in_report(command.what, self.view.overrides)
        steps = overrides.next_bytes(command.what, shown, command.percent)
        if not steps and (report.overrides is not None or self.view.override_reports):
            self._steer = None
            self._events.append(CommandDone(command))
        elif now_s > until_s:
            self._steer = None
            self._events.append(CommandDone(command, f"{command.what} override stays at {shown} %"))
        elif self._steer_reports >= 2:
            self._urgent += steps
            self._steer_reports = 0


def shown(text: bytes) -> str:
    words = text.decode("ascii", "backslashreplace")
    return words if len(words) <= 80 else words[:77] + "..."


def _name(banner: str) -> str:
    return banner.partition("[")[0].strip()


def _controller_words(banner: str, settings: ControllerSettings) -> str:
    name = {"grbl": "Grbl", "grblhal": "grblHAL", "fluidnc": "FluidNC"}[settings.firmware]
    return f"{name} {settings.version.partition(':')[0]}".strip() if settings.version else _name(banner)
