"""Monitors a program under way: compares answers, echoes, reports and silence with what was sent."""

from __future__ import annotations

from dataclasses import dataclass

from machines.driver import FaultCause, Notice, ProgramDone
from machines.grbl.flow_control import Pacer
from machines.grbl.link import GrblLink
from machines.grbl.replies import Status, error_words, is_boot_text, show
from machines.grbl.states import HELD_STATES, Phase
from machines.grbl.stopping import StopControl
from machines.grbl.streaming import Flight, Stream, Streamer, name_line
from machines.grbl.timeouts import IDLE_REPORTS, IDLE_S, MARGIN_S, NOTIFY_SILENCE_S, REPORT_SILENCE_S, longest_wait_s
from machines.grbl.tracking import Place
from phrases.phrase import Phrase

BUFFER_REPORTS = 3  # in a row that show more bytes in the controller than may be there
DONE_REPORTS = 2  # one Idle may be reported between the `ok` of a move and its start


@dataclass(slots=True, eq=False)
class StreamMonitor:
    """Finds the first sign of a fault, and the end of a program. Keeps the signs of progress.

    A sign is an answer, a new position, a step proven or a hold; its time is the link's (SilenceClock.heard_s).
    """

    link: GrblLink
    streamer: Streamer
    stops: StopControl
    pacer: Pacer
    _sign_heard_s: float = 0.0
    _idle_reports: int = 0  # Idle with nothing unanswered
    _standing_reports: int = 0  # Idle in a row, with no answer between
    _standing_heard_s: float = 0.0  # when the first of them came
    _lone_s: float | None = None  # when a line was sent to an idle mill: its answer measures the round trip
    _full_reports: int = 0  # in a row, with more bytes in the receive buffer than may be there

    def note_sign(self) -> None:
        """Restart the wait for a sign."""
        self._sign_heard_s = self.link.silence.heard_s

    def note_sent(self) -> None:
        """Start waiting for an answer: lines were sent while none was under way."""
        self.note_sign()
        self._lone_s = self.link.silence.spent_s if self._standing_reports else None
        self._standing_reports = 0

    def begin(self) -> None:
        """Begin to watch a program."""
        self.note_sign()
        self._idle_reports = self._full_reports = 0

    def take_ok(self, stream: Stream) -> None:
        """Take an unmistakable `ok`: the fast path for nearly every line from a controller."""
        self._note_answer(stream)
        stream.take_answer()

    def _note_answer(self, stream: Stream) -> None:
        self._sign_heard_s = self.link.silence.heard_s
        if self._lone_s is not None:
            sent_s, self._lone_s = self._lone_s, None
            if stream.first is not None and not stream.first[1].waits_for_empty_buffer:
                self.link.silence.note_answer(self.link.silence.spent_s - sent_s)
        self._idle_reports = self._standing_reports = 0

    def take_answer(self, error: int, now_s: float) -> None:
        """Take `ok` (0) or the number of an error for the oldest line under way."""
        streamer, stream = self.streamer, self._stream
        self._note_answer(stream)
        words = error_words(error) if error else Phrase("ok")
        first = stream.first
        if first is None:
            words = Phrase("{words} came although every line was answered already", words=words)
            self.stops.raise_fault(FaultCause.REPLY_COUNT, words, 0, now_s)
        elif streamer.echoes and not stream.echoed:
            line = stream.first_line
            words = Phrase("{line} was answered ({words}) without its echo", line=name_line(line), words=words)
            self.stops.raise_fault(FaultCause.ECHO, words, line, now_s)
        elif error:
            block = first[0]
            words = Phrase(
                "{line} '{text}' was refused: {words}", line=name_line(block.number), text=show(block.text), words=words
            )
            self.stops.raise_fault(FaultCause.ERROR_REPLY, words, block.number, now_s)
        else:
            stream.take_answer()

    def take_echo(self, text: bytes, now_s: float) -> None:
        """Compare an echo, the line as the controller has read it, with the oldest line under way."""
        if self.link.phase is not Phase.STREAMING:
            self.streamer.echoes = True
            return
        stream = self._stream
        first = stream.first
        if first is None:
            words = Phrase("the controller has read '{read}', which was not sent", read=show(text))
            self.stops.raise_fault(FaultCause.ECHO, words, 0, now_s)
        elif stream.echoed or _as_read(first[0].text) != _as_read(text):
            block = first[0]
            words = Phrase(
                "{line} was sent as '{text}', but read as '{read}'",
                line=name_line(block.number),
                text=show(block.text),
                read=show(text),
            )
            self.stops.raise_fault(FaultCause.ECHO, words, block.number, now_s)
        else:
            self.streamer.echoes = stream.echoed = True

    def take_garbled(self, raw: bytes, now_s: float) -> None:
        """End the program because of a line that no controller sends."""
        if self.link.phase is Phase.STREAMING:
            words = Phrase("'{text}' is not a reply that a controller sends: it was damaged on the way", text=show(raw))
            if is_boot_text(raw):
                words = Phrase("'{text}' is the start message of an ESP32: the board has restarted", text=show(raw))
            self.stops.raise_fault(FaultCause.GARBLED_REPLY, words, self.streamer.first_line, now_s)
        elif self.link.phase is not Phase.CLEARING:
            self.link.events.append(Notice(Phrase("not understood: '{text}'", text=show(raw))))

    def note_report(self, report: Status, now_s: float, *, moved: bool) -> None:
        """Note the signs in a report, in every phase."""
        if moved or report.state in HELD_STATES:  # waiting for a person is not a stall
            self.note_sign()
        if self.streamer.stream is not None:
            self.streamer.stream.count.take_report(now_s)
        if report.state not in ("Idle", "Check"):
            self._standing_reports = 0
            return
        self._standing_reports += 1
        if self._standing_reports == 1:
            self._standing_heard_s = self.link.silence.heard_s

    def compare(self, report: Status, now_s: float) -> None:
        """Compare a report with the program under way: is the mill on the path, off it, or done?"""
        stream = self._stream
        if report.state in ("Alarm", "Sleep") and not self.link.view.alarm:
            words = Phrase("the controller reports '{state}' in the middle of a program", state=report.state)
            self.stops.raise_fault(FaultCause.ALARM, words, stream.first_line, now_s)
            return
        self._compare_buffer(report, now_s)
        if self.link.phase is not Phase.STREAMING:
            return
        if report.state in ("Run", "Hold", "Idle"):
            self._compare_place(stream, now_s)
            if self.link.phase is not Phase.STREAMING:
                return
        if report.state not in ("Idle", "Check") or stream.window.used:
            self._idle_reports = 0
            return
        self._idle_reports += 1
        if self._idle_reports >= DONE_REPORTS:
            stream.tracker.note_all_executed()
            if stream.drained:
                self._finish(stream, report, now_s)

    def _compare_buffer(self, report: Status, now_s: float) -> None:
        """Compare Bf: with the bytes under way: after one answer too many, the buffer may overflow.

        Answers sent before a report arrive before it, so the buffer never holds more than is under way. While the mill
        runs, the oldest line has left the buffer: it is being parsed or waits for room in the planner.
        """
        stream, used = self._stream, self.link.view.rx_used
        first = stream.first
        taken = len(first[0].text) + 1 if first is not None and report.state == "Run" else 0
        if used is None or used <= max(stream.window.used - taken, 2 * taken):
            self._full_reports = 0
            return
        self._full_reports += 1
        if self._full_reports >= BUFFER_REPORTS:
            words = Phrase(
                "the controller holds {used} bytes, and at most {allowed} can be there: an answer came twice",
                used=used,
                allowed=stream.window.used - taken,
            )
            self.stops.raise_fault(FaultCause.REPLY_COUNT, words, stream.first_line, now_s)

    def _compare_place(self, stream: Stream, now_s: float) -> None:
        position = self.link.view.work_mm
        if position is None:
            return
        sight = stream.tracker.take_report(position)
        if sight.place is Place.ON_PATH:
            stream.compared = True
        elif sight.place is Place.OFF_PATH:
            stream.tracker.distrust_positions()
            at = " ".join(f"{axis}{value:.3f}" for axis, value in zip("XYZ", position, strict=True))
            words = Phrase(
                "the mill reports {place}, {distance_mm:.3f} mm from the nearest line that can be under way "
                "({near_line}; allowed {allowed_mm:.3f} mm): a byte was damaged or a step lost",
                place=at,
                distance_mm=sight.distance_mm,
                near_line=name_line(sight.line),
                allowed_mm=stream.tracker.tolerance_mm,
            )
            self.stops.raise_fault(FaultCause.OFF_PATH, words, sight.line, now_s)
        elif sight.place is Place.UNANSWERED:
            line = stream.first_line
            words = Phrase(
                "the mill is on {near_line}, but {line} was never answered: a reply was lost",
                near_line=name_line(sight.line),
                line=name_line(line),
            )
            self.stops.raise_fault(FaultCause.REPLY_COUNT, words, line, now_s)

    def _finish(self, stream: Stream, report: Status, now_s: float) -> None:
        """Check, once everything is sent, answered and executed, that the mill stands where the program ends."""
        last, position = stream.tracker.last_move, self.link.view.work_mm
        if report.state == "Idle" and last is not None and position is not None and not last.probes:
            away = max((abs(p - e) for p, e in zip(position, last.end_mm, strict=True) if e is not None), default=0.0)
            if away > stream.tracker.tolerance_mm:
                words = Phrase(
                    "the program is done, but the mill stands {distance_mm:.3f} mm from its end", distance_mm=away
                )
                self.stops.raise_fault(FaultCause.OFF_PATH, words, stream.answered_line, now_s)
                return
        self.streamer.end()
        self.link.enter(Phase.READY, now_s)
        self.link.events.append(ProgramDone())

    def watch(self, now_s: float) -> None:
        """Check the clock: is the mill silent, is a count of the answers due, or is a sign overdue?"""
        link, stream, silence = self.link, self._stream, self.link.silence
        silent_s = silence.silent_s
        if silent_s > REPORT_SILENCE_S:
            self.streamer.late_answers = True
            words = Phrase("no answer to '?' for {silent_s:.1f} s", silent_s=silent_s)
            self.stops.raise_fault(FaultCause.STALL, words, stream.first_line, now_s)
            return
        if silent_s > NOTIFY_SILENCE_S and not silence.notified:
            silence.notified = True
            words = Phrase(
                "no answer to '?' for {silent_s:.0f} s: the mill's position is unknown; hold and stop are still "
                "sent; after {limit_s:.0f} s the run is interrupted",
                silent_s=silent_s,
                limit_s=REPORT_SILENCE_S,
            )
            link.events.append(Notice(words))
        if not link.paused and not stream.exhausted and now_s >= stream.count.due_s:
            covered_s = stream.tracker.last_sent_s(self.streamer.planner_blocks - 2, link.view.overrides[0])
            stream.count.consider(covered_s - silence.round_trip_s, now_s, paced=self.pacer.is_paced)
        if not link.paused:
            self._watch_signs(stream, now_s)

    def _watch_signs(self, stream: Stream, now_s: float) -> None:
        view, heard_s = self.link.view, self.link.silence.heard_s
        waited_s = heard_s - self._sign_heard_s
        if waited_s < MARGIN_S or not (stream.window.used or stream.drained):
            return
        late_s = self.link.silence.late_s
        standing = self._standing_reports >= IDLE_REPORTS and heard_s > self._standing_heard_s + IDLE_S + late_s
        first = stream.first
        allowed_s = longest_wait_s(
            first[1] if first is not None else None,
            stream.tracker.unproven_answered,
            view.settings,
            view.overrides,
            standing=standing,
        )
        if allowed_s is None or waited_s <= allowed_s + late_s:
            return
        words = _describe_stall(first, waited_s, allowed_s, standing)
        if standing and first is not None:
            words = Phrase(
                "{words} after {line} (if a line, it was not cut: look at the part from there on)",
                words=words,
                line=name_line(agreed) if (agreed := stream.agreed_line) else Phrase("the start of the program"),
            )
        self.stops.raise_fault(FaultCause.STALL, words, stream.first_line, now_s)

    @property
    def _stream(self) -> Stream:
        stream = self.streamer.stream
        assert stream is not None  # in Phase.STREAMING
        return stream


def _describe_stall(first: Flight | None, waited_s: float, allowed_s: float, standing: bool) -> Phrase:
    if first is None:
        return Phrase(
            "every line is answered, but for {waited_s:.1f} s the mill has neither moved nor come to rest",
            waited_s=waited_s,
        )
    words = Phrase(
        "{line} '{text}' got no answer and nothing moved for {waited_s:.1f} s",
        line=name_line(first[0].number),
        text=show(first[0].text),
        waited_s=waited_s,
    )
    if standing:
        return Phrase("{words}; the mill reports Idle: a line or a reply was lost", words=words)
    return Phrase("{words} (the moves under way explain at most {allowed_s:.1f} s)", words=words, allowed_s=allowed_s)


def _as_read(text: bytes) -> bytes:
    """Return a block as GRBL's reader keeps it: no blanks, upper case (comments are never sent)."""
    return text.replace(b" ", b"").upper()
