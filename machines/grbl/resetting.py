"""Resets: when 0x18 goes out, and again, until the banner. A reset that nobody has answered is none."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from machines.driver import FaultCause, Notice
from machines.grbl.link import GrblLink
from machines.grbl.states import Phase
from machines.grbl.streaming import Streamer
from machines.grbl.timeouts import BANNER_S, PERSON_S
from phrases.phrase import Phrase

BUSY_S = 0.05  # between status requests while the mill is being stopped
RESET = b"\x18"
# After ALARM:1 and ALARM:2 GRBL 1.1 stands still for 500 ms, forgets a reset that came meanwhile, says so and waits.
MESSAGE = "Reset to continue"
MESSAGE_S = 0.6  # where the message is lost on the way
AGAIN_S = 0.25
SLOW_AFTER_S, SLOW_S = 10.0, 1.0  # an emergency stop that is still pressed, a mill without power: ask less often


class ResetSequence:
    """One reset on its way. `take` gives the byte whenever it is due; the banner ends the sequence from outside."""

    def __init__(self, now_s: float, *, first_s: float = 0.0, again_s: float = inf, ours: bool = True) -> None:
        """ours: sent to a mill that stands, so that the position is kept"""
        self.ours = ours
        self.sent = 0
        self.due_s = now_s + first_s
        self._again_s = again_s
        self._begun_s = now_s

    @staticmethod
    def at_standstill(now_s: float) -> ResetSequence:
        """Reset once: where no banner comes, the session looks again whether the mill stands."""
        return ResetSequence(now_s)

    @staticmethod
    def after_critical_alarm(now_s: float) -> ResetSequence:
        """Reset when the controller has said that it waits for one, or must have; then until it hears."""
        return ResetSequence(now_s, first_s=MESSAGE_S, again_s=AGAIN_S)

    @staticmethod
    def by_a_person(now_s: float) -> ResetSequence:
        """Reset a controller that answers nothing: whether it stands is not known, so the position is not kept."""
        return ResetSequence(now_s, again_s=AGAIN_S, ours=False)

    @property
    def repeats(self) -> bool:
        return self._again_s < inf

    def take_message(self, now_s: float) -> None:
        """Note that the controller says that it waits."""
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
        """Put a reset on its way, or another one in its place. Of what waits to be written only '!' goes before it."""
        link = self.link
        self.streamer.end()
        link.text.clear()
        link.urgent = bytearray((b"!" if b"!" in link.urgent else b"") + sequence.take(now_s))
        if link.phase is not Phase.CLEARING:
            link.enter(Phase.CLEARING, now_s)
        self._sequence = sequence
        link.poll_at_s = now_s + BUSY_S

    def begin_for_person(self, now_s: float) -> None:
        """Carry out a reset that a person asks for: of a mill that stands, or of one that answers nothing."""
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
        """Look at the clock. True: of a reset that is sent once no banner has come; whether the mill stands is open."""
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
