"""Command sequences: a command as a generator that yields what to send or to wait for and gets the answer back.

One line at a time, the next only after the answer: settings and offsets are written to EEPROM, and while that is
written the controller hears nothing, so such lines must never be part of a counted stream.
"""

from __future__ import annotations

from dataclasses import replace

from machines.driver import (
    CheckMode,
    Command,
    Home,
    Jog,
    ProbeCorner,
    ProbeZ,
    ReadSettings,
    SendBlock,
    SetZero,
    Unlock,
)
from machines.grbl import replies
from machines.grbl.asking import (
    BLOCK_S,
    OFFSET_TAG,
    PARSER_TAG,
    REPLY_S,
    VERSION_TAG,
    Answer,
    Ask,
    CommandSequence,
    Outcome,
    SequenceFailedError,
    WaitStill,
    ask_offsets,
    ask_twice,
    require_ok,
)
from machines.grbl.probing import leave_probing, probe_corner, probe_z
from machines.grbl.settings import ControllerSettings, read_settings
from machines.grbl.timeouts import longest_homing_s
from phrases.phrase import Phrase


def identify(banner: str) -> CommandSequence:
    """Ask $I, $$, $#, $G: who is there and how it is set. Moves nothing, changes nothing."""
    heard: list[replies.Reply] = []
    version = Answer(Phrase("not asked"))
    for _ in range(3):
        # A line half sent by someone before us may be in the controller's reader: '$' makes it an error, not a motion.
        version = yield Ask(b"$I", expect=VERSION_TAG)
        if not version.failure:
            break
    heard += version.heard
    settings = yield from ask_twice(b"$$", "$")
    if version.failure and not settings:
        raise SequenceFailedError(Phrase("neither $I nor $$ is answered ({failure})", failure=version.failure))
    if commas := next((one for one in settings if isinstance(one, replies.Setting) and one.has_comma), None):
        text = f"${commas.number}={commas.value}"
        raise SequenceFailedError(Phrase("settings are written with decimal commas ({setting})", setting=text))
    heard += settings
    heard += yield from ask_twice(b"$#", OFFSET_TAG)
    heard += yield from ask_twice(b"$G", PARSER_TAG)
    found = read_settings(heard, banner)
    return Outcome(settings=found, answer=describe_settings(found))


def read_again(settings: ControllerSettings) -> CommandSequence:
    """Ask again for what may have changed since the handshake: $$, $#, $G."""
    heard = [*(yield from ask_twice(b"$$", "$")), *(yield from ask_twice(b"$#", OFFSET_TAG))]
    heard += yield from ask_twice(b"$G", PARSER_TAG)
    reported = read_settings(heard)
    found = replace(settings, values=reported.values, offsets=reported.offsets, parser_state=reported.parser_state)
    return Outcome(settings=found, answer=describe_settings(found))


def describe_settings(settings: ControllerSettings) -> dict[str, object]:
    """Return settings as plain data, for CommandDone."""
    return {
        "settings": settings.to_dict(),
        "offsets": {name: list(value) for name, value in settings.offsets.items()},
        "parser_state": settings.parser_state,
    }


def home(settings: ControllerSettings, modes: str) -> CommandSequence:
    yield Ask(b"$G", expect=PARSER_TAG)  # the `ok` of a probe comes half a second behind its alarm: it is not of $H
    require_ok((yield Ask(b"$H", longest_homing_s(settings))))
    require_ok((yield WaitStill(REPLY_S)))
    yield from leave_probing(modes)
    return Outcome(vouched="XYZ")


def unlock(modes: str) -> CommandSequence:
    require_ok((yield Ask(b"$X")))
    yield from leave_probing(modes)
    return Outcome()


def ask_once(text: bytes) -> CommandSequence:
    require_ok((yield Ask(text)))
    return Outcome()


def jog(command: Jog, settings: ControllerSettings) -> CommandSequence:
    axes = "".join(f"{axis}{value:.4f}" for axis, value in zip("XYZ", command.by_mm, strict=True) if value)
    if not axes:
        return Outcome()
    length_mm = sum(value * value for value in command.by_mm) ** 0.5
    require_ok((yield Ask(f"$J=G91G21{axes}F{command.feed_mm_per_min:.1f}".encode())))
    slowest = min((command.feed_mm_per_min, *(settings.max_rate_mm_per_min or (500.0,))))
    require_ok((yield WaitStill(10.0 + 3.0 * length_mm / max(slowest, 1.0) * 60.0)))
    return Outcome()


def set_zero(command: SetZero, settings: ControllerSettings) -> CommandSequence:
    words = "".join(f"{axis}0" for axis in command.axes)
    require_ok((yield Ask(f"G10L20P0{words}".encode())))
    fresh, reported = yield from ask_offsets(settings)
    return Outcome({"offsets": reported}, fresh, vouched=command.axes)


def send_block(command: SendBlock, settings: ControllerSettings) -> CommandSequence:
    text = command.text.strip().encode("ascii")
    answer = require_ok((yield Ask(text, BLOCK_S)))
    if not text.startswith(b"$"):
        require_ok((yield WaitStill()))
    heard = [*answer.heard]
    again = yield from identify(settings.version) if text.startswith(b"$") else _modal_again(settings)
    return Outcome(answer={"heard": [str(reply) for reply in heard]}, settings=again.settings)


def _modal_again(settings: ControllerSettings) -> CommandSequence:
    fresh, _ = yield from ask_offsets(settings)
    reported = read_settings((yield from ask_twice(b"$G", PARSER_TAG))).parser_state
    return Outcome(settings=replace(fresh, parser_state=reported or fresh.parser_state))


def make_sequence(command: Command, settings: ControllerSettings, modes: str) -> CommandSequence:
    """Return the sequence that carries out a command. A realtime byte or a note needs none.

    modes : [GC:] words as they were known last
    """
    match command:
        case Home():
            return home(settings, modes)
        case Unlock():
            return unlock(modes)
        case ReadSettings():
            return read_again(settings)
        case Jog():
            return jog(command, settings)
        case ProbeZ():
            return probe_z(command, settings)
        case ProbeCorner():
            return probe_corner(command, settings)
        case SetZero():
            return set_zero(command, settings)
        case CheckMode():
            return ask_once(b"$C")  # a toggle; off ends in a soft reset of the controller's own, with a banner
        case SendBlock():
            return send_block(command, settings)
        case _:
            raise AssertionError(f"{type(command).__name__} has no sequence")
