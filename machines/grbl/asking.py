"""Steps of line sequences to the controller: a line and its answer, a wait for standstill, a query sent twice."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, replace

from machines.driver import Triple
from machines.grbl import replies
from machines.grbl.settings import ControllerSettings, read_settings
from phrases.phrase import NO_WORDS, Phrase

REPLY_S = 3.0  # a line that does not move: parsed at once, or after an EEPROM write
BLOCK_S = 60.0
TOLD_AT_MOST = 5  # most repetitions of a query until two consecutive answers agree
PROBE_TAG, VERSION_TAG, PARSER_TAG, OFFSET_TAG = "PRB", "VER", "GC", "G54"
_QUESTIONS = frozenset({b"$I", b"$$", b"$#", b"$G"})


@dataclass(frozen=True, slots=True)
class Ask:
    """Send this line and wait for its answer.

    expect : tag of a push, or "$" for a setting, that must come before the `ok` that counts as this line's answer: an
    earlier `ok` belongs to something sent before. "": any `ok` counts.
    timeout_s : in addition to the link's own delay (`SilenceClock.late_s`)
    twice  : write the line twice at once, which takes the time of one answer; the second answer is `Answer.again`
    """

    text: bytes
    timeout_s: float = REPLY_S
    expect: str = ""
    twice: bool = False

    @property
    def is_question(self) -> bool:
        """Return whether the line is only a query, which moves and changes nothing."""
        return self.text in _QUESTIONS


@dataclass(frozen=True, slots=True)
class WaitStill:
    """Wait for two reports of a mill that stands idle (or checks)."""

    timeout_s: float = BLOCK_S


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a line. `failure` in words; "" if `ok` came."""

    failure: Phrase = NO_WORDS
    heard: tuple[replies.Reply, ...] = ()
    again: tuple[replies.Reply, ...] | None = None
    machine_mm: Triple | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """The effects of a finished sequence."""

    answer: dict[str, object] = field(default_factory=dict)
    settings: ControllerSettings | None = None
    vouched: str = ""  # axes whose coordinates are right from now on


class SequenceFailedError(Exception):
    """The sequence cannot go on; the text is for the operator."""

    def __init__(self, words: Phrase) -> None:
        super().__init__(words)
        self.words = words


CommandSequence = Generator[Ask | WaitStill, Answer, Outcome]


def require_ok(answer: Answer) -> Answer:
    if answer.failure:
        raise SequenceFailedError(answer.failure)
    return answer


def ask_twice(text: bytes, expect: str) -> Generator[Ask | WaitStill, Answer, tuple[replies.Reply, ...]]:
    """Ask until two consecutive answers agree, and return that answer: one lost byte could turn 300 mm of travel into 0
    mm.

    The first two queries are sent at once, because on a slow link two take as long as one. Return nothing if two
    consecutive queries are not answered.
    """
    both = yield Ask(text, expect=expect, twice=True)
    if not both.failure and both.heard == both.again:
        return both.heard
    last = both.again
    unanswered = 1 if both.failure else 0
    for _ in range(TOLD_AT_MOST):
        answer = yield Ask(text, expect=expect)
        if answer.failure:
            unanswered += 1
            if unanswered == 2:
                return ()
        elif answer.heard == last:
            return answer.heard
        else:
            last = answer.heard
    raise SequenceFailedError(
        Phrase("{text} is answered differently every time: the link damages bytes", text=text.decode("ascii"))
    )


def ask_offsets(
    settings: ControllerSettings,
) -> Generator[Ask | WaitStill, Answer, tuple[ControllerSettings, dict[str, list[float]]]]:
    """Query $#: return the settings with the present offsets, and the offsets as plain data."""
    unit = replies.Setting(13, settings.values.get(13, "0"))
    heard = yield from ask_twice(b"$#", OFFSET_TAG)
    offsets = read_settings((unit, *heard)).offsets
    fresh = replace(settings, offsets={**settings.offsets, **offsets})
    return fresh, {name: list(value) for name, value in offsets.items()}
