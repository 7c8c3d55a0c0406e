"""The handshake: identifies the controller after a link was opened and after every start of the controller."""

from __future__ import annotations

from dataclasses import dataclass

from machines.driver import FaultCause, Faulted, Notice
from machines.grbl import replies
from machines.grbl.commands import CommandChannel
from machines.grbl.link import GrblLink
from machines.grbl.replies import POSITION_LOST_ALARMS
from machines.grbl.sequences import identify
from machines.grbl.settings import ControllerSettings
from machines.grbl.states import Phase, stands
from machines.grbl.stopping import ResetControl, StopControl
from machines.grbl.streaming import Streamer
from machines.grbl.timeouts import HANDSHAKE_SILENCE_S
from phrases.phrase import NO_WORDS, Phrase

NAMES = {"grbl": "Grbl", "grblhal": "grblHAL", "fluidnc": "FluidNC"}


@dataclass(slots=True, eq=False)
class Handshake:
    """Asks '?' until a report comes, then $I $$ $# $G while the mill stands. A banner begins it anew.

    Owns the banner; it stores its findings in the link.
    """

    link: GrblLink
    streamer: Streamer
    commands: CommandChannel
    resets: ResetControl
    stops: StopControl
    _banner: str = ""

    def begin(self, now_s: float) -> None:
        """Begin on a link that was just opened: its last user may have left it in any state."""
        link, view = self.link, self.link.view
        link.urgent.clear()
        link.text.clear()
        link.failure, self._banner, self.commands.held_line = NO_WORDS, "", ""
        self.streamer.echoes = False
        view.begin_epoch(position_kept=False)
        view.judge_place()
        view.locked_by = 0
        view.spindle_on = None  # no banner has stopped it: the last user of the link may have left it on
        link.greet(now_s, recognised=False)

    def take_banner(self, banner: str, now_s: float) -> None:
        """Begin a new epoch: everything the controller held is gone."""
        link, commands, streamer = self.link, self.commands, self.streamer
        link.report_restart()
        reset, report = self.resets.sequence, link.view.report
        checked_off = reset is None and now_s < commands.banner_due_s
        sure = reset is not None and reset.ours and (report is None or report.state != "Sleep")
        kept = (sure and link.view.alarm not in POSITION_LOST_ALARMS) or checked_off
        streaming, line = link.phase is Phase.STREAMING, streamer.first_line
        known = bool(link.controller)
        link.restart = banner, reset is not None or link.phase is Phase.STOPPING
        link.epoch += 1
        self._banner, link.controller = banner, banner.partition("[")[0].strip()
        link.urgent.clear()
        link.text.clear()
        link.hold_wanted = link.paused = False
        self.stops.abort_wanted = self.stops.abort_wanted and reset is not None
        streamer.echoes = streamer.late_answers = False
        commands.banner_due_s, commands.held_line = 0.0, ""
        commands.override.end(Phrase("the controller restarted"))
        link.view.begin_epoch(position_kept=kept)
        commands.end(NO_WORDS if checked_off else Phrase("the controller restarted"))
        streamer.end()
        link.greet(now_s, recognised=known)
        link.greeting.banner = True
        if streaming:
            words = Phrase(
                "the controller restarted by itself ('{banner}'): reset button, power or a reset line", banner=banner
            )
            link.events.append(Faulted(FaultCause.RESET, words, line, now_s))

    def take_reply(self, reply: replies.Reply, line: bytes, now_s: float) -> None:
        """Take a line in HAILING, where only a status report, an alarm or a banner has a meaning."""
        self.link.greeting.take(reply, line)
        if isinstance(reply, replies.Message):
            self.resets.take_message(reply.text, now_s)
        elif isinstance(reply, replies.AlarmReply):
            self.stops.take_alarm(reply.number, now_s)
        elif isinstance(reply, replies.Status):
            self._take_report(reply, now_s)

    def _take_report(self, report: replies.Status, now_s: float) -> None:
        link = self.link
        link.silence.take_report()
        link.offers_reset = False
        link.view.take(report)
        link.greeting.recognised = True
        link.report_restart()
        if link.greeting.banner and report.state in ("Idle", "Alarm") and not link.hold_under_way:
            self.stops.abort_wanted = False  # the reset during which it was requested has done it
        if self.stops.abort_wanted:
            self.stops.abort(now_s)
        elif link.hold_wanted and not stands(report):
            link.put_hold()  # requested while the link was away
        elif report.state in ("Idle", "Alarm", "Check"):
            link.enter(Phase.IDENTIFYING, now_s)
            self.commands.run(identify(self._banner), self._note_identity, now_s)

    def _note_identity(self, failure: Phrase, _: dict[str, object], now_s: float) -> None:
        link = self.link
        if failure:
            words = Phrase("the controller answers '?' as GRBL does, but it cannot be used: {failure}", failure=failure)
            link.close(words, now_s, FaultCause.DEVICE)
            return
        link.view.identified = True
        link.hold_wanted = False
        version = link.view.settings.version
        if version:
            link.controller = _name_controller(link.view.settings)
        elif not link.controller:
            link.controller = "Grbl"
        link.enter(Phase.READY, now_s)
        if slow := self.stops.reporter.slow_link_words():
            link.events.append(Notice(slow))

    def watch(self, now_s: float) -> None:
        """Check the clock: nothing answers, or no longer does."""
        link, silent_s = self.link, self.link.silence.silent_s
        if link.phase is Phase.READY:
            if silent_s > HANDSHAKE_SILENCE_S + link.silence.late_s:
                link.events.append(Notice(Phrase("no answer to '?' for {silent_s:.0f} s", silent_s=silent_s)))
                link.view.report = None
                link.greet(now_s, recognised=True)
        elif (
            link.greeting.is_foreign or not link.greeting.recognised
        ) and link.silence.waited_s >= link.options.identify_s:
            self.commands.end(Phrase("not connected"))
            link.close(link.greeting.verdict(), now_s, FaultCause.DEVICE)


def _name_controller(settings: ControllerSettings) -> str:
    return f"{NAMES[settings.firmware]} {settings.version.partition(':')[0]}".strip()
