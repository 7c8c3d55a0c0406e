"""Carries an errand out: one line, its answer, the next. Pure: lines in, lines out, time given."""

from __future__ import annotations

from collections.abc import Callable

from machines.driver import Command, Triple
from machines.grbl.codes import error_words
from machines.grbl.errands import PARSER_TAG, Answer, Ask, Errand, ErrandFailedError, Outcome, WaitStill
from machines.grbl.replies import Push, Reply, Setting
from machines.grbl.settings import is_parser_state

STILL_REPORTS = 2  # a report may have been made just before the motion of an answered line began


class ErrandRunner:
    """One errand at a time. `write` puts a line on its way; `outcome` or `failure` is set when it has ended."""

    def __init__(self, errand: Errand, command: Command | None, write: Callable[[bytes], None], now_s: float) -> None:
        self.command = command
        self.outcome: Outcome | None = None
        self.failure = ""
        self.waiting: Ask | WaitStill | None = None
        self.due_s = now_s
        self._errand = errand
        self._write = write
        self._heard: list[Reply] = []
        self._still = 0
        self._advance(None, now_s)

    @property
    def asked(self) -> str:
        """The line whose answer is awaited; "" if none is."""
        return self.waiting.text.decode("ascii") if isinstance(self.waiting, Ask) else ""

    @property
    def ended(self) -> bool:
        return self.waiting is None

    def _advance(self, answer: Answer | None, now_s: float) -> None:
        self._heard, self._still, self.waiting = [], 0, None
        try:
            self.waiting = next(self._errand) if answer is None else self._errand.send(answer)
        except StopIteration as stop:
            self.outcome = stop.value
            return
        except ErrandFailedError as failed:
            self.failure = str(failed)
            return
        self.due_s = now_s + self.waiting.timeout_s
        if isinstance(self.waiting, Ask):
            self._write(self.waiting.text + b"\n")

    def heard(self, reply: Reply) -> None:
        """A push or a setting came."""
        if isinstance(self.waiting, Ask):
            self._heard.append(reply)

    def answered(self, error: int, now_s: float) -> bool:
        """`ok` (0) or an error number came; False if it answers nothing of this errand."""
        ask = self.waiting
        if not isinstance(ask, Ask):
            return False
        if error:
            self._advance(Answer(f"{ask.text.decode('ascii')}: {error_words(error)}", tuple(self._heard)), now_s)
            return True
        if ask.expect and not any(_is(reply, ask.expect) for reply in self._heard):
            if not any(isinstance(reply, Push) and reply.tag == ask.expect for reply in self._heard):
                return False
            text = ask.text.decode("ascii")
            self._advance(Answer(f"{text}: its answer was damaged on the way", tuple(self._heard)), now_s)
            return True
        self._advance(Answer("", tuple(self._heard)), now_s)
        return True

    def reported(self, *, idle: bool, machine_mm: Triple | None, now_s: float) -> None:
        """A status report came."""
        if not isinstance(self.waiting, WaitStill):
            return
        self._still = self._still + 1 if idle else 0
        if self._still >= STILL_REPORTS:
            self._advance(Answer("", machine_mm=machine_mm), now_s)

    def watch(self, now_s: float) -> None:
        """Gives up where nothing comes."""
        waiting = self.waiting
        if waiting is None or now_s < self.due_s:
            return
        what = waiting.text.decode("ascii") if isinstance(waiting, Ask) else "standstill"
        self._advance(Answer(f"{what}: no answer in {waiting.timeout_s:g} s", tuple(self._heard)), now_s)

    def fail(self, words: str) -> None:
        """Ended from outside."""
        self._errand.close()
        self.waiting = None
        self.failure = words


def _is(reply: Reply, expect: str) -> bool:
    if expect == "$":
        return isinstance(reply, Setting)
    return isinstance(reply, Push) and reply.tag == expect and (expect != PARSER_TAG or is_parser_state(reply.body))
