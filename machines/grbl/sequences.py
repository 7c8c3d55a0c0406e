"""Command sequences: a command as a generator that yields what to send or to wait for and gets the answer back.

One line at a time, the next only after the answer: settings and offsets are written to EEPROM, and while that is
written the controller hears nothing, so such lines must never be part of a counted stream.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, replace

from machines.driver import CheckMode, Command, Home, Jog, ProbeZ, ReadSettings, SendBlock, SetZero, Triple, Unlock
from machines.grbl import replies
from machines.grbl.settings import ControllerSettings, read_settings
from machines.grbl.timeouts import longest_homing_s

REPLY_S = 3.0  # a line that does not move: parsed at once, or after an EEPROM write
BLOCK_S = 60.0
TOLD_AT_MOST = 5  # times a thing is asked until two answers running agree
PROBE_TAG, VERSION_TAG, PARSER_TAG, OFFSET_TAG = "PRB", "VER", "GC", "G54"


@dataclass(frozen=True, slots=True)
class Ask:
    """Send this line and wait for its answer.

    expect : tag of a push, or "$" for a setting, that must have come before an `ok` is taken for this line's answer:
             one that comes earlier belongs to something sent before. "" takes any.
    """

    text: bytes
    timeout_s: float = REPLY_S
    expect: str = ""


@dataclass(frozen=True, slots=True)
class WaitStill:
    """Wait for two reports of a mill that stands idle (or checks)."""

    timeout_s: float = BLOCK_S


@dataclass(frozen=True, slots=True)
class Answer:
    """What came back. `failure` in words; "" if `ok` came."""

    failure: str = ""
    heard: tuple[replies.Reply, ...] = ()
    machine_mm: Triple | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a finished sequence leaves behind."""

    answer: dict[str, object] = field(default_factory=dict)
    settings: ControllerSettings | None = None
    vouched: str = ""  # axes whose coordinates are right from now on


class SequenceFailedError(Exception):
    """The sequence cannot go on; the text is for the operator."""


CommandSequence = Generator[Ask | WaitStill, Answer, Outcome]


def identify(banner: str) -> CommandSequence:
    """Ask $I, $$, $#, $G: who is there and how it is set. Moves nothing, changes nothing."""
    heard: list[replies.Reply] = []
    version = Answer("not asked")
    for _ in range(3):
        # A line half sent by someone before us may be in the controller's reader: '$' makes it an error, not a motion.
        version = yield Ask(b"$I", expect=VERSION_TAG)
        if not version.failure:
            break
    heard += version.heard
    heard += yield from _ask_twice(b"$$", "$")
    heard += yield from _ask_twice(b"$#", OFFSET_TAG)
    heard += yield from _ask_twice(b"$G", PARSER_TAG)
    settings = read_settings(heard, banner)
    if version.failure and not banner and not settings.values and not settings.parser_state:
        raise SequenceFailedError(f"answers '?' like GRBL, but neither $I nor $$ ({version.failure})")
    return Outcome(settings=settings, answer=describe_settings(settings))


def _ask_twice(text: bytes, expect: str) -> Generator[Ask | WaitStill, Answer, tuple[replies.Reply, ...]]:
    """Return what the controller says to this twice in the same words: a byte lost on the way makes 300 mm of travel 0
    mm.

    Nothing, where it does not answer twice running.
    """
    last: tuple[replies.Reply, ...] | None = None
    unanswered = 0
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
    raise SequenceFailedError(f"{text.decode('ascii')} is answered differently every time: the link damages bytes")


def describe_settings(settings: ControllerSettings) -> dict[str, object]:
    """Return settings as plain data, for CommandDone."""
    return {
        "settings": settings.to_dict(),
        "offsets": {name: list(value) for name, value in settings.offsets.items()},
        "parser_state": settings.parser_state,
    }


def _require_ok(answer: Answer) -> Answer:
    if answer.failure:
        raise SequenceFailedError(answer.failure)
    return answer


def home(settings: ControllerSettings) -> CommandSequence:
    _require_ok((yield Ask(b"$H", longest_homing_s(settings))))
    _require_ok((yield WaitStill(REPLY_S)))
    return Outcome(vouched="XYZ")


def ask_once(text: bytes) -> CommandSequence:
    _require_ok((yield Ask(text)))
    return Outcome()


def jog(command: Jog, settings: ControllerSettings) -> CommandSequence:
    axes = "".join(f"{axis}{value:.4f}" for axis, value in zip("XYZ", command.by_mm, strict=True) if value)
    if not axes:
        return Outcome()
    length_mm = sum(value * value for value in command.by_mm) ** 0.5
    _require_ok((yield Ask(f"$J=G91G21{axes}F{command.feed_mm_per_min:.1f}".encode())))
    slowest = min((command.feed_mm_per_min, *(settings.max_rate_mm_per_min or (500.0,))))
    _require_ok((yield WaitStill(10.0 + 3.0 * length_mm / max(slowest, 1.0) * 60.0)))
    return Outcome()


def probe(command: ProbeZ, settings: ControllerSettings) -> CommandSequence:
    """Down until contact; then the zero is set so that the *contact point*, not the place after braking, has its Z."""
    modal = _require_ok((yield Ask(b"$G", expect=PARSER_TAG)))
    restore = _words_to_restore(modal)
    seconds = 20.0 + 3.0 * command.depth_mm / command.feed_mm_per_min * 60.0
    down = f"G21G91G38.2Z{-abs(command.depth_mm):.4f}F{command.feed_mm_per_min:.1f}"
    answer = _require_ok((yield Ask(down.encode(), seconds, PROBE_TAG)))
    contact = _contact(answer, settings.unit_mm)
    still = _require_ok((yield WaitStill()))
    if still.machine_mm is None:
        raise SequenceFailedError("the probe touched, but the controller reports no machine position: zero not set")
    height_mm = command.plate_mm + still.machine_mm[2] - contact[2]
    _require_ok((yield Ask(f"G10L20P0Z{height_mm:.4f}".encode())))
    _require_ok((yield Ask(f"G91G0Z{abs(command.retract_mm):.4f}".encode(), BLOCK_S)))
    _require_ok((yield WaitStill()))
    _require_ok((yield Ask(restore)))
    fresh, told = yield from _ask_offsets(settings)
    return Outcome({"contact_machine_mm": list(contact), "offsets": told}, fresh, vouched="Z")


def _words_to_restore(modal: Answer) -> bytes:
    """Return words that bring back units, distance mode and motion as [GC:] told before."""
    words = {word for push in modal.heard if isinstance(push, replies.Push) for word in push.body.split()}
    return (("G20" if "G20" in words else "G21") + ("G91" if "G91" in words else "G90")).encode()


def _contact(answer: Answer, unit_mm: float) -> Triple:
    for reply in answer.heard:
        if isinstance(reply, replies.Push) and reply.tag == PROBE_TAG:
            place, _, success = reply.body.rpartition(":")
            try:
                x, y, z = (float(part) * unit_mm for part in place.split(",")[:3])
            except ValueError:
                break
            if success == "1":
                return (x, y, z)
    raise SequenceFailedError("the probe did not touch: zero not set")


def set_zero(command: SetZero, settings: ControllerSettings) -> CommandSequence:
    words = "".join(f"{axis}0" for axis in command.axes)
    _require_ok((yield Ask(f"G10L20P0{words}".encode())))
    fresh, told = yield from _ask_offsets(settings)
    return Outcome({"offsets": told}, fresh, vouched=command.axes)


def _ask_offsets(
    settings: ControllerSettings,
) -> Generator[Ask | WaitStill, Answer, tuple[ControllerSettings, dict[str, list[float]]]]:
    """Ask $#: the settings with the offsets told now, and these alone as plain data."""
    unit = replies.Setting(13, settings.values.get(13, "0"))
    heard = yield from _ask_twice(b"$#", OFFSET_TAG)
    offsets = read_settings((unit, *heard)).offsets
    fresh = replace(settings, offsets={**settings.offsets, **offsets})
    return fresh, {name: list(value) for name, value in offsets.items()}


def send_block(command: SendBlock, settings: ControllerSettings) -> CommandSequence:
    text = command.text.strip().encode("ascii")
    answer = _require_ok((yield Ask(text, BLOCK_S)))
    if not text.startswith(b"$"):
        _require_ok((yield WaitStill()))
    heard = [*answer.heard]
    again = yield from identify(settings.version) if text.startswith(b"$") else _modal_again(settings)
    return Outcome(answer={"heard": [str(reply) for reply in heard]}, settings=again.settings)


def _modal_again(settings: ControllerSettings) -> CommandSequence:
    fresh, _ = yield from _ask_offsets(settings)
    told = read_settings((yield from _ask_twice(b"$G", PARSER_TAG))).parser_state
    return Outcome(settings=replace(fresh, parser_state=told or fresh.parser_state))


def make_sequence(command: Command, settings: ControllerSettings) -> CommandSequence:
    """Return the sequence that carries out a command; all but those that are a realtime byte or a note have one."""
    match command:
        case Home():
            return home(settings)
        case Unlock():
            return ask_once(b"$X")
        case ReadSettings():
            return identify(settings.version)
        case Jog():
            return jog(command, settings)
        case ProbeZ():
            return probe(command, settings)
        case SetZero():
            return set_zero(command, settings)
        case CheckMode():
            return ask_once(b"$C")  # a toggle; off ends in a soft reset of the controller's own, with a banner
        case SendBlock():
            return send_block(command, settings)
        case _:
            raise AssertionError(f"{type(command).__name__} has no sequence")
